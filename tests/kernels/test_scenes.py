import numpy as np
import pytest
from support.surfel_clouds import even_square

from spnr_jax.kernels import scenes
from spnr_jax.surfels.sides import spiral

BALLS = {0: ((-1.0, 0.5, 0.0), 4000), 1: ((0.6, 0.5, 0.9), 3000), 2: ((0.9, 0.5, -1.0), 2000)}  # on a table
TABLE = 20000


def table_scene(tilt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of three balls above a table at y = 0, shuffled; of which each is: 0, 1, 2, the table 3."""
    parts = [0.2 * spiral(count) + place for place, count in BALLS.values()]
    parts.append(np.insert(3 * even_square(TABLE), 1, 0, axis=1))
    positions, part = np.concatenate(parts), np.repeat(np.arange(4), [*(count for _, count in BALLS.values()), TABLE])
    turn = np.array([[np.cos(tilt), -np.sin(tilt), 0], [np.sin(tilt), np.cos(tilt), 0], [0, 0, 1]])
    order = np.random.default_rng(0).permutation(len(part))
    return (positions @ turn.T)[order], part[order]


@pytest.mark.parametrize("tilt", [0.0, 0.4])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_dominant_plane_is_the_table_and_takes_its_noise_along(tilt, noise):
    positions, part = table_scene(tilt)
    positions = positions + noise * np.random.default_rng(1).normal(size=positions.shape)
    plane = scenes.find_dominant_plane(positions)
    np.testing.assert_allclose(abs(plane.normal @ [-np.sin(tilt), np.cos(tilt), 0]), 1, atol=1e-3)
    held = plane.holds(positions)
    assert held[part == 3].mean() > 0.99
    assert not held[part < 3].any()
    assert plane.thickness < 0.1  # spacings of the table: 0.04


def test_clusters_are_numbered_by_their_size_and_do_not_depend_on_the_order_of_the_points():
    positions, part = table_scene()
    positions, part = positions[part < 3], part[part < 3]
    labels = scenes.find_clusters(positions)
    np.testing.assert_array_equal(labels, part)
    turned = np.random.default_rng(3).permutation(len(part))
    np.testing.assert_array_equal(scenes.find_clusters(positions[turned]), labels[turned])


def test_clusters_are_those_of_a_plain_loop_over_voxels():
    positions = np.random.default_rng(0).uniform(-1, 1, (150, 3))
    cells = {tuple(cell) for cell in np.floor((positions - positions.min(axis=0)) / 0.2).astype(int)}
    names = dict.fromkeys(cells, -1)
    for start in sorted(cells):
        reached = [start] if names[start] < 0 else []
        while reached:
            cell = reached.pop()
            names[cell] = max(names[cell], sorted(cells).index(start))
            reached += [c for c in cells if names[c] < 0 and max(abs(np.subtract(c, cell))) < 2 and c not in reached]
    expected = [names[tuple(c)] for c in np.floor((positions - positions.min(axis=0)) / 0.2).astype(int)]
    labels = scenes.find_clusters(positions, 0.2)
    pairs = set(zip(labels.tolist(), expected, strict=True))
    assert len(pairs) == len(set(labels.tolist())) == len(set(expected)) > 3


@pytest.mark.parametrize("nth", [1, 2, 3])
def test_what_stands_on_the_table_is_cut_out_ball_by_ball(nth):
    positions, part = table_scene(0.2)
    rows, said = object_of(positions, nth=nth)
    np.testing.assert_array_equal(part[rows], np.full(BALLS[nth - 1][1], nth - 1))
    assert [line.split(":")[0] for line in said] == ["--remove-plane", "--object"]


def object_of(positions, nth=None):
    """Rows of what is left without the dominant plane, or of one cluster of it."""
    return scenes.select_object(positions, np.zeros(3), remove_plane=True, nth=nth, seed=0)


def test_a_box_holds_what_lies_on_its_borders():
    inside = scenes.is_inside(np.array([[0.0, 0, 0], [1, 1, 1], [2, 0, 0]]), (0, 0, 0, 1, 1, 1))
    np.testing.assert_array_equal(inside, np.array([True, True, False]))


def test_a_step_that_leaves_nothing_is_named():
    positions, part = table_scene()
    for given, nth, message in (
        (positions, 4, r"--object 4: there are 3 clusters"),
        (positions[part == 3], None, r"--remove-plane: all of the 20,000 points"),
        (spiral(20000), None, r"--remove-plane: no plane holds 10% of the surface"),
    ):
        with pytest.raises(ValueError, match=message):
            object_of(given, nth)


@pytest.mark.parametrize("count", [1, 2, 3, 50])
@pytest.mark.parametrize("size", [0.0, 1e-35, 1e30])
def test_few_points_of_any_size_have_clusters_and_perhaps_a_plane(count, size):
    positions = size * np.random.default_rng(count).normal(size=(count, 3))
    labels = scenes.find_clusters(positions)
    assert sorted(set(labels.tolist())) == list(range(labels.max() + 1))
    plane = scenes.find_dominant_plane(positions)
    assert plane is None or np.isfinite(plane.normal).all()


def test_a_point_at_the_end_of_the_world_is_a_cluster_of_its_own():
    labels = scenes.find_clusters(np.concatenate([[[1e35, 0, 0]], spiral(5000)]))
    np.testing.assert_array_equal(labels, np.arange(5001) == 0)
