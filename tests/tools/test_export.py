"""The exported network draws the pictures of the pure functions where there is nothing but JAX."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from support import tiny_surfels, tiny_viewer
from support.laws import close
from support.surfel_clouds import cloud, shape

import spnr_jax
from spnr_jax import cli
from spnr_jax.kernels import cloud_arrays
from spnr_jax.surfels.lighting import room_light
from spnr_jax.surfels.skies import sun
from spnr_jax.tools import export
from spnr_jax.training import weights

POINTS, SIZE = 128, 32
# what a stranger does with the files: imports of ours and of Flax fail
STRANGER = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"spnr_jax", "flax", "optax", "orbax"}:
            raise ImportError(name + " is not here")
sys.meta_path.insert(0, Blocked())
import jax, numpy as np
encode, render = (
    jax.jit(jax.export.deserialize(bytearray(open(f"{name}.jax", "rb").read())).call) for name in ("encode", "render"))
volume, camera = encode(dict(np.load("cloud.npz"))), dict(np.load("camera.npz"))
for light in sys.argv[1:]:
    np.savez(f"{light}_picture.npz", **render(volume, camera, dict(np.load(f"{light}.npz"))))
"""


def arrays(record, names="positions base_color roughness metallic mask"):
    return {name: np.asarray(getattr(record, name)) for name in names.split()}


def pictures_of_a_stranger(folder, points, camera, *lights):
    """What a process that knows JAX alone draws with the files of a folder."""
    np.savez(folder / "cloud.npz", **arrays(points))
    np.savez(folder / "camera.npz", **arrays(camera, "cam_to_world intrinsics"))
    command = [sys.executable, "-W", "error", "-c", STRANGER, *lights]
    subprocess.run(command, cwd=folder, capture_output=True, check=True)
    return [dict(np.load(folder / f"{light}_picture.npz")) for light in lights]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda model: export.export_encode(model, num_points=0), "num_points must be at least 1, got 0"),
        (lambda model: export.export_render(model, resolution=18), "multiple of 4 from 16 to 16384, got 18"),
        (lambda model: export.load_exported(b"PK\x03\x04 a zip"), "not a function that JAX exported"),
    ],
)
def test_what_cannot_be_exported_or_loaded_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as refused:
        make(tiny_viewer.surfels())
    assert "\n" not in str(refused.value)


@pytest.mark.ci
def test_a_process_that_knows_jax_alone_draws_the_pictures_of_the_pure_functions(tmp_path, monkeypatch, capsys):
    run, model = tiny_surfels.untrained(), spnr_jax.load(tiny_surfels.untrained())
    older = jax.tree.map(lambda x: 2 * x, model.params["densifier"])
    weights.write_variables(tmp_path / "densifier.npz", older)
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    options = {"num_points": POINTS, "resolution": SIZE, "platforms": ("cpu", "cuda")}
    cli.run(cli.Export(run=run, out=tmp_path, **options))
    capsys.readouterr()
    functions = {f"{name}.{kind}" for name in ("encode", "render") for kind in ("jax", "stablehlo")}
    kept = {"weights.npz", "densifier.npz", "light.npz", "export.json"}
    assert {path.name for path in tmp_path.iterdir()} == functions | kept
    exported = spnr_jax.load(tmp_path / "weights.npz").params["densifier"]
    jax.tree.map(np.testing.assert_array_equal, exported, model.params["densifier"])  # not that of an older export
    assert (tmp_path / "encode.stablehlo").read_bytes().startswith(b"ML\xefR"), "MLIR's bytecode"
    said = json.loads((tmp_path / "export.json").read_text())
    assert said["render"]["platforms"] == ["cpu", "cuda"]
    assert said["encode"]["outputs"] == said["render"]["inputs"][0], "the volume goes from one to the other"
    positions, normals, _ = shape("sphere", 110)
    red = np.where(normals[:, :1] > 0, [0.8, 0.1, 0.1], [0.2, 0.4, 0.7])
    points = cloud_arrays.pad(cloud(7 * positions + 3, base_color=red), POINTS)  # far from the box's units
    scene = jax.jit(spnr_jax.encode)(model.params, points, spnr_jax.neighbors(points))
    camera = model.camera(scene, azimuth=50.0, resolution=SIZE)
    np.savez(tmp_path / "sun.npz", tables=sun(40, 30).tables)
    found = pictures_of_a_stranger(tmp_path, points, camera, "light", "sun")
    plan = export.make_plan(model, POINTS, SIZE)
    draw = jax.jit(spnr_jax.render, static_argnames="plan")
    for drawn, light in zip(found, (room_light(), sun(40, 30)), strict=True):
        whole = draw(model.params, scene, camera, light, plan=plan)
        assert drawn["overflow"] == 0
        assert drawn["acc"].max() > 0.5, "a picture of nothing would agree with anything"
        close(drawn, arrays(whole, "image depth acc overflow"), rtol=1e-4, atol=1e-4)
    assert np.abs(found[0]["image"] - found[1]["image"]).max() > 0.05


@pytest.mark.parametrize("count", [1, 110])
def test_neighbors_found_in_jax_are_those_of_the_tree(count):
    points = cloud_arrays.pad(cloud(np.random.default_rng(count).normal(size=(count, 3))), POINTS)
    found = np.asarray(export.nearest(points.positions, points.mask))
    np.testing.assert_array_equal(found, spnr_jax.neighbors(points))
    repeated = np.asarray(points.positions).copy()
    repeated[1:count] = repeated[0]
    own = np.asarray(export.nearest(repeated, points.mask))[:count, 0]
    np.testing.assert_array_equal(own, np.arange(count), err_msg="each point is its own first neighbor")
