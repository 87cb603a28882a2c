"""Laws of whole runs: what is made, checked and shown, and one clear line for what goes wrong."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.command_line import spnr_data
from support.folders import contents
from support.handmade import ball, box

from data_gen.make import objects
from data_gen.plan import tasks
from data_gen.render.light import Lights
from data_gen.store import check, layout, show
from spnr_jax.formats import data_sets
from spnr_jax.surfels.lighting import texel_directions

VIEWS = 6
SMALL = ["--resolution", 32, "--views", VIEWS, "--points", 64, "--spp", 16, "--visibility-grid", 2]
SMALL += ["--lights", "random", "--test-fraction", 0.25]


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder of four good mesh files and a bad one."""
    folder = tmp_path_factory.mktemp("meshes")
    for number, part in enumerate((ball(radius=0.3), box(half=(0.3, 0.5, 0.4)), ball(radius=0.5), box())):
        trimesh.Trimesh(part.positions, part.faces, process=False).export(folder / f"thing_{number}.ply")
    (folder / "empty.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    return folder


@pytest.fixture(scope="module")
def finished(meshes, tmp_path_factory, generate_here):
    """An undisturbed run, each view in a light of its own."""
    out = tmp_path_factory.mktemp("finished") / "set"
    assert generate_here(out, "--meshes", meshes, *SMALL) == 0
    return out


def test_a_bad_mesh_is_left_out_with_its_reason_and_the_others_are_made(finished):
    rows = [json.loads(line) for line in (finished / "rejected.jsonl").read_text().splitlines()]
    assert [(row["id"], row["path"]) for row in rows] == [("empty", "empty.ply")]
    assert rows[0]["reason"]
    assert layout.list_completed(finished) == {f"thing_{number}" for number in range(4)}
    assert len((finished / "splits" / "test.txt").read_text().split()) == 1
    assert spnr_data("check", finished) == 0


def test_a_view_is_brighter_where_the_map_that_is_kept_says_that_its_light_comes_from(finished):
    dataset = data_sets.open_dataset(finished)
    assert dataset.settings["environment_map"]["kinds"] == [{"name": "random"}]
    item = data_sets.read_object(dataset, "thing_2")
    assert len({light.tobytes() for light in item.lights}) == len(item.lights) == VIEWS
    area = np.sin(np.pi * (np.arange(32) + 0.5) / 32)[:, None, None]
    np.testing.assert_allclose((item.lights * area).mean(axis=(1, 2, 3)) / area.mean(), 0.6, rtol=0.02)
    agreeing = []
    for view, light in enumerate(item.lights):
        weight = area[..., 0] * light.mean(axis=-1)
        across = (weight[..., None] * texel_directions(32)).sum(axis=(0, 1)) @ item.camera.cam_to_world[view][:, :3]
        image, inside = item.images[view, ..., :3].mean(axis=-1), item.images[view, ..., 3] > 250
        grid = np.stack(np.meshgrid(np.arange(32) - 15.5, 15.5 - np.arange(32)), axis=-1)
        gradient = np.linalg.lstsq(grid[inside], image[inside] - image[inside].mean(), rcond=None)[0]
        agreeing.append(gradient @ across[:2] > 0)
    assert np.mean(agreeing) > 0.8


def test_a_run_with_another_setting_is_refused_in_one_line_and_changes_nothing(
    meshes, finished, generate_here, tmp_path, capsys
):
    before = contents(finished)
    for option, value in (("seed", 1), ("spp", 8), ("fov", 30), ("objects", 1)):
        assert generate_here(finished, "--meshes", meshes, *SMALL, f"--{option}", value) == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1
        assert f"{option} " in message
    assert contents(finished) == before
    (tmp_path / "thesis.txt").write_text("years of work")
    assert generate_here(tmp_path, "--objects", 1, *SMALL) == 2
    assert "holds no data set" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_meshes_that_changed_are_named_and_touched_ones_are_not(meshes, finished, generate_here, tmp_path, capsys):
    folder = tmp_path / "meshes"
    shutil.copytree(meshes, folder)
    for path in folder.iterdir():
        path.touch()
    again = [finished, "--meshes", folder, *SMALL]
    before = contents(finished)
    assert generate_here(*again) == 0
    assert "changed since" not in capsys.readouterr().err
    shutil.copy(folder / "thing_0.ply", folder / "thing_2.ply")
    assert generate_here(*again) == 0
    assert "1 objects are kept whose mesh files changed since: thing_2; remove" in capsys.readouterr().err
    assert contents(finished) == before


def test_an_object_does_not_depend_on_which_others_are_made():
    alone = tasks.plan_objects(tasks.GenerateConfig(out=Path("x"), objects=2, categories=("lamp", "car")))
    among = tasks.plan_objects(tasks.GenerateConfig(out=Path("x"), objects=8))
    assert {task.object_id for task in alone} <= {task.object_id for task in among}
    seeds = [objects.object_seeds(seed, name) for seed, name in ((0, "a"), (0, "b"), (1, "a"))]
    assert len({tuple(seed.values()) for seed in seeds}) == 3
    assert objects.object_seeds(0, "a") == seeds[0]


def test_an_unexpected_error_leaves_out_that_object_only_but_a_full_disk_stops_the_run(tmp_path, monkeypatch):
    task, lights = tasks.Task(object_id="a", category="chair"), Lights(np.ones((4, 8, 3)))
    config = tasks.GenerateConfig(out=tmp_path)
    bench = objects.Workbench(config=config, lights=lights, variant="scalar_rgb")

    def fail(error):
        def failing(*_):
            raise error

        return failing

    monkeypatch.setattr(objects.procedural, "make", fail(ZeroDivisionError("no legs\nto stand on")))
    assert objects.make_and_write(bench, task) == "unexpected ZeroDivisionError: no legs"
    monkeypatch.setattr(objects, "make_record", lambda bench, task: None)
    monkeypatch.setattr(objects.layout, "write_object", fail(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        objects.make_and_write(bench, task)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--meshes", "absent"], "absent is not a folder"),
        (["--views", "0"], "--views: expected 1 or more, got 0"),
        (["--categories", "spaceship"], "no category spaceship; there are chair"),
        (["--categories", "chair", "--objects", "0"], "--categories: of procedural objects; give --objects"),
        (["--reshape-variants"], "--reshape-variants: give --colour-variants"),
        (["--distance", "0.5"], "--distance: expected more than 1"),
        (["--distance", "inf"], "--distance: expected more than 1"),
        (["--test-fraction", "1"], "leave some objects"),
        (["--test-fraction", "nan"], "leave some objects"),
        (["--val-fraction", "nan"], "leave some objects"),
        (["--objects", "0"], "nothing to do"),
        (["--envmap", "absent.hdr"], "no such file"),
        (["--lights", "absent"], "--lights absent: expected room, random, or a folder"),
        (["--lights", "room", "--envmap", __file__], "not together with --envmap"),
        (["--test-list", "absent.txt"], "not a readable text file"),
        (["--variant", "fast"], "variant: expected auto"),
        (["--root", "."], "only with --preset"),
        (["--preset", "abo"], "--preset abo: give --root"),
        (["--preset", "abo", "--meshes", "."], "not together"),
        (["--objects", "8", "--test-objects", "8"], "--test-objects 8: leaves none of the 8"),
        (["--colour-variants", "-1"], "--colour-variants: expected 0 or more"),
        (["--train-objects", "0"], "--train-objects: expected 1 or more"),
        (["--no-such-option", "3"], "--no-such-option"),
        (["--preset"], "--preset needs a value"),
    ],
)
def test_a_bad_option_is_one_line_and_exit_code_2(arguments, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    objects = () if "--preset" in arguments else ("--objects", 1)
    assert spnr_data("generate", "out", *objects, "--variant", "scalar_rgb", *arguments) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1
    assert not Path("out").exists()


def damage_points(whole):
    points = np.frombuffer(whole.partition(b"end_header\n")[2], layout.POINT_TYPE).copy()
    points["x"][0] = np.nan
    return layout.encode_points(points)


def turn_camera(whole):
    transforms = json.loads(whole)
    transforms["frames"][0]["transform_matrix"][0][0] += 0.1
    return json.dumps(transforms).encode()


@pytest.mark.parametrize(
    ("name", "damage", "expected"),
    [
        ("objects/thing_0/images/000.png", lambda _: b"not a picture", "000.png: cannot be read (is not an image)"),
        ("objects/thing_1/points.ply", damage_points, "thing_1/points.ply: cannot be read (holds 1 points"),
        ("objects/thing_2/transforms.json", turn_camera, "orthonormal"),
        ("splits/val.txt", lambda _: b"thing_0\nthing_1\nthing_2\nthing_3\n", "listed more than once"),
    ],
)
def test_check_names_what_is_damaged_and_exits_with_1(name, damage, expected, finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    (folder / name).write_bytes(damage((folder / name).read_bytes()))
    assert spnr_data("check", folder) == 1
    assert expected in capsys.readouterr().out


def test_check_notices_points_that_miss_the_object(finished):
    item = data_sets.read_object(data_sets.open_dataset(finished), "thing_0")
    assert check.points_on_object(item) > 0.9
    assert check.points_on_object(replace(item, images=np.zeros_like(item.images))) == 0


def test_a_damaged_object_is_left_out_of_the_contact_sheet_and_named(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "data")
    first, *others = sorted(layout.list_completed(folder))
    (folder / "objects" / first / "points.ply").write_bytes(b"ply\n")
    page = show.show(show.ShowConfig(dataset=folder)).read_text()
    assert f"left out: {folder}" in capsys.readouterr().err
    assert all(name in page for name in others)


def test_the_contact_sheet_is_one_file_that_shows_every_picture(finished, tmp_path):
    page = show.show(show.ShowConfig(dataset=finished, to=tmp_path / "sheet.html")).read_text()
    assert page.count("data:image/png;base64,") == 4 * (2 * VIEWS + 3)
    assert "http" not in page
