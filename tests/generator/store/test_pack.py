"""Laws of the packed form: the same bytes as the folder, the same batches, and whole or not at all."""

import dataclasses
import json
import shutil

import pytest
from support import tiny_dataset
from support.command_line import spnr_data
from support.laws import same_bits
from support.tiny_dataset import CONFIG

from data_gen.store import layout, pack, storage
from spnr_jax.formats import data_sets, shards
from spnr_jax.training import batching


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The tests' data set, with what `spnr-data generate` writes beside the objects."""
    target = shutil.copytree(tiny_dataset.dataset().folder, tmp_path_factory.mktemp("unpacked") / "data")
    layout.write_text(target / "dataset.json", layout.json_text({"schema_version": layout.SCHEMA_VERSION}))
    layout.write_text(target / "rejected.jsonl", "")
    return target


@pytest.fixture(scope="module")
def packed(folder, tmp_path_factory):
    """Its packed form, in shards of few objects."""
    out = tmp_path_factory.mktemp("packed") / "data"
    patch = pytest.MonkeyPatch()
    patch.setattr(pack, "BYTES_PER_MB", 15_000)  # an object has 8 kB
    pack.pack(pack.PackConfig(dataset=folder, out=out, shard_mb=1))
    patch.undo()
    return out


def test_every_file_of_every_object_comes_out_as_it_went_in(folder, packed):
    opened = shards.open_shards(packed)
    names = sorted(name for split in tiny_dataset.SPLITS.values() for name in split)
    assert sorted(opened.places) == names == sorted(layout.completed_objects(folder))
    for name in names:
        place = folder / "objects" / name
        files = {path.relative_to(place).as_posix(): path.read_bytes() for path in place.rglob("*") if path.is_file()}
        assert shards.read_files(opened, name) == files
    counts = json.loads((packed / "index.json").read_text())["shards"].values()
    assert len(counts) > 2
    assert max(counts) > 1


def test_both_forms_give_the_same_batches_from_any_first_step(folder, packed):
    for first in (0, 3):
        batches = zip(
            batching.batches(data_sets.open_dataset(packed), CONFIG, first),
            batching.batches(data_sets.open_dataset(folder), CONFIG, first),
            strict=True,
        )
        count = 0
        for ours, theirs in batches:
            same_bits(ours, theirs)
            count += 1
        assert count == CONFIG.num_steps - first


def test_the_same_objects_are_the_same_bytes(folder, packed, tmp_path):
    for out in (tmp_path / "a", tmp_path / "b"):
        pack.pack(pack.PackConfig(dataset=folder, out=out))
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    assert set(tree(tmp_path / "a")) - {"shards/00000.array_record"} <= set(tree(packed))


def tree(place):
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in place.rglob("*") if path.is_file()}


def test_a_run_of_both_forms_opens_as_the_same_data_set(folder, packed):
    ours, theirs = data_sets.open_dataset(packed), data_sets.open_dataset(folder)
    assert (ours.settings, ours.splits) == (theirs.settings, theirs.splits)
    assert theirs.shards is None


def test_nothing_is_left_where_packing_fails(folder, tmp_path, monkeypatch):
    broken = shutil.copytree(folder, tmp_path / "broken")
    (broken / "objects/ball_000004/images/001.png").write_bytes(b"other")
    with pytest.raises(ValueError, match=r"ball_000004/images/001.png is not as it was written"):
        pack.pack(pack.PackConfig(dataset=broken, out=tmp_path / "packed"))
    assert [path.name for path in tmp_path.iterdir()] == ["broken"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--shard-mb", "0"], "--shard-mb: expected 1 or more, got 0"),
        (["--out", "{folder}"], "exists already: choose another folder"),
    ],
)
def test_a_bad_option_is_one_line_and_exit_code_2(arguments, expected, folder, tmp_path, capsys):
    options = ["--out", str(tmp_path / "x"), *(argument.format(folder=folder) for argument in arguments)]
    assert spnr_data("pack", folder, *options) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1


def cut_off(packed):
    path = sorted((packed / "shards").iterdir())[1]
    path.write_bytes(path.read_bytes()[:-100])


def lost(packed):
    sorted((packed / "shards").iterdir())[1].unlink()


def damaged(packed):
    path = sorted((packed / "shards").iterdir())[0]
    content = bytearray(path.read_bytes())
    content[200:900] = bytes(700)
    path.write_bytes(content)


def shortened(packed):
    index = json.loads((packed / "index.json").read_text())
    (packed / "index.json").write_text(json.dumps({**index, "ids": index["ids"][1:]}))


def no_json(packed):
    (packed / "index.json").write_text("{")


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (cut_off, "cannot be read"),
        (lost, "00001.array_record: missing"),
        (damaged, "cannot be read"),
        (shortened, "9 objects in the shards, 8 in index.json"),
        (no_json, "index.json: damaged"),
    ],
)
def test_damage_is_named_with_its_remedy(damage, expected, packed, tmp_path):
    target = shutil.copytree(packed, tmp_path / "copy")
    damage(target)
    with pytest.raises(ValueError, match=rf"copy.*{expected}.*; pack (them|the data set) again"):
        list(
            batching.batches(
                data_sets.open_dataset(target), dataclasses.replace(CONFIG, batch_objects=5, num_steps=2), 0
            )
        )


def test_unfinished_packing_carries_the_name_of_unfinished_things(folder, tmp_path, monkeypatch):
    seen = []

    def look(place, *rest):
        seen.append(place.parent.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(pack, "write_shards", look)
    with pytest.raises(KeyboardInterrupt):
        pack.pack(pack.PackConfig(dataset=folder, out=tmp_path / "packed"))
    assert seen[0].startswith(storage.UNFINISHED)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["check", "show", "pack"])
def test_commands_that_look_at_folders_of_objects_say_so_of_a_packed_one(command, packed, tmp_path, capsys):
    out = ["--out", str(tmp_path / "again")] if command == "pack" else []
    assert spnr_data(command, packed, *out) == 2
    assert "is packed; look at the folder of objects" in capsys.readouterr().err


@pytest.mark.parametrize("files", ['{"files": {"../../../secret": "a"}}', '{"files": 3}', "[]", "[" * 10**5])
def test_an_object_that_names_files_of_others_is_not_packed(files, tmp_path):
    (tmp_path / "objects" / "a").mkdir(parents=True)
    (tmp_path / "objects" / "a" / "object.json").write_text(files)
    (tmp_path / "secret").write_text("a")
    with pytest.raises(ValueError, match=r"object\.json: "):
        pack.object_files(tmp_path, "a")
