"""Columns under any name in common use mean the same, in any range, and what is assumed is said."""

import numpy as np
import pytest

from spnr_jax.formats.columns import keep_visible, materials, useful

POSITION = {axis: np.zeros(2) for axis in "xyz"}
LEVEL = 0.2140411  # linear value of sRGB 0.5


def read(**columns):
    """Materials of two points with the columns, and what was reported."""
    lines: list[str] = []
    return materials(useful(POSITION | {name: np.asarray(v) for name, v in columns.items()}), lines.append), lines


@pytest.mark.parametrize(
    "names",
    [
        "red green blue",
        "r g b",
        "diffuse_red diffuse_green diffuse_blue",
        "rf gf bf",
        "color_red color_green color_blue",
    ],
)
def test_srgb_colours_have_many_names(names):
    values, lines = read(**{name: [0.5, 1.0] for name in names.split()})
    np.testing.assert_allclose(values["base_color"], [[LEVEL] * 3, [1.0] * 3], rtol=1e-5)
    assert lines[0] == "red green blue taken as sRGB in 0..1"


@pytest.mark.parametrize("names", ["base_color_r base_color_g base_color_b", "albedo_r albedo_g albedo_b"])
def test_base_colours_are_linear(names):
    values, _ = read(**{name: [0.5, 1.0] for name in names.split()}, red=[0, 0], green=[0, 0], blue=[0, 0])
    np.testing.assert_array_equal(values["base_color"], [[0.5] * 3, [1.0] * 3])


@pytest.mark.parametrize("rough", ["roughness", "scalar_roughness", "pbr_roughness"])
@pytest.mark.parametrize("metal", ["metallic", "metalness", "scalar_metallic"])
def test_roughness_and_metallic_have_many_names_and_whole_bytes(rough, metal):
    values, _ = read(**{rough: np.array([0, 255], np.uint8), metal: [0.25, 0.75]})
    np.testing.assert_array_equal(values["roughness"], [0, 1])
    np.testing.assert_array_equal(values["metallic"], [0.25, 0.75])


INTENSITY_SHOWN = "no colour in the file: intensity 100..298 shown as grey"


def test_intensity_is_grey_where_there_is_no_colour_and_unused_where_there_is():
    values, lines = read(scalar_intensity=[100, 300])
    np.testing.assert_allclose(values["base_color"][:, 0], [0, 1])
    assert lines[0] == INTENSITY_SHOWN
    values, lines = read(intensity=[100, 300], red=[1, 1], green=[0, 0], blue=[0, 0])
    np.testing.assert_array_equal(values["base_color"], [[1, 0, 0]] * 2)
    assert read(intensity=[100, 300], red=[0, 0], green=[0, 0], blue=[0, 0])[1][0] == INTENSITY_SHOWN
    values, lines = read(intensity=[5, 5])
    assert lines[0].startswith("no base_color in the file")


def test_splats_become_points_of_their_constant_colour_and_fog_is_dropped():
    splats = {f"f_dc_{i}": np.array([0.0, 9.0]) for i in range(3)} | {"opacity": np.array([2.0, -3.0])}
    extra = {f"f_rest_{i}": np.ones(2) for i in range(45)} | {f"rot_{i}": np.ones(2) for i in range(4)}
    columns = useful(POSITION | {"x": np.array([5.0, 6.0])} | splats | extra)
    lines: list[str] = []
    columns = keep_visible(columns, keep_noise=False, report=lines.append)
    np.testing.assert_array_equal(columns["x"], [5.0])
    assert lines == ["1 of 2 points left out: opacity near 0 (--keep-noise keeps them)"]
    np.testing.assert_allclose(materials(columns, lambda line: None)["base_color"], [[LEVEL] * 3], rtol=1e-5)
