"""Laws of the densifier: where learned points lie, batching, order, padding, rotation, gradients, degenerate clouds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.laws import close
from support.surfel_clouds import cloud, lumpy_ball, shape

import spnr_jax
from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.method import densifier, surfel_method
from spnr_jax.nn import point_prediction
from spnr_jax.surfels import candidates, symmetry
from spnr_jax.surfels.candidates import CANDIDATES, Nodes, build_graph, place_candidates
from spnr_jax.surfels.neighbors import measure_evenness
from spnr_jax.training import weights

COUNT, SIZE = 150, 512  # real points, and with padding; whole clouds have as many, so that they share programs
run = jax.jit(densifier.densify)
ball = functools.cache(functools.partial(lumpy_ball, COUNT, SIZE, noise=0.1))


@pytest.fixture(scope="module")
def params():
    return {"densifier": weights.read_variables(weights.packaged_file("densifier"))}


def kept(dense):
    """What is kept of a dense cloud, sorted by place, so that orders can be compared."""
    columns = [dense.positions, dense.normals, dense.base_color, dense.learned[:, None]]
    rows = np.concatenate([np.asarray(x) for x in columns], axis=1)[np.asarray(dense.mask)]
    return rows[np.lexsort(np.round(rows[:, :3], 3).T)]


def test_measured_points_are_kept_as_they_are_and_learned_points_are_told(params):
    points = ball()
    dense = run(params, points, spnr_jax.neighbors(points))
    assert dense.mask.shape == (SIZE * (1 + CANDIDATES),)
    for name in ("positions", "base_color", "roughness", "metallic", "mask"):
        np.testing.assert_array_equal(getattr(dense, name)[:SIZE], getattr(points, name))
    learned = np.asarray(dense.learned)[np.asarray(dense.mask)]
    np.testing.assert_array_equal(learned[:COUNT], 0)
    assert (learned[COUNT:] >= 0.5).all()
    assert (learned <= 1).all()
    assert COUNT < len(learned) - COUNT < 4 * COUNT
    close(np.linalg.norm(np.asarray(dense.normals)[np.asarray(dense.mask)], axis=1), 1, atol=1e-5)
    told = points.replace(learned=np.full(SIZE, 0.7, np.float32))
    np.testing.assert_array_equal(run(params, told, spnr_jax.neighbors(points)).learned[:SIZE], told.learned)
    evenness = measure_evenness(points, spnr_jax.neighbors(points))
    close(dense.evenness, np.full(len(dense.mask), evenness), rtol=1e-4)


def test_learned_points_lie_on_a_ball_nearer_than_the_middles_of_pairs(params):
    points, spacing = cloud(shape("sphere", SIZE)[0]), np.sqrt(4 * np.pi / SIZE)
    dense = run(params, points, spnr_jax.neighbors(points))
    learned = np.asarray(dense.positions)[SIZE:][np.asarray(dense.mask)[SIZE:]]
    off = np.abs(np.linalg.norm(learned, axis=1) - 0.6)
    assert len(learned) > 2 * SIZE
    assert np.sqrt(np.mean(off**2)) < 0.6 * (1 - np.cos(spacing / 2)) / 2
    assert cKDTree(learned).query(shape("sphere", 20_000)[0])[0].max() < 1.1 * 0.6 * spacing


def nodes_of(positions, normals, spacing):
    """What is known of points of one colour."""
    return Nodes(*map(jnp.asarray, (positions, normals)), jnp.full(len(positions), spacing), 0 * normals, None)


def test_places_of_pairs_lie_on_circles_that_their_ends_do():
    normals = shape("sphere", 1000)[1]
    found = jax.jit(place_candidates)(nodes_of(0.6 * normals, normals, 0.067), spnr_jax.neighbors(cloud(0.6 * normals)))
    pairs = np.asarray(found.exists & (found.first != found.second))
    assert pairs.sum() > 2500
    close(np.linalg.norm(np.asarray(found.middle)[pairs], axis=1), 0.6, atol=1e-4)  # a cubic, to fourth order
    both = np.sort(np.stack([found.first, found.second])[:, pairs], axis=0)
    assert len(np.unique(both, axis=1).T) == pairs.sum()
    frames = np.asarray(found.frame)[np.asarray(found.exists)]
    close(np.einsum("mij,mkj->mik", frames, frames), np.broadcast_to(np.eye(3), frames.shape), atol=1e-5)
    close(np.linalg.det(frames), 1, atol=1e-5)


def test_no_two_learned_points_are_nearer_than_the_closest(params):
    points = cloud(shape("sphere", SIZE, "random")[0])
    near = spnr_jax.neighbors(points)
    dense = jax.tree.map(lambda x: np.asarray(x)[SIZE:], run(params, points, near))
    distance = np.linalg.norm(points.positions[near] - points.positions[:, None], axis=2)
    scale = 0.8 * np.sqrt(np.pi / 6) * np.repeat(distance[near[:, :9], 6].mean(axis=1), CANDIDATES)[dense.mask]
    positions, normals = dense.positions[dense.mask], dense.normals[dense.mask]
    distance, other = cKDTree(positions).query(positions, 2)
    facing = np.sum(normals * normals[other[:, 1]], axis=1)
    measure = (distance[:, 1] / (densifier.LEAST_DISTANCE * np.minimum(scale, scale[other[:, 1]]))) ** 2
    assert (
        measure + densifier.NORMAL_PENALTY * (1 - facing) >= 0.999
    ).mean() > 0.95  # rivals are looked for at 12 neighbors


@pytest.mark.ci
def test_vmap_is_a_loop_and_a_program_is_the_plain_function(params):
    clouds = [ball(0), ball(1)]
    near = [spnr_jax.neighbors(x) for x in clouds]
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *clouds)
    found = jax.jit(jax.vmap(densifier.densify, in_axes=(None, 0, 0)))(params, stacked, jnp.stack(near))
    for i in (0, 1):
        close(kept(jax.tree.map(lambda x, i=i: x[i], found)), kept(run(params, clouds[i], near[i])), atol=1e-3)


@pytest.mark.ci
def test_blocks_are_the_whole_at_once(params, monkeypatch):
    points = ball()
    near = jnp.asarray(spnr_jax.neighbors(points))
    nodes, places = jax.jit(build_graph)(points, near)
    found = []
    for block in (SIZE * CANDIDATES, 37):
        monkeypatch.setattr(point_prediction, "BLOCK", block)
        found.append(jax.jit(lambda *x: point_prediction.predict(*x))(params["densifier"], nodes, near, places))
    jax.tree.map(lambda *x: close(*(y[np.asarray(places.exists)] for y in x), atol=1e-5), *found)


def test_a_dense_cloud_gets_learned_points_where_it_ends_or_bends_alone(monkeypatch):
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(31)), axis=-1).reshape(-1, 2)
    edge = np.concatenate([np.insert(grid[:400], 2, 0, axis=1), np.insert(grid[20:], 0, 0, axis=1)])
    near = spnr_jax.neighbors(cloud(edge * 0.05))
    nodes = nodes_of(edge * 0.05, np.repeat(np.eye(3)[[2, 0]], [400, 600], axis=0), 0.05)
    everywhere = jax.jit(place_candidates)(nodes, near)
    monkeypatch.setattr(candidates, "SPARSE", len(edge) - 1)
    some = jax.jit(lambda *x: place_candidates(*x))(nodes, near)
    pairs = [np.asarray(x.exists & (x.first != x.second)) for x in (everywhere, some)]
    middle = [np.asarray(x.middle)[y] for x, y in zip((everywhere, some), pairs, strict=True)]
    flat = [np.sum((x > 0.1).sum(axis=1) == 2) for x in middle]  # well inside one of the two squares
    assert flat[0] > 300
    assert flat[1] == 0
    assert len(middle[1]) > 0
    ways = [np.asarray(x.exists & (x.first == x.second)).sum() for x in (everywhere, some)]
    assert ways[1] >= ways[0] > 20


def test_both_sides_of_a_thin_wall_get_learned_points(monkeypatch):
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) * 0.05
    wall = np.concatenate([np.insert(grid, 2, 0, axis=1), np.insert(grid + 0.02, 2, -0.02, axis=1)])
    normals = np.repeat([[0, 0, 1.0], [0, 0, -1.0]], 400, axis=0)
    points = dataclasses.replace(cloud(wall), normals=np.float32(normals))
    monkeypatch.setattr(candidates, "SPARSE", 0)
    found = jax.jit(lambda *x: place_candidates(*x))(nodes_of(wall, normals, 0.05), spnr_jax.neighbors(points))
    facing = normals[:, 2]
    same = np.asarray(found.exists & (found.first != found.second)) & (facing[found.first] == facing[found.second])
    for side in (1, -1):
        assert (same & (facing[found.first] == side)).sum() > 400


def test_padding_and_the_order_of_points_do_not_matter(params):
    points, order = ball(), np.random.default_rng(3).permutation(SIZE)
    whole = kept(run(params, points, spnr_jax.neighbors(points)))
    filled = jax.tree.map(lambda x: np.where(points.mask.reshape(-1, *[1] * (x.ndim - 1)), x, 0.5), points)
    filled = jax.tree.map(np.float32, filled).replace(mask=points.mask)
    close(kept(run(params, filled, spnr_jax.neighbors(filled))), whole, atol=1e-3)
    turned = jax.tree.map(lambda x: x[order], points)
    found = kept(run(params, turned, spnr_jax.neighbors(turned)))
    distance = cKDTree(whole[:, :3]).query(found[:, :3])[0]
    assert (distance < 1e-3).mean() > 0.97  # which end owns a pair follows the numbers, and some points own too many


def test_a_turned_cloud_has_turned_learned_points(params):
    normals = shape("sphere", SIZE, "random")[1]
    turn = np.float32([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    points = cloud(0.6 * normals)
    other = dataclasses.replace(points, positions=points.positions @ turn.T)
    one, two = (run(params, x, spnr_jax.neighbors(x)) for x in (points, other))
    there = cKDTree(np.asarray(two.positions)[np.asarray(two.mask)])
    distance = there.query(np.asarray(one.positions)[np.asarray(one.mask)] @ turn.T)[0]
    assert (distance < 2e-3).mean() > 0.7  # openness is seen from directions that do not turn


@pytest.mark.ci
def test_gradients_are_finite_and_reach_positions_and_weights(params):
    points = ball()
    near = spnr_jax.neighbors(points)

    def total(params, positions):
        dense = densifier.densify(params, dataclasses.replace(points, positions=positions), near)
        return jnp.sum(jnp.where(dense.mask[:, None], jnp.sin(dense.positions) * dense.normals + dense.base_color, 0))

    by_params, by_positions = jax.jit(jax.grad(total, argnums=(0, 1)))(params, jnp.asarray(points.positions))
    for gradient in jax.tree.leaves((by_params, by_positions)):
        assert np.isfinite(gradient).all()
    assert (np.abs(np.asarray(by_positions)[:COUNT]).sum(axis=1) > 0).all()


@pytest.mark.parametrize("positions", [np.zeros((1, 3)), np.eye(3)[:2], np.eye(3), np.zeros((30, 3)), np.ones((2, 3))])
def test_few_points_and_equal_ones_stay_finite(params, positions):
    points = pad(cloud(positions), SIZE)
    dense = run(params, points, spnr_jax.neighbors(points))
    for values in jax.tree.leaves(dense):
        assert np.isfinite(values).all()
    assert int(dense.mask.sum()) <= len(positions) * (1 + CANDIDATES)
    np.testing.assert_array_equal(dense.mask[: len(positions)], True)


@pytest.mark.ci
def test_the_handle_densifies_sparse_clouds_alone(params, monkeypatch):
    monkeypatch.setattr(surfel_method, "_densify", lambda weights, *given: run({"densifier": weights}, *given))
    sparse = cloud(shape("sphere", 300)[0])
    dense = surfel_method.densify_sparse(params, sparse)
    reflected = len(symmetry.complete(sparse).mask)  # a ball is symmetric
    assert reflected > 2 * 300
    assert 2 * reflected < len(dense.mask) < 5 * reflected
    assert dense.mask.all()
    assert surfel_method.densify_sparse({}, sparse) is sparse
    assert surfel_method.densify_sparse(params, dense) is dense
    many = cloud(shape("sphere", densifier.MOST_POINTS + 1)[0])
    assert surfel_method.densify_sparse(params, many) is many


def test_the_handle_encodes_the_points_alone_where_it_is_asked_to():
    surfels = spnr_jax.load().encode(cloud(shape("sphere", 300)[0]), densify=False).surfels
    assert int(np.sum(surfels.mask)) == 300
    np.testing.assert_array_equal(surfels.learned, 0)
