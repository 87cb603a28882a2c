"""Laws of the plan: splits are by product, of the size that was asked for, and variants belong to training products."""

from pathlib import Path

import pytest

from data_gen.__main__ import parse
from data_gen.make.generate import describe
from data_gen.plan import tasks

OUT = ["generate", "out"]


def config(**options):
    return tasks.GenerateConfig(out=Path("x"), **options)


def planned(**options):
    """The plan of 40 procedural objects."""
    return tasks.plan_data_set(config(objects=40, **options))


def ids(tasks):
    return [task.object_id for task in tasks]


def test_splits_are_disjoint_complete_and_of_the_size_asked_for():
    for options, num_test in (({"test_fraction": 0.2}, 8), ({"test_objects": 11}, 11)):
        made = planned(val_fraction=0.1, **options)
        split = made.split(ids(made.tasks))
        assert sorted(split["train"] + split["val"] + split["test"]) == ids(made.tasks)
        assert (len(split["val"]), len(split["test"])) == (4, num_test)
    assert planned(seed=1, test_objects=11).split(ids(made.tasks)) != split


def test_an_object_that_cannot_be_used_takes_no_place_in_the_test_split():
    made = planned(test_objects=11, val_fraction=0)
    first = made.split(ids(made.tasks))
    usable = [name for name in ids(made.tasks) if name != first["test"][0]]
    second = made.split(usable)
    assert len(second["test"]) == 11
    assert set(first["test"]) - set(second["test"]) == {first["test"][0]}
    assert len(second["train"]) == len(first["train"]) - 1


def test_a_test_list_is_the_test_split(tmp_path):
    made = planned()
    (tmp_path / "test.txt").write_text("\n".join(ids(made.tasks)[3:7]))
    split = planned(test_list=tmp_path / "test.txt", val_fraction=0.25).split(ids(made.tasks))
    assert split["test"] == ids(made.tasks)[3:7]
    assert len(split["val"]) == 9
    (tmp_path / "test.txt").write_text("\ufeffchair_000000\n\nfull moon\n sun\n", encoding="utf-8")
    reason = r"^--test-list .*test\.txt: no object 'full moon' \(2 of 3 ids unknown\); ids are .*chair_000000"
    with pytest.raises(ValueError, match=reason):
        tasks.plan_data_set(config(objects=8, test_list=tmp_path / "test.txt"))


def test_originals_come_first_and_variants_fill_up_to_the_number_asked_for():
    asked = {"test_objects": 10, "val_fraction": 0.1, "colour_variants": 5, "train_objects": 67}
    made = planned(**asked)
    train = made.split(ids(made.tasks))["train"]
    variants = made.variants(train)
    assert len(train) + len(variants) == 67
    assert {variant.product for variant in variants} <= set(train)
    assert all(variant.object_id == f"{variant.product}--{variant.colour_variant}" for variant in variants)
    assert len(set(ids(variants))) == len(variants)
    assert variants == made.variants(train) != planned(**asked, seed=1).variants(train)
    made = planned(test_objects=10, val_fraction=0, colour_variants=3)  # without a number all of each product
    assert len(made.variants(made.split(ids(made.tasks))["train"])) == 90
    assert planned().variants(["chair_000000"]) == []


def test_variants_are_reshaped_if_asked_for_and_older_data_sets_that_were_not_stay_the_same():
    for asked in (False, True):
        made = planned(test_objects=10, colour_variants=1, reshape_variants=asked)
        assert {task.reshaped for task in made.variants(made.split(ids(made.tasks))["train"])} == {asked}
        assert not any(task.reshaped for task in made.tasks)
        assert ("reshape_variants" in describe(made, "scalar_rgb")["settings"]) == asked


def test_fewer_training_objects_than_there_are_leave_some_aside():
    made = planned(test_objects=10, val_fraction=0.1, train_objects=7)
    split = made.split(ids(made.tasks))
    assert [len(split[name]) for name in ("train", "val", "test")] == [7, 4, 10]
    assert split["test"] == planned(test_objects=10, val_fraction=0.1).split(ids(planned().tasks))["test"]


def test_a_preset_is_the_default_of_the_options_and_they_override_it():
    for name, preset in tasks.PRESETS.items():
        made = parse([*OUT, "--preset", name, "--root", "data", "--spp", "16"])
        assert vars(made) == {**vars(preset("out")), "root": Path("data"), "spp": 16, "out": made.out}
        assert made.preset == name
        tasks.check_options(made)
    assert parse([*OUT, f"--preset={name}", "--colour-variants", "2"]).colour_variants == 2
    assert parse(OUT) == tasks.GenerateConfig(out=parse(OUT).out)


def test_meshes_are_named_after_their_files_and_go_with_procedural_objects(tmp_path):
    for name in ("b.ply", "a.glb"):
        (tmp_path / name).write_bytes(b"")
    assert ids(tasks.plan_objects(config(meshes=tmp_path))) == ["a", "b"]
    mixed = tasks.plan_objects(config(meshes=tmp_path, objects=1))
    assert [task.shown_path for task in mixed] == ["a.glb", "b.ply", ""]
    assert len(tasks.plan_objects(config())) == 200


def test_the_presets_hold_the_papers_numbers():
    numbers = ("resolution", "views", "colour_variants", "train_objects", "test_objects")
    found = {name: preset(Path("x")) for name, preset in tasks.PRESETS.items()}
    assert {name: tuple(getattr(one, number) for number in numbers) for name, one in found.items()} == {
        "abo": (128, 10, 5, 16161, 200),
        "shapenet_car": (200, 10, 0, None, 128),
        "shapenet_plane": (200, 10, 0, None, 406),
        "shapenet_chair": (200, 10, 0, None, 105),
    }
