"""Laws of whole runs: the same bytes whatever happens on the way, and one clear line for what goes wrong."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.command_line import spnr_data
from support.handmade import ball, box

from data_gen.make import objects
from data_gen.plan import tasks
from data_gen.render import views
from data_gen.render.light import Lights
from data_gen.store import check, layout, show

SMALL = ["--resolution", "32", "--views", "2", "--points", "64", "--spp", "16", "--visibility-grid", "2"]


def tree(folder):
    """Every file of a folder with its bytes."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder of five good mesh files and one bad one."""
    folder = tmp_path_factory.mktemp("meshes")
    for number in range(4):
        part = box(half=(0.2 + 0.1 * number, 0.5, 0.4)) if number % 2 else ball(radius=0.3)
        trimesh.Trimesh(part.positions, part.faces, process=False).export(folder / f"thing_{number}.ply")
    (folder / "empty.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    return folder


@pytest.fixture(scope="module")
def finished(meshes, tmp_path_factory):
    """An undisturbed run with one worker."""
    out = tmp_path_factory.mktemp("finished") / "set"
    assert spnr_data("generate", out, "--meshes", meshes, *SMALL, "--workers", 1, "--test-fraction", 0.25) == 0
    return out


def test_a_bad_mesh_is_left_out_with_its_reason_and_the_others_are_made(finished):
    rows = [json.loads(line) for line in (finished / "rejected.jsonl").read_text().splitlines()]
    assert [(row["id"], row["path"]) for row in rows] == [("empty", "empty.ply")]
    assert rows[0]["reason"]
    assert layout.list_completed(finished) == {f"thing_{number}" for number in range(4)}
    assert len(layout.read_split(finished, "test")) == 1


def test_a_run_with_another_setting_is_refused_in_one_line_and_changes_nothing(meshes, finished, capsys):
    before = tree(finished)
    for change in (["--seed", 1], ["--spp", 8], ["--fov", 30], ["--objects", 1]):
        assert spnr_data("generate", finished, "--meshes", meshes, *SMALL, "--test-fraction", 0.25, *change) == 2
        message = capsys.readouterr().err
        assert message.count("\n") == 1
        assert f"{change[0][2:]} " in message
    assert tree(finished) == before


def test_an_object_does_not_depend_on_which_others_are_made():
    alone = tasks.plan_objects(tasks.GenerateConfig(out=Path("x"), objects=2, categories=("lamp", "car")))
    among = tasks.plan_objects(tasks.GenerateConfig(out=Path("x"), objects=8))
    assert {task.object_id for task in alone} <= {task.object_id for task in among}
    seeds = [objects.object_seeds(seed, name) for seed, name in ((0, "a"), (0, "b"), (1, "a"))]
    assert len({tuple(seed.values()) for seed in seeds}) == 3
    assert objects.object_seeds(0, "a") == seeds[0]


def test_an_unexpected_error_leaves_out_that_object_only_but_a_full_disk_stops_the_run(tmp_path, monkeypatch):
    task = tasks.Task(object_id="a", category="chair")
    bench = objects.Workbench(
        out=str(tmp_path),
        lights=Lights(np.ones((4, 8, 3))),
        view=views.ViewConfig(),
        num_points=4,
        seed=0,
        variant="scalar_rgb",
    )

    def broken(category, seed):
        raise ZeroDivisionError("no legs\nto stand on")

    monkeypatch.setattr(objects.procedural, "make", broken)
    assert objects.make_and_write(bench, task) == "unexpected ZeroDivisionError: no legs"

    def full(out, object_id, record):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(objects, "make_record", lambda bench, task: None)
    monkeypatch.setattr(objects.layout, "write_object", full)
    with pytest.raises(OSError, match="No space"):
        objects.make_and_write(bench, task)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--meshes", "absent"], "absent is not a folder"),
        (["--views", "0"], "--views: expected 1 or more, got 0"),
        (["--categories", "spaceship"], "no category spaceship; there are chair"),
        (["--distance", "0.5"], "--distance: expected more than 1"),
        (["--test-fraction", "1"], "leave some objects"),
        (["--objects", "0"], "nothing to do"),
        (["--envmap", "absent.hdr"], "no such file"),
        (["--lights", "absent"], "--lights absent: expected room, random, or a folder"),
        (["--lights", "room", "--envmap", __file__], "not together with --envmap"),
        (["--test-list", "absent.txt"], "not a readable text file"),
        (["--variant", "fast"], "variant: expected auto"),
    ],
)
def test_a_bad_option_is_one_line_and_exit_code_2(arguments, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert spnr_data("generate", "out", "--objects", 1, *arguments) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1
    assert not Path("out").exists()


def test_a_folder_with_other_things_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("years of work")
    assert spnr_data("generate", tmp_path, "--objects", 1, *SMALL) == 2
    assert "holds no data set" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def damage_picture(folder):
    (folder / "objects/thing_0/images/000.png").write_bytes(b"not a picture")


def damage_points(folder):
    path = folder / "objects/thing_1/points.ply"
    points = layout.read_points(path)
    points["x"][0] = np.nan
    path.write_bytes(layout.encode_points(points))


def damage_camera(folder):
    path = folder / "objects/thing_2/transforms.json"
    transforms = json.loads(path.read_text())
    transforms["frames"][0]["transform_matrix"][0][0] += 0.1
    path.write_text(json.dumps(transforms))


def damage_splits(folder):
    (folder / "splits/val.txt").write_text((folder / "splits/train.txt").read_text())


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (damage_picture, "000.png: not a readable PNG"),
        (damage_points, "not finite"),
        (damage_camera, "orthonormal"),
        (damage_splits, "listed more than once"),
    ],
)
def test_check_names_what_is_damaged_and_exits_with_1(damage, expected, finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "copy")
    damage(folder)
    assert not check.check(folder)
    assert expected in capsys.readouterr().out
    assert spnr_data("check", folder) == 1


def test_check_notices_points_that_miss_the_object(finished, tmp_path):
    record = layout.read_object(finished / "objects" / "thing_0")
    assert check.points_on_object(record) > 0.9
    blank = layout.ObjectRecord(**{**vars(record), "images": np.zeros_like(record.images)})
    assert check.points_on_object(blank) == 0


def test_the_contact_sheet_is_one_file_that_shows_every_picture(finished, tmp_path):
    page = show.show(show.ShowConfig(dataset=finished, to=tmp_path / "sheet.html")).read_text()
    assert page.count("data:image/png;base64,") == 4 * (2 + 2 + 3)
    assert "http" not in page
