"""The densifier of the package made from scratch, as part of the recipe: data without pictures, training, weights.

Truth are random points of training meshes and of procedural objects, with normals that point outward.  A record holds
the truth of one object and several clouds of it, sparse, even or random or noisy, with what the network sees of them.
Both halves can be stopped and go on where they were.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from data_gen import procedural
from data_gen.make.augmentation import draw_reshaping, reshape
from data_gen.plan.sources import find_meshes
from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.errors import UserError
from spnr_jax.formats import meshes
from spnr_jax.formats.array_files import pack_arrays, read_arrays
from spnr_jax.formats.assets import Asset
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.surface_points import normalise, sample_surface
from spnr_jax.kernels import cloud_arrays
from spnr_jax.kernels.cloud_arrays import farthest_points
from spnr_jax.kernels.records import PointCloud
from spnr_jax.nn.point_prediction import init, predict, rotate, weigh_rows
from spnr_jax.surfels import geometry, sides, symmetry
from spnr_jax.surfels.candidates import CANDIDATES, Candidates, Nodes, build_graph
from spnr_jax.surfels.geometry import PointColumns
from spnr_jax.surfels.neighbors import order_in_space
from spnr_jax.training.trainer import check_finite
from spnr_jax.training.weights import write_variables

VARIANTS = 2  # of each mesh: itself, and a stretched one
RATE = 2e-3  # of learning, the highest, after which it falls along a cosine
TRUTH, VOTERS, EVEN = 2**17, 2**15, 2**12  # points of a surface, those that look for its sides, and even ones at most
DENSER, MATCHED = 48, 48  # true points for each of a cloud, and those that a learned point is compared with
ASKED, NEAREST = 6, 6  # query points: true points for each of a cloud, and the places near each
CORE, NODES, PLACES, QUERIES = 1024, 1920, 4864, 3072  # of a batch: points in its middle, sizes of its arrays
FEWEST = 300  # points of a cloud
OFTEN = 0.35, 0.25, 0.1, 0.2, 0.1  # how often each cloud of a record trains: sparse ones are harder
UNLIKE = 0.12  # squared spacings that a normal at right angles counts as
HIDDEN = 0.1  # weight of what nothing outside sees
EXACT = 0.08  # spacings off the surface at which a learned point is half there
ROBUST = 0.15  # and at which errors begin to count less
OF_KEPT = "off", "cosine", "good"  # metrics of the learned points that are kept, summed by weight


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the densifier is made of, and where."""

    meshes: Path | None  # folder of .glb, .gltf, .obj and .ply files that train beside the procedural objects
    left_out: frozenset[str]  # ids of meshes that do not train
    out: Path  # folder of records, checkpoint and weights
    objects: int  # procedural ones
    steps: int
    batch: int = 1  # parts of clouds in a step, of 1,024 points each; 32 on a GPU


# --- records ----------------------------------------------------------------------------------------------------------


def make_records(options: Options) -> None:
    """Writes the record of each object that has none, in random order."""
    jobs: list[tuple[str, Any, int]] = [(f"procedural{i}", i, 0) for i in range(options.objects)]
    for name, path in find_meshes(options.meshes) if options.meshes else []:
        if name not in options.left_out:
            jobs += [(f"{name}.{variant}", path, variant) for variant in range(VARIANTS)]
    for number in np.random.default_rng(0).permutation(len(jobs)):
        name, source, variant = jobs[number]
        file = options.out / "records" / f"{name}.npz"
        if file.exists():
            continue
        begin = time.time()
        try:
            record = make_record(load(source, variant, int(number)), int(number))
        except UserError as error:
            print(f"{name} is left out: {error}", flush=True)
            continue
        write_whole(file, pack_arrays(record))
        print(f"{name}: {time.time() - begin:.1f} s", flush=True)


def load(source: Path | int, variant: int, seed: int) -> Asset:
    """A procedural object by its number, or a mesh, variants of which are stretched."""
    if isinstance(source, int):
        return procedural.make(procedural.category_of(source), 5000 + source)
    asset = meshes.load_mesh(source, source.parent)
    return reshape(asset, draw_reshaping(seed)) if variant else asset


def make_record(asset: Asset, seed: int) -> dict[str, np.ndarray]:
    """Truth of an object, and its sparse clouds as the network sees them."""
    rng = np.random.default_rng(seed)
    truth = sample_surface(normalise(asset)[0], TRUTH, seed)
    position = truth.positions.astype(np.float32)
    flipped, visible = find_outside(position, truth.normals.astype(np.float32))
    color = np.sqrt(np.clip(truth.base_color, 0, 1))
    record: dict[str, np.ndarray] = {"position": position, "normal": flipped.astype(np.float16), "visible": visible}
    record["color"] = (255 * color + 0.5).astype(np.uint8)
    even = farthest_points(position[: 2**16], EVEN, seed)
    fewer, more = (int(np.exp(rng.uniform(*np.log(x)))) for x in ((FEWEST, 1000), (1100, EVEN)))
    kinds = [(1024, True, 0.0), (fewer, True, 0.0), (4096, True, 0.0), (int(rng.choice([1024, 2048])), False, 0.0)]
    kinds += [(more, bool(rng.random() < 0.5), float(rng.choice([0.0, 0.1, 0.2])))]
    for number, (count, evenly, noise) in enumerate(kinds):
        chosen = even[:count] if evenly else rng.permutation(TRUTH)[:count]
        places = position[chosen]
        if noise:
            spacing = np.median(cKDTree(places).query(places, 2)[0][:, 1])
            places = places + noise * spacing * rng.normal(size=places.shape)
        cloud = make_cloud(np.clip(places, -1, 1).astype(np.float32), chosen, truth, position, rng)
        record |= {f"{name}{number}": values for name, values in cloud.items()}
    return record | {"clouds": np.array(len(kinds))}


def find_outside(
    position: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """True normals that point outward, and which points something outside sees, by the votes of directions."""
    voters = position[:VOTERS], normal[:VOTERS]
    spacing = cKDTree(voters[0]).query(voters[0], 7)[0][:, 6] * np.sqrt(np.pi / 6)
    front, back = map(np.asarray, count_sides(*(x.T for x in voters), spacing.astype(np.float32)))
    lean = (front - back) / (front + back + 1)
    scale = 4 * np.median(spacing)
    both = (np.concatenate([of, scale * to], axis=1) for of, to in (voters, (position, normal)))
    nearest = cKDTree(next(both)).query(next(both))[1]
    return normal * np.where(lean < -0.5, -1, 1)[nearest, None], (front + back > 0.4)[nearest]


@partial(jax.jit, compiler_options=QUICKEST)
def count_sides(position: Array, normal: Array, spacing: Array) -> tuple[Array, Array]:
    """How many directions see each point from before and from behind."""
    mask = jnp.ones(position.shape[1], bool)
    points = PointColumns(jnp.zeros((1, len(mask)), jnp.int32), mask, mask, position, position)
    return sides.sum_visibility(normal, geometry.estimate_visibility(points, normal, spacing))


_see = jax.jit(build_graph, compiler_options=QUICKEST)


def make_cloud(
    places: np.ndarray, chosen: np.ndarray, truth: Any, true_position: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """What the network sees of a cloud, with reflected points, and the true points near each candidate."""
    columns = {name: getattr(truth, name)[chosen] for name in ("base_color", "roughness", "metallic")}
    cloud = symmetry.complete(PointCloud(positions=places, mask=np.ones(len(places), bool), **columns))
    order, near = order_in_space(np.asarray(cloud.positions))
    count = len(order)
    size = cloud_arrays.bucket(count)
    cloud = jax.tree.map(lambda x: x[order], cloud)
    neighbors = np.pad(near, [(0, size - count), (0, 0)], constant_values=-1)
    nodes, found = jax.device_get(_see(cloud_arrays.pad(cloud, size), neighbors))
    kept = np.flatnonzero(found.exists[: CANDIDATES * count])
    arrays = {name: values[:count] for name, values in nodes._asdict().items()}
    arrays |= {f"place_{name}": values[kept] for name, values in found._asdict().items()}
    dense = true_position[: min(DENSER * count, TRUTH)]
    asked = rng.choice(len(dense), ASKED * count, replace=False)
    arrays |= {"neighbors": near, "asked": asked.astype(np.int32), "floor": np.array(0.7 * np.sqrt(count / len(dense)))}
    arrays["matched"] = cKDTree(dense).query(found.middle[kept], MATCHED)[1].astype(np.int32)
    arrays["nearest"] = cKDTree(found.middle[kept]).query(dense[asked], NEAREST)[1].astype(np.int32)
    arrays["parents"] = cKDTree(cloud.positions).query(dense[asked], 2)[1].astype(np.int32)
    return {
        name: values.astype(np.float32) if values.dtype == np.float64 else values for name, values in arrays.items()
    }


# --- batches ----------------------------------------------------------------------------------------------------------


class Truth(NamedTuple):
    """What learned points are compared with: true points near each place, and query points."""

    position: Any
    normal: Any
    color: Any
    visible: Any
    floor: Any
    asked: Any
    asked_normal: Any
    asked_visible: Any
    nearest: Any
    parents: Any


class Batch(NamedTuple):
    """Parts of clouds, padded to fixed sizes."""

    nodes: Nodes
    neighbors: Any
    places: Candidates
    truth: Truth


def make_batch(records: list[Path], rng: np.random.Generator) -> Batch:
    """Parts of random clouds until there are as many points as a batch has."""
    parts: list[Batch] = []
    count = 0
    while count < CORE - FEWEST:
        with np.load(records[rng.integers(len(records))]) as record:  # reads what is asked for: all need 24 MB each
            number = int(rng.choice(int(record["clouds"]), p=OFTEN))
            part, core = cut(record, number, min(CORE - count, CORE), rng)
        parts.append(mirror(part) if rng.random() < 0.5 else part)
        count += core
    return join(parts)


def cut(record: Mapping[str, np.ndarray], number: int, most: int, rng: np.random.Generator) -> tuple[Batch, int]:
    """The part of a cloud around a random point that owns at most so many points, and how many those are."""
    get = {name.removesuffix(str(number)): record[name] for name in record if name.endswith(str(number))}
    position, near = get["position"], get["neighbors"]
    count = min(most, len(position))
    core = cKDTree(position).query(position[rng.integers(len(position))], count)[1].reshape(-1)
    inside = np.zeros(len(position), bool)
    inside[core] = True
    chosen = np.flatnonzero(inside[get["place_first"]])
    rows: dict[str, Any] = {
        name.removeprefix("place_"): x[chosen] for name, x in get.items() if name.startswith("place_")
    }
    used = np.unique(np.concatenate([core, rows["second"], near[core].ravel(), rows["around"].ravel()]))
    used = used[used >= 0]

    def renumber(size: int, kept: np.ndarray) -> np.ndarray:
        table = np.full(size + 1, -1, np.int32)
        table[kept] = np.arange(len(kept), dtype=np.int32)
        return table  # -1 stays -1

    point, site = renumber(len(position), used), renumber(len(get["place_first"]), chosen)
    rows |= {name: point[rows[name]] for name in ("first", "second", "around")}
    nodes = Nodes(*(get[name][used] for name in Nodes._fields))
    asked = np.flatnonzero(site[get["nearest"][:, 0]] >= 0)
    asked = rng.permutation(asked)[: int(QUERIES * count / CORE * 0.95)]
    true = get["asked"][asked]
    at = get["matched"][chosen]
    at_places = (record[name][at] for name in ("position", "normal", "color", "visible"))
    floor = np.full(len(chosen), get["floor"], np.float32)
    of_asked = (record[name][true] for name in ("position", "normal", "visible"))
    compared = (*at_places, floor, *of_asked, site[get["nearest"][asked]], point[get["parents"][asked]])
    truth = Truth(*compared)
    return Batch(nodes, point[near[used]], Candidates(**rows), truth), count


def mirror(part: Batch) -> Batch:
    """The part mirrored along x; frames stay right-handed."""
    sign = np.array([-1, 1, 1], np.float32)
    nodes, places, truth = part.nodes, part.places, part.truth
    frame = places.frame * sign * np.array([1, -1, 1], np.float32)[:, None]
    return Batch(
        nodes._replace(position=nodes.position * sign, normal=nodes.normal * sign),
        part.neighbors,
        places._replace(middle=places.middle * sign, frame=frame),
        truth._replace(
            position=truth.position * sign,
            normal=truth.normal * sign.astype(np.float16),
            asked=truth.asked * sign,
            asked_normal=truth.asked_normal * sign.astype(np.float16),
        ),
    )


def join(parts: list[Batch]) -> Batch:
    """Parts side by side, padded."""
    nodes = np.cumsum([0] + [len(part.neighbors) for part in parts])
    sites = np.cumsum([0] + [len(part.places.first) for part in parts])
    shifted = []
    for part, point, site in zip(parts, nodes, sites, strict=False):

        def move(x: Any, by: int) -> Any:
            return np.where(x < 0, -1, x + by).astype(np.int32)

        moved = {name: move(getattr(part.places, name), point) for name in ("first", "second", "around")}
        places = part.places._replace(**moved)
        truth = part.truth._replace(nearest=move(part.truth.nearest, site), parents=move(part.truth.parents, point))
        shifted.append(Batch(part.nodes, move(part.neighbors, point), places, truth))
    joined = jax.tree.map(lambda *x: np.concatenate(x), *shifted)

    def pad(x: Any, size: int, fill: float = 0) -> Any:
        return np.concatenate([x[:size], np.full((max(size - len(x), 0), *x.shape[1:]), fill, x.dtype)])

    given, places, truth = joined.nodes, joined.places, joined.truth
    points = Nodes(*(pad(x, NODES) for x in given))._replace(spacing=pad(given.spacing, NODES, 1))
    padded = Candidates(*(pad(x, PLACES) for x in places))
    padded = padded._replace(scale=pad(places.scale, PLACES, 1), around=pad(places.around, PLACES, -1))
    nearest = pad(truth.nearest, QUERIES, -1)
    true: tuple[Any, ...] = (*(pad(x, PLACES) for x in truth[:5]), *(pad(x, QUERIES) for x in truth[5:8]))
    truth = Truth._make((*true, np.where(nearest < PLACES, nearest, -1), pad(truth.parents, QUERIES, -1)))
    return Batch(points, pad(joined.neighbors, NODES, -1), padded, truth)


# --- training ---------------------------------------------------------------------------------------------------------


def measure_loss(params: dict, batch: Batch) -> tuple[Array, dict[str, Array]]:
    """(loss, metrics): learned points on the surface, true points near them, existence, normals, colors."""
    nodes, places, truth = batch.nodes, batch.places, batch.truth
    learned = predict(params, nodes, batch.neighbors, places)
    shift = rotate(learned.offset, places.frame)
    weight = places.exists * (HIDDEN + (1 - HIDDEN) * jnp.mean(truth.visible[:, :4].astype(jnp.float32), axis=1))
    weight = weight / jnp.maximum(jnp.sum(weight), 1)
    way = (truth.position - places.middle[:, None]) / places.scale[:, None, None]
    normal = truth.normal.astype(jnp.float32)
    seen, facing = jax.lax.stop_gradient((shift, learned.normal))
    squared = jnp.sum((way - seen[:, None]) ** 2, axis=-1)
    unlike = UNLIKE * (1 - jnp.einsum("mi,mti->mt", facing, normal)) + 0.2 * (1 - truth.visible)
    match = jnp.argmin(squared + unlike, axis=1)[:, None]
    goal, at_goal = (jnp.take_along_axis(x, match[..., None], axis=1)[:, 0] for x in (way, normal))
    error = shift - goal
    height = jnp.sum(error * at_goal, axis=-1)
    beside = jnp.sqrt(jnp.sum((error - height[:, None] * at_goal) ** 2, axis=-1) + 1e-8)
    beyond = jax.nn.relu(beside - truth.floor)
    off = jnp.sqrt(height**2 + beyond**2 + 1e-4) - 0.01
    cosine = jnp.sum(learned.normal * at_goal, axis=-1)
    likely = jax.nn.sigmoid(learned.logit)
    quality = jnp.exp(-0.5 * (off / EXACT) ** 2) * jnp.clip((cosine - 0.2) / 0.5, 0, 1)
    quality = jax.lax.stop_gradient(quality)
    existence = optax.sigmoid_binary_cross_entropy(learned.logit, quality)
    certain = jax.lax.stop_gradient(0.2 + 0.8 * likely) * weight
    color = weigh_rows(learned.weights, nodes.color[places.around])
    true_color = jnp.take_along_axis(truth.color, match[..., None], axis=1)[:, 0].astype(jnp.float32) / 255
    parts = {
        "learned": jnp.sum(certain * ROBUST * jnp.log1p(off / ROBUST)),
        "normal": jnp.sum(certain * (1 - cosine)),
        "existence": jnp.sum(weight * existence),
        "color": jnp.sum(certain * jnp.mean(jnp.abs(color - true_color), axis=-1)),
        "cover": measure_cover(batch, learned, likely),
    }
    factors = {"learned": 4.0, "normal": 0.6, "existence": 0.4, "color": 0.6, "cover": 1.5}
    kept = weight * (likely > 0.5)
    of_kept = zip(OF_KEPT, (off, cosine, quality), strict=True)
    metrics = parts | {"kept": jnp.sum(kept)} | {name: jnp.sum(kept * value) for name, value in of_kept}
    return sum((factors[name] * value for name, value in parts.items()), jnp.zeros(())), metrics


def measure_losses(params: dict, batch: Batch) -> tuple[Array, dict[str, Array]]:
    """Mean loss and metrics of several parts (a leading axis)."""
    return jax.tree.map(jnp.mean, jax.vmap(partial(measure_loss, params))(batch))


def measure_cover(batch: Batch, learned: Any, likely: Array) -> Array:
    """Mean distance, in spacings, from true points to the nearest likely learned or measured point that faces alike."""
    truth, places, nodes = batch.truth, batch.places, batch.nodes
    scale = places.scale[jnp.maximum(truth.nearest[:, :1], 0)]
    position = jnp.concatenate([learned.position[truth.nearest], nodes.position[truth.parents]], axis=1)
    normal = jnp.concatenate([learned.normal[truth.nearest], nodes.normal[truth.parents]], axis=1)
    real = jnp.concatenate([truth.nearest >= 0, truth.parents >= 0], axis=1)
    doubt = jnp.concatenate([1 - likely[truth.nearest], jnp.zeros(truth.parents.shape)], axis=1)
    squared = jnp.sum(((position - truth.asked[:, None]) / scale[..., None]) ** 2, axis=-1)
    cosine = jnp.einsum("qki,qi->qk", normal, truth.asked_normal.astype(jnp.float32))
    metric = jnp.where(real, squared + UNLIKE * (1 - cosine) + 0.3 * doubt, jnp.inf)
    best = jnp.argmin(jax.lax.stop_gradient(metric), axis=1)[:, None]
    distance = jnp.sqrt(jnp.take_along_axis(squared, best, axis=1)[:, 0] + 1e-3)
    weight = (truth.nearest[:, 0] >= 0) * (HIDDEN + (1 - HIDDEN) * truth.asked_visible)
    return jnp.sum(weight * distance) / jnp.maximum(jnp.sum(weight), 1)


def optimizer(options: Options) -> optax.GradientTransformation:
    """Adam with a cosine schedule."""
    warm_up = min(100, options.steps // 10)
    rate = optax.warmup_cosine_decay_schedule(0.0, RATE, warm_up, options.steps, RATE / 100)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, b2=0.99))


def train(options: Options) -> None:
    """From the checkpoint on; the weights are written beside it."""
    records = sorted((options.out / "records").glob("*.npz"))
    print(f"{len(records)} objects", flush=True)
    rule = optimizer(options)
    first = make_batch(records, np.random.default_rng(0))
    params = init(jax.random.key(0), *jax.device_put((first.nodes, first.places)))
    print(f"{sum(x.size for x in jax.tree.leaves(params))} weights", flush=True)
    state = {"params": params, "rule": rule.init(params), "step": 0}
    checkpoint = options.out / "checkpoint.npz"
    if checkpoint.exists():
        leaves, structure = jax.tree.flatten(state)
        with checkpoint.open("rb") as file:
            found = read_arrays(file)
        state = jax.tree.unflatten(structure, [found[f"leaf{i}"] for i in range(len(leaves))])
        print(f"resuming at step {state['step']} of {options.steps}", flush=True)

    @jax.jit
    def advance(params: dict, rule_state: Any, batch: Batch) -> tuple[dict, Any, dict[str, Array]]:
        (_, metrics), gradient = jax.value_and_grad(measure_losses, has_aux=True)(params, batch)
        update, rule_state = rule.update(gradient, rule_state, params)
        return optax.apply_updates(params, update), rule_state, metrics

    begin, sums = time.time(), []
    for step in range(int(state["step"]), options.steps):
        parts = [make_batch(records, np.random.default_rng((1, step, part))) for part in range(options.batch)]
        batch = jax.tree.map(lambda *x: np.stack(x), *parts)
        state["params"], state["rule"], metrics = advance(state["params"], state["rule"], batch)
        sums.append(jax.device_get(metrics))
        check_finite([(step + 1, sums[-1])])
        if step % 100 == 99 or step == 9:
            print(f"step {step + 1}, {time.time() - begin:.0f} s: {describe(sums)}", flush=True)
            sums = []
        if step % 300 == 299 or step + 1 == options.steps:
            state["step"] = step + 1
            write_variables(options.out / "densifier.npz", state["params"])
            kept = {f"leaf{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(state))}
            write_whole(checkpoint, pack_arrays(kept))  # last: a training that is killed before it makes both again


def describe(steps: list[dict[str, np.ndarray]]) -> str:
    """Mean metrics of steps; those of OF_KEPT are means over the learned points that are kept, NaN if none is."""
    mean = {name: float(np.mean([metrics[name] for metrics in steps])) for name in steps[0]}
    mean |= {name: mean[name] / (mean["kept"] or np.nan) for name in OF_KEPT}
    return " ".join(f"{name} {value:.4f}" for name, value in mean.items())
