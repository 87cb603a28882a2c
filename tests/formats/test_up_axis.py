"""An object is found upright, turned as it may be; formats that say which way is up are believed."""

from pathlib import Path

import numpy as np

from spnr_jax.formats.orientation import ROTATIONS, find_up, standing


def table() -> np.ndarray:
    """Points of a table, y up: a plate on four legs."""
    rng = np.random.default_rng(0)
    plate = rng.uniform([-1, 0.98, -0.6], [1, 1, 0.6], (800, 3))
    corners = np.array([[-0.9, 0, -0.5], [0.9, 0, -0.5], [-0.9, 0, 0.5], [0.9, 0, 0.5]])
    legs = corners[np.arange(400) % 4] + rng.uniform([-0.05, 0, -0.05], [0.05, 1, 0.05], (400, 3))
    return np.concatenate([plate, legs])


def cone() -> np.ndarray:
    """Points of a cone that stands on its base, y up."""
    rng = np.random.default_rng(1)
    height, angle = 1 - np.sqrt(rng.uniform(size=900)), rng.uniform(0, 2 * np.pi, 900)
    radius = np.where(np.arange(900) % 3, 1 - height, np.sqrt(rng.uniform(size=900)))
    height = np.where(np.arange(900) % 3, height, 0)
    return np.stack([radius * np.cos(angle), 2 * height, radius * np.sin(angle)], axis=-1)


def test_what_stands_is_found_upright_whether_the_file_is_y_up_or_z_up():
    for positions in (table(), cone()):
        for up in "yz":
            assert find_up(positions @ np.array(ROTATIONS[up]), Path("a.ply"))[0] == up


def test_the_size_and_place_of_the_object_do_not_matter():
    for axis in range(3):
        np.testing.assert_allclose(standing(table() * 1e5 + [3e5, 0, 7e5], axis), standing(table(), axis), atol=1e-6)


def test_formats_that_define_their_axes_are_believed():
    lying = table() @ np.array(ROTATIONS["z"])
    assert [find_up(lying, Path(name))[0] for name in ("a.glb", "A.GLTF", "a.las", "a.laz")] == ["y", "y", "z", "z"]


def test_points_on_a_line_or_alone_are_y_up():
    for positions in (np.zeros((1, 3)), np.linspace([0, 0, 0], [1, 2, 3], 50), np.ones((9, 3))):
        assert find_up(positions, Path("a.xyz"))[0] == "y"
