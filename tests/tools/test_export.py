"""An exported network draws the same pictures where there is nothing but JAX."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from flax.serialization import to_state_dict
from support import tiny_untrained, tiny_viewer
from support.laws import close

from spnr_jax import cli
from spnr_jax.kernels import cloud_arrays
from spnr_jax.tools import export

POINTS, SIZE = 256, 32
# what a stranger does with the two files: no class of ours, no flax, no weights
STRANGER = """
import json, sys
from pathlib import Path
import jax, numpy as np
encode, render = (jax.export.deserialize(bytearray(Path(name).read_bytes())).call for name in ("encode", "render"))
cloud, camera = ({k: given[k] for k in keys.split()} for given, keys in (
    (np.load("cloud.npz"), "positions base_color roughness metallic mask"),
    (np.load("camera.npz"), "cam_to_world intrinsics")))
np.savez("picture.npz", **render(encode(cloud), camera))
print(json.dumps(sorted({name.split(".")[0] for name in sys.modules})))
"""


def arrays(record):
    return {name: np.asarray(values) for name, values in vars(record).items() if values is not None}


def given():
    """A cloud of 200 points padded to the bucket, as the exported functions take it."""
    return arrays(cloud_arrays.pad(tiny_viewer.cloud(), POINTS))


@pytest.fixture(scope="module")
def encoded():
    return export.export_encode(tiny_viewer.model(), num_points=POINTS)


@pytest.fixture(scope="module")
def expected():
    """Volume, camera and picture of the handle."""
    handle = tiny_viewer.model()
    volume = handle.encode(tiny_viewer.cloud())
    camera = handle.camera(volume, azimuth=50.0, resolution=SIZE)
    return volume, camera, handle.render(volume, camera)


@pytest.fixture(scope="module")
def rendered(expected):
    return export.export_render(tiny_viewer.model(), resolution=SIZE, reach=expected[0].reach)


def test_a_process_that_knows_jax_alone_draws_the_handles_picture(encoded, rendered, expected, tmp_path):
    _, camera, picture = expected
    (tmp_path / "encode").write_bytes(encoded)
    (tmp_path / "render").write_bytes(rendered)
    np.savez(tmp_path / "cloud.npz", **given())
    np.savez(tmp_path / "camera.npz", cam_to_world=camera.cam_to_world, intrinsics=camera.intrinsics)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", STRANGER], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert not {"spnr_jax", "flax", "optax", "orbax"} & set(json.loads(done.stdout))
    drawn = np.load(tmp_path / "picture.npz")
    assert np.asarray(picture.acc).mean() > 0.1, "a picture of nothing would agree with anything"
    close(dict(drawn), {name: np.asarray(value) for name, value in arrays(picture).items()}, rtol=1e-5, atol=1e-5)


def test_the_exported_encode_finds_box_and_features_of_the_handle_and_leaves_the_padding_out(encoded, expected):
    volume = expected[0]
    encode = export.load_exported(encoded)
    made = encode(given())
    close(made["centre"], volume.centre)
    close(made["scale"], volume.scale)
    close(made["scene"]["volume"], volume.scene.volume, atol=1e-5 * float(np.abs(volume.scene.volume).max()))
    np.testing.assert_array_equal(made["scene"]["occupied"], volume.scene.occupied)
    nonsense = given()
    nonsense["positions"][200:] = np.inf
    nonsense["base_color"][200:] = 7
    close(encode(nonsense), made)


def test_the_box_of_points_without_extent_has_scale_1(encoded):
    one = given()
    one["positions"][:] = [3, 4, 5]
    made = export.load_exported(encoded)(one)
    np.testing.assert_array_equal(made["centre"], [3, 4, 5])
    assert made["scale"] == 1
    assert np.isfinite(made["scene"]["volume"]).all()


def test_quality_and_reach_are_part_of_what_is_exported(rendered, expected):
    volume, camera, picture = expected
    draft = export.export_render(tiny_viewer.model(), resolution=SIZE, quality="draft", reach=volume.reach)
    handle = tiny_viewer.model().render(volume, camera, "draft")
    inputs = jax.tree.map(np.asarray, to_state_dict(volume)), arrays(camera)
    del inputs[1]["height"], inputs[1]["width"]
    close(export.load_exported(draft)(*inputs)["image"], handle.image, atol=1e-5)
    close(export.load_exported(rendered)(*inputs)["image"], picture.image, atol=1e-5)
    assert np.abs(np.asarray(handle.image) - np.asarray(picture.image)).max() > 1e-3


def test_one_export_may_serve_several_platforms_and_says_which_and_what_it_takes():
    both = export.export_encode(tiny_viewer.model(), num_points=64, platforms=("cpu", "cuda"))
    said = export.signature(both)
    assert said["platforms"] == ["cpu", "cuda"]
    assert said["inputs"] == [
        {
            "positions": {"shape": [64, 3], "dtype": "float32"},
            "base_color": {"shape": [64, 3], "dtype": "float32"},
            "roughness": {"shape": [64], "dtype": "float32"},
            "metallic": {"shape": [64], "dtype": "float32"},
            "mask": {"shape": [64], "dtype": "bool"},
        }
    ]
    assert said["outputs"]["scale"] == {"shape": [], "dtype": "float32"}
    assert export.stablehlo(both).startswith(b"ML\xefR"), "MLIR's bytecode"


def test_another_size_than_the_buckets_is_refused(encoded):
    with pytest.raises(ValueError, match="64"):
        export.load_exported(encoded)({name: value[:64] for name, value in given().items()})


def test_the_command_writes_both_functions_their_stablehlo_and_what_they_take(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)  # it would write to the home folder
    cli.run(cli.Export(run=tiny_untrained.run(), out=tmp_path, num_points=64, resolution=SIZE))
    assert str(tmp_path) in capsys.readouterr().out
    names = {"weights.npz", "encode.jax", "encode.stablehlo", "render.jax", "render.stablehlo", "export.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    said = json.loads((tmp_path / "export.json").read_text())
    assert said["encode"]["outputs"] == said["render"]["inputs"][0], "the volume goes from one to the other"
    assert said["render"]["outputs"]["image"]["shape"] == [SIZE, SIZE, 3]
    assert said["render"] == export.signature((tmp_path / "render.jax").read_bytes())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda model: export.export_encode(model, num_points=0), "num_points must be at least 1, got 0"),
        (lambda model: export.export_render(model, resolution=18), "multiple of 4 of at least 16, got 18"),
        (lambda model: export.export_render(model, reach=0), "reach must be 1 to 4 voxels, got 0"),
        (lambda model: export.load_exported(b"PK\x03\x04 a zip"), "not a function that JAX exported"),
    ],
)
def test_what_cannot_be_exported_or_loaded_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as refused:
        make(tiny_viewer.model())
    assert "\n" not in str(refused.value)
