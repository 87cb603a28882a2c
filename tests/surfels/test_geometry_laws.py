"""Laws of `spnr_jax.neighbors` and `spnr_jax.encode`: gradients, vmap, padding, rotation, float64, extremes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close
from support.surfel_clouds import cloud, lumpy_ball, shape

import spnr_jax
from spnr_jax.kernels.cloud_arrays import normalization, pad
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.surfels import geometry
from spnr_jax.surfels.constants import NEIGHBORS

pytestmark = pytest.mark.ci
COUNT, SIZE = 150, 160  # real points, and with padding
ball = functools.cache(functools.partial(lumpy_ball, COUNT, SIZE))
CONSTANT = ("visibility", "one_sided", "mask")  # to gradients


def with_normals(points):
    """The cloud with normals that are a little off those of a ball."""
    away = points.positions - 30
    away = away / np.linalg.norm(away, axis=1, keepdims=True) + 0.1 * np.roll(away, 1, axis=1) / 7
    return dataclasses.replace(points, normals=np.float32(away))


def projection(columns, points, near):
    """A number that all of a scene's fields with a gradient take part in, and the scene."""
    scene = surfel_renderer.encode(None, dataclasses.replace(points, **columns), near)
    fields = {name: values for name, values in vars(scene.surfels).items() if name not in CONSTANT}
    fields |= {name: getattr(scene, name) for name in ("spacing", "centre", "scale")}
    rng = np.random.default_rng(5)
    weights = {name: rng.normal(size=values.shape) for name, values in sorted(fields.items())}
    total = jnp.zeros((), points.positions.dtype)
    for name, values in sorted(fields.items()):
        of_points = values.shape[:1] == (SIZE,)
        kept = jnp.where(scene.surfels.mask.reshape(-1, *[1] * (values.ndim - 1)), values, 0) if of_points else values
        total += jnp.sum(jnp.asarray(weights[name], values.dtype) * kept)
    return total, scene


def plain(points, near):
    return surfel_renderer.encode(None, points, near)


both = jax.jit(jax.value_and_grad(projection, has_aux=True))


def columns_of(points):
    return {name: jnp.asarray(getattr(points, name)) for name in ("positions", "base_color", "normals")}


def without_normals(points):
    """Normals of length 0 are estimated, as where none are given, and share a program with those that are given."""
    return dataclasses.replace(points, normals=np.zeros_like(points.positions))


def run(points, near):
    points = without_normals(points) if points.normals is None else points
    (_, scene), gradients = both(columns_of(points), jax.tree.map(jnp.asarray, points), jnp.asarray(near))
    return jax.tree.map(np.asarray, (scene, gradients))


@pytest.mark.parametrize("given", [False, True])
def test_gradients_are_those_of_central_differences_in_float64_and_float32_is_near(given):
    points = with_normals(ball()) if given else without_normals(ball())
    near = spnr_jax.neighbors(points)
    single, gradients32 = run(points, near)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.float64(x) if x.dtype == np.float32 else x), points)
        columns = columns_of(wide)
        (_, double), gradients = both(columns, wide, jnp.asarray(near))
        if not given:
            assert not np.asarray(gradients.pop("normals")).any()
        for name, gradient in gradients.items():
            way = np.random.default_rng(1).normal(size=gradient.shape) * points.mask[:, None]
            step = 1e-7 * (7 if name == "positions" else 1)  # a shorter way crosses fewer choices
            ends = [both(columns | {name: columns[name] + s * step * way}, wide, near)[0][0] for s in (1, -1)]
            slope = float(ends[0] - ends[1]) / (2 * step)
            np.testing.assert_allclose(np.vdot(gradient, way), slope, rtol=0.01, err_msg=name)
            assert not np.asarray(gradient)[COUNT:].any()
            scale = np.abs(gradient).max()
            assert np.mean(np.abs(gradients32[name] - gradient) > 0.02 * scale) < 0.01
    for name, values in vars(double.surfels).items():
        off = np.abs(np.float64(getattr(single.surfels, name)) - np.float64(values)).reshape(SIZE, -1).max(axis=1)
        assert np.mean(off > 1e-3 * max(np.abs(np.float64(values)).max(), 1)) < 0.02, name


def test_blocks_of_points_and_the_padding_of_the_last_one_change_no_gradient(monkeypatch):
    points = with_normals(ball())
    near = spnr_jax.neighbors(points)
    one = run(points, near)
    monkeypatch.setattr(geometry, "CONSTANTS", dataclasses.replace(geometry.CONSTANTS, block_size=64))
    in_blocks = jax.jit(jax.value_and_grad(projection, has_aux=True))
    (_, scene), gradients = in_blocks(columns_of(points), jax.tree.map(jnp.asarray, points), jnp.asarray(near))
    close((scene.surfels, gradients), (one[0].surfels, one[1]), rtol=1e-3, atol=2e-3)


def test_clouds_of_equal_padding_are_mapped_as_they_are_encoded_one_by_one_and_stack():
    clouds = [ball(0), ball(1)]
    near = [spnr_jax.neighbors(points) for points in clouds]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *clouds)
    np.testing.assert_array_equal(spnr_jax.neighbors(stacked), np.stack(near))
    mapped = jax.jit(jax.vmap(plain))(stacked, jnp.stack(near))
    each = [run(points, of)[0] for points, of in zip(clouds, near, strict=True)]
    close(mapped, jax.tree.map(lambda *x: np.stack(x), *each), rtol=1e-3, atol=2e-3)


def test_the_scene_turns_and_moves_and_grows_with_the_cloud_but_for_what_fixed_directions_see():
    points = ball()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = np.where(points.mask[:, None], 1e3 * points.positions @ turn.T + [5, -4e3, 100], 0)
    near = spnr_jax.neighbors(points)
    one = run(points, near)[0]
    other = run(dataclasses.replace(points, positions=np.float32(moved)), near)[0]
    # the box does not turn with the points
    ratio = float(other.scale / one.scale) * 1e3
    real = one.surfels.mask & other.surfels.mask
    assert np.mean(one.surfels.mask == other.surfels.mask) > 0.97
    cosine = np.sum((one.surfels.normal @ turn.T * other.surfels.normal)[real], axis=1)
    assert np.mean(np.abs(cosine) > 1 - 1e-4) > 0.95
    off = np.abs(other.surfels.spacing[real] / (ratio * one.surfels.spacing[real]) - 1)
    assert np.median(off) < 0.02
    assert np.mean(off < 0.25) > 0.9  # gaps are looked for in 16 directions of the tangent plane, sides in 64
    middle = (other.surfels.position / other.scale + other.centre)[real]
    close(middle, moved[real], rtol=1e-3, atol=2)


EXTREMES = {
    "one": [[1.0, 2, 3]],
    "two": [[1.0, 2, 3], [4, 5, 6]],
    "three": [[1.0, 2, 3], [4, 5, 6], [0, 1, 0]],
    "coincident": np.zeros((40, 3)),
    "twice": np.repeat(np.random.default_rng(0).normal(size=(60, 3)), 2, axis=0),
    "line": np.linspace(-1, 1, 50)[:, None] * [0.6, 0, 0.8],
    "plane": np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), [0.0]), -1).reshape(-1, 3),
    "close": 1e-7 * np.random.default_rng(1).normal(size=(80, 3)),
    "far": 1e7 * np.random.default_rng(1).normal(size=(80, 3)),
    "outlier": np.concatenate([1e-7 * np.random.default_rng(1).normal(size=(80, 3)), [[1e7, 0, 0]]]),
    "none": np.zeros((0, 3)),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_values_and_gradients_are_finite_for_any_points(name):
    positions = np.reshape(EXTREMES[name], (-1, 3))
    colors = np.random.default_rng(2).integers(0, 2, (len(positions), 3))  # black among them
    points = pad(cloud(positions, base_color=colors), SIZE)
    near = spnr_jax.neighbors(points)
    scene, gradients = run(points, near)
    for leaf in jax.tree.leaves((scene, gradients)):
        assert np.isfinite(leaf).all()
    assert scene.surfels.mask.sum() == len(positions)
    close(np.linalg.norm(scene.surfels.normal[: len(positions)], axis=1), np.ones(len(positions)), atol=1e-4)


@pytest.mark.parametrize("known", [0, COUNT // 2, COUNT])
def test_a_given_normal_may_have_any_length_and_one_of_length_0_is_none(known):
    points = with_normals(ball())
    length = np.where(np.arange(SIZE) < known, np.geomspace(1e-15, 1e15, SIZE), 0)[:, None]
    scaled = dataclasses.replace(points, normals=np.float32(points.normals * length))
    scaled.normals[~points.mask] = np.nan
    near = spnr_jax.neighbors(points)
    (scene, gradients), (whole, _) = run(scaled, near), run(points, near)
    bare = run(ball(), near)[0].surfels.normal
    for other, some in ((whole.surfels.normal, slice(known)), (bare, slice(known, COUNT))):
        cosine = np.abs(np.sum(scene.surfels.normal * other, axis=1))[some]
        assert np.sum(cosine < 1 - 1e-4) <= 0.1 * len(cosine)
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())
    assert not gradients["normals"][known:].any()


def test_neighbors_are_the_nearest_of_the_real_points_and_each_is_its_own_first():
    rng = np.random.default_rng(3)
    points = cloud(rng.normal(size=(90, 3)))
    points = dataclasses.replace(points, mask=rng.random(90) < 0.7)
    found = spnr_jax.neighbors(points)
    assert found.dtype == np.int32
    assert found.shape == (90, NEIGHBORS)
    distance = np.linalg.norm(points.positions[:, None] - points.positions, axis=2)
    for i in range(90):
        others = [j for j in np.argsort(distance[i]) if points.mask[j]][:NEIGHBORS]
        np.testing.assert_array_equal(found[i], others if points.mask[i] else -1)
    few = spnr_jax.neighbors(cloud(np.zeros((3, 3))))
    np.testing.assert_array_equal(few[:, 0], np.arange(3))
    assert np.all(np.sort(few[:, :3]) == np.arange(3))
    assert np.all(few[:, 3:] == -1)
    np.testing.assert_array_equal(spnr_jax.neighbors(cloud(np.zeros((50, 3))))[:, 0], np.arange(50))


@pytest.mark.parametrize("count", [25, 90])
def test_of_two_equally_near_points_the_one_that_faces_the_same_way_is_a_neighbor(count):
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3)) * (rng.random(count) > 0.2)[:, None]
    points = dataclasses.replace(cloud(rng.normal(size=(count, 3))), normals=normals)
    found = spnr_jax.neighbors(points)
    plain = spnr_jax.neighbors(dataclasses.replace(points, normals=None))
    assert (found != plain).any()
    for i in range(count):
        distance = np.linalg.norm(points.positions - points.positions[i], axis=1)
        near = np.argsort(distance)[:32]
        length = np.linalg.norm(normals[i]) * np.linalg.norm(normals[near], axis=1)
        cosine = np.where(length > 0, normals[near] @ normals[i] / np.maximum(length, 1e-9), 1)
        away = 2.0 * np.sqrt(np.pi / 6) * distance[near[6]] * np.sqrt(np.maximum(1 - cosine, 0) / 2)
        chosen = near[np.argsort(np.hypot(distance[near], away))[:NEIGHBORS]]
        np.testing.assert_array_equal(found[i], sorted(chosen, key=lambda j, d=distance: d[j]))


def count_programs():
    """Of `encode`: with a cache of compiled programs, and without one."""
    return len(surfel_method._encode.programs) + surfel_method._encode.jitted._cache_size()


def test_the_box_is_that_of_the_handle_and_clouds_of_one_bucket_share_a_program():
    points = ball()
    centre, scale = normalization(points.positions[points.mask])
    scene, _ = run(points, spnr_jax.neighbors(points))
    close((scene.centre, scale), (centre, scene.scale), rtol=1e-6)
    programs = set()
    for count in (300, 400):
        positions = shape("sphere", count)[0]
        found = surfel_method.encode_in_box(cloud(positions))
        assert found.surfels.mask.shape == (512,)
        assert found.surfels.mask.sum() == count
        order = np.lexsort(np.asarray(found.surfels.position)[:count].T)
        close(np.asarray(found.surfels.position)[order], positions[np.lexsort(positions.T)])
        programs.add(count_programs())
    assert len(programs) == 1


@pytest.mark.parametrize("half", [np.float16, jnp.bfloat16])
def test_half_floats_are_computed_in_float32(half):
    points = pad(cloud(shape("sphere", COUNT, "random")[0]), SIZE)
    halves = jax.tree.map(lambda x: x if x.dtype == np.bool_ else x.astype(half), points)
    wide = jax.tree.map(lambda x: x if x.dtype == np.bool_ else np.asarray(x, np.float32), halves)
    jax.tree.map(np.testing.assert_array_equal, *map(surfel_renderer.normalise_cloud, (halves, wide)))
    scene = jax.eval_shape(plain, halves, spnr_jax.neighbors(wide))
    assert {x.dtype for x in jax.tree.leaves(scene)} == {jnp.dtype(np.float32), jnp.dtype(np.bool_)}
