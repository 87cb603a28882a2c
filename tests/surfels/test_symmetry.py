"""Points of symmetric clouds reflected in the planes of symmetry (`surfels/symmetry.py`)."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.laws import close
from support.surfel_clouds import cloud

from spnr_jax.kernels.cloud_arrays import farthest_points, pad
from spnr_jax.surfels import symmetry
from spnr_jax.surfels.neighbors import measure_evenness, neighbors

DEEP = 0.35  # half the depth of the seat
BACK = np.array([0.0, 0.35, -DEEP + 0.05])
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
LEAN = np.array([0.1, -0.05, 0.02])  # where the turned chair stands


def box(middle, half, count, rng):
    """Random points of a box's surface, and their normals."""
    half = np.asarray(half)
    areas = np.repeat(half.prod() / half, 2)
    side = rng.choice(6, count, p=areas / areas.sum())
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), side // 2] = np.where(side % 2, 1, -1)
    normals = np.zeros((count, 3))
    normals[np.arange(count), side // 2] = points[np.arange(count), side // 2]
    return points * half + middle, normals


def chair(seed: int = 0, lamp: bool = False):
    """Random points of a chair that is symmetric in x, with a lamp on one side where asked, and their normals."""
    rng = np.random.default_rng(seed)
    boxes = [([0, 0, 0], [0.35, 0.03, DEEP], 20000), (BACK, [0.35, 0.3, 0.03], 20000)]
    boxes += [([x, -0.3, z], [0.03, 0.3, 0.03], 4000) for x in (-0.3, 0.3) for z in (-0.3, 0.3)]
    boxes += [([0.3, 0.3, 0.25], [0.1, 0.27, 0.1], 9000)] * lamp
    parts = [box(*one, rng) for one in boxes]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def sparse(points, count=1000, spread="even", **columns):
    """Even or random points of a dense cloud, as a cloud; columns (points, ...) likewise."""
    chosen = farthest_points(points.astype(np.float32), count, 0) if spread == "even" else slice(count)
    chosen = np.arange(len(points))[chosen]
    return cloud(points[chosen], **{name: values[chosen] for name, values in columns.items()}), chosen


def surface_of(one) -> symmetry.Surface:
    return symmetry.measure_surface(one, symmetry.choose_limits(evenness_of(one), one.normals is not None))


def evenness_of(one) -> float:
    return float(measure_evenness(one, neighbors(one)))


def stays_as_it_is(one) -> bool:
    """Whether nothing is reflected: the same arrays, but for what is said of them."""
    more = symmetry.complete(one)
    return all(values is getattr(more, name) for name, values in vars(one).items() if name != "evenness")


def spacing_of(one) -> float:
    return surface_of(one).spacing


@pytest.mark.parametrize(("spread", "expected"), [("even", 0.77), ("random", 0.53)])
def test_the_evenness_is_that_of_the_program_in_any_units_and_kept_beside_added_points(spread, expected):
    one, _ = sparse(chair()[0], spread=spread)
    found = evenness_of(one)
    assert abs(found - expected) < 0.05
    for scale in (1e-4, 1.0, 1e4):
        padded = pad(dataclasses.replace(one, positions=scale * one.positions), 1024)
        close(measure_evenness(padded, jnp.asarray(neighbors(padded))), found, rtol=1e-4)
    more = symmetry.complete(one)
    assert len(more.mask) > len(one.mask)
    close(evenness_of(more), found)
    assert abs(evenness_of(dataclasses.replace(more, evenness=None)) - found) > 0.03


@pytest.mark.parametrize(("count", "off"), [(1000, 0.05), (300, 0.15)])
def test_the_plane_of_a_turned_chair_is_found(count, off):
    points, _ = chair()
    one, _ = sparse(points @ TURN.T + LEAN, count)
    plane = symmetry.find_planes(surface_of(one))[0]
    true = TURN[:, 0]
    position = np.asarray(one.positions, float)
    wrong = [
        position - 2 * (position @ n - d)[:, None] * n for n, d in ((plane.normal, plane.offset), (true, true @ LEAN))
    ]
    assert np.sqrt(np.mean(np.sum((wrong[0] - wrong[1]) ** 2, axis=1))) < off * spacing_of(one)


def test_reflected_points_lie_on_the_surface_between_the_measured_ones():
    points, _ = chair()
    one, _ = sparse(points)
    both = symmetry.complete(one)
    assert 1450 < len(both.mask) < 2001
    assert both.mask.all()
    np.testing.assert_array_equal(both.positions[:1000], one.positions)
    spacing = spacing_of(one)
    dense = cKDTree(points)
    assert np.quantile(dense.query(both.positions[1000:])[0], 0.98) < 0.2 * spacing
    gap = cKDTree(one.positions).query(both.positions[1000:])[0]
    assert 0.29 * spacing < gap.min()
    assert gap.max() < 0.81 * spacing


def test_what_stands_on_one_side_alone_is_not_copied():
    points, _ = chair(lamp=True)
    one, _ = sparse(points)
    more = symmetry.complete(one).positions[1000:]
    assert len(more) > 400
    beside = (more[:, 0] < -0.15) & (more[:, 1] > 0.15) & (more[:, 2] > 0.1)
    assert not beside.any()


def test_normals_are_reflected():
    points, normals = chair()
    one, chosen = sparse(points, normals=normals)
    both = symmetry.complete(one)
    nearest = cKDTree(points).query(both.positions[1000:])[1]
    cosine = np.sum(both.normals[1000:] * normals[nearest], axis=1)
    assert np.mean(cosine > 0.99) > 0.9  # at edges the nearest true point may lie on another face
    np.testing.assert_array_equal(both.normals[:1000], normals[chosen].astype(np.float32))


def test_no_color_is_copied_to_where_there_is_another():
    points, _ = chair()
    color = np.where(points[:, :1] > 0.1, [0.8, 0.05, 0.05], [0.05, 0.05, 0.8])  # blue from the middle to 0.1
    one, _ = sparse(points, base_color=color)
    more = symmetry.complete(one)
    position, reddish = more.positions[1000:], more.base_color[1000:, 0] > 0.4
    assert not reddish.any()
    assert (np.abs(position[:, 0]) < 0.1 + spacing_of(one)).all()
    assert len(position) > 50


def test_a_pattern_that_is_symmetric_comes_with_its_points():
    points, _ = chair()
    color = np.where((np.abs(points[:, :1]) * 5) % 1 > 0.5, 0.9, 0.1) * np.ones(3)
    one, _ = sparse(points, base_color=color)
    both = symmetry.complete(one)
    assert len(both.mask) > 1400
    expected = np.where((np.abs(both.positions[1000:, :1].astype(float)) * 5) % 1 > 0.5, 0.9, 0.1)[:, 0]
    assert np.mean(np.abs(both.base_color[1000:, 0] - expected) < 0.01) > 0.95


def test_two_planes_bring_points_of_all_quarters():
    rng = np.random.default_rng(0)
    points = box([0, 0, 0], [0.5, 0.3, 0.2], 20000, rng)[0]
    one, _ = sparse(points)
    both = symmetry.complete(one)
    assert len(both.mask) > 2300
    distance = np.abs(np.max(np.abs(both.positions) / [0.5, 0.3, 0.2], axis=1) - 1)
    assert np.quantile(distance, 0.98) < 0.1


@pytest.mark.parametrize("spread", ["even", "random"])
def test_a_cloud_without_symmetry_stays_as_it_is(spread):
    rng = np.random.default_rng(0)
    parts = [
        box(rng.uniform(-0.5, 0.5, 3), rng.uniform(0.05, 0.3, 3), 8000, rng)[0]
        @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        for _ in range(5)
    ]
    one, _ = sparse(rng.permutation(np.concatenate(parts)), spread=spread)
    assert stays_as_it_is(one)


def test_a_plate_is_not_reflected_in_its_middle():
    rng = np.random.default_rng(0)
    inside = rng.uniform(size=(1000, 2))
    inside = np.where(inside.sum(axis=1, keepdims=True) > 1, 1 - inside, inside) * [1.5, 0.7]  # a scalene triangle
    one = cloud(np.concatenate([inside, rng.choice([-0.005, 0.005], (1000, 1))], axis=1) - [0.5, 0.25, 0])
    assert 0.5 * spacing_of(one) > 0.01
    assert stays_as_it_is(one)


@pytest.mark.parametrize("spread", ["each side evenly", "random"])
def test_a_plate_is_reflected_across_and_not_in_its_middle(spread):
    rng = np.random.default_rng(0)
    side = rng.choice([-1, 1], (9000, 1))
    points, normals = (
        np.concatenate([rng.uniform(size=(9000, 2)) * [1.5, 0.7], 0.005 * side], axis=1),
        side * [0, 0, 1.0],
    )
    kept = farthest_points(points, 1000, 0, normals)
    one = cloud(points[:1000]) if spread == "random" else cloud(points[kept], normals=normals[kept])
    surface = surface_of(one)
    assert 0.5 * surface.spacing > 0.01
    planes = symmetry.find_planes(surface)
    assert planes  # across the rectangle
    assert all(abs(plane.normal[2]) < 0.1 for plane in planes)


def test_reflected_points_fill_the_gaps_of_random_ones():
    points = np.random.default_rng(1).permutation(chair()[0])
    one, _ = sparse(points, 1000, "random")
    both, spacing = symmetry.complete(one), spacing_of(one)
    assert len(both.mask) > 1200
    assert np.quantile(cKDTree(points).query(both.positions[1000:])[0], 0.95) < 0.35 * spacing
    apart = cKDTree(both.positions).query(both.positions[1000:], 2)[0][:, 1]
    assert apart.min() > 0.44 * spacing
    before, after = (np.quantile(cKDTree(x.positions).query(points)[0], 0.98) for x in (one, both))
    assert after < 0.8 * before


def test_spaced_points_leave_no_room_for_others():
    rng = np.random.default_rng(0)
    position, distance = rng.uniform(-1, 1, (500, 3)), rng.uniform(size=500)
    kept = symmetry.space_out(position, distance, 0.3)
    assert np.argmax(distance) in kept
    assert cKDTree(position[kept]).query(position[kept], 2)[0][:, 1].min() >= 0.3
    assert cKDTree(position[kept]).query(position)[0].max() <= 0.3
    assert len(symmetry.space_out(position[:0], distance[:0], 0.3)) == 0


@pytest.mark.parametrize(
    ("count", "spread", "stays"),
    [
        (symmetry.FEWEST_POINTS - 1, "even", True),
        (symmetry.EVENLY_SPREAD.most_points, "even", False),
        (symmetry.EVENLY_SPREAD.most_points + 1, "even", True),
        (symmetry.RANDOM.most_points, "random", False),
        (symmetry.RANDOM.most_points + 1, "random", True),
    ],
)
def test_very_few_and_many_points_stay_as_they_are(count, spread, stays):
    one, _ = sparse(np.random.default_rng(0).permutation(chair()[0]), count, spread)
    assert stays_as_it_is(one) == stays


@pytest.mark.parametrize("case", ["line", "plane", "place", "no normals", "helix"])
def test_degenerate_clouds_stay_finite(case):
    rng = np.random.default_rng(0)
    along = rng.uniform(-1, 1, (400, 1))
    points = {
        "line": along * [1, 0, 0],
        "plane": rng.uniform(-1, 1, (400, 3)) * [1, 1, 0],
        "place": 1e-7 * rng.normal(size=(400, 3)),
        "no normals": chair()[0][:400],
        "helix": np.concatenate([np.cos(9 * along), np.sin(9 * along), along], axis=1),
    }[case]
    columns = {"normals": np.zeros((400, 3))} if case == "no normals" else {}
    both = symmetry.complete(cloud(points, **columns))
    for field in dataclasses.fields(both):
        values = getattr(both, field.name)
        assert values is None or (np.isfinite(values).all() and len(values) == len(both.mask))
