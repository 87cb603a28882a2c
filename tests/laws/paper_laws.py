"""Laws of the paper's network: sampling along rays, voxels, normalisation, a whole rendering; as `kernel_laws.py`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from kernel_laws import FINITE, each, seeds, sizes, towards_box, usual
from support import reference
from support.laws import TINY, Axis, Extremes, Law, close, extremes, sorted_distances

from spnr_jax.config import PaperConfig, SamplingConfig
from spnr_jax.kernels import compositing, sampling, voxels
from spnr_jax.kernels.records import Rays, Scene
from spnr_jax.method import inference, paper_method
from spnr_jax.nn.convolution import BatchNorm, GroupNorm

BINS, POINTS = 8, 12


# along rays


def middles(near, far):
    """Samples without a key, and the edges of their parts."""
    return sampling.stratified(None, near, far, 5)


def middles_twin(near, far):
    places = near + (far - near) * np.arange(11) / 10
    return places[1::2], places[::2]


def one_per_part(arguments, outputs):
    distances, edges = outputs
    assert ((edges[..., :-1] <= distances) & (distances <= edges[..., 1:])).all()


def short(near, far):
    """Shorter intervals round to either edge, and so do their gradients."""
    return (0.0, 0.0) if (far - near > 1e-5 * near).all() else (FINITE, FINITE)


@st.composite
def near_and_far(draw):
    near, length = draw(extremes(3, signed=False)), draw(extremes(3, signed=False))
    return near, near + length


def layers(rng, depth=3.0, n=128):
    """Densities of about that optical depth in all, and lengths."""
    return depth * rng.uniform(0.01, 2, (6, n)), rng.uniform(0.5, 1.5, (6, n)) / n


def shares(rng, n=128):
    weights = rng.uniform(0.1, 1, (6, n))
    return 0.9 * weights / weights.sum(-1, keepdims=True)


def along(rng, size):
    """Weights, distances between 2 and 3 sizes, and the far side."""
    return shares(rng), size * np.sort(rng.uniform(2, 3, (6, 128))), np.full(6, 3.0 * size)


def add_up(arguments, outputs):
    """Weights are no less than 0, and 1 with the residual transmittance."""
    weights, residual = outputs
    assert (weights >= 0).all()
    close(weights.sum(-1) + residual, np.ones(len(residual)), rtol=0, atol=1e-6)


@st.composite
def marched(draw):
    """Weights of any density along sorted distances, and the far side."""
    distances = draw(sorted_distances(3, BINS + 2))
    density, delta = draw(extremes(3, BINS, signed=False)), np.diff(distances[:, 1:])
    return (
        np.asarray(compositing.volume_weights(jnp.asarray(density), jnp.asarray(delta))[0]),
        distances[:, 1:-1],
        distances[:, -1],
    )


@st.composite
def weighted(draw):
    """Weights of any density, values and background of any size."""
    density, values = draw(extremes(3, BINS, signed=False)), draw(extremes(3, BINS, 2))
    background = draw(st.sampled_from([0, 1, -1e-30, 1e30]))
    weights = compositing.volume_weights(jnp.asarray(density), jnp.ones((3, BINS)))[0]
    return np.asarray(weights), values, np.full((3, 2), background, np.float32)


def between(arguments, outputs):
    """A distance lies between the first sample and the end."""
    _, distances, far = arguments
    slack = 2e-6 * far
    assert ((outputs[0] >= distances[:, 0] - slack) & (outputs[0] <= far + slack)).all()


def union_twin(coarse, fine, density, far):
    """Of the sorted samples, put back in their places."""
    distances = np.concatenate([coarse, fine])
    order, weights = np.argsort(distances, kind="stable"), np.empty(len(distances))
    weights[order], _ = reference.volume_weights(density[order], np.diff(np.append(distances[order], far)))
    return weights


def two_lists(rng):
    """Coarse and fine distances, densities of both, the far side."""
    return (*(np.sort(rng.uniform(-1, 1, (6, n))) for n in (5, 4)), rng.uniform(0, 3, (6, 9)), np.full(6, 1.5))


@st.composite
def two_marches(draw):
    """Sorted lists with ties, within each and between them, up to the far side, and densities of any size."""
    rng = np.random.default_rng(draw(seeds))
    coarse, fine = (np.sort(rng.integers(0, draw(st.sampled_from([1, 6, 1000])), (3, n)) / 1000) for n in (5, 4))
    return coarse, fine, draw(extremes(3, 9, signed=False)), np.ones(3)


# fmt: off
RAYS = (
    Law("stratified", middles, each(middles_twin, "(),()->(n),(m)"),
        sizes("size of near and far", 1e-32, 1e36,
        lambda rng, v: (v * rng.uniform(0.5, 1, 6), v * rng.uniform(1.5, 2, 6))), (0, 0),
        Extremes((near_and_far(),), floors=short, rtol=2e-6, check=one_per_part)),
    Law("interval_lengths", compositing.interval_lengths, lambda t, far: np.diff(t, append=far[:, None]),
        usual(lambda rng: (np.sort(rng.uniform(0, 2, (6, 8))), np.full(6, 2.5))), (1, 0)),
    Law("volume_weights", compositing.volume_weights, each(reference.volume_weights, "(n),(n)->(n),()"),
        (Axis("optical depth of a ray", 1e-32, 1, 1e36, layers),
        Axis("number of samples", 1, 64, 4096, lambda rng, n: layers(rng, n=int(n))),
        # the transmittance of each rounds to 1 in float32, and so would their product
        Axis("number of thin samples", 1, 64, 4096, lambda rng, n: layers(rng, 1e-4, int(n)))), (1, 1),
        floors=(0.0, 1.0), extremes=Extremes((extremes(3, BINS, signed=False), extremes(3, BINS, signed=False)),
        rtol=1e-5, atol=lambda *x: 1e-12, check=add_up)),
    Law("composite", compositing.composite, each(reference.composite, "(n),(n,f),(f)->(f)"),
        sizes("size of the colours", 1e-40, 1e36, lambda rng, v: (shares(rng), v * rng.uniform(0, 1, (6, 128, 3)),
            np.ones((6, 3)))), (1, 2, 1), floors=(1.0,),
        extremes=Extremes((weighted(),), floors=(0.0, 0.0, 1.0), rtol=0,
        atol=lambda w, x, b: 2e-6 * max(np.abs(x).max(), np.abs(b).max()) + TINY)),
    Law("expected_distance", compositing.expected_distance, lambda w, t, far: (w * t).sum(-1) + (1 - w.sum(-1)) * far,
        sizes("size of the distances", 1e-32, 1e36, along), (1, 1, 0),
        Extremes((marched(),), floors=lambda w, t, far: (float(far.max()), 1.0, 1.0), rtol=2e-6,
        atol=lambda w, t, far: 2e-6 * far.max() + TINY, check=between)),
    Law("union_weights", paper_method.union_weights, each(union_twin, "(c),(f),(n),()->(n)"), usual(two_lists),
        (1, 1, 1, 0), Extremes((two_marches(),), floors=(FINITE,) * 4, rtol=1e-5, atol=lambda *x: 1e-6)),
)
# fmt: on

# volumes


def cells(rng, n, resolution):
    """Positions well inside voxels, away from their walls and centres' planes."""
    cell = rng.integers(0, resolution, (*n, 3)) + rng.choice([0.25, 0.75], (*n, 3)) + rng.uniform(-0.2, 0.2, (*n, 3))
    return cell * 2 / resolution - 1


def scatter(features, positions, mask, like):
    """Mean and occupancy in a volume of the size of another."""
    return voxels.scatter_mean(jax.lax.stop_gradient(positions), features, mask > 0.5, len(like))


def scatter_twin(features, positions, mask, like):
    return reference.scatter_mean(positions, features, mask > 0.5, len(like))


def points(rng, n, resolution, size=1.0):
    """Features up to a size, positions, nine tenths of them real, and a volume that says the resolution."""
    mask = np.tile(np.arange(n) % 10 != 9, (6, 1))
    return size * rng.uniform(0, 1, (6, n, 1)), cells(rng, (6, n), resolution), mask, np.zeros([resolution] * 3)


def lookup(rng, resolution, size=1.0):
    return size * rng.normal(size=(*[resolution] * 3, 2)), cells(rng, (36,), resolution)


def on_grid(positions):
    """Positions whose place in a volume float32 computes without rounding, so that both precisions see one voxel."""
    return np.where(np.abs(positions) < 8, np.round(positions * 2**20) / 2**20, positions).astype(np.float32)


anywhere = st.one_of(  # on the faces of voxels and of the box, too
    extremes(POINTS, 3),
    seeds.map(lambda seed: 1.3 * np.random.default_rng(seed).uniform(-1, 1, (POINTS, 3))),
    seeds.map(lambda seed: np.random.default_rng(seed).integers(-5, 6, (POINTS, 3)) / 4),
).map(on_grid)
volumes = st.sampled_from([1, 4]).flatmap(lambda n: extremes(n, n, n, 2))
masks = st.tuples(seeds, st.sampled_from([0, 0.5, 1])).map(
    lambda drawn: np.float32(np.random.default_rng(drawn[0]).random(POINTS) < drawn[1])
)
# fmt: off
VOLUMES = (
    Law("scatter_mean", scatter, each(scatter_twin, "(n,f),(n,p),(n),(d,d,d)->(d,d,d,f),(d,d,d)"),
        (Axis("size of the features", 1e-32, 1, 1e36, lambda rng, v: points(rng, 40, 4, v)),
        Axis("points in one voxel", 1, 64, 512, lambda rng, n: points(rng, int(n), 1))), (2, 2, 1, None),
        Extremes((extremes(POINTS, 2), anywhere, masks,
            st.sampled_from([1, 4]).map(lambda n: np.zeros([n] * 3, np.float32))),
        atol=lambda features, *others: 1e-6 * max(np.abs(features).max(), 1) + TINY)),
    Law("trilinear", voxels.trilinear, each(reference.trilinear, "(d,d,d,f),(p)->(f)"),
        (Axis("size of the features", 1e-32, 1, 1e36, lambda rng, v: lookup(rng, 8, v)),
        Axis("voxels along an axis", 2, 32, 64, lambda rng, d: lookup(rng, int(d)))), (None, 1),
        Extremes((volumes, anywhere), floors=lambda volume, at: (0.0, np.abs(volume).max()), rtol=0,
        atol=lambda volume, at: 1e-6 * np.abs(volume).max() + TINY)),
)
# fmt: on

# the paper's network


def initial(module, x, *others):
    """The ones and zeros that a normalisation starts with, in the format of x."""
    return jax.tree.map(lambda leaf: leaf.astype(x.dtype), module.init(jax.random.key(0), x, *others))


def batch_norm(x, mask):
    """In training; and its running statistics, which have no gradient."""
    inputs = (x, mask > 0.5, True)
    out, updated = BatchNorm().apply(initial(BatchNorm(), *inputs), *inputs, mutable=["batch_stats"])
    stats = jax.lax.stop_gradient(updated["batch_stats"])
    return jnp.where(mask[:, None] > 0.5, out, 0), stats["mean"], stats["variance"]


def batch_norm_twin(x, mask):
    """A tenth of the way from 0 and 1 to the mean and the unbiased variance of what is real."""
    real = mask > 0.5
    normalised, mean, variance = reference.batch_norm(x[real])
    out, count = np.zeros_like(x), max(real.sum(), 1)
    out[real] = normalised
    return out, 0.1 * mean, 0.9 + 0.1 * variance * count / max(count - 1, 1)


def rounding_of_means(x, mask):
    """A mean is rounded relative to its size, and the output counts in standard deviations."""
    _, _, variance = reference.batch_norm(x[mask > 0.5])
    size = np.abs(x).max()
    return (
        (1e-6 * size / np.sqrt(variance + 1e-5)).max() + 1e-6,
        1e-6 * size + TINY,
        1e-6 * np.float64(size) ** 2 + TINY,
    )


def moved_by(rng, value, shape, moved):
    """Features of that spread, or of that mean and spread 1."""
    return value + rng.normal(size=shape) if moved else value * rng.normal(size=shape)


def spreads(shape, *others):
    """How wide features are spread, and how far they lie from 0."""
    return (
        Axis("spread of the features", 1e-33, 1, 1e15, lambda rng, v: (moved_by(rng, v, shape, False), *others)),
        Axis("mean over spread", 1, 1, 100, lambda rng, v: (moved_by(rng, v, shape, True), *others)),
    )


def render(volume, origins, directions, bias):
    """Features, depth and opacity of rays through a volume by a small network; `bias` moves every density."""
    config = PaperConfig(
        field_width=8, num_features=4, direction_frequencies=1, sampling=SamplingConfig(num_coarse=16, num_fine=16)
    )
    module, rays = inference.network(config), Rays(origins=origins, directions=directions)
    encoded, rng = Scene(volume=volume, occupied=jnp.ones(volume.shape[:-1], bool)), np.random.default_rng(7)
    traced = partial(paper_method.render_rays, samples=config.sampling, block_size=None, key=None)
    shapes = jax.eval_shape(lambda: module.init(jax.random.key(0), encoded, rays, method=traced))

    def draw(x):
        weights = np.float32(rng.normal(size=x.shape) / max(int(np.prod(x.shape[:-1])), 1) ** 0.5)
        return jnp.asarray(weights, volume.dtype)

    variables = jax.tree.map(draw, shapes)
    head = variables["params"]["field"]["head"]
    # no gradient by the bias: one number for all rays, whose gradients would cancel
    head["bias"] = head["bias"] + jnp.concatenate([jax.lax.stop_gradient(bias), jnp.zeros(3, bias.dtype)])
    return tuple(traced(module.bind(variables), encoded, rays))


def scene(rng, density=3.0, distance=3.0):
    """A random volume of about that density, seen from that far away."""
    origins, directions = towards_box(rng, distance)
    bias = np.array([1 + (density if density > 30 else np.log(np.expm1(density)))])
    return rng.normal(size=(1, 8, 8, 8, 16)), origins[None], directions[None], bias


# fmt: off
NETWORK = (
    Law("BatchNorm", batch_norm, batch_norm_twin, spreads((256, 8), np.ones(256)),
        extremes=Extremes((extremes(POINTS, 3, high=17), masks), rtol=1e-5, atol=rounding_of_means), smooth=False),
    Law("GroupNorm", lambda x: GroupNorm(2).apply(initial(GroupNorm(2), x[None]), x[None])[0],
        lambda x: reference.group_norm(x, 2), spreads((4, 4, 4, 4))),
    Law("whole render", render, None, (Axis("density", 1e-30, 1, 1e30, scene),
            Axis("distance of the camera", 1, 3, 10, lambda rng, v: scene(rng, distance=v))), floors=(1.0, 1.0, 1.0),
        smooth=False),
)
# fmt: on

LAWS = (*RAYS, *VOLUMES, *NETWORK)
