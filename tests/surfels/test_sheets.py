"""Two skins nearer to each other than a layer is thick: colours tell them apart, and nothing else looks like them."""

import jax
import numpy as np
import pytest
from support.surfel_clouds import cloud, estimate

from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.surfels import geometry, normals
from spnr_jax.surfels.neighbors import neighbors
from spnr_jax.surfels.sides import spiral

COUNT = 2000  # points of a skin
SPACING = np.float32(0.6 * np.sqrt(2 * np.pi / COUNT))  # of the points of two skins of a ball of radius .6 together
WHITE, BLACK = (0.8, 0.8, 0.8), (0.02, 0.02, 0.02)


def lined_ball(gap):
    """Positions, colours and outward normals of a white ball with a black lining, so many spacings within it."""
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])  # not point below point
    skin, lining = spiral(COUNT), spiral(COUNT) @ turn
    positions = np.concatenate([0.6 * skin, (0.6 - gap * SPACING) * lining]).astype(np.float32)
    colors = np.repeat(np.float32([WHITE, BLACK]), COUNT, axis=0)
    return positions, colors, np.concatenate([skin, -lining]).astype(np.float32)


@jax.jit
def _both_layers(points):
    return [geometry.find_layers(points, None, split_by_color=sheets)[1] for sheets in (False, True)]


def layers_of(positions, colors):
    """The layers before and after colours part them."""
    count = len(positions)
    padded = pad(cloud(positions, base_color=colors), 2 * COUNT)
    number = np.ascontiguousarray(neighbors(padded).T)
    columns = (np.float32(x).T for x in (padded.positions, padded.base_color))
    points = geometry.PointColumns(number, padded.mask, np.zeros(2 * COUNT, bool), *columns)
    return jax.tree.map(lambda x: np.asarray(x)[..., :count], _both_layers(points))


def changed(positions, colors):
    """Share of the points whose layer colours change."""
    one, two = layers_of(positions, colors)
    return np.mean((np.abs(one.height - two.height) > 1e-3).any(axis=0))


@pytest.mark.parametrize("gap", [0.1, 0.3])
def test_skin_and_lining_face_away_from_each_other_and_are_one_sheet_of_one_colour_without_colours(gap):
    positions, colors, normals = lined_ball(gap)
    found = estimate(positions, colors)
    place, normal = found.position[found.mask], found.normal[found.mask]
    outer = np.linalg.norm(place, axis=1) > 0.6 - 0.5 * gap * SPACING
    outward_share = np.mean(np.sum(normal * place, axis=1)[outer] > 0)
    inward_share = np.mean(np.sum(normal * place, axis=1)[~outer] < 0)
    assert outward_share > 0.99
    assert inward_share > 0.97 or np.mean(~outer) < 0.02  # what is not drawn does not show through, either
    assert np.abs(found.color_jump[found.mask][outer]).max(axis=1).mean() < 0.02  # no black in the white
    assert changed(positions, np.full_like(colors, 0.5)) == 0


@pytest.mark.parametrize("gap", [0.1, 0.15])
def test_true_normals_of_skin_and_lining_are_kept(gap):
    positions, colors, normals = lined_ball(gap)
    found = estimate(positions, colors, normals=normals)
    place, normal = found.position[found.mask], found.normal[found.mask]
    black = found.base_color[found.mask][:, 0] < 0.5
    assert np.mean(np.sum(normal * place, axis=1)[black] < 0) > 0.98 or np.mean(black) < 0.01
    assert np.all(np.sum(normal * place, axis=1)[~black] > 0)


def test_thinned_points_get_normals_away_from_the_other_skin():
    positions, colors, true = lined_ball(0.15)
    kept = np.arange(0, 2 * COUNT, 3)
    found = normals.outward_normals(positions.astype(np.float64), colors, kept)
    assert np.mean(np.sum(found * true[kept], axis=1) > 0.9) > 0.97


def test_the_border_of_two_colours_on_a_bent_surface_and_at_an_edge_is_no_step():
    ball = spiral(3000)
    assert changed(0.6 * ball, np.where(ball[:, :1] > 0.1, WHITE, BLACK)) < 0.005
    u, v = np.random.default_rng(0).uniform(0, 0.6, (2, 3000))
    lying = np.arange(3000) % 2 == 0
    fold = np.stack([np.where(lying, u, 0), np.where(lying, 0, u), v], axis=1)
    assert changed(fold, np.where(lying[:, None], WHITE, BLACK)) < 0.02


@pytest.mark.parametrize(("count", "inner"), [(1000, 0.4), (3000, 0.45)])
def test_the_frame_around_the_faces_of_a_thin_box_is_no_step(count, inner):
    rng = np.random.default_rng(1)
    place, face = rng.uniform(-0.5, 0.5, (count, 2)), rng.integers(0, 6, count)
    box = np.zeros((count, 3))
    for axis in range(3):
        of = face % 3 == axis
        across = np.where(face[of] < 3, 0.5, -0.5)
        box[of] = np.roll(np.column_stack([across, place[of]]), axis, axis=1)
    framed = np.abs(place).max(axis=1, keepdims=True) > inner
    assert changed(box * [1, 0.1, 1], np.where(framed, WHITE, BLACK)) < 0.001


def test_two_colours_among_each_other_on_one_surface_are_one_sheet_with_noise_and_without():
    rng = np.random.default_rng(1)
    ball, colors = spiral(3000), np.where(rng.random((3000, 1)) < 0.5, WHITE, BLACK)
    assert changed(0.6 * ball, colors) < 0.005
    noise = 0.2 * SPACING * rng.normal(size=ball.shape)
    assert changed(0.6 * ball + noise, colors) < 0.01
