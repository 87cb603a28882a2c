"""Laws of the functions of surfels: their geometry, light, blending and shading (docs/lab/stability.md).

Points are the last axis.  Neighbourhoods are noisy sheets of points; numbers of `layers` and `discs` are in spacings.
Inputs stay away from kinks, as those of `kernel_laws.py` do: where a texel, a neighbour or a direction changes, a
gradient jumps.
"""

import dataclasses
from unittest import mock

import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from kernel_laws import FINITE, encode_srgb, sizes, unit, usual
from scipy.ndimage import map_coordinates
from support import reference
from support.laws import TINY, Axis, Extremes, Law, close, extremes
from support.surfel_clouds import surfels, tangents

from spnr_jax.kernels import numerics
from spnr_jax.kernels.records import Light
from spnr_jax.nn import shader
from spnr_jax.nn.shader import COLOR_STEP, LOGIT_MARGIN, LOGIT_STEP, NOTHING
from spnr_jax.surfels import blending, discs, layers, lighting
from spnr_jax.surfels.constants import CONSTANTS, NEIGHBORS

POINTS = 16
NUM_MAPS = 17  # of a pixel, for the shader


def columns(vectors):
    return np.moveaxis(np.asarray(vectors), 0, -1)


def rows(vectors):
    return np.moveaxis(np.asarray(vectors), -1, 0)


# small systems


def systems(rng, ridge):
    """Positive definite matrices, less so the less is added, and right sides."""
    root = rng.normal(size=(5, 5, POINTS))
    return np.einsum("ikp,jkp->ijp", root, root) + ridge * np.eye(5)[..., None], rng.normal(size=(5, 2, POINTS))


def normals(rng, angle):
    """Unit normals about that far from straight down."""
    turn, away = rng.uniform(0, 6, POINTS), angle * rng.uniform(0.5, 1, POINTS)
    return (np.stack([np.cos(turn) * np.sin(away), np.sin(turn) * np.sin(away), -np.cos(away)]),)


def some_normals(vectors):
    """Unit vectors along those in rows, and straight down for 0."""
    vectors = np.where(vectors.any(axis=-1, keepdims=True), np.float64(vectors), [0, 0, -1])
    return np.float32(columns(unit(vectors)))


def are_frames(arguments, outputs):
    axes = rows(outputs[0])
    close(axes @ axes.swapaxes(1, 2), np.broadcast_to(np.eye(3), axes.shape), atol=2e-6)


def covariances(rng, thickness):
    places = rng.normal(size=(POINTS, 12, 3)) * [1, 0.6, thickness] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return (columns(places.swapaxes(1, 2) @ places / 12),)


def least_variance(arguments, outputs):
    """Along a unit vector that is nearly the narrowest axis; 0 where there is no extent."""
    matrix, axis = rows(np.float64(arguments[0])), rows(np.float64(outputs[0]))
    size = np.trace(matrix, axis1=1, axis2=2)
    clear = size > 2 * numerics.LEAST_TRACE
    close(np.linalg.norm(axis[clear], axis=1), np.ones(clear.sum()), atol=1e-5)
    found = np.einsum("ni,nij,nj->n", axis, matrix, axis)
    assert np.all(found <= 1.01 * np.linalg.eigvalsh(matrix)[:, 0] + 1e-5 * size + TINY)


def ratios(arguments, outputs):
    """Of standard deviations: within 0 and 1, and LAPACK's to a hundredth where no two variances are nearly alike."""
    matrix, found = rows(np.float64(arguments[0])), outputs[0].T
    assert ((found >= 0) & (found <= 1)).all()
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(matrix), 0))
    clear = extents[:, 2] > 1e-4
    expected = extents[clear, :2] / extents[clear, 1:].clip(1e-12)
    known = extents[clear, :2] > 1e-3 * extents[clear, 2:]  # of smaller ones float32 knows nothing
    close(found[clear][known], expected[known], rtol=0, atol=0.03)


clouds = extremes(POINTS, 8, 3, low=-4, high=4).map(lambda x: np.float32(columns(x.swapaxes(1, 2) @ x)))
# fmt: off
SYSTEMS = (
    Law("solve", numerics.solve, lambda matrix, right: columns(np.linalg.solve(rows(matrix), rows(right))),
        (Axis("ridge of unknowns", 1, 10, 1e6, systems),), shared=0),
    Law("solve, one unknown", numerics.solve, lambda matrix, right: right / matrix[:1],
        usual(lambda rng: (rng.uniform(1, 2, (1, 1, POINTS)), rng.normal(size=(1, 3, POINTS))))),
    Law("frame", numerics.tangent_frame, lambda normal: np.stack([*(x.T for x in tangents(normal.T)), normal]),
        (Axis("angle from straight down", 1e-6, 1, 1.5, normals),), shared=0,
        extremes=Extremes((extremes(9, 3).map(some_normals),), floors=(FINITE,), check=are_frames, twin=False)),
    Law("cross and dot", lambda a, b: (numerics.cross(a, b), numerics.dot(a, b)),
        lambda a, b: (np.cross(a, b, axis=0), np.sum(a * b, axis=0)),
        usual(lambda rng: tuple(rng.normal(size=(2, 3, POINTS)))), shared=0),
    Law("sum_products and multiply", lambda a, b: (numerics.sum_products(a, b), numerics.multiply(a, b)),
        lambda a, b: (np.einsum("kip,kjp->ijp", a, b), np.einsum("ikp,kjp->ijp", a, b)),
        usual(lambda rng: tuple(rng.normal(size=(2, 3, 3, POINTS)))), shared=0),
    Law("unit", numerics.normalize_columns, lambda v: v / np.linalg.norm(v, axis=0),
        sizes("length", 1e-8, 1e10, lambda rng, v: (v * rng.uniform(0.5, 1, (3, POINTS)),)), shared=0),
    Law("find_narrowest", numerics.find_narrowest, None, (Axis("thickness", 0.1, 0.2, 0.3, covariances),),
        shared=0, extremes=Extremes((clouds,), floors=(FINITE,), check=least_variance, twin=False)),
    Law("measure_shape", numerics.measure_shape, None, (Axis("thickness", 0.2, 0.3, 1, covariances),), shared=0,
        extremes=Extremes((clouds,), floors=(FINITE,), check=ratios, twin=False)),
    Law("measure_shape, variances nearly alike", numerics.measure_shape, None,
        usual(lambda rng: covariances(rng, 0.55)), budget=1e-3),
)
# fmt: on

# neighbourhoods


def sheets(rng, size=1.0):
    """Ways to the neighbours of points on noisy sheets of that spacing, and spacings."""
    flat = np.concatenate([np.zeros((1, 2, POINTS)), rng.uniform(-2, 2, (NEIGHBORS - 1, 2, POINTS))])
    height = 0.2 * flat[:, 0] ** 2 + 0.05 * rng.normal(size=flat[:, 0].shape)
    offset = np.stack([flat[:, 0], flat[:, 1], height - height[:1]], axis=1)
    return size * offset, size * rng.uniform(0.9, 1.1, POINTS)


def hood_of(offset):
    return layers.Neighborhood(jnp.ones_like(offset[:, 0]), offset, jnp.sum(offset**2, axis=1), offset[:, :0])


def covariance(offset, spacing):
    return layers.measure_covariance(hood_of(offset), spacing, jnp.ones_like(offset[:, 0]))


def covariance_twin(offset, spacing):
    return columns([np.cov(o.T, bias=True) for o in rows(offset / spacing)])


def spacings(offset):
    """From the discs that hold some of the neighbours, whatever their layer."""
    return discs.measure_raw_spacing(hood_of(offset))


def spacings_twin(offset):
    distance = np.sort(np.linalg.norm(offset, axis=1), axis=0)
    return np.sqrt(np.pi / CONSTANTS.raw_neighbors) * distance[CONSTANTS.raw_neighbors]


def sorted_sheets(rng, size):
    """Ways to neighbours, the nearest first."""
    offset, _ = sheets(rng, size)
    order = np.argsort(np.sum(offset**2, axis=1), axis=0)
    return (np.take_along_axis(offset, order[:, None], axis=0),)


def quadric(offset, spacing):
    """Normal and heights of the layers that begin straight up, after a round."""
    up = jnp.stack([jnp.zeros_like(spacing), jnp.zeros_like(spacing), jnp.ones_like(spacing)])
    weight = jnp.exp(-0.2 * jnp.sum((offset / spacing[None, None]) ** 2, axis=1))
    free = jnp.zeros(spacing.shape, bool)
    with mock.patch.object(layers, "CONSTANTS", dataclasses.replace(CONSTANTS, fit_rounds=1)):
        layer, _ = layers.fit_layers(hood_of(offset), spacing, up, weight, free, None)
    return layer.normal, layer.height


def places(rng, size):
    return (size * sheets(rng)[0][:, :2],)


def farthest_twin(place):
    return np.stack([(place[:, 0] * np.cos(t) + place[:, 1] * np.sin(t)).max(axis=0) for t in discs.RIM_ANGLES])


def borders(place, colors):
    """Of two colours in tangent planes, where there are two; the point itself lies at 0."""
    place = jnp.concatenate([0 * place[:1], place[1:]])
    one, up = jnp.ones_like(place[0, 0]), jnp.zeros_like(place[0, 0])
    axes = jnp.stack([jnp.stack([one, up, up]), jnp.stack([up, one, up]), jnp.stack([up, up, one])])
    return discs.find_color_edge(place, jnp.ones_like(place[:, 0]), one, axes, colors)


def parted(rng, size):
    """Places, and colours of two kinds on the sides of a line."""
    (place,) = places(rng, 1.0)
    side = np.sign(place[:, 0] + 0.5 * place[:, 1] - 0.4)[:, None]
    speckled = side * np.array([1, -0.5, 0.3])[None, :, None] + rng.uniform(-0.1, 0.1, (len(place), 3, place.shape[2]))
    return place, 0.5 + 0.2 * size * speckled


# fmt: off
NEIGHBORHOODS = (
    Law("measure_covariance", covariance, covariance_twin, sizes("spacing", 1e-12, 1e12, sheets), shared=0),
    Law("first_spacing", spacings, spacings_twin, (Axis("spacing", 1e-4, 0.1, 1e12, sorted_sheets),), shared=0),
    Law("fit_layers, a round", quadric, None, sizes("spacing", 1e-12, 1e12, sheets), shared=0),
    Law("find_farthest", discs.find_farthest, farthest_twin, sizes("distance", 1e-30, 1e30, places), shared=0),
    Law("find_border", borders, None, sizes("difference of colors", 0.1, 2, parted), shared=0),
)
# fmt: on

# lists of entries


def lists(rng, tau=1.0, distance=2.0):
    """Optical depths up to that, narrow ones, depths from that distance on, spacings."""
    depth = np.sort(distance + rng.uniform(0, 3, (24, POINTS)), axis=0)
    tau, narrowing = tau * rng.uniform(0.1, 1, depth.shape), rng.uniform(0.1, 1, depth.shape)
    return tau, tau * narrowing, depth, rng.uniform(0.2, 0.6, depth.shape)


def shares_twin(*lists):
    return reference.shares(*lists, blending.COMPARED)


@st.composite
def any_lists(draw):
    """Of any optical depth, size and spacing."""
    tau, seed = draw(extremes(24, 6, signed=False, high=3)), draw(st.integers(0, 99))
    high, size, rng = draw(st.integers(-6, 3)), draw(st.integers(-3, 1)), np.random.default_rng(seed)
    depth = np.sort(1 + 10.0**high * rng.uniform(size=tau.shape), axis=0)
    narrow = np.float32(tau * rng.uniform(size=tau.shape))
    return tau, narrow, np.float32(depth), np.float32(10.0**size * rng.uniform(0.5, 1, tau.shape))


def gap_rounding(tau, narrow, depth, spacing):
    """What float32 knows of a gap in spacings."""
    return np.abs(depth).max() / spacing.min()


def within_one(arguments, outputs):
    """Shares lie in 0 to 1, and so does the sum of those that are blend weights."""
    share, colored, left = outputs
    assert min(share.min(), colored.min()) >= 0
    assert max(colored.max(), left.max()) <= 1 + 1e-5
    assert share.sum(axis=0).max() <= 1 + 1e-5


# fmt: off
LISTS = (
    # thin lists are a series, to 7e-9: no twin for all
    Law("blend weights", blending.compute_blend_weights, None,
        (Axis("optical depth of an entry", 1e-30, 1, 1e15, lists),), shared=0, floors=(0.0, 0.0, 1.0)),
    Law("blend weights of a thin list", blending.compute_blend_weights, shares_twin,
        (Axis("optical depth of an entry", 1e-4, 5e-3, 1e-2, lists),), floors=(0.0, 0.0, 1.0), agreement=1e-7),
    Law("blend weights beside the loop", blending.compute_blend_weights, shares_twin,
        (Axis("distance in spacings", 1, 2, 1e4, lambda rng, v: lists(rng, distance=v)),), floors=(0.0, 0.0, 1.0),
        extremes=Extremes((any_lists(),), floors=lambda *x: (1.0, 1.0, gap_rounding(*x), gap_rounding(*x)), rtol=1e-4,
        atol=lambda tau, *x: 1e-6 * (1 + gap_rounding(tau, *x) * tau.max()), check=within_one)),
)
# fmt: on

# light


def towards(rng):
    """Unit directions well inside the texels of a light's tables."""
    row = rng.integers(2, lighting.HEIGHT - 2, POINTS) + rng.uniform(0.6, 1.4, POINTS)
    column = rng.integers(0, lighting.WIDTH, POINTS) + rng.uniform(0.6, 1.4, POINTS)
    column[0] = lighting.WIDTH  # where the azimuth begins anew
    polar, azimuth = np.pi * row / lighting.HEIGHT, 2 * np.pi * column / lighting.WIDTH
    return np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)])


def tables(rng, size):
    return size * rng.uniform(0.1, 1, (1 + len(lighting.LEVELS), lighting.HEIGHT, lighting.WIDTH, 3))


def mirrors(light, directions, roughness):
    return jnp.stack(lighting.reflect(Light(tables=light), list(directions), roughness))


def mirrors_twin(light, directions, roughness):
    """Linear between texels and between roughnesses; at a pole the azimuth is 0."""
    x, y, z = directions
    across = np.hypot(x, z)
    azimuth = np.where(across > lighting.POLE, np.arctan2(x, -z), 0) % (2 * np.pi)
    row = np.arctan2(across, y) / np.pi * lighting.HEIGHT - 0.5
    column = azimuth / (2 * np.pi) * lighting.WIDTH + 0.5  # after the last one, which is put before the first
    place = [np.clip(roughness, 0, 1) * (len(lighting.LEVELS) - 1), row, column]
    around = np.pad(light[1:], ((0, 0), (0, 0), (1, 1), (0, 0)), mode="wrap")
    return np.stack([map_coordinates(around[..., i], place, order=1, mode="nearest") for i in range(3)])


@st.composite
def any_mirror(draw):
    """A map, directions along the axes among them, and roughnesses at the levels and beyond."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    roughness = rng.choice([-0.1, *lighting.LEVELS, 0.33, 1.1], 9)
    return tables(rng, 1.0), draw(extremes(9, 3).map(some_normals)), roughness


def arrives(light, visible, normal):
    """Irradiance, as `lighting.gather_irradiance` has it of surfels."""
    count = visible.shape[-1]
    found = surfels(np.zeros((count, 3)), (0.0, 0.0, 1.0), 0.1)
    return lighting.gather_irradiance(
        dataclasses.replace(found, visibility=visible.T, normal=normal.T), Light(tables=light)
    ).T


def shade(outputs, maps, ambient):
    return shader.compose_picture(outputs, maps, ambient, 0)


def shade_twin(outputs, maps, ambient):
    color, metallic, opacity, factor, summand, irradiance, unshadowed, mirrored, reflected = np.split(
        maps, [3, 4, 5, 6, 7, 10, 13, 16], axis=-1
    )
    steps, logit_step, factors, constant, bands, metallic_step, rougher = np.split(
        outputs, [3, 4, 8, 11, 19, 20], axis=-1
    )
    darker, open_sky, shine, glow = np.split(factors, 4, axis=-1)
    color, metallic = np.clip(color + COLOR_STEP * steps, 0, 1), np.clip(metallic + COLOR_STEP * metallic_step, 0, 1)
    mirrored = mirrored + np.clip(rougher, 0, 1) * (unshadowed - mirrored)
    bounced = constant * ambient[0, 0] + bands @ ambient[0, 1:]
    diffuse = (1 + darker) * irradiance + open_sky * unshadowed + bounced
    specular = ((lighting.SPECULAR * (1 - metallic) + color * metallic) * factor + summand) * mirrored
    linear = color * (1 - metallic) * diffuse + specular * ((1 + shine) * reflected + glow)
    odds = np.exp(LOGIT_STEP * logit_step) * (opacity + LOGIT_MARGIN) / (1 + LOGIT_MARGIN - opacity)
    alpha = odds / (1 + odds) * -np.expm1(-opacity / NOTHING)
    return np.minimum(encode_srgb(np.maximum(linear, 0)), 1), alpha[..., 0]


def lit(rng, light):
    """Outputs of the network, and maps under light of that size that leave no pixel white."""
    maps = rng.uniform(0.2, 0.8, (1, 4, 4, NUM_MAPS))
    maps[..., 7:16] *= light
    maps[..., 6] *= 0.1
    return 0.3 * rng.normal(size=(1, 4, 4, shader.NUM_OUTPUTS)), maps, light * rng.uniform(0, 0.1, (1, 9, 3))


@st.composite
def strange_pixels(draw):
    """Outputs up to 10, and materials at the ends of opacity, under light of any size or none."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    maps = rng.uniform(0.1, 0.9, (1, 4, 4, NUM_MAPS))
    maps[..., 4] = draw(st.sampled_from([0.0, 1e-8, 0.5, 1.0]))
    light = draw(st.sampled_from([0.0, 1e-6, 1.0, 1e6]))
    maps[..., 7:16] = light
    outputs = 10 * rng.uniform(-1, 1, (1, 4, 4, shader.NUM_OUTPUTS))
    return tuple(map(np.float32, (outputs, maps, np.full((1, 9, 3), light))))


def is_a_picture(arguments, outputs):
    """Colours and opacities lie in 0 to 1; without light all is black."""
    assert all(((x >= 0) & (x <= 1)).all() for x in outputs)
    if not arguments[2].any():
        assert (outputs[0] == 0).all()


# fmt: off
LIGHT = (
    Law("reflect", mirrors, mirrors_twin, sizes("size of the light", 1e-30, 1e30,
            lambda rng, v: (tables(rng, v), towards(rng), rng.choice(lighting.LEVELS[:-1], POINTS) + 0.1)), shared=1,
        extremes=Extremes((any_mirror(),), floors=(FINITE,) * 3, rtol=1e-4, atol=lambda *x: 1e-4)),
    Law("arriving", arrives, None, sizes("size of the light", 1e-30, 1e30,
            lambda rng, v: (tables(rng, v), rng.uniform(size=(64, POINTS)), unit(rng.normal(size=(POINTS, 3))).T)),
        shared=1),
    Law("reflectance", lighting.reflectance, None,
        (Axis(*("cosine", 1e-6, 0.5, 1), lambda rng, v: (rng.uniform(0.1, 0.9, POINTS),
            v * rng.uniform(0.5, 1, POINTS))),), shared=0),
    Law("picture", shade, shade_twin, (Axis("size of the light", 1e-3, 0.3, 0.5, lit),), floors=(1.0, 1.0),
        extremes=Extremes((strange_pixels(),), floors=(FINITE,) * 3, rtol=1e-4, atol=lambda *x: 1e-5,
        check=is_a_picture)),
)
# fmt: on

LAWS = (*SYSTEMS, *NEIGHBORHOODS, *LISTS, *LIGHT)
