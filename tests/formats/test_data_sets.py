"""Batches are a function of (seed, step), and agree with the files; what is broken on disk is named with its remedy."""

import dataclasses
import json
import shutil
import threading
import time
import zlib
from contextlib import closing
from itertools import islice

import jax
import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_dataset import CONFIG

from spnr_jax.formats import data_sets
from spnr_jax.training import batching

NAMES = tiny_dataset.SPLITS["train"]


@pytest.fixture
def copy(tmp_path):
    return shutil.copytree(tiny_dataset.dataset().folder, tmp_path / "data")


def one_object(name=NAMES[0]):
    return data_sets.read_object(tiny_dataset.dataset(), name)


def test_batches_are_the_same_from_any_first_step():
    whole = list(batching.batches(tiny_dataset.dataset(), CONFIG, 0))
    assert len(whole) == CONFIG.num_steps
    for first in (0, 2, 5):
        rest = list(batching.batches(tiny_dataset.dataset(), CONFIG, first))
        assert len(rest) == CONFIG.num_steps - first
        for a, b in zip(rest, whole[first:], strict=True):
            same_bits(a, b)


def test_steps_and_seeds_give_different_points_and_views():
    objects = [one_object()]
    batch = batching.make_batch(objects, CONFIG, 0)
    for other in (
        batching.make_batch(objects, CONFIG, 1),
        batching.make_batch(objects, dataclasses.replace(CONFIG, seed=1), 0),
    ):
        assert not np.array_equal(batch.cloud.positions, other.cloud.positions)


def test_places_in_a_batch_draw_independently():
    batch = batching.make_batch([one_object(), one_object()], CONFIG, 0)
    assert not np.array_equal(batch.cloud.positions[0], batch.cloud.positions[1])


@pytest.mark.parametrize("batch_objects", [1, 2, 3, 7])
def test_every_object_appears_once_per_epoch(batch_objects):
    config = dataclasses.replace(CONFIG, batch_objects=batch_objects)
    steps = 4 * len(NAMES)
    order = [name for step in range(steps) for name in batching.object_names(NAMES, config, step)]
    epochs = [tuple(order[i : i + len(NAMES)]) for i in range(0, len(order), len(NAMES))]
    assert all(sorted(epoch) == sorted(NAMES) for epoch in epochs)
    assert len(set(epochs)) > 1, "the order is a new one in each epoch"


def test_points_are_a_subset_without_repetition_and_padding_is_masked():
    cloud = one_object().cloud
    rows = {tuple(row) for row in cloud.positions}
    chosen = batching.choose_points(cloud, 9, 16, np.random.default_rng(0))
    assert chosen.mask.tolist() == [True] * 9 + [False] * 7
    found = {tuple(row) for row in chosen.positions[:9]}
    assert len(found) == 9
    assert found <= rows
    assert not any(np.any(column[9:]) for column in jax.tree.leaves(chosen))


def test_normals_are_read_and_stay_with_their_points_and_a_cloud_may_lack_them():
    item = one_object()
    np.testing.assert_allclose(item.cloud.normals, item.cloud.positions / tiny_dataset.RADIUS, atol=1e-6)
    chosen = batching.choose_points(item.cloud, 9, 16, np.random.default_rng(1))
    np.testing.assert_allclose(chosen.normals, chosen.positions / tiny_dataset.RADIUS, atol=1e-6)
    np.testing.assert_array_equal(data_sets.first_points(item, 5).normals, item.cloud.normals[:5])
    without = dataclasses.replace(item, cloud=item.cloud.replace(normals=None))
    assert batching.choose_points(without.cloud, 9, 16, np.random.default_rng(1)).normals is None
    assert data_sets.first_points(without, 5).normals is None
    assert item.num_bytes - without.num_bytes == item.cloud.normals.nbytes


def test_materials_stay_with_their_points():
    cloud = one_object().cloud
    chosen = batching.choose_points(cloud, 12, 12, np.random.default_rng(3))
    roughness = {tuple(p): r for p, r in zip(cloud.positions, cloud.roughness, strict=True)}
    assert [roughness[tuple(p)] for p in chosen.positions] == chosen.roughness.tolist()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_that_share_of_the_clouds_are_the_first_points(share):
    cloud = one_object().cloud
    chosen = [batching.choose_points(cloud, 9, 16, np.random.default_rng(seed), share) for seed in range(60)]
    first = np.mean([np.array_equal(c.positions[:9], cloud.positions[:9]) for c in chosen])
    assert first == pytest.approx(share, abs=0.2)
    assert share == 0.5 or first == share


def test_first_points_of_a_data_set_of_random_ones_are_refused_as_even():
    dataset = tiny_dataset.dataset()
    config = dataclasses.replace(CONFIG, even_share=0.5)
    with pytest.raises(ValueError, match=f"{dataset.folder}: its points are drawn at random.*--spread even"):
        next(batching.batches(dataset, config, 0))
    even = dataclasses.replace(dataset, settings={"settings": {"spread": "even"}})
    assert (dataset.spread, even.spread) == ("random", "even")
    with closing(batching.batches(even, config, 0)) as batches:
        next(batches)


def test_a_cloud_with_fewer_points_than_asked_is_taken_whole():
    cloud = one_object().cloud
    chosen = batching.choose_points(cloud, 1000, 64, np.random.default_rng(0))
    assert chosen.mask.sum() == tiny_dataset.POINTS
    assert {tuple(p) for p in chosen.positions[chosen.mask]} == {tuple(p) for p in cloud.positions}


def test_the_number_of_points_stays_within_the_config_and_varies():
    item = one_object()
    counts = {int(batching.make_batch([item], CONFIG, step).cloud.mask.sum()) for step in range(40)}
    assert CONFIG.min_points <= min(counts) < max(counts) <= CONFIG.max_points
    assert len(counts) > 5


def test_pictures_conditions_and_cameras_of_a_batch_are_those_of_the_files():
    item = one_object()
    batch = batching.make_batch([item], CONFIG, 4)
    poses = list(map(bytes, item.camera.cam_to_world))
    views = [poses.index(bytes(pose)) for pose in batch.camera.cam_to_world[0]]
    assert len(set(views)) == CONFIG.views_per_object
    folder = tiny_dataset.dataset().folder / "objects" / NAMES[0]
    for i, view in enumerate(views):
        picture, condition = (
            np.asarray(Image.open(folder / kind / f"{view:03d}.png"), np.float64) / 255
            for kind in ("images", "conditions")
        )
        seen = condition[..., 3] == 1
        assert 0 < seen.sum() < seen.size
        np.testing.assert_array_equal(batch.condition_mask[0, i], seen)
        np.testing.assert_allclose(batch.condition[0, i][seen], condition[..., :3][seen], atol=1e-6)
        assert not batch.condition[0, i][~seen].any()
        over_white = picture[..., :3] * picture[..., 3:] + (1 - picture[..., 3:])
        np.testing.assert_allclose(batch.image[0, i], over_white, atol=1e-6)


def test_transparent_is_white_opaque_is_itself_and_half_is_between():
    rgba = np.array([[255, 0, 51, 0], [255, 0, 51, 255], [0, 0, 0, 51]], np.uint8)
    np.testing.assert_allclose(data_sets.on_white(rgba), [[1, 1, 1], [1, 0, 0.2], [0.8, 0.8, 0.8]], atol=1e-6)


def test_the_reader_stops_when_its_consumer_stops_and_reads_only_a_little_ahead(monkeypatch):
    asked, before = [], threading.active_count()
    object_names = batching.object_names
    monkeypatch.setattr(batching, "object_names", lambda *a: asked.append(a[-1]) or object_names(*a))
    line = batching.batches(tiny_dataset.dataset(), dataclasses.replace(CONFIG, num_steps=1000), 0)
    next(line)
    line.close()
    deadline = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before
    assert max(asked) <= batching.READ_AHEAD


def test_the_order_of_a_million_objects_costs_nothing_per_step():
    names = tuple(map(str, range(10**6)))
    start = time.monotonic()
    for step in range(100):
        batching.object_names(names, CONFIG, step)
    assert time.monotonic() - start < 5, "one permutation for all these steps takes 0.1 s, one each takes a minute"


def test_the_cache_holds_as_many_objects_as_fit():
    read = batching.cached_reader(tiny_dataset.dataset(), CONFIG, int(2.5 * one_object().num_bytes))
    first = [read(name) for name in NAMES]
    assert [read(name) is kept for name, kept in zip(NAMES, first, strict=True)] == [True, True, False, False, False]


def test_a_step_whose_object_is_broken_names_it_after_the_good_steps(copy):
    config = dataclasses.replace(CONFIG, batch_objects=1)
    broken = batching.object_names(NAMES, config, 2)[0]
    (copy / "objects" / broken / "images" / "001.png").unlink()
    line = batching.batches(data_sets.open_dataset(copy), config, 0)
    assert len(list(islice(line, 2))) == 2
    with pytest.raises(ValueError, match=rf"{broken}.images.001\.png: cannot be read .*spnr-data check"):
        next(line)


def damaged(copy, file, change):
    path = copy / "objects" / NAMES[0] / file
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match="cannot be read") as error:
        data_sets.read_object(data_sets.open_dataset(copy), NAMES[0])
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.count(str(path)) == 1
    assert message.endswith(f"run `spnr-data check {copy}`")
    assert "\n" not in message
    return message


@pytest.mark.parametrize("file", ["transforms.json", "points.ply", "images/002.png", "conditions/000.png"])
@pytest.mark.parametrize("change", [lambda b: b"", lambda b: b[: len(b) // 2], lambda b: b"\x00" * len(b)])
def test_a_damaged_file_is_named_with_the_remedy(file, change, copy):
    damaged(copy, file, change)


def test_a_png_with_a_broken_chunk_is_named(copy):
    damaged(copy, "images/000.png", lambda b: b[:33] + b"\xff" * 8 + b[41:])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.pop("fl_x"), "no entry 'fl_x'"),
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
    with pytest.raises(ValueError, match="cannot be read") as error:
        data_sets.read_object(data_sets.open_dataset(copy), NAMES[0])
    assert reason in str(error.value)
    assert "spnr-data check" in str(error.value)


def test_a_folder_without_a_data_set_says_how_to_make_one(tmp_path):
    with pytest.raises(ValueError, match="dataset.json is missing.*spnr-data generate"):
        data_sets.open_dataset(tmp_path / "nothing")


def test_an_unfinished_data_set_and_a_damaged_description_are_named(copy):
    (copy / "splits" / "val.txt").unlink()
    with pytest.raises(ValueError, match=r"val.txt: missing; run `spnr-data generate"):
        data_sets.open_dataset(copy)
    (copy / "dataset.json").write_text("{")
    with pytest.raises(ValueError, match=r"dataset.json: not valid JSON"):
        data_sets.open_dataset(copy)


def test_an_empty_train_split_is_refused(copy):
    (copy / "splits" / "train.txt").write_text("")
    with pytest.raises(ValueError, match="the train split is empty"):
        next(batching.batches(data_sets.open_dataset(copy), CONFIG, 0))


def test_images_of_another_size_than_the_presets_are_refused_with_both_sizes(tmp_path):
    folder = tiny_dataset.write_dataset(tmp_path, {"train": ("small",), "val": (), "test": ()}, size=16)
    with pytest.raises(ValueError, match="16 x 16 pixels.*needs 24 x 24.*--resolution 24"):
        next(batching.batches(data_sets.open_dataset(folder), CONFIG, 0))


def test_more_views_per_step_than_there_are_is_refused():
    config = dataclasses.replace(CONFIG, views_per_object=4)
    with pytest.raises(ValueError, match="has 3 views, views_per_object is 4"):
        next(batching.batches(tiny_dataset.dataset(), config, 0))


def test_objects_beyond_the_memory_of_the_cache_are_read_again_to_the_same_batches():
    expected = list(batching.batches(tiny_dataset.dataset(), CONFIG, 0))
    for a, b in zip(batching.batches(tiny_dataset.dataset(), CONFIG, 0, cache_bytes=0), expected, strict=True):
        same_bits(a, b)


def deep() -> str:
    return "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        ("dataset.json", deep(), "not valid JSON"), ("dataset.json", "3", "no settings"),
        ("splits/train.txt", "../../secret", "no name of an object"), ("splits/train.txt", ".", "no name of an object"),
    ],
)  # fmt: skip
def test_a_data_set_whose_lists_lead_elsewhere_or_too_deep_is_refused(file, content, reason, copy):
    (copy / file).write_text(content)
    with pytest.raises(ValueError, match=reason):
        data_sets.open_dataset(copy)


@pytest.mark.parametrize(
    "content",
    [deep(), "3", '{"frames": []}', '{"fl_x": -1, "fl_y": 1, "cx": 1, "cy": 1, "w": 24, "h": 24, "frames": []}'],
)
def test_transforms_of_another_form_are_named(content, copy):
    (copy / "objects" / NAMES[0] / "transforms.json").write_text(content)
    with pytest.raises(ValueError, match=r"transforms\.json: cannot be read"):
        data_sets.read_object(data_sets.open_dataset(copy), NAMES[0])


def test_a_picture_that_announces_billions_of_pixels_is_refused_before_memory_is_taken(copy):
    path = copy / "objects" / NAMES[0] / "images" / "000.png"
    content = bytearray(path.read_bytes())
    content[16:24] = (70_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(ValueError, match="pixels"):
        data_sets.read_object(data_sets.open_dataset(copy), NAMES[0])
