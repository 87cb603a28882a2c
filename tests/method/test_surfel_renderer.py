"""Pictures of a ball by an untrained network: places, sizes, white around it, and any number of points."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.surfel_clouds import camera, cloud, shape, surfels

from spnr_jax.config import SurfelConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import SurfelScene
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.method.surfel_renderer import GRID, Plan, choose_resolution
from spnr_jax.nn.shader import NUM_FEATURES, Shader
from spnr_jax.surfels.lighting import light_of

pytestmark = pytest.mark.ci
CONFIG = SurfelConfig(widths=(8, 8), top=8)
LIGHT = jax.tree.map(jnp.asarray, light_of(np.full((32, 64, 3), 0.8, np.float32)))
RADIUS = 0.6


def render(variables, scene, view, quality="best"):
    """As the handle draws it, without its network for None."""
    quality = "draft" if variables is None else quality
    return next(surfel_method.render_each(variables or {}, scene, [view], [LIGHT], config=CONFIG, quality=quality))


@pytest.fixture(scope="module")
def scene():
    return encode_in_box(cloud(shape("sphere", 400)[0], base_color=np.full((400, 3), [0.7, 0.3, 0.1])))


@pytest.fixture(scope="module")
def fresh():
    return Shader(CONFIG.widths, CONFIG.top).init(jax.random.key(0), jnp.zeros((1, 8, 8, NUM_FEATURES)), 1)


@pytest.fixture(scope="module")
def wobbled(fresh):
    leaves, form = jax.tree.flatten(fresh)
    return jax.tree.unflatten(form, [x + 0.1 * numbers(i, *x.shape) for i, x in enumerate(leaves)])


def test_weights_in_bfloat16_have_almost_the_same_outputs(wobbled):
    inputs, network = numbers(3, 1, 8, 8, NUM_FEATURES), Shader(CONFIG.widths, CONFIG.top)
    half, whole = (
        network.apply(jax.tree.map(lambda x, kind=kind: x.astype(kind), wobbled), inputs, 1)
        for kind in ("bfloat16", "float32")
    )
    assert half.dtype == jnp.float32
    close(half, whole, atol=0.05 * float(jnp.abs(whole).max()))


def test_more_padding_changes_no_surfel_of_a_rod_thinner_than_a_cell_of_the_depth_buffers():
    rod = cloud(shape("rod", 1200)[0] * np.float32([0.02, 0.02, 1]))
    narrow, wider = (encode_in_box(rod, count).surfels for count in (2048, 8192))
    assert wider.mask.shape == (8192,)
    for name, values in vars(wider).items():
        assert not np.any(values[1200:]) or name == "spacing"
        change = np.abs(1.0 * values[:1200] - getattr(narrow, name)[:1200])
        assert np.mean(change > 1e-3) < 2e-3, name  # by rounding, a point may lie in the next cell


def test_an_eye_close_to_a_floor_sees_none_of_it_above_the_horizon():
    across = np.stack(np.meshgrid(*2 * [np.arange(-3, 3, 0.3)]), axis=-1).reshape(-1, 2)
    floor = surfels(np.insert(across, 1, -0.1, axis=1), (0.0, 1, 0), 0.3, one_sided=np.zeros(len(across)))
    scene = SurfelScene(surfels=floor, spacing=jnp.float32(0.3), centre=jnp.zeros(3), scale=jnp.float32(1))
    view = camera(64, eye=(0, 0, 0), target=(0.0, 0, -1), field_of_view=np.pi / 2)
    found = surfel_renderer.render(None, scene, view, LIGHT, plan=Plan(0, 1, 96, 96, 2**18, 96**2))
    assert not found.acc[:30].any()
    assert found.acc[34:].min() > 0.9


def test_from_inside_points_are_drawn_at_the_resolution_at_which_they_are_seen(scene):
    inside, outside = (camera(128, eye=(0, 0, z), target=(0.0, 0, -5), field_of_view=1.57) for z in (0.0, 0.6))
    assert choose_resolution(scene, inside) == choose_resolution(scene, outside)


def truth(view):
    """Distance along each ray to the ball, 0 beside it, and how near the ray passes its middle."""
    rays = jax.tree.map(np.float64, cameras.camera_rays(view))
    along = -np.sum(rays.origins * rays.directions, axis=-1)
    miss = np.sqrt(np.sum(rays.origins**2, axis=-1) - along**2)
    return along - np.sqrt(np.maximum(RADIUS**2 - miss**2, 0)), miss


def check_ball(found, view, spacing):
    distance, miss = truth(view)
    inside, outside = miss < RADIUS - spacing, miss > RADIUS + 2.5 * spacing
    assert found.image.shape == (view.height, view.width, 3)
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(np.asarray(leaf)).all()
    assert np.asarray(found.acc)[inside].min() > 0.9
    assert np.all(np.asarray(found.acc)[outside] == 0)
    assert np.all(np.asarray(found.image)[outside] == 1)
    assert np.abs(np.asarray(found.depth) - distance)[inside].max() < spacing + 0.02 * distance.max()
    rays = cameras.camera_rays(view)
    seen, far = np.asarray(found.acc) > 0.05, np.asarray(cameras.intersect_box(rays.origins, rays.directions)[1])
    own = ((found.depth - (1 - found.acc) * far) / found.acc)[seen]  # also along the outline
    assert own.min() > np.linalg.norm(view.cam_to_world[:, 3]) - RADIUS - spacing


def test_a_ball_is_drawn_where_it_is_on_white(scene, fresh):
    view = camera(64)
    found = render(fresh, scene, view)
    check_ball(found, view, scene.spacing)
    middle = np.asarray(found.image)[28:36, 28:36].reshape(-1, 3)
    assert np.all(np.diff(middle, axis=1) < -0.1)  # a brown ball: red above green above blue
    close(render(None, scene, view).image, found.image, atol=1e-5)  # fresh weights change nothing


def test_a_picture_of_an_odd_size_shows_the_ball_at_its_place(scene):
    view = cameras.pinhole(camera(8).cam_to_world, 0.9, 33, 47)
    check_ball(render(None, scene, view), view, scene.spacing + 2.0 * 2.5 / view.intrinsics[0, 0])


def test_a_small_ball_in_the_corner_of_a_picture_is_drawn_there(scene):
    view = camera(96, eye=(0.0, 0.0, 4.5), target=(1.1, 1.1, 0.0))
    check_ball(render(None, scene, view), view, 2 * scene.spacing)


@pytest.mark.parametrize("target", [(0.0, 0.0, 9.0), (9.0, 0.0, 2.5)])
def test_a_camera_that_looks_away_sees_white(scene, fresh, target):
    found = render(fresh, scene, camera(64, target=target))
    assert np.all(np.asarray(found.image) == 1)
    assert np.all(np.asarray(found.acc) == 0)


def test_a_cloud_of_twice_the_size_from_twice_as_far_has_the_same_picture_and_depths_twice_as_large(scene, fresh):
    one = render(fresh, scene, camera(64))
    other = render(fresh, scene.replace(scale=jnp.float32(0.5)), camera(64, (0, 0, 5.0)))
    close(other.image, one.image, atol=1e-5)
    close(other.depth, 2 * np.asarray(one.depth), rtol=1e-5)


def test_the_picture_moves_with_the_principal_point(scene, wobbled):
    size = 96
    view = camera(size, eye=(1.2, 0.8, 4.2))
    doublings, side = choose_resolution(scene, view)
    assert side == 1
    step = GRID * 2**doublings
    moved = dataclasses.replace(view, intrinsics=view.intrinsics.at[0, 2].add(step).at[1, 2].add(-step))
    one, other = (np.asarray(render(wobbled, scene, v).image) for v in (view, moved))
    close(other[: size - step, step:], one[step:, : size - step], atol=1e-4)
    assert np.abs(one - np.asarray(render(None, scene, view).image)).max() > 0.01


def test_a_plan_of_several_views_holds_each_and_changes_none():
    found = surfels(*shape("sphere", 2000))
    scene = SurfelScene(surfels=found, spacing=found.spacing[0], centre=jnp.zeros(3), scale=jnp.ones(()))
    far, near = (camera(192, eye=(0.0, 0.6 * away, 0.8 * away)) for away in (3.2, 2.2))
    cut = dataclasses.replace(near, intrinsics=near.intrinsics.at[0, 2].add(110))  # by the right border
    assert choose_resolution(scene, far) == choose_resolution(scene, cut)
    both = surfel_renderer.plan(scene, jax.tree.map(lambda *x: jnp.stack(x), far, cut))
    draw = jax.jit(surfel_renderer.render, static_argnames="plan")
    for view in (far, cut):
        own, common = (draw(None, scene, view, LIGHT, plan=x) for x in (surfel_renderer.plan(scene, view), both))
        assert int(own.overflow) == int(common.overflow) == 0
        close(common.image, own.image, atol=1e-6)
        assert np.asarray(own.acc).max() > 0.9


def test_what_the_border_of_a_picture_cuts_looks_as_in_a_wider_picture(scene, wobbled):
    near, wider = camera(96, eye=(0.9, 0.6, 1.0)), 64
    moved = near.intrinsics.at[:2, 2].add(wider)
    large = dataclasses.replace(near, intrinsics=moved, height=96 + 2 * wider, width=96 + 2 * wider)
    assert choose_resolution(scene, near) == choose_resolution(scene, large)
    for variables, most in ((None, 1e-5), (wobbled, 0.02)):
        own, cut = render(variables, scene, near), render(variables, scene, large)
        assert np.asarray(own.acc)[0].max() > 0.9, "the border cuts the object"
        close(own.image, np.asarray(cut.image)[wider:-wider, wider:-wider], atol=most)


@pytest.mark.parametrize("size", [31, 96, 160])
def test_no_window_is_wider_than_that_of_an_object_that_exceeds_the_picture(scene, size):
    for spacing, away in itertools.product((0.02, 0.1, 0.4), (0.9, 2.0, 3.0)):
        other = scene.replace(spacing=jnp.float32(spacing))
        plan = surfel_renderer.plan(other, camera(size, (0.0, 0.0, away)))
        widest = surfel_renderer.bound_window(size, plan.doublings, plan.side)
        assert max(plan.width, plan.height) <= widest
        assert away > 1 or plan.doublings or plan.width == widest


def test_a_share_of_the_pixels_is_doubled_as_often_and_enlarged_to_nearly_the_same_picture(scene, fresh):
    share = 0.75
    view = camera(64)
    for size, spacing in itertools.product((60, 160), np.geomspace(0.01, 1, 40)):
        large = camera(size, (0.6, 0.4, 2.6))
        small = cameras.resize(large, round(share * size), round(share * size))
        other = scene.replace(spacing=spacing)
        assert choose_resolution(other, small, share) == choose_resolution(other, large)
    whole, found = (render(fresh, scene, view, quality) for quality in ("best", "balanced"))
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, whole)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
        assert np.abs(np.asarray(one) - np.asarray(other)).mean() < 0.05  # depth jumps at the outline


def test_more_entries_than_can_be_sorted_are_refused_in_one_line(scene, monkeypatch):
    monkeypatch.setattr(surfel_renderer, "MOST_ENTRIES", 100)
    with pytest.raises(ValueError, match="ask for a smaller one"):
        render(None, scene, camera(64))
