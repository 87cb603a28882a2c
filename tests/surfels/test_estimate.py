"""Surfels of bodies whose normals, spacing and colours are known."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.laws import close
from support.surfel_clouds import estimate, even_square, shape, tangents

from spnr_jax.kernels.cloud_arrays import farthest_points
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.surfels.splatting import RADIUS

CASES = [
    ("plane", 1024, "random", 1), ("sphere", 256, "even", 2), ("sphere", 256, "random", 10),
    ("sphere", 4096, "even", 1), ("sphere", 4096, "random", 3), ("rod", 1024, "random", 10),
]  # fmt: skip


@pytest.mark.parametrize(("name", "count", "spread", "degrees"), CASES)
def test_normals_point_outward_within_degrees_and_the_spacing_is_the_root_of_the_area_per_point(
    name, count, spread, degrees
):
    positions, normals, spacing = shape(name, count, spread)
    found = estimate(positions)
    cosine = np.sum(found.normal * normals, axis=1)
    if name == "plane":
        assert found.one_sided.max() < 0.05  # both of its sides are seen alike
        cosine = np.abs(cosine)
    else:
        assert np.mean(found.one_sided > 0.95) > 0.99
        assert np.mean(cosine > 0) > 0.995
    assert np.rad2deg(np.arccos(np.clip(np.quantile(cosine, 0.1), -1, 1))) < degrees
    ratio = found.spacing / spacing
    assert 0.75 < np.median(ratio) < 1.25
    assert np.mean((ratio > 0.75) & (ratio < 1.25)) > (0.98 if spread == "even" else 0.75)  # wider beside gaps


def test_the_spacing_on_a_thin_leg_is_at_most_a_fifth_above_that_by_all_neighbors():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 8000), rng.uniform(-0.9, 0.9, 8000)
    dense = np.stack([0.03 * np.cos(angle), height, 0.03 * np.sin(angle)], axis=1)
    positions = dense[farthest_points(dense, 200, 0)]
    by_all = np.sqrt(np.pi / 6) * cKDTree(positions).query(positions, 7)[0][:, 6]
    assert 1.1 < np.median(estimate(positions).spacing / by_all) < 1.2  # 1.43 by the neighbors of a layer alone


@pytest.mark.parametrize(("evenness", "low", "high"), [(None, 0.95, 1.1), (0.5, 1.3, 1.6)])
def test_discs_are_enlarged_beside_a_gap_if_the_points_were_random_and_leave_a_hole_if_even(evenness, low, high):
    positions, _, spacing = shape("plane", 1024, "even")
    away = np.linalg.norm(positions, axis=1) / spacing
    outside = away > 1.6
    told = None if evenness is None else np.full(outside.sum(), evenness)
    found = estimate(positions[outside], evenness=told).spacing
    assert low < found[away[outside] < 2.4].mean() / np.median(found) < high


def test_the_shape_is_0_in_a_plane_and_on_a_line():
    planarity, linearity = estimate(shape("plane", 600)[0]).shape_ratios.T
    assert planarity.max() < 0.01
    assert np.quantile(linearity, 0.1) > 0.5
    line = np.linspace(-0.9, 0.9, 300)[:, None] * [0.6, 0, 0.8]
    assert estimate(line).shape_ratios[:, 1].max() < 0.01


def test_the_block_of_a_point_and_its_order_among_others_change_nothing():
    positions, _, _ = shape("sphere", 700, "random")
    color = 0.5 + 0.5 * positions
    whole = estimate(positions, color)
    shuffled = vars(estimate(positions, color, order=np.random.default_rng(3).permutation(4096)[:700]))
    for name, values in vars(whole).items():
        off = np.abs(shuffled[name] - values * 1.0).reshape(len(positions), -1).max(axis=1)
        # a visible cell's border is a border: rounding of a normal may move a lifted point over it
        assert np.mean(off > 1e-3 * max(np.abs(values).max(), 1)) < 0.01, name


def test_normals_that_are_given_are_kept_and_those_of_the_wrong_sign_turned():
    positions, normals, _ = shape("sphere", 800)
    tilted = normals + 0.1 * tangents(normals)[0]
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    wrong = np.random.default_rng(1).uniform(size=(800, 1)) < 0.3
    found = estimate(positions, normals=np.where(wrong, -3 * tilted, 3 * tilted))
    close(found.normal, tilted, atol=1e-5)
    close(found.one_sided, 1 - CONSTANTS.back_weight, atol=1e-6)  # a little weight from behind


def test_a_normal_given_on_a_sheet_keeps_its_sign():
    positions, normals, _ = shape("plane", 500)
    close(estimate(positions, normals=normals).normal, normals, atol=1e-5)
    close(estimate(positions, normals=-normals).normal, -normals, atol=1e-5)


def cube(count):
    """Points, normals and spacing of a cube of side 1."""
    faces = [(axis, sign) for axis in range(3) for sign in (-1, 1)]
    positions = [np.insert(0.5 * even_square(count), axis, 0.5 * sign, axis=1) for axis, sign in faces]
    normals = np.repeat([sign * np.eye(3)[axis] for axis, sign in faces], count, axis=0)
    return np.float32(np.concatenate(positions)), np.float32(normals), count**-0.5


def ends(found, count):
    """Where each disc ends in its four directions (points, 4, 3), and how far from the point, in spacings."""
    rim = found.rim_tangent[:count]
    side = np.cross(found.normal[:count], rim)
    ways = np.stack([rim, -rim, side, -side], axis=1)
    reach = np.minimum(found.rim_distances[:count], RADIUS)[..., None]
    return found.position[:count, None] + ways * reach * found.spacing[:count, None, None], reach[..., 0]


@pytest.mark.parametrize(("known", "share"), [(True, 0.99), (False, 0.95)])
def test_discs_end_where_the_faces_of_a_cube_meet(known, share):
    positions, normals, spacing = cube(500)
    found = estimate(positions, normals=normals if known else None)
    places, reach = ends(found, len(positions))
    beyond = (np.abs(places).max(axis=(1, 2)) - 0.5) / spacing
    assert np.mean(beyond < CONSTANTS.cut_margin + 0.15) > share
    cut_margin = (
        np.sort(np.abs(positions), axis=1)[:, 1] > 0.5 - 0.5 * spacing
    )  # near an edge: cut there, and not sooner
    assert np.mean(beyond[cut_margin] > -0.2) > share
    assert np.median(reach[np.sort(np.abs(positions), axis=1)[:, 1] < 0.3]) == pytest.approx(RADIUS, abs=0.2)


def test_discs_of_a_sheet_end_a_little_beyond_its_last_points():
    positions, normals, spacing = shape("plane", 900)
    found = estimate(positions, normals=normals)
    first, second = np.array([0.8, 0, -0.6]), np.array([-0.36, 0.8, -0.48])
    places, _ = ends(found, 900)
    beyond = (np.abs(np.stack([places @ first, places @ second])).max(axis=(0, 2)) - 0.6) / spacing
    assert np.quantile(beyond, 0.99) < 0.6
    assert beyond.max() > 0


@pytest.mark.parametrize("thickness", [0.2, 0.5, 1.0])
def test_the_sides_of_a_thin_wall_face_away_from_each_other_and_keep_their_colours(thickness):
    """Thinner than what the directions that see a point can tell apart; thickness in spacings of a side."""
    u, v = 0.6 * even_square(1500).T
    spacing = 1.2 / np.sqrt(1500)
    sign = np.where(np.arange(3000) < 1500, 1.0, -1.0)
    u, v = np.concatenate([u, v]), np.concatenate([v, u])
    positions = np.stack([u, 0.5 * thickness * spacing * sign, v], axis=1)
    color = np.where(sign[:, None] > 0, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9])
    found = estimate(positions, color)
    inner = np.hypot(u, v) < 0.5
    assert np.mean(found.normal[inner, 1] * sign[inner] > 0.9) > 0.97
    assert np.mean(np.abs(found.color_jump[inner]).max(axis=1) < 0.1) > 0.97
