"""Batches are a function of (seed, step), and agree with the files; what is broken on disk is named with its remedy."""

import dataclasses
import json
import shutil
import zlib
from itertools import islice

import numpy as np
import pytest
from support import tiny_dataset
from support.stopped_runs import without_network
from support.tiny_dataset import CONFIG, NAMES

from spnr_jax.formats import data_sets
from spnr_jax.training import batching, trainer


@pytest.fixture
def copy(tmp_path):
    return shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")


def test_transparent_is_white_opaque_is_itself_and_half_is_between():
    rgba = np.array([[255, 0, 51, 0], [255, 0, 51, 255], [0, 0, 0, 51]], np.uint8)
    np.testing.assert_allclose(data_sets.on_white(rgba), [[1, 1, 1], [1, 0, 0.2], [0.8, 0.8, 0.8]], atol=1e-6)


def test_a_step_whose_object_is_broken_names_it_after_the_good_steps(copy):
    config = dataclasses.replace(CONFIG, batch_objects=1)
    broken = batching.object_names(NAMES, config, 2)[0]
    (copy / "objects" / broken / "images" / "001.png").unlink()
    line = batching.batches(data_sets.open_dataset(copy), config, 0)
    assert len(list(islice(line, 2))) == 2
    with pytest.raises(ValueError, match=rf"{broken}.images.001\.png: cannot be read .*same `spnr-data generate`"):
        next(line)


def refused(copy, file):
    """What reading an object says whose file is damaged: a line that begins with its path and ends with the remedy."""
    path = copy / "objects" / NAMES[0] / file
    with pytest.raises(ValueError, match="cannot be read") as error:
        data_sets.read_object(data_sets.open_dataset(copy), NAMES[0])
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.count(str(path)) == 1, "not once more in the reason"
    assert message.endswith(f"remove {copy / 'objects' / NAMES[0]} and run the same `spnr-data generate` again")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("file", ["transforms.json", "points.ply", "images/002.png", "conditions/000.png"])
def test_a_damaged_or_missing_file_is_named_with_the_remedy(file, copy):
    path = copy / "objects" / NAMES[0] / file
    whole = path.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"\x00" * len(whole)):
        path.write_bytes(content)
        refused(copy, file)
    path.unlink()
    assert "No such file" in refused(copy, file)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.pop("h"), "no entry 'h'"),
        (lambda t: t["frames"].clear(), "cannot be read"),
        (lambda t: t["frames"][0]["transform_matrix"][1].__setitem__(2, float("nan")), "NaN"),
        (lambda t: t.update(w=12), "24 x 24 pixels, transforms.json says 12 x 24"),
        (lambda t: t.update(frames=3), "cannot be read"),
    ],
)
def test_transforms_that_say_nonsense_are_named(change, reason, copy):
    path = copy / "objects" / NAMES[0] / "transforms.json"
    transforms = json.loads(path.read_text())
    change(transforms)
    path.write_text(json.dumps(transforms))
    assert reason in refused(copy, "images/000.png" if "pixels" in reason else "transforms.json")


def test_images_of_another_size_than_the_presets_are_refused_with_both_sizes(tmp_path):
    folder = tiny_dataset.write_dataset(tmp_path, {"train": ("small",), "val": (), "test": ()}, size=16)
    with pytest.raises(ValueError, match="16 x 16 pixels.*needs 24 x 24.*--resolution 24"):
        next(batching.batches(data_sets.open_dataset(folder), CONFIG, 0))


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        ("dataset.json", "{", "not valid JSON"),
        ("dataset.json", "[" * 100_000 + "]" * 100_000, "not valid JSON"),
        ("dataset.json", "3", "no settings"),
        ("splits/val.txt", None, "val.txt: missing; repeat the `spnr-data generate` command"),
        ("splits/train.txt", "../../secret", "no name of an object"),
        ("splits/train.txt", ".", "no name of an object"),
    ],
)
def test_a_data_set_that_is_unfinished_or_whose_lists_lead_elsewhere_is_refused(file, content, reason, copy):
    (copy / file).unlink() if content is None else (copy / file).write_text(content)
    with pytest.raises(ValueError, match=reason):
        data_sets.open_dataset(copy)


@pytest.mark.parametrize("file", ["points.ply", "images/001.png", "object.json"])
def test_the_record_of_an_object_changes_with_its_files_also_without_object_json(file, copy):
    dataset, folder = data_sets.open_dataset(copy), copy / "objects" / NAMES[0]
    (folder / "object.json").unlink(missing_ok=True)  # as in data made by hand
    before = data_sets.read_record(dataset, NAMES[0])
    assert data_sets.read_record(dataset, NAMES[0]) == before
    (folder / file).write_bytes(b"another")
    assert data_sets.read_record(dataset, NAMES[0]) != before
    assert data_sets.read_record(dataset, "none") == b""


def test_a_picture_that_announces_billions_of_pixels_is_refused_before_memory_is_taken(copy):
    path = copy / "objects" / NAMES[0] / "images" / "000.png"
    content = bytearray(path.read_bytes())
    content[16:24] = (70_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    path.write_bytes(content)
    assert "pixels" in refused(copy, "images/000.png")


@pytest.mark.parametrize("error", [MemoryError, SystemExit, RuntimeError])
def test_whatever_ends_a_reading_thread_ends_the_training(error, monkeypatch, tmp_path):
    """Threads are part of the training's process: none can die and leave it waiting."""

    def make_batch(*_):
        raise error("the thread is over")

    without_network(monkeypatch)
    monkeypatch.setattr(batching, "make_batch", make_batch)
    schedule = trainer.Schedule(log_every=99, preview_every=99, checkpoint_every=99)
    with pytest.raises(error, match="the thread is over"):
        trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, schedule)
