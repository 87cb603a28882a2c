"""What splats and meshes lose: the whole study on one ball, and each thing that it compares of known pictures."""

import json

import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels
from support.tiny_runs import goes_on

from data_gen.render.variant import LLVM, SCALAR, choose_variant
from experiments.comparison.object_views import at, on_white
from experiments.studies import splat_quality
from spnr_jax.errors import UserError
from spnr_jax.formats.mesh.assets import Asset, Material, Part
from spnr_jax.kernels.cloud_arrays import plain_cloud

NAME = "ball_000000"
SETTINGS = {"resolution": tiny_surfels.SIZE, "fov": 40.0, "spp": 4, "max_depth": 3}


@pytest.fixture
def folder(tmp_path):
    """One ball with what dataset.json says of its light and cameras."""
    found = tiny_dataset.write_dataset(tmp_path / "set", {"train": (), "val": (), "test": (NAME,)}, tiny_surfels.SIZE)
    described = {"settings": SETTINGS, "environment_map": {"name": "procedural room", "sha256": None}}
    content = json.loads((found / "dataset.json").read_text()) | described
    (found / "dataset.json").write_text(json.dumps(content))
    return found


@pytest.mark.ci
def test_the_study_scores_every_method_at_every_size_and_goes_on_where_it_stopped(folder, tmp_path):
    pytest.importorskip("mitsuba")
    if choose_variant()[0] != LLVM:
        pytest.skip("needs an LLVM library that Mitsuba's compiled variant works with")
    options = splat_quality.SplatStudy(
        data=folder,
        out=tmp_path / "out",
        run=str(tiny_surfels.run()),
        sizes=(tiny_surfels.SIZE // 2, tiny_surfels.SIZE),
        views=2,
        seconds=(0.5, 1.0),
        step_seconds=0.5,
        fitting_views=6,
        fitting_resolution=tiny_surfels.SIZE,
        spp=2,
    )
    splat_quality.main(options)
    row = json.loads((tmp_path / "out" / "results.json").read_text())["objects"][NAME]
    for method in options.methods:
        for size in options.sizes:
            assert np.isfinite([row[f"{method}, {size}"][score] for score in ("psnr", "inside")]).all()
    assert row[f"network, {tiny_surfels.SIZE}"]["network"] == 100
    for seconds, steps in (("0.5", 1), ("1", 2)):
        made = row[f"splats, {seconds} s, made"]
        assert made["steps"] == steps, "of half a second each"
        assert 0 < made["splats"] <= options.most
    assert (tmp_path / "out" / "gallery.png").is_file()
    goes_on(splat_quality.main, options)


@pytest.mark.ci
def test_without_the_compiled_variant_the_study_says_so_and_writes_nothing(folder, tmp_path, monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(splat_quality, "choose_variant", lambda: (SCALAR, None))
    with pytest.raises(UserError, match="install LLVM 17 or newer"):
        splat_quality.main(splat_quality.SplatStudy(data=folder, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def red_square() -> Asset:
    """A red square, of one material, half as wide as what a camera at three sees."""
    positions = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    red = Material(base_color=np.float32([0.8, 0.05, 0.05]), roughness=np.float32(1), metallic=np.float32(0))
    return Asset(parts=(Part(positions=positions, faces=np.array([[0, 1, 2], [0, 2, 3]]), material=red),))


def test_a_mesh_is_drawn_from_the_objects_cameras_in_the_light_of_the_data_set(folder):
    pytest.importorskip("mitsuba")
    from experiments.comparison import poisson
    from spnr_jax.formats import data_sets

    dataset = data_sets.open_dataset(folder)
    item = data_sets.read_object(dataset, NAME)
    drawn = poisson.Renderer(dataset.settings, variant="scalar_rgb").drawn(red_square(), item)
    size = tiny_surfels.SIZE
    assert drawn.shape == item.images.shape
    front = drawn[0]  # this camera looks along -z
    width = 1 / 3 / (2 * np.tan(np.deg2rad(20)))
    assert (front[..., 3] > 127).mean() == pytest.approx(width**2, abs=3 / size)
    red, green, _, _ = front[size // 2, size // 2].astype(int)
    assert red > green + 40
    assert front[0, 0, 3] == 0


def test_pictures_become_smaller_as_the_references_do():
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[:2, :2] = 255, 0, 0, 255
    rgba[0, 2] = 0, 0, 255, 255  # a quarter of the next square
    image, opacity = on_white(at(rgba, 2))
    np.testing.assert_allclose(opacity, [[1, 0.25], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(image[0, 0], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(image[0, 1], [0.75, 0.75, 1], atol=1e-5)
    np.testing.assert_allclose(image[1], 1, atol=1e-5)


def test_an_object_without_a_surface_has_no_mesh_and_the_reason(monkeypatch):
    def nothing(*_):
        raise UserError("no surface to write as a mesh")

    monkeypatch.setattr(splat_quality.fused_surface, "solidity", nothing)
    asset, found = splat_quality._meshed([], None, plain_cloud(np.zeros((1, 3), np.float32)))
    assert asset is None
    assert found["empty"] == "no surface to write as a mesh"
    assert found["faces"] == 0
