"""The G-buffer of discs: float64 loops, what a plane shows, what hides what, and continuity."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from support import reference
from support.laws import close, hypotheses
from support.surfel_clouds import camera, even_square, shape, surfels

from spnr_jax.kernels import cameras
from spnr_jax.surfels import blending, splatting

TOTAL = 2**15  # entries, and 500 points in most scenes: few programs are compiled


@partial(jax.jit, static_argnames="slots")
def blend(entries, found, attributes, view, slots):
    return blending.blend(entries, splatting.project_discs(found, view), found, attributes, view, slots=slots)


@partial(jax.jit, static_argnames="capacity")
def make_entries(found, view, capacity):
    return splatting.make_entries(splatting.project_discs(found, view), view, capacity=capacity)


count = jax.jit(lambda found, view: splatting.count_entries(splatting.project_discs(found, view).covered))


def draw(found, view, attributes=None):
    """G-buffer (as NumPy arrays) of surfels, and the entries that it was blended from."""
    attributes = found.base_color if attributes is None else attributes
    entries, lost = make_entries(found, view, capacity=TOTAL)
    assert int(np.sum(np.asarray(entries.pixel) < view.height * view.width)) <= int(count(found, view)) <= TOTAL
    assert int(lost) == 0
    assert int(blending.count_covered_pixels(entries)) <= view.height * view.width
    buffer = blend(entries, found, jnp.asarray(attributes), view, slots=view.height * view.width)
    return jax.tree.map(np.asarray, buffer), entries


def layer(count=500, height=0.0, normal=(0.0, 0.0, 1.0), **columns):
    """A square layer of discs around the z axis, turned about the x axis to a normal."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    u, v = 1.1 * even_square(count).T
    position = u[:, None] * [1, 0, 0] + v[:, None] * [0, normal[2], -normal[1]] + [0, 0, height]
    return surfels(position, normal, 2.2 / np.sqrt(count), **columns)


def blend_twin(entries, found, view, pixel):
    """Opacity, coverage, depth, spread, log spacing, normal, attributes and color of a pixel, in float64."""
    order = np.asarray(entries.order)[np.asarray(entries.pixel) == pixel][: blending.LIST_LENGTH]
    point = np.asarray(entries.point)[order]
    kernel, facing, depth = (np.float64(x)[order] for x in (entries.kernel, entries.facing, entries.depth))
    spacing, weight = np.float64(found.spacing)[point], kernel**2 * facing
    tau = blending.CENTRE_TAU * weight
    lists = (x[:, None] for x in (tau, tau * kernel**blending.SHARP_POWER * facing, depth, spacing))
    share, colored, left = (x[:, 0] for x in reference.shares(*lists, blending.COMPARED))
    opacity = share.sum()
    divisor = max(opacity, blending.LEAST_OPACITY)
    mean = depth[0] + share @ (depth - depth[0]) / divisor
    spread = np.sqrt(share @ (depth - mean) ** 2 / divisor)
    normal = np.float64(found.normal)[point] @ np.float64(view.cam_to_world)[:, :3]
    color = np.float64(found.base_color)[point]
    wide = (share @ x / divisor for x in (np.log(spacing), normal, color))
    return min(opacity, 1), weight @ left, mean, spread, *wide, colored @ color / colored.sum()


class TestEntries:
    def test_they_are_all_pairs_of_a_float64_loop_over_discs_and_pixels_also_for_a_wide_view(self):
        position, normal, _ = shape("sphere", 40, "random")
        reach = np.random.default_rng(6).uniform(0.2, 2, (40, 4))
        found = surfels(position, normal, 0.25, rim_distances=reach)
        view = camera(20, (0.9, 0.8, 0.9), field_of_view=1.9)
        _, entries = draw(found, view)
        table = np.zeros((40, 400))
        order = np.asarray(entries.order)[np.asarray(entries.pixel) < 400]
        kernel, point = np.asarray(entries.kernel), np.asarray(entries.point)
        table[point[order], np.asarray(entries.pixel)[: len(order)]] = kernel[order]
        rays = cameras.camera_rays(view)
        directions, eye = np.float64(rays.directions).reshape(-1, 3), np.float64(view.cam_to_world[:, 3])
        pixels, _ = cameras.project(view, found.position)
        places = np.stack(np.meshgrid(*[np.arange(20) + 0.5] * 2), axis=-1).reshape(-1, 2)
        facing = np.asarray(splatting.project_discs(found, view).facing) > 0
        for i, (p, n) in enumerate(zip(np.float64(position), np.float64(normal), strict=True)):
            slope = directions @ n
            hit = eye + directions * ((n @ (p - eye)) / np.where(abs(slope) < 0.05, np.nan, slope))[:, None]
            rim = np.float64(found.rim_tangent[i])
            side = np.cross(n, rim)
            ends = [e + (p - hit) @ way / 0.25 for e, way in zip(reach[i], (rim, -rim, side, -side), strict=True)]
            kept = np.prod([np.clip(0.5 + e / splatting.RIM_WIDTH, 0, 1) for e in ends], axis=0)
            within = ((hit - p) ** 2).sum(axis=1) / (splatting.RADIUS * 0.25) ** 2
            on_picture = 1 - ((places - np.asarray(pixels)[i]) ** 2).sum(axis=1) / splatting.MIN_RADIUS**2
            drawn = np.max([kept - within, splatting.RIM_SKIRT * (1 - within), on_picture], axis=0)
            clear = np.isfinite(drawn) & (directions @ (hit - eye).T[:, 0] > -9)
            expected = facing[i] * np.clip(drawn, 0, 1)
            close(table[i][clear], expected[clear], atol=2e-3)

    def test_they_are_sorted_by_pixel_and_depth_whatever_the_size_of_the_picture(self):
        found = layer(20, normal=(0, 1, 1))
        for size in (24, 2100):  # the second has more pixels than 21 bits count
            view = camera(size, field_of_view=2.9 if size > 24 else 0.7)
            entries, lost = make_entries(found, view, capacity=int(count(found, view)))
            slots = blending.count_covered_pixels(entries)
            assert int(lost) == 0
            order, pixel = np.asarray(entries.order), np.asarray(entries.pixel)
            live = pixel < size**2
            assert np.all(np.diff(pixel) >= 0)
            depth = np.asarray(entries.depth)[order]
            assert np.all((np.diff(depth) > -1e-4) | (np.diff(pixel) > 0) | ~live[1:])
            assert len(np.unique(pixel[live])) == int(slots) > 0
            rows, columns = pixel[live] // size, pixel[live] % size
            assert abs(rows.mean() + 0.5 - size / 2) < 0.1 * size
            assert abs(columns.mean() + 0.5 - size / 2) < 0.1 * size

    def test_discs_that_do_not_fit_are_left_out_whole_and_counted(self):
        found, view = layer(20, normal=(0, 1, 1)), camera(20)
        covered = np.asarray(splatting.project_discs(found, view).covered)
        room = int(covered[:12].sum()) + 1
        entries, lost = make_entries(found, view, capacity=room)
        assert int(lost) == covered[12:].sum() > 0
        live = np.asarray(entries.pixel) < 400
        drawn = np.asarray(entries.point)[np.asarray(entries.order)[live]]
        assert set(drawn) == set(np.flatnonzero(covered[:12]))

    def test_numbers_that_int32_does_not_hold_do_not_wrap(self):
        found, view = layer(500), camera(16000, eye=(0.0, 0.0, 0.06))
        assert np.int64(splatting.project_discs(found, view).covered).sum() > 2**31
        assert int(make_entries(found, view, capacity=2**12)[1]) == splatting.MOST_COUNTED


class TestBlend:
    @settings(hypotheses, max_examples=12)
    @given(st.integers(0, 999), st.floats(-2, -0.6), st.floats(0, 1), st.floats(1, 4))
    def test_every_pixel_is_that_of_a_float64_loop_over_its_list(self, seed, size, one_sided, away):
        rng = np.random.default_rng(seed)
        normal = rng.normal(size=(500, 3))
        found = surfels(
            *(rng.uniform(-0.6, 0.6, (500, 3)), normal / np.linalg.norm(normal, axis=1, keepdims=True)),
            0.3 * 10.0**size * rng.uniform(0.5, 1, 500),
            base_color=rng.uniform(size=(500, 3)),
            one_sided=one_sided * rng.uniform(size=500),
        )
        view = camera(24, (0.0, 0.6 * away, 0.8 * away))
        entries, lost = make_entries(found, view, capacity=TOTAL)
        assume(int(lost) == 0 and int(blending.count_covered_pixels(entries)) > 0)
        buffer = blend(entries, found, found.base_color, view, slots=24**2)
        names = ("opacity", "coverage", "depth", "depth_deviation", "log_spacing", "normal", "attributes", "color")
        entries, buffer = jax.tree.map(np.asarray, (entries, buffer))
        for pixel in rng.choice(entries.pixel[entries.pixel < 24**2], 3):
            ours = [getattr(buffer, name).reshape(24**2, -1)[pixel].squeeze() for name in names]
            close(ours, blend_twin(entries, found, view, pixel), rtol=1e-4, atol=1e-4)

    def test_mean_transmittance_and_slope_are_those_of_float64(self):
        tau = np.logspace(-3, 1.5, 40)
        ours = blending._mean_transmittance(jnp.asarray(tau, jnp.float32))
        close(ours, (-np.expm1(-tau) / tau, (np.exp(-tau) * (1 + tau) - 1) / tau**2), rtol=1e-4)

    def test_the_depth_of_a_pixel_that_discs_hardly_cover_is_that_of_its_discs(self):
        position = np.where(np.arange(500)[:, None] < 1, [0.1, -0.2, 0.0], [0.0, 0.0, 9.0])
        buffer, _ = draw(surfels(position, (0, 0, 1.0), 0.2), camera(128))
        covered = buffer.opacity > 0
        assert (buffer.opacity[covered] < blending.LEAST_OPACITY).any()
        close(buffer.depth[covered], np.full(covered.sum(), 2.5), rtol=1e-4)

    def test_a_bright_layer_behind_shows_by_its_share_of_the_opacity_where_the_front_discs_end(self):
        there = np.random.default_rng(0).random(250) < 0.6
        position = np.concatenate([layer(250, 0.5).position[there], layer(250).position])
        color = np.repeat(np.where(position[:, 2:] > 0.1, 0.0, 1.0), 3, axis=1)
        found = surfels(position, (0, 0, 1.0), 2.2 / np.sqrt(250), base_color=color)
        buffer, _ = draw(found, camera())
        shown = draw(found.replace(mask=position[:, 2] > 0.1), camera())[0].opacity
        inner = (shown > 0.05) & (buffer.opacity > 0.2)
        share = (buffer.opacity - shown)[inner] / buffer.opacity[inner]
        close(buffer.color[inner].mean(axis=-1), share, atol=0.01)

    def test_a_border_of_two_colours_is_a_line_a_pixel_wide_on_a_plane(self):
        across, at, jump = np.array([0.6, 0.8, 0.0]), 0.15, np.array([0.3, -0.2, 0.1])
        found, view = layer(), camera()
        distance = at - np.asarray(found.position) @ across
        ahead = distance > 0  # the line lies before these points; those beyond it have the other colour
        border = np.concatenate([np.where(ahead[:, None], across, -across), np.abs(distance)[:, None]], axis=1)
        color = np.where(ahead[:, None], 0.5, 0.5 + jump)
        jumps = np.where(ahead[:, None], jump, -jump)
        buffer, _ = draw(
            surfels(found.position, (0, 0, 1.0), found.spacing, base_color=color, color_edge=border, color_jump=jumps),
            view,
        )
        rays = np.asarray(cameras.camera_rays(view).directions)
        hit = [0, 0, 2.5] - 2.5 * rays / rays[..., 2:]
        pixel = 2.5 / float(view.intrinsics[0, 0])
        share = np.clip(0.5 + (hit @ across - at) / pixel, 0, 1)[..., None]
        inner = buffer.opacity > 0.9
        assert np.any((share > 0.1) & (share < 0.9) & inner[..., None])
        close(buffer.color[inner], (0.5 + share * jump)[inner], atol=1e-4)

    def test_a_lone_disc_says_how_far_its_centre_lies_beside_each_pixel(self):
        position = np.where(np.arange(500)[:, None] < 1, [0.1, -0.2, 0.0], [0.0, 0.0, 9.0])
        found, view = surfels(position, (0, 0, 1.0), 0.3), camera()
        buffer, _ = draw(found, view)
        (centre, *_), _ = cameras.project(view, found.position)
        columns, rows = np.meshgrid(*[np.arange(view.width) + 0.5] * 2)
        near = buffer.sharp_weight > 0.1
        assert 10 < near.sum() < (buffer.opacity > 0.1).sum()
        expected = np.stack([centre[0] - columns, centre[1] - rows], axis=-1)
        close(buffer.centre_offset[near], expected[near], atol=0.01 * np.abs(expected[near]).max())
        close(np.hypot(*buffer.centre_offset[buffer.sharp_weight == buffer.sharp_weight.max()].T).min(), 0.5, atol=0.5)

    @pytest.mark.parametrize("seed", [0, 1])
    def test_it_is_continuous_in_the_camera(self, seed):
        rng = np.random.default_rng(seed)
        position, normal, spacing = shape("sphere", 400, "random")
        clutter = rng.uniform(-0.9, 0.9, (100, 3))
        normal = np.concatenate([normal, clutter / np.linalg.norm(clutter, axis=1, keepdims=True)])
        color = rng.uniform(size=(500, 3))
        found = surfels(
            np.concatenate([position, clutter]),
            normal,
            spacing,
            base_color=color,
            one_sided=rng.uniform(size=500) < 0.7,
        )
        one, other = (draw(found, camera(24, (0.3 + step, 0.2, 2.4)))[0] for step in (0.0, 1e-6))
        assert np.abs(one.opacity - other.opacity).max() < 2e-4
        assert np.abs(one.sharp_weight - other.sharp_weight).max() < 2e-4
        for name in ("attributes", "normal", "color", "centre_offset"):
            change = one.opacity[..., None] * getattr(one, name) - other.opacity[..., None] * getattr(other, name)
            assert np.abs(change).max() < 2e-4, name
