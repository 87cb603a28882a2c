"""The surface around points: planes, the points nearest to cells, and what a sample is told of them."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import close, numbers, same_bits

from spnr_jax.config import MOST_CELLS, surface_grid
from spnr_jax.kernels import surface
from spnr_jax.kernels.numerics import normalize
from spnr_jax.kernels.records import PointCloud

COUNT = 4


def ball(seed=0, points=300, objects=2):
    """Points on spheres of different size and place, one in four of them padding that says nonsense."""
    directions = normalize(numbers(seed, objects, points, 3))
    radius = jnp.linspace(0.4, 0.6, objects)[:, None, None]
    return PointCloud(
        positions=jnp.where(jnp.arange(points)[None, :, None] % 4 > 0, radius * directions + 0.1, 0.3),
        base_color=numbers(seed + 1, objects, points, 3, low=0.0),
        roughness=numbers(seed + 2, objects, points, low=0.0),
        metallic=numbers(seed + 3, objects, points, low=0.0),
        mask=jnp.broadcast_to(jnp.arange(points) % 4 > 0, (objects, points)),
    )


@partial(jax.jit, static_argnames=("count", "least"))
def estimate(cloud, count, least=1):
    return surface.estimate(cloud, count, surface_grid(cloud.mask.shape[-1], least))


neighbourhoods = jax.jit(surface.neighbourhoods)
describe = jax.jit(surface.describe)


def views(positions, seed=9):
    """Unit directions for samples, and the object of each in turn."""
    return normalize(numbers(seed, len(positions), 3)), jnp.arange(len(positions)) % 2


class TestPlanes:
    def test_the_nearest_points_are_those_of_a_sorted_list(self):
        cloud = ball()
        index, squared = surface.neighbours(cloud.positions[0], cloud.mask[0], 5)
        real = np.flatnonzero(cloud.mask[0])
        away = ((np.float64(cloud.positions[0])[:, None] - np.float64(cloud.positions[0])[real]) ** 2).sum(axis=-1)
        close(squared, np.sort(away, axis=1)[:, :5], atol=1e-6)
        same_bits(index[real], jnp.asarray(real[np.argsort(away[real], axis=1)[:, :5]], jnp.int32))

    def test_normals_of_a_ball_point_along_its_radius_and_the_spacing_is_the_distance_between_points(self):
        cloud = ball(points=2000, objects=1)
        around = neighbourhoods(cloud.positions[0], cloud.mask[0])
        normals, spacing = around.normals, around.spacing
        real, outward = np.asarray(cloud.mask[0]), normalize(cloud.positions[0] - 0.1)
        assert np.quantile(np.abs(np.sum(normals * outward, axis=1))[real], 0.01) > 0.99
        close(jnp.linalg.norm(normals, axis=1), jnp.ones(2000), atol=1e-5)
        area_of_a_point = 4 * math.pi * 0.4**2 / 1500
        assert 0.6 < np.median(spacing[real]) / math.sqrt(area_of_a_point) < 1.0

    @pytest.mark.parametrize(
        ("extent", "flat", "narrow"),
        [((1, 1, 1), False, False), ((1, 1, 0), True, False), ((1, 1e-3, 1e-3), False, True)],
    )
    def test_a_plane_is_flat_and_a_stick_narrow(self, extent, flat, narrow):
        points = 0.9 * numbers(5, 512, 3) * jnp.array([extent])
        flatness, narrowness = np.median(neighbourhoods(points, jnp.ones(512, bool)).ratios, axis=0)
        assert (flatness < 0.1) == flat
        assert (narrowness < 0.35) == narrow

    def test_the_way_to_the_middle_of_the_neighbours_leads_inwards_at_a_rim_and_nowhere_inside(self):
        rows = jnp.linspace(-0.5, 0.5, 21)
        square = jnp.stack([*jnp.meshgrid(rows, rows, indexing="ij"), jnp.zeros((21, 21))], axis=-1)
        square = square.reshape(-1, 3) + 0.001 * numbers(7, 441, 3)
        inward = np.asarray(neighbourhoods(square, jnp.ones(441, bool)).inward)
        rim, middle = np.asarray(square[:, 0] > 0.49), np.abs(np.asarray(square[:, :2])).max(axis=1) < 0.2
        assert (inward[rim, 0] < -0.4).all()
        assert np.linalg.norm(inward[middle], axis=1).max() < 0.3

    @pytest.mark.parametrize("points", [1, 2, 3, 12])
    def test_few_points_points_on_a_line_and_points_in_one_place_have_finite_planes(self, points):
        line = jnp.arange(points)[:, None] * jnp.array([[0.1, 0.05, 0.0]])
        for positions in (line, jnp.zeros((points, 3)), 1e-30 * line):
            around = neighbourhoods(positions, jnp.arange(points) < max(points - 1, 1))
            assert all(jnp.isfinite(numbers).all() for numbers in around)
            assert (around.spacing >= surface.LEAST_SPACING).all()
            assert ((around.ratios >= 0) & (around.ratios <= 1)).all()


class TestCells:
    @pytest.mark.parametrize("resolution", [1, 5, 12])
    def test_each_cell_knows_the_nearest_of_the_points_around_it(self, resolution):
        cloud = ball()
        positions = np.array(cloud.positions[0])
        positions[7], positions[9] = (1, -1, 1), (1.5, 0, 0)
        found = np.asarray(surface.nearest_by_cell(jnp.asarray(positions), cloud.mask[0], resolution, COUNT))
        cells = [
            reference.voxel_of(p, resolution) if real else None
            for p, real in zip(positions, cloud.mask[0], strict=True)
        ]
        for cell in np.ndindex(*[resolution] * 3):
            centre = (2 * np.float64(cell[::-1]) + 1) / resolution - 1
            near = [
                (math.dist(centre, np.float64(positions[i])), i)
                for i, other in enumerate(cells)
                if other is not None and max(abs(a - b) for a, b in zip(cell, other, strict=True)) <= 1
            ]
            expected = [i for _, i in sorted(near)[:COUNT]] + [len(positions)] * max(COUNT - len(near), 0)
            assert found[cell].tolist() == expected

    @pytest.mark.parametrize("num_points", [1, 2, 1000, 8192, 8193, 10**6])
    def test_entries_are_sorted_by_cell_then_distance_then_point(self, num_points):
        generator = np.random.default_rng(0)
        rows = generator.integers(0, 40, 500).astype(np.int32) * (MOST_CELLS**3 // 39)
        away = np.float32(generator.choice([0.0, 1e-30, 0.25, 0.5, 6.75], 500))  # ties, and unlike in their first bits
        point = generator.integers(0, num_points, 500).astype(np.int32)
        found = surface.in_order(*map(jnp.asarray, (rows, away, point)), num_points)
        order = np.lexsort((point, away, rows))
        same_bits(found, (rows[order], point[order]))
        assert found[0].dtype == found[1].dtype == jnp.int32

    def test_three_by_three_cells_of_a_large_surface_hold_four_or_five_points_however_many_there_are(self):
        for points in (512, 1024, 4096):
            side = 2 * 3 / surface_grid(points)
            assert 4 < points * side**2 / 8 < 5  # 8: the area of a cube with half diagonal 1
        assert surface_grid(10**7) == MOST_CELLS
        assert [surface_grid(n, 45) for n in (1, 128, 2048, 4096)] == [45, 45, 45, 64]


class TestSamples:
    def test_a_sample_is_told_what_the_blend_over_its_cells_points_says(self):
        """Written out for one sample after the other."""
        cloud = ball()
        known = estimate(cloud, COUNT)
        positions = cloud.positions.reshape(-1, 3)[:60] + 0.03 * numbers(8, 60, 3)
        directions, objects = views(positions)
        told = jax.tree.map(np.asarray, describe(known, positions, directions, objects))
        known, positions, directions = jax.tree.map(np.asarray, (known, positions, directions))
        for s in range(60):
            rows, near = np.float64(known.points[s % 2]), known.nearest[s % 2]
            cell = reference.voxel_of(positions[s], len(near))
            rows = rows[[i for i in near[cell] if i < 300]]
            assert bool(told.exists[s]) == (len(rows) > 0)
            if not len(rows):
                continue
            offset = (np.float64(positions[s]) - rows[:, :3]) / rows[:, 16:]
            away = np.linalg.norm(offset, axis=1)
            share = np.exp(-0.5 * (away**2 - away.min() ** 2))
            share /= share.sum()
            normal = rows[:, 3:6] * np.where(rows[:, 3:6] @ np.float64(directions[s]) > 0, -1, 1)[:, None]
            height = np.sum(normal * offset, axis=1)
            ahead = np.clip(height / np.maximum(-normal @ np.float64(directions[s]), surface.LEAST_FACING), -10, 10)
            miss = np.minimum(np.linalg.norm(offset + ahead[:, None] * np.float64(directions[s]), axis=1), 10)
            met = np.exp(-0.5 * (miss**2 - miss.min() ** 2))
            expected = {
                "ahead": met @ ahead / met.sum(),
                "miss": miss.min(),
                "outside": -share @ np.sum(rows[:, 11:14] * offset, axis=1),
                "flatness": share @ rows[:, 14],
                "narrowness": share @ rows[:, 15],
                "height": share @ height,
                "beside": np.linalg.norm(share @ offset),
                "nearest": min(away.min(), surface.FAR),
                "spacing": share @ rows[:, 16],
                "normal": share @ normal,
                "base_color": share @ rows[:, 6:9],
                "roughness": share @ rows[:, 9],
                "metallic": share @ rows[:, 10],
            }
            close({name: getattr(told, name)[s] for name in expected}, expected, rtol=1e-3, atol=1e-4)

    def test_far_from_all_points_nothing_exists(self):
        positions = jnp.full((4, 3), 0.99)
        told = describe(estimate(ball(), COUNT), positions, *views(positions))
        assert not told.exists.any()
        close((told.nearest, told.miss), (jnp.full(4, surface.FAR),) * 2)
        for name in (
            "height",
            "beside",
            "ahead",
            "outside",
            "flatness",
            "narrowness",
            "spacing",
            "normal",
            "base_color",
        ):
            assert (getattr(told, name) == 0).all(), name

    def test_a_ray_is_told_where_it_meets_a_wall_and_how_far_from_the_walls_points(self):
        rows = jnp.linspace(-0.5, 0.5, 21)
        wall = jnp.stack([*jnp.meshgrid(rows, rows, indexing="ij"), jnp.zeros((21, 21))], axis=-1).reshape(1, -1, 3)
        ones = jnp.ones((1, 441))
        cloud = PointCloud(
            positions=wall, base_color=0 * wall, roughness=ones, metallic=ones, mask=jnp.ones((1, 441), bool)
        )
        oblique = jnp.array([[0.6, 0.0, -0.8]])
        for point in (wall[0, 220], wall[0, 220] + jnp.array([0.02, 0.02, 0.0])):
            for distance in (0.04, -0.04):
                told = describe(
                    estimate(cloud, COUNT), (point - distance * oblique[0])[None], oblique, jnp.zeros(1, jnp.int32)
                )
                close(told.ahead * told.spacing, jnp.array([distance]), rtol=1e-3)
                away = jnp.linalg.norm(point[None] - wall[0], axis=1).min()
                close(told.miss * told.spacing, away[None], atol=2e-4)

    def test_height_is_positive_on_the_viewers_side_and_changes_sign_with_it(self):
        cloud = ball()
        outward = normalize(cloud.positions[0, 1:4] - 0.1)
        known, objects = estimate(cloud, COUNT), jnp.zeros(3, jnp.int32)
        above, below = cloud.positions[0, 1:4] + 0.02 * outward, cloud.positions[0, 1:4] - 0.02 * outward
        assert (describe(known, above, -outward, objects).height > 0.1).all()
        assert (describe(known, below, -outward, objects).height < 0).all()
        close(
            describe(known, above, outward, objects).height,
            -describe(known, above, -outward, objects).height,
            rtol=0.01,
        )

    def test_neither_the_size_of_an_object_nor_the_order_of_its_points_matters(self):
        """But for the spacing, and where a sample lies so near a border of cells that rounding moves it over."""
        cloud = ball()
        half = dataclasses.replace(cloud, positions=0.5 * cloud.positions)
        whole, small = (neighbourhoods(c.positions[0], c.mask[0]) for c in (cloud, half))
        close(2 * small.spacing, whole.spacing)
        close(jnp.abs(jnp.sum(small.normals * whole.normals, axis=1)), jnp.ones(300), atol=1e-4)
        close((small.inward, small.ratios), (whole.inward, whole.ratios), rtol=1e-3, atol=1e-4)
        order = np.random.default_rng(3).permutation(300)
        mixed = jax.tree.map(lambda x: x[:, order], cloud)
        positions = cloud.positions.reshape(-1, 3)[:50] + 0.02
        one, other = (describe(estimate(c, COUNT), positions, *views(positions)) for c in (cloud, mixed))
        close(one, other, rtol=1e-3, atol=1e-4)

    def test_what_fills_the_padding_does_not_matter(self):
        cloud, positions = ball(), numbers(5, 64, 3)
        other = jax.tree.map(
            lambda x: (
                x if x.dtype == bool else jnp.where(cloud.mask.reshape(*cloud.mask.shape, *[1] * (x.ndim - 2)), x, -7)
            ),
            cloud,
        )
        same_bits(estimate(other, COUNT), estimate(cloud, COUNT))
        nothing = dataclasses.replace(cloud, mask=jnp.zeros_like(cloud.mask))
        assert not describe(estimate(nothing, COUNT), positions, *views(positions)).exists.any()

    def test_how_much_padding_there_is_does_not_matter_where_the_least_grid_is_that_of_all(self):
        cloud, positions = ball(), numbers(5, 64, 3)
        padded = jax.tree.map(
            lambda x: jnp.pad(x, ((0, 0), (0, 3 * x.shape[1]), *[(0, 0)] * (x.ndim - 2)), constant_values=0), cloud
        )
        least = surface_grid(padded.mask.shape[1])
        known, more = (estimate(c, COUNT, least) for c in (cloud, padded))
        told, same = (describe(s, positions, *views(positions)) for s in (known, more))
        close(told, same, atol=1e-5)
        assert told.exists.any()
        assert estimate(cloud, COUNT).nearest.shape[1] < known.nearest.shape[1] == least

    def test_an_object_does_not_know_what_is_encoded_beside_it(self):
        cloud, positions = ball(), numbers(5, 64, 3, low=0.0, high=0.6)
        directions, _ = views(positions)
        both, second = estimate(cloud, COUNT), estimate(jax.tree.map(lambda x: x[1:], cloud), COUNT)
        ones = jnp.ones(64, jnp.int32)
        close(describe(both, positions, directions, ones), describe(second, positions, directions, 0 * ones), atol=1e-5)

    def test_gradients_are_finite_on_a_point_far_from_all_and_between_them_and_the_points_get_none(self):
        cloud = ball()
        positions = jnp.concatenate([cloud.positions[0, 1:4], jnp.full((1, 3), 0.99), cloud.positions[1, 1:4] + 0.01])
        directions, _ = views(positions)
        objects = jnp.array([0, 0, 0, 0, 1, 1, 1])

        @jax.jit
        def gradients(places, positions):
            def total(places, positions):
                moved = dataclasses.replace(cloud, positions=places)
                told = surface.describe(estimate(moved, COUNT), positions, directions, objects)
                return sum(jnp.sum(x) for x in jax.tree.leaves(dataclasses.replace(told, exists=jnp.zeros(7))))

            return jax.grad(total, (0, 1))(places, positions)

        by_points, by_place = gradients(cloud.positions, positions)
        assert (by_points == 0).all()
        assert jnp.isfinite(by_place).all()
        assert (by_place[3] == 0).all()
        assert (by_place[4:] != 0).all()
