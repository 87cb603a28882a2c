"""`spnr export --splats` and `spnr share`: what they write, and what they refuse in one line."""

import base64
import dataclasses
import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from support import command_line, splat_balls, tiny_surfels

from spnr_jax import cli
from spnr_jax.formats import images
from spnr_jax.formats.clouds import read_cloud
from spnr_jax.formats.point_files import parse_ply
from spnr_jax.method import surfel_method
from spnr_jax.surfels.gaussians import View
from spnr_jax.tools import export, surfaces
from spnr_jax.tools.commands import Lighting, Render

pytestmark = pytest.mark.ci  # it makes splats with the network of the package


@pytest.fixture
def cloud(tmp_path):
    """The ball of the tiny data set as a file."""
    path = tmp_path / "ball.ply"
    path.write_bytes((tiny_surfels.dataset().folder / "objects" / tiny_surfels.NAME / "points.ply").read_bytes())
    return path


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    """Quick ones."""
    monkeypatch.setattr(surfaces, "RESOLUTION", tiny_surfels.SIZE)
    monkeypatch.setattr(surfel_method, "densify_sparse", lambda variables, cloud, *_: cloud)  # it takes long to trace


def made_by(*arguments):
    network = str(tiny_surfels.untrained())
    name = "--network" if arguments[0] == "export" else "--run"
    options = (name, network, "--fitting-views", "6", "--up", "y")
    return command_line.exit_code(cli, *arguments, *options)


def test_splats_of_a_file_lie_around_its_points_in_its_units(cloud, tmp_path, capsys):
    out = tmp_path / "out.ply"
    code = made_by("export", cloud, "--splats", out, "--exposure", "-1")
    assert code == 0, capsys.readouterr().err
    columns, points = parse_ply(out.read_bytes()), read_cloud(cloud).positions
    positions = np.stack([columns["x"], -columns["y"], -columns["z"]], axis=-1)
    low, high = points.min(axis=0), points.max(axis=0)
    spare = 0.35 * (high - low).max()  # the ball has few points
    assert ((positions > low - spare) & (positions < high + spare)).all()
    note = "ball.ply, drawn by spnr_jax"
    assert note.encode() in out.read_bytes()[:300]
    assert "splats" in capsys.readouterr().out


@pytest.mark.parametrize(("command", "option", "name"), [("export", "--splats", "a.ply"), ("share", "--out", "a.html")])
def test_pictures_without_a_surface_are_one_line(cloud, tmp_path, monkeypatch, capsys, command, option, name):
    def empty(*_):
        size, camera = (8, 8), splat_balls.camera(size=8)
        nothing = np.ones((*size, 3), np.float32), np.zeros(size, np.float32), np.full(size, np.nan, np.float32)
        return [View(camera, *nothing)]

    monkeypatch.setattr(surfaces, "draw_around", empty)
    assert made_by(command, cloud, option, tmp_path / name) == 2
    said = capsys.readouterr().err
    assert "no surface" in said.splitlines()[-1]
    assert "Traceback" not in said
    assert not (tmp_path / name).exists()


def test_ctrl_c_while_a_file_is_written_leaves_what_was_there(cloud, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out.spz"
    out.write_bytes(b"before")

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(images.os, "replace", stopped)
    assert made_by("export", cloud, "--splats", out) == 130
    assert out.read_bytes() == b"before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "out.spz"]
    assert "Traceback" not in capsys.readouterr().err


def test_a_page_of_splats_that_are_too_small_for_its_format_is_that_of_larger_ones():
    splats, camera, poster = splat_balls.ball(50), splat_balls.camera(size=8), np.ones((8, 8, 3), np.float32)
    pose = np.asarray(camera.cam_to_world)
    small = dataclasses.replace(splats, position=1e-4 * splats.position, scale=1e-4 * splats.scale)
    near = dataclasses.replace(camera, cam_to_world=np.column_stack([pose[:, :3], 1e-4 * pose[:, 3]]))
    starts, widths = [], []
    for one, seen in ((splats, camera), (small, near)):
        content = export.page(one, poster, seen, (30.0, 20.0), "t", "n").decode()
        start = json.loads(re.search(r"const START = (.*?);", content)[1])
        packed = gzip.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', content)[1]))
        logarithms = np.frombuffer(packed, np.uint8, 150, 16 + 13 * 50) / 16 - 10
        starts.append(start)
        widths.append(np.exp(logarithms) / start["distance"])
    assert starts[1]["distance"] == pytest.approx(1)
    np.testing.assert_allclose(starts[1]["target"], np.array(starts[0]["target"]) / starts[0]["distance"], atol=1e-6)
    np.testing.assert_allclose(widths[1], widths[0], rtol=0.07)  # steps of 1/16


def test_a_page_that_is_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(export, "MOST_BYTES", 1000)
    poster = np.ones((8, 8, 3), np.float32)
    with pytest.raises(ValueError, match="--most-splats"):
        export.page(splat_balls.ball(50), poster, splat_balls.camera(size=8), (30.0, 20.0), "t", "n")
    asked = Render(cloud=Path("a/b.ply"), lighting=Lighting(light="/home/me/sky.hdr", sun=(40, 30)))
    named = export.describe_source(asked)
    assert named == "b.ply, drawn by spnr_jax (surfels), light: sky.hdr + sun", "without folders"
