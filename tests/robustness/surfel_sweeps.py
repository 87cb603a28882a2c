"""The sweeps of the functions of surfels: their geometry, light, blending and shading (docs/stability.md).

Neighbourhoods are noisy sheets of points; numbers of `layers` and `discs` are in spacings.  Inputs stay away from kinks
as those of `sweeps.py` do: where a texel, a neighbour or a direction changes, a gradient jumps.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from support import reference
from support.surfel_clouds import surfels
from sweeps import NAMES, Sweep, unit

from spnr_jax.kernels.records import Light
from spnr_jax.nn import shader
from spnr_jax.surfels import discs, layers, lighting, small_systems, splatting
from spnr_jax.surfels.features import NUM_MAPS
from spnr_jax.surfels.rules import NEIGHBORS, RULES

POINTS = 16


def columns(vectors):
    """Vectors in rows as columns."""
    return np.moveaxis(np.asarray(vectors), 0, -1)


def lists(rng, tau=1.0, distance=2.0):
    """Optical depths up to that, depths from that distance on, spacings."""
    depth = np.sort(distance + rng.uniform(0, 3, (24, POINTS)), axis=0)
    return tau * rng.uniform(0.1, 1, depth.shape), depth, rng.uniform(0.2, 0.6, depth.shape)


def shares_twin(tau, depth, spacing):
    """Every entry beside every other."""
    return reference.shares(tau, depth, spacing, splatting.NEAR)


def systems(rng, ridge):
    """Positive definite matrices, less so the less is added, and right sides."""
    root = rng.normal(size=(5, 5, POINTS))
    return np.einsum("ikp,jkp->ijp", root, root) + ridge * np.eye(5)[..., None], rng.normal(size=(5, 2, POINTS))


def solve_twin(matrix, right):
    """LAPACK."""
    return (columns(np.linalg.solve(np.moveaxis(matrix, -1, 0), np.moveaxis(right, -1, 0))),)


def normals(rng, angle):
    """Unit normals about that far from straight down."""
    turn, away = rng.uniform(0, 6, POINTS), angle * rng.uniform(0.5, 1, POINTS)
    return (np.stack([np.cos(turn) * np.sin(away), np.sin(turn) * np.sin(away), -np.cos(away)]),)


def frame_twin(normal):
    """Pixar's formula."""
    sign = np.where(normal[2] >= 0, 1, -1)
    a = -1 / (sign + normal[2])
    (x, y, _), b = normal, normal[0] * normal[1] * a
    first = [1 + sign * x**2 * a, sign * b, -sign * x]
    return (np.stack([np.stack(first), np.stack([b, sign + y**2 * a, -y]), normal]),)


def covariances(rng, thickness):
    """Of clouds of that thickness."""
    places = rng.normal(size=(POINTS, 12, 3)) * [1, 0.6, thickness] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return (columns(places.swapaxes(1, 2) @ places / 12),)


def sheets(rng, size=1.0):
    """Ways to the neighbours of points on noisy sheets of that spacing, and spacings."""
    flat = np.concatenate([np.zeros((1, 2, POINTS)), rng.uniform(-2, 2, (NEIGHBORS - 1, 2, POINTS))])
    height = 0.2 * flat[:, 0] ** 2 + 0.05 * rng.normal(size=flat[:, 0].shape)
    offset = np.stack([flat[:, 0], flat[:, 1], height - height[:1]], axis=1)
    return size * offset, size * rng.uniform(0.9, 1.1, POINTS)


def hood_of(offset):
    """Neighbourhoods without columns."""
    return layers.Hood(jnp.ones_like(offset[:, 0]), offset, jnp.sum(offset**2, axis=1), offset[:, :0])


def covariance(offset, spacing):
    """Of all neighbours alike."""
    return layers.measure_covariance(hood_of(offset), spacing, jnp.ones_like(offset[:, 0]))


def covariance_twin(offset, spacing):
    """NumPy's, point by point."""
    return (columns([np.cov(o.T, bias=True) for o in np.moveaxis(offset / spacing, -1, 0)]),)


def spacings(offset):
    """From the discs that hold some of the neighbours, whatever their layer."""
    return discs.first_spacing(hood_of(offset), RULES)


def spacings_twin(offset):
    """Of sorted distances."""
    distance = np.sort(np.linalg.norm(offset, axis=1), axis=0)
    return (np.sqrt(np.pi / RULES.first_disc) * distance[RULES.first_disc],)


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
    layer, _ = layers.fit_layers(hood_of(offset), spacing, up, weight, free, None, dataclasses.replace(RULES, rounds=1))
    return layer.normal, layer.height


def places(rng, size):
    """In tangent planes."""
    return (size * sheets(rng)[0][:, :2],)


def farthest_twin(place):
    """Direction by direction."""
    return (np.stack([(place[:, 0] * np.cos(t) + place[:, 1] * np.sin(t)).max(axis=0) for t in discs.TURN]),)


def slopes(place, colors):
    """Of colours over tangent planes, where there are no two."""
    one, up = jnp.ones_like(place[0, 0]), jnp.zeros_like(place[0, 0])
    axes = jnp.stack([jnp.stack([one, up, up]), jnp.stack([up, one, up]), jnp.stack([up, up, one])])
    return discs.fit_colors(place, jnp.ones_like(place[:, 0]), one, axes, colors, RULES).gradient


def tinted(rng, size):
    """Places, and colours whose square roots differ by less than two colours do."""
    (place,) = places(rng, 1.0)
    slope = rng.uniform(-1, 1, (3, 2, POINTS))
    return place, 0.5 + 0.01 * size * np.einsum("cip,kip->kcp", slope, place)


def towards(rng):
    """Unit directions well inside the texels of a light's tables."""
    row = rng.integers(2, lighting.HEIGHT - 2, POINTS) + rng.uniform(0.6, 1.4, POINTS)
    column = rng.integers(0, lighting.WIDTH, POINTS) + rng.uniform(0.6, 1.4, POINTS)
    polar, azimuth = np.pi * row / lighting.HEIGHT, 2 * np.pi * column / lighting.WIDTH
    return np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)], axis=1)


def tables(rng, size):
    """Of a light of that size."""
    return size * rng.uniform(0.1, 1, (1 + len(lighting.LEVELS), lighting.HEIGHT, lighting.WIDTH, 3))


def mirrors(light, directions, roughness):
    """What mirrors of a roughness show."""
    return jnp.stack(lighting.mirrored(Light(tables=light), list(directions.T), roughness), axis=-1)


def arrives(light, visible, normal):
    """Irradiance, as `lighting.arriving` has it of surfels."""
    found = surfels(np.zeros((POINTS, 3)), (0.0, 0.0, 1.0), 0.1)
    return lighting.arriving(dataclasses.replace(found, visible=visible, normal=normal), Light(tables=light))


def shade(outputs, maps, ambient):
    """The shader's picture, not enlarged."""
    return shader.picture(outputs, maps, ambient, 0)


def lit(rng, light):
    """Outputs of the network, and maps under light of that size that leave no pixel white."""
    maps = rng.uniform(0.2, 0.8, (1, 4, 4, NUM_MAPS))
    maps[..., 7:16] *= light
    maps[..., 6] *= 0.1
    return 0.3 * rng.normal(size=(1, 4, 4, shader.NUM_OUTPUTS)), maps, light * rng.uniform(0, 0.1, (1, 9, 3))


ROWS = (  # kernel, axis, low, usual, high, function, inputs, twin, floors
    (
        "shares",
        "optical depth of an entry",
        1e-30,
        1,
        1e15,
        splatting.shares,
        lists,
        None,
        (0.0, 1.0),
    ),  # thin: a series, to 7e-9
    (
        *("shares", "distance in spacings", 1, 2, 1e4, splatting.shares),
        *(lambda rng, v: lists(rng, distance=v), shares_twin, (0.0, 1.0)),
    ),
    ("solve", "ridge of unknowns", 1, 10, 1e6, small_systems.solve, systems, solve_twin),
    ("frame", "angle from straight down", 1e-6, 1, 1.5, small_systems.frame, normals, frame_twin),
    ("find_narrowest", "thickness", 0.1, 0.2, 0.3, small_systems.find_narrowest, covariances),
    ("measure_shape", "thickness", 0.2, 0.3, 1, small_systems.measure_shape, covariances),
    ("measure_covariance", "spacing", 1e-12, 1, 1e12, covariance, sheets, covariance_twin),
    ("first_spacing", "spacing", 1e-4, 0.1, 1e12, spacings, sorted_sheets, spacings_twin),
    ("fit_layers, a round", "spacing", 1e-12, 1, 1e12, quadric, sheets),
    ("find_farthest", "distance", 1e-30, 1, 1e30, discs.find_farthest, places, farthest_twin),
    ("fit_colors", "difference of colors", 0.1, 1, 10, slopes, tinted),
    (
        *("mirrored", "size of the light", 1e-30, 1, 1e30, mirrors),
        lambda rng, v: (tables(rng, v), towards(rng), rng.choice(lighting.LEVELS[:-1], POINTS) + 0.1),
    ),
    (
        *("arriving", "size of the light", 1e-30, 1, 1e30, arrives),
        lambda rng, v: (tables(rng, v), rng.uniform(size=(POINTS, 64)), unit(rng.normal(size=(POINTS, 3)))),
    ),
    (
        *("reflectance", "cosine", 1e-6, 0.5, 1, lighting.reflectance),
        lambda rng, v: (rng.uniform(0.1, 0.9, POINTS), v * rng.uniform(0.5, 1, POINTS)),
    ),
    ("picture", "size of the light", 1e-3, 0.3, 0.5, shade, lit, None, (1.0, 1.0)),
)

SURFEL_SWEEPS = [Sweep(**dict(zip(NAMES, row, strict=False))) for row in ROWS]
