"""Light from all around, and what of it meets a surface: every function here is linear in the environment map.

A map is (height, 2 * height, 3), linear radiance, latitude-longitude: row 0 is straight up (+y), column c of w looks
along the azimuth phi = 2 pi (c + 0.5) / w, where the direction is (sin phi, 0, -cos phi) on the horizon.

    tables    irradiance by normal, and the map blurred by the GGX lobes of LEVELS by mirrored direction (split-sum
              approximation, Karis 2013), 32 x 64 texels each
    arriving  what each surfel receives of it: irradiance through the directions that see the surfel
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels.records import Light, Surfels
from spnr_jax.surfels.visibility import DIRECTIONS

HEIGHT, WIDTH = 32, 64  # of a table
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of roughness
TOLD = 2  # the level whose values at the directions of the visibility stand for what comes from there
SPECULAR = 0.04  # reflectance of what is not metal, seen from straight above
LOBE = 8.0  # of the directions around the mirrored one whose visibility counts
SH_BANDS = 9  # spherical harmonics up to degree 2


def directions(height: int) -> Float[np.ndarray, "height width 3"]:
    """Unit directions through the middles of a map's texels."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    across = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height))
    return np.stack([across * np.sin(phi), up, -across * np.cos(phi)], axis=-1).astype(np.float32)


def solid_angles(height: int) -> Float[np.ndarray, "height width"]:
    """Of the texels of a map, in steradian."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    rows = (edges[:-1] - edges[1:]) * np.pi / height
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


@cache
def _lobes() -> Float[np.ndarray, "tables texels texels"]:
    """Weights of the texels in each entry of the tables, those of a lobe adding up to 1."""
    towards, area = directions(HEIGHT).reshape(-1, 3), solid_angles(HEIGHT).reshape(-1)
    cosine = np.maximum(towards @ towards.T, -1)
    lobes = [np.maximum(cosine, 0)]
    half = np.clip((1 + cosine) / 2, 0, 1)
    for roughness in LEVELS[1:]:
        squared = roughness**4
        lobes.append(squared / (half * (squared - 1) + 1) ** 2 * np.maximum(cosine, 0))
    weights = np.stack(lobes) * area
    return (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)


def light_of(envmap: Float[np.ndarray, "height width 3"]) -> Light:
    """The light of a map of any size whose width is twice its height; energy is kept."""
    small = resampled(np.asarray(envmap, np.float32), HEIGHT)
    tables = (_lobes() @ small.reshape(-1, 3)).reshape(-1, HEIGHT, WIDTH, 3)
    return Light(tables=np.concatenate([tables[:1], small[None], tables[1:]]))


def resampled(envmap: Float[np.ndarray, "h w 3"], height: int) -> Float[np.ndarray, "height width 3"]:
    """A map of another size: means over its texels' solid angles, of a map refined first where it is too coarse."""
    fine = envmap
    for axis, size in ((0, height), (1, 2 * height)):
        repeats = int(np.lcm(fine.shape[axis], size) // fine.shape[axis])
        fine = np.repeat(fine, repeats, axis=axis) if repeats < 16 else _stretched(fine, axis, 16 * size)
    area = np.repeat(_row_areas(fine.shape[0])[:, None], fine.shape[1], axis=1)[..., None]
    shape = (height, fine.shape[0] // height, 2 * height, fine.shape[1] // (2 * height))
    total, weight = ((x.reshape(*shape, -1)).sum(axis=(1, 3)) for x in (fine * area, area))
    return (total / weight).astype(np.float32)


def _stretched(values: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Nearest texels at `size` places."""
    return np.take(values, (np.arange(size) + 0.5) * values.shape[axis] // size, axis=axis, mode="clip")


def _row_areas(height: int) -> np.ndarray:
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (edges[:-1] - edges[1:]).astype(np.float32)


def look_up(tables: Float[Array, "rows 3"], towards: list[Array], first: Array | int = 0) -> list[Array]:
    """Bilinear values of flattened tables at unit directions, given and returned as columns.

    `first` is the row at which a table begins, for each direction.
    """
    x, y, z = towards
    row = jnp.arccos(jnp.clip(y, -1, 1)) / jnp.pi * HEIGHT - 0.5
    column = jnp.arctan2(x, -z) / (2 * jnp.pi) % 1.0 * WIDTH - 0.5
    above, left = jnp.floor(row), jnp.floor(column)
    down, right = row - above, column - left
    above, left = above.astype(jnp.int32), left.astype(jnp.int32)
    rows = [jnp.clip(above + i, 0, HEIGHT - 1) * WIDTH + first for i in (0, 1)]
    columns = [(left + j) % WIDTH for j in (0, 1)]
    corners = [
        (rows[i] + columns[j], (down if i else 1 - down) * (right if j else 1 - right)) for i in (0, 1) for j in (0, 1)
    ]
    return [sum(weight * channel[index] for index, weight in corners) for channel in jnp.asarray(tables).T]


def irradiance(light: Light, normal: list[Array]) -> list[Array]:
    """Irradiance over pi of unshadowed surfaces, colours as columns."""
    return look_up(light.tables[0].reshape(-1, 3), normal)


def mirrored(light: Light, towards: list[Array], roughness: Array) -> list[Array]:
    """Radiance that unshadowed surfaces mirror: between the tables of the two nearest roughnesses."""
    level = jnp.clip(roughness, 0, 1) * (len(LEVELS) - 1)
    below = jnp.clip(jnp.floor(level), 0, len(LEVELS) - 2)
    share, first = level - below, (1 + below.astype(jnp.int32)) * (HEIGHT * WIDTH)
    tables = light.tables.reshape(-1, 3)
    smooth, rough = (look_up(tables, towards, first + step * HEIGHT * WIDTH) for step in (0, 1))
    return [(1 - share) * a + share * b for a, b in zip(smooth, rough, strict=True)]


def reflectance(roughness: Array, cosine: Array) -> tuple[Array, Array]:
    """Factor and summand of the reflectance at normal incidence, integrated over the lobe (Karis' fit, 2014)."""
    one = [r * s + o for r, s, o in ((roughness, -1, 1), (roughness, -0.0275, 0.0425))]
    two = [r * s + o for r, s, o in ((roughness, -0.572, 1.04), (roughness, 0.022, -0.04))]
    grazing = jnp.minimum(one[0] ** 2, 2.0 ** (-9.28 * cosine)) * one[0] + one[1]
    return two[0] - 1.04 * grazing, two[1] + 1.04 * grazing


def arriving(surfels: Surfels, light: Light) -> Float[Array, "points 3"]:
    """Irradiance over pi at each surfel through the directions that see it."""
    cosines = jnp.maximum(jnp.einsum("pi,di->pd", surfels.normal, DIRECTIONS, precision="highest"), 0)
    tables = jnp.asarray(light.tables)[1 + TOLD].reshape(-1, 3)
    radiance = jnp.stack(look_up(tables, [jnp.asarray(x) for x in DIRECTIONS.T]), axis=-1)
    return (4 / len(DIRECTIONS)) * jnp.einsum("pd,dc->pc", surfels.visible * cosines, radiance, precision="highest")


def harmonics(x: Array, y: Array, z: Array) -> list[Array]:
    """Real spherical harmonics of unit directions up to degree 2."""
    return [
        jnp.full_like(x, 0.282095),
        *(0.488603 * y, 0.488603 * z, 0.488603 * x),
        *(1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y)),
    ]


def projected(light: Light, rotation: Float[Array, "3 3"]) -> Float[Array, "9 3"]:
    """Spherical harmonics of the map over pi in the axes of a camera, columns of cam_to_world."""
    towards = jnp.asarray(directions(HEIGHT).reshape(-1, 3)) @ rotation
    basis = jnp.stack(harmonics(*towards.T)) * jnp.asarray(solid_angles(HEIGHT).reshape(1, -1))
    return jnp.einsum("bt,tc->bc", basis, jnp.asarray(light.tables)[1].reshape(-1, 3), precision="highest") / jnp.pi
