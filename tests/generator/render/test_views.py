"""Laws of the pictures: where things appear, what is seen, and which colour is written."""

import numpy as np
import pytest
from support.handmade import BLUE, GREEN, GREY, RED, WHITE_LIGHT, ball, box, checked_box_and_ball, plain

from data_gen.render import views
from spnr_jax.formats import data_sets, surface_points
from spnr_jax.formats.assets import Asset
from spnr_jax.kernels.imaging import srgb_to_linear

CONFIG = views.ViewConfig(resolution=32, spp=16, views=2)


def picture(asset, eye, config=CONFIG):
    scene = views.build_scene(asset, WHITE_LIGHT)
    return views.straight_srgb(views.render_view(scene, views.look_at(np.asarray(eye, float)), config, 0))


def test_cameras_are_orthonormal_right_handed_look_at_the_origin_and_stand_at_the_distance():
    poles = np.stack([views.look_at(3 * np.array([0.0, sign, 1e-9])) for sign in (-1, 1)])
    for pose in [*poles, *views.random_viewpoints(50, 3.0, np.random.default_rng(0))]:
        rotation, eye = pose[:3, :3], pose[:3, 3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(eye, 3 * rotation[:, 2], atol=1e-8)
        assert rotation[1, 1] > -1e-6, "up is up in the picture"


def test_random_viewpoints_cover_the_sphere_uniformly():
    heights = views.random_viewpoints(4000, 2.0, np.random.default_rng(1))[:, 1, 3] / 2
    shares = np.histogram(heights, bins=4, range=(-1, 1))[0] / 4000
    np.testing.assert_allclose(shares, 0.25, atol=0.03)  # equal areas between equal steps of height (Archimedes)


def test_projected_points_land_where_the_renderer_draws_them():
    # balls of six pixels: what the middle of one covers hangs little on where the rays of a pixel happen to go
    asset = Asset(parts=(ball((0.5, 0.3, -0.2), 0.05, plain(RED)), ball((-0.6, -0.1, 0.4), 0.05, plain(GREEN))))
    config = views.ViewConfig(resolution=128, spp=16)
    for pose in views.random_viewpoints(6, 3.0, np.random.default_rng(2)):
        image = views.straight_srgb(views.render_view(views.build_scene(asset, WHITE_LIGHT), pose, config, 0))
        rows, columns = np.nonzero(image[..., 3])
        weights = image[rows, columns, 3].astype(float)
        for part, channel in zip(asset.parts, (0, 1), strict=True):
            own = image[rows, columns, :3].argmax(-1) == channel
            centre = np.average(np.stack([columns, rows], 1)[own] + 0.5, axis=0, weights=weights[own])
            np.testing.assert_allclose(centre, views.project(pose, part.positions, config).mean(0), atol=0.35)


def test_visible_faces_are_counted_through_all_parts_even_past_an_empty_one():
    empty = box(material=plain(BLUE))
    empty = type(empty)(positions=empty.positions, faces=empty.faces[:0], material=empty.material)
    front, behind = box((0, 0, 0.5), (0.6, 0.6, 0.05)), box((0, 0, -0.5), (0.2, 0.2, 0.05))
    scene = views.build_scene(Asset(parts=(behind, empty, front)), WHITE_LIGHT)
    assert views.visible_faces(scene, views.look_at(np.array([0, 0, 3.0])), CONFIG, 0).tolist() == [22, 23]


def test_condition_pixels_carry_the_reference_colour_and_hidden_points_leave_none():
    asset = checked_box_and_ball()
    surface = surface_points.sample_surface(asset, 500, 0)
    poses = views.random_viewpoints(2, 3.0, np.random.default_rng(3))
    images, conditions = views.render_views(asset, surface, poses, [WHITE_LIGHT], CONFIG, 0)
    scene = views.build_scene(asset, WHITE_LIGHT)
    for view, pose in enumerate(poses):
        seen = np.isin(surface.face, views.visible_faces(scene, pose, CONFIG, view))
        assert 0.2 < seen.mean() < 0.8
        expected = np.zeros((32, 32), bool)
        for column, row in np.floor(views.project(pose, surface.positions[seen], CONFIG)).astype(int):
            expected[row, column] = True
        np.testing.assert_array_equal(conditions[view, ..., 3], 255 * expected)
        reference = np.round(255 * data_sets.on_white(images[view]))
        np.testing.assert_array_equal(conditions[view, expected, :3], reference[expected])
        assert (conditions[view, ~expected] == 0).all()
        assert (images[view, expected, 3] > 0).mean() > 0.95


def test_the_light_itself_is_not_in_the_picture_and_alpha_is_coverage():
    image = picture(Asset(parts=(box(half=(0.3, 0.3, 0.3), material=plain(GREY)),)), (0, 0, 3))
    assert (image[0] == 0).all()
    assert (image[14:18, 14:18, 3] == 255).all()
    half_width = CONFIG.focal_length * 0.3 / 2.7
    assert image[16, :, 3].sum() / 255 == pytest.approx(2 * half_width, rel=0.05)


def test_straight_alpha_keeps_the_colour_of_a_half_covered_pixel():
    color = np.array([0.02, 0.5, 0.9])
    premultiplied = np.array([[[*(0.25 * color), 0.25], [*color, 1.0], [0, 0, 0, 0], [5.0, 0, 0, 1.0]]])
    encoded = views.straight_srgb(premultiplied)[0]
    np.testing.assert_array_equal(encoded[0, :3], encoded[1, :3])
    assert encoded[:, 3].tolist() == [64, 255, 0, 255]
    assert encoded[2].tolist() == [0, 0, 0, 0]
    assert encoded[3].tolist() == [255, 0, 0, 255]
    np.testing.assert_allclose(srgb_to_linear(encoded[1, :3] / 255), color, atol=0.004)
