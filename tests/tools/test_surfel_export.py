"""The default network exported: the pictures of the pure functions where there is nothing but JAX."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from support import tiny_surfels
from support.laws import close
from support.surfel_clouds import cloud, shape

import spnr_jax
from spnr_jax import cli
from spnr_jax.kernels import cloud_arrays
from spnr_jax.surfels.lighting import room_light, sun
from spnr_jax.tools import export

POINTS, SIZE = 128, 32
# what a stranger does: imports of ours and of Flax fail
STRANGER = """
import sys
from pathlib import Path
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"spnr_jax", "flax", "optax", "orbax"}:
            raise ImportError(name + " is not here")
sys.meta_path.insert(0, Blocked())
import jax, numpy as np
encode, render = (
    jax.jit(jax.export.deserialize(bytearray(Path(f"exported/{name}.jax").read_bytes())).call)
    for name in ("encode", "render"))
volume = encode(dict(np.load("cloud.npz")))
camera = dict(np.load("camera.npz"))
for light in ("exported/light", "sun"):
    picture = render(volume, camera, dict(np.load(f"{light}.npz")))
    np.savez(f"{Path(light).name}_picture.npz", **picture)
"""


def ball():
    """A half red ball in units far from the box's, padded."""
    positions, normals, _ = shape("sphere", 110)
    red = np.where(normals[:, :1] > 0, [0.8, 0.1, 0.1], [0.2, 0.4, 0.7])
    return cloud_arrays.pad(cloud(7 * positions + 3, base_color=red), POINTS)


def arrays(record, names):
    return {name: np.asarray(getattr(record, name)) for name in names.split()}


@pytest.mark.ci
def test_a_process_that_knows_jax_alone_draws_the_pictures_of_the_pure_functions(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)  # it would write to the home folder
    folder = tmp_path / "exported"
    cli.run(
        cli.Export(run=tiny_surfels.run(), out=folder, num_points=POINTS, resolution=SIZE, platforms=("cpu", "cuda"))
    )
    capsys.readouterr()
    said = json.loads((folder / "export.json").read_text())
    assert said["render"]["platforms"] == ["cpu", "cuda"]
    assert said["encode"]["outputs"] == said["render"]["inputs"][0], "the volume goes from one to the other"
    model = spnr_jax.load(tiny_surfels.run())
    points = ball()
    scene = jax.jit(spnr_jax.encode)(model.params, points, spnr_jax.neighbors(points))
    camera = model.camera(scene, azimuth=50.0, resolution=SIZE)
    np.savez(tmp_path / "cloud.npz", **arrays(points, "positions base_color roughness metallic mask"))
    np.savez(tmp_path / "camera.npz", **arrays(camera, "cam_to_world intrinsics"))
    np.savez(tmp_path / "sun.npz", tables=sun(40, 30).tables)
    subprocess.run([sys.executable, "-W", "error", "-c", STRANGER], cwd=tmp_path, capture_output=True, check=True)
    plan = export.make_plan(model, POINTS, SIZE)
    draw = jax.jit(spnr_jax.render, static_argnames="plan")
    pictures = []
    for name, light in (("light", room_light()), ("sun", sun(40, 30))):
        drawn = dict(np.load(tmp_path / f"{name}_picture.npz"))
        whole = draw(model.params, scene, camera, light, plan=plan)
        assert drawn["overflow"] == 0
        assert drawn["acc"].max() > 0.5, "a picture of nothing would agree with anything"
        close(drawn, arrays(whole, "image depth acc overflow"), rtol=1e-4, atol=1e-4)
        pictures.append(drawn["image"])
    assert np.abs(pictures[0] - pictures[1]).max() > 0.05


@pytest.mark.parametrize("count", [1, 19, 110])
def test_neighbors_found_in_jax_are_those_of_the_tree(count):
    points = cloud_arrays.pad(cloud(np.random.default_rng(count).normal(size=(count, 3))), POINTS)
    found = np.asarray(export.nearest(points.positions, points.mask))
    np.testing.assert_array_equal(found, spnr_jax.neighbors(points))


def test_enlarged_pictures_are_not_exported():
    with pytest.raises(ValueError, match="export a smaller resolution"):
        export.export_render(spnr_jax.load(tiny_surfels.run()), resolution=SIZE, quality="balanced")
