"""Laws of the pure `render`: jit, vmap, grad, jvp, remat, map; plans and overflow; finite at the extremes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers
from support.surfel_clouds import camera, cloud, shape

from spnr_jax.config import SurfelConfig
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.records import Rendering
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.method.densifier import densify
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.method.surfel_renderer import Plan, encode, plan, render
from spnr_jax.surfels.candidates import CANDIDATES
from spnr_jax.surfels.lighting import room_light
from spnr_jax.surfels.neighbors import neighbors
from spnr_jax.surfels.skies import sun
from spnr_jax.training.weights import load

CONFIG = SurfelConfig(widths=(4, 6), top=4)
EYES = (0.3, 0.4, 2.4), (1.5, 1.0, 1.5)
ROOM = Plan(doublings=2, side=1, width=32, height=32, entries=2**12, slots=2**10)
drawn = jax.jit(render, static_argnames="plan")


def stacked(trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def in_units(scene, scale=0.5, centre=(0.3, -0.2, 0.1)):
    """The scene of a larger object that stands elsewhere, and the camera that sees the same of it."""
    return scene.replace(scale=jnp.float32(scale), centre=jnp.asarray(centre, jnp.float32))


def view(size=24, eye=EYES[0], scale=0.5, centre=(0.3, -0.2, 0.1), target=(0.0, 0.0, 0.0)):
    eye, target = (np.asarray(place) / scale + np.asarray(centre) for place in (eye, target))
    return camera(size, eye, 0.8, target=target)


def body(name, count=90):
    color = np.random.default_rng(3).random((count, 3))
    return in_units(
        encode_in_box(cloud(shape(name, count, "random")[0], base_color=color, metallic=np.full(count, 0.3)))
    )


@pytest.fixture(scope="module")
def params():
    fresh = jax.jit(surfel_method.init, static_argnums=1)(jax.random.key(0), CONFIG)
    leaves, form = jax.tree.flatten(fresh)
    return jax.tree.unflatten(form, [x + 0.1 * numbers(i, *x.shape) for i, x in enumerate(leaves)])


@pytest.fixture(scope="module")
def scenes():
    return [body(name) for name in ("sphere", "rod")]


@pytest.fixture(scope="module")
def views():
    return [view(eye=eye) for eye in EYES]


@pytest.fixture(scope="module")
def lights():
    return [jax.tree.map(jnp.asarray, light) for light in (room_light(), sun(30, 40))]


def projection(scene, found: Rendering):
    """A number that image, opacity and depth take part in."""
    return jnp.sum(found.image**2) + jnp.sum(found.acc) + 0.1 * jnp.sum(found.depth * scene.scale)


@pytest.fixture(scope="module")
def value_and_gradient():
    def loss(params, scene, seen, light):
        found = render(params, scene, seen, light, plan=ROOM)
        return projection(scene, found), found

    return jax.jit(jax.value_and_grad(loss, (0, 1, 2, 3), has_aux=True, allow_int=True))


def test_mapped_over_objects_cameras_and_lights_it_is_the_loop_over_them_by_one_program(params, scenes, views, lights):
    drawn.clear_cache()
    loop = [[[drawn(params, s, v, x, plan=ROOM) for x in lights] for v in views] for s in scenes]
    assert drawn._cache_size() == 1
    each = partial(render, plan=ROOM)
    for axes in ((None, None, None, 0), (None, None, 0, None), (None, 0, None, None)):
        each = jax.vmap(each, axes)
    together = jax.jit(each)(params, stacked(scenes), stacked(views), stacked(lights))
    close(together, stacked([stacked([stacked(row) for row in rows]) for rows in loop]), rtol=1e-4, atol=1e-4)
    assert np.std(np.asarray(together.image), axis=(0, 1, 2)).max() > 0.05  # they differ


@pytest.mark.ci
def test_compiled_it_is_what_its_operations_give_one_by_one(params, views, lights):
    """From the cloud to the picture."""
    points = cloud(shape("sphere", 90, "random")[0], base_color=np.random.default_rng(3).random((90, 3)))
    near = neighbors(points)

    def draw(points):
        return render(params, in_units(encode(params, points, near)), views[0], lights[1], plan=ROOM)

    eager, compiled = draw(points), jax.jit(draw)(points)
    assert int(eager.overflow) == 0
    close(eager, compiled, rtol=1e-3, atol=1e-3)
    assert np.std(np.asarray(eager.image)) > 0.05


@pytest.mark.ci
def test_what_does_not_fit_into_a_plan_is_counted_and_what_fits_is_whole(scenes, views, lights):
    blend = jax.jit(surfel_renderer.rasterize_window, static_argnames="plan")
    given = scenes[0], views[0], lights[0]
    sizes = jax.device_get(surfel_renderer.count_sizes(*given[:2], doublings=ROOM.doublings, side=ROOM.side))
    exact = ROOM._replace(entries=int(sizes.entries), slots=int(sizes.slots))
    whole, fitting = (blend(*given, plan=room) for room in (ROOM, exact))
    assert int(whole.overflow) == 0
    close(fitting, whole, rtol=1e-4, atol=1e-4)
    last = blend(*given, plan=exact._replace(entries=exact.entries - 1))
    narrow = blend(*given, plan=exact._replace(slots=4, width=24))
    assert 0 < int(last.overflow) < 100  # a disc
    fits = np.sum(np.asarray(whole.buffer.opacity)[:, :24] > 0)
    assert int(narrow.overflow) == 8 + fits - 4 > 8
    check_finite((last, narrow))


def test_a_plan_holds_every_view_and_every_object_it_is_made_of(scenes, views):
    singles = [plan(s, v) for s in scenes for v in views]
    together = plan(stacked(scenes), jax.tree.map(lambda x: jnp.stack([x, x]), stacked(views)))
    assert hash(together) == hash(Plan(*together))
    for name in ("width", "height", "entries", "slots"):
        assert getattr(together, name) == max(getattr(single, name) for single in singles)
    assert plan(stacked(scenes), views[0]).entries == max(plan(s, views[0]).entries for s in scenes)
    with pytest.raises(ValueError, match="same leading axes"):
        plan(stacked([*scenes, scenes[0]]), stacked(views))


def test_a_plan_of_what_a_jitted_function_closes_over_is_that_of_outside(params, scenes, views):
    wanted = []

    @jax.jit
    def of_pose(pose):
        wanted.append(plan(scenes[0], views[0]))
        return render(params, scenes[0], views[0].replace(cam_to_world=pose), plan=wanted[0]).image

    assert of_pose(views[0].cam_to_world).shape == (24, 24, 3)
    assert wanted == [plan(scenes[0], views[0])]
    shared = views[0].replace(cam_to_world=np.stack([x.cam_to_world for x in views[:2]]))
    assert plan(scenes[0], shared) == plan(scenes[0], stacked(views[:2])), "one lens for all views"


@pytest.mark.ci
def test_nothing_traced_leaves_encode_and_padded_clouds_can_be_traced():
    points = cloud(shape("sphere", 90)[0])
    near = np.pad(neighbors(points), [(0, 38), (0, 0)], constant_values=-1)
    with jax.checking_leaks():
        made = jax.eval_shape(lambda points: encode(None, cloud_arrays.pad(points, 128), near), points)
    assert made.surfels.mask.shape == (128,)


@pytest.mark.ci
@pytest.mark.parametrize("context", [jax.numpy_dtype_promotion("strict"), jax.enable_x64(True)], ids=["strict", "x64"])
def test_gradients_in_strict_promotion_and_by_a_camera_of_float64(lights, context):
    points, params = cloud(shape("sphere", 90)[0]), load().params
    near = neighbors(points)
    of_dense = np.tile(near, (1 + CANDIDATES, 1))

    def loss(position, color, pose):
        dense = densify(params, points.replace(positions=position, base_color=color), near)
        assert dense.positions.dtype == jnp.float32
        seen = view().replace(cam_to_world=pose, intrinsics=lens)
        return jnp.mean(render(params, encode(params, dense, of_dense), seen, lights[0], plan=ROOM).image)

    given = jnp.asarray(points.positions), jnp.asarray(points.base_color)
    with context:
        pose, lens = (jnp.asarray(np.float64(x)) for x in (view().cam_to_world, view().intrinsics))
        by_position, by_pose = jax.eval_shape(jax.grad(loss, (0, 2)), *given, pose)
        by_color = jax.eval_shape(jax.grad(lambda color: loss(given[0], color, pose)), given[1])  # pose has no tangent
    assert by_position.dtype == by_color.dtype == jnp.float32
    assert by_pose.dtype == pose.dtype


def test_order_and_padding_of_the_points_do_not_matter(params, scenes, views, lights):
    def rolled(x):
        return jnp.roll(x, 211, axis=0)  # what is real lies between two stretches of padding

    moved = scenes[1].replace(surfels=jax.tree.map(rolled, scenes[1].surfels))
    one, other = (drawn(params, scene, views[1], lights[0], plan=ROOM) for scene in (scenes[1], moved))
    close(other, one, rtol=1e-3, atol=1e-4)


@pytest.mark.ci
def test_remat_and_map_have_the_same_values_and_gradients(params, scenes, views, lights, value_and_gradient):
    scene, light = scenes[0], lights[0]

    @jax.jit
    def mapped(position, brightness, cameras):
        def loss(position, brightness):
            moved = scene.replace(surfels=scene.surfels.replace(position=position))
            each = jax.checkpoint(lambda camera: render(params, moved, camera, brightness * light, plan=ROOM))
            return jnp.sum(jax.lax.map(lambda camera: projection(moved, each(camera)), cameras))

        return jax.value_and_grad(loss, (0, 1))(position, brightness)

    value, (by_position, by_brightness) = mapped(scene.surfels.position, jnp.float32(1), stacked(views))
    each = [value_and_gradient(params, scene, view, light) for view in views]
    close(value, sum(found[0] for found, _ in each), rtol=1e-4)
    close(by_position, sum(by[1].surfels.position for _, by in each), rtol=2e-3, atol=2e-3)
    close(by_brightness, sum(np.vdot(by[3].tables, light.tables) for _, by in each), rtol=1e-3)


@pytest.mark.ci
def test_forward_mode_is_reverse_mode(params, scenes, views, lights, value_and_gradient):
    given = params, scenes[0], views[0], lights[0]
    way = numbers(5, *scenes[0].surfels.position.shape)

    @jax.jit
    def forward(position, brightness):
        def loss(position, brightness):
            moved = scenes[0].replace(surfels=scenes[0].surfels.replace(position=position))
            return projection(moved, render(params, moved, views[0], brightness * lights[0], plan=ROOM))

        return jax.jvp(loss, (position, brightness), (way, jnp.float32(1)))[1]

    _, by = value_and_gradient(*given)
    slope = np.vdot(by[1].surfels.position, way) + np.vdot(by[3].tables, lights[0].tables)
    close(forward(scenes[0].surfels.position, jnp.float32(1)), slope, rtol=2e-3, atol=1e-3)


@pytest.mark.ci
def test_gradients_are_central_differences_of_float64(params, scenes, views, lights, value_and_gradient):
    """By every number of scene, camera and light."""
    given, rng = (scenes[0], views[0], lights[0]), np.random.default_rng(7)
    gradients = jax.tree.leaves(value_and_gradient(params, *given)[1][1:])
    with jax.enable_x64(True):
        params, given = jax.tree.map(
            lambda x: jnp.asarray(x, jnp.float64 if x.dtype == jnp.float32 else x.dtype), (params, given)
        )
        places, form = jax.tree_util.tree_flatten_with_path(given)
        leaves, slopes = [x for _, x in places], {}

        @jax.jit
        def value(leaves):
            scene, *asked = jax.tree.unflatten(form, leaves)
            return projection(scene, render(params, scene, *asked, plan=ROOM))

        for i, ((place, x), gradient) in enumerate(zip(places, gradients, strict=True)):
            if x.dtype == jnp.float64:
                way = 0.1 * np.abs(x).max() * rng.normal(size=x.shape)
                ends = [value([*leaves[:i], x + t * way, *leaves[i + 1 :]]) for t in (1e-6, -1e-6)]
                slopes[jax.tree_util.keystr(place)] = np.vdot(gradient, way), float(ends[0] - ends[1]) / 2e-6
    assert sum(abs(difference) > 1e-2 for _, difference in slopes.values()) >= 16
    for place, pair in slopes.items():
        np.testing.assert_allclose(*pair, rtol=3e-3, err_msg=place)


LINE = np.linspace(-0.6, 0.6, 40)[:, None] * np.array([[0.6, 0.0, 0.8]])
EXTREMES = {
    "one point": np.zeros((1, 3)),
    "two points": np.array([[0.1, 0, 0], [-0.1, 0, 0]]),
    "three points": np.eye(3) * 0.3,
    "duplicates": np.repeat(np.eye(3) * 0.4, 9, axis=0),
    "a line": LINE,
    "a plane": shape("plane", 60)[0],
    "points 1e-7 apart": 1e-7 * shape("sphere", 40)[0],
}


def check_finite(found):
    for place, leaf in jax.tree_util.tree_leaves_with_path(found):
        if leaf.dtype != jax.dtypes.float0:
            assert np.isfinite(np.asarray(leaf)).all(), jax.tree_util.keystr(place)


@pytest.mark.parametrize("name", EXTREMES)
def test_few_and_strange_points_have_finite_pictures_and_gradients(params, lights, value_and_gradient, name):
    check_finite(value_and_gradient(params, in_units(encode_in_box(cloud(EXTREMES[name]))), view(), lights[0]))


CASES = {
    "a camera inside": (1.0, {"eye": (0.05, 0.02, 0.1)}, 1.0),
    "a camera at a point": (1.0, {"eye": (0.6, 0.0, 0.0)}, 1.0),
    "an empty picture": (1.0, {"target": (5.0, 4.0, 9.0)}, 1.0),
    "black light": (1.0, {}, 0.0),
    "light of 1e6": (1.0, {}, 1e6),
    "an object of 1e7": (1e-7, {}, 1.0),
    "an object of 1e-7": (1e7, {}, 1.0),
}


@pytest.mark.parametrize("name", CASES)
def test_strange_cameras_lights_and_units_have_finite_pictures_and_gradients(
    params, scenes, lights, value_and_gradient, name
):
    scale, seen, brightness = CASES[name]
    centre = (0.3 / scale, -0.2 / scale, 0.1 / scale)
    scene = in_units(scenes[0], scale, centre)
    found = value_and_gradient(params, scene, view(scale=scale, centre=centre, **seen), brightness * lights[0])
    check_finite(found)
    if name == "an empty picture":
        assert np.all(np.asarray(found[0][1].acc) == 0)
        assert np.all(np.asarray(found[0][1].image) == 1)
