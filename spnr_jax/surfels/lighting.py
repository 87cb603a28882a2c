"""Distant light and the part of it that reaches a surface: every function here is linear in the environment map.

map       (height, 2 * height, 3), linear radiance, latitude-longitude: row 0 is straight up (+y); column c of w has the
          azimuth phi = 2 pi (c + 0.5) / w, which is the direction (sin phi, 0, -cos phi) on the horizon
tables    irradiance by normal, and the map blurred by GGX lobes of the roughnesses LEVELS by mirrored direction
          (split-sum approximation, Karis 2013), 32 x 64 texels each
arriving  irradiance of each surfel from the directions that it is visible from
"""

from collections.abc import Sequence
from functools import cache, reduce
from importlib import resources
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.errors import UserError
from spnr_jax.kernels.numerics import array_namespace, clamp, larger, safe_sqrt, smaller, split_columns
from spnr_jax.kernels.records import TABLES, AnyArray, Light, Surfels
from spnr_jax.surfels.sides import DIRECTIONS

# --- maps as arrays ---------------------------------------------------------------------------------------------------


def texel_directions(height: int) -> Float[np.ndarray, "height width 3"]:
    """Unit directions through the centres of a map's texels."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    across = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height))
    return np.stack([across * np.sin(phi), up, -across * np.cos(phi)], axis=-1)


def solid_angles(height: int) -> Float[np.ndarray, "height width"]:
    """Solid angles of a map's texels, in steradian."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    rows = (edges[:-1] - edges[1:]) * np.pi / height
    return np.repeat(rows[:, None], 2 * height, axis=1).astype(np.float32)


def resample(envmap: Float[AnyArray, "h w 3"], height: int) -> Float[AnyArray, "height width 3"]:
    """The map at another size: each texel is the mean, by solid angle, of those that it overlaps; energy is kept."""
    rows = _overlap(
        -np.cos(np.pi * np.arange(envmap.shape[0] + 1) / envmap.shape[0]),
        -np.cos(np.pi * np.arange(height + 1) / height),
    )
    columns = _overlap(np.linspace(0, 1, envmap.shape[1] + 1), np.linspace(0, 1, 2 * height + 1))
    xp = array_namespace(envmap)
    narrow = xp.tensordot(rows, envmap, axes=(1, 0))
    return xp.tensordot(narrow, columns, axes=(1, 1)).swapaxes(1, 2)


def _overlap(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Share of each old interval in each new one (new, old), from sorted edges."""
    overlap = np.minimum(old[1:], new[1:, None]) - np.maximum(old[:-1], new[:-1, None])
    return (np.maximum(overlap, 0) / (new[1:] - new[:-1])[:, None]).astype(np.float32)


# --- light ------------------------------------------------------------------------------------------------------------


HEIGHT, WIDTH = TABLES[1:3]  # of a table
ROOM = "room_light.npz"
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # roughnesses
BLUR_LEVEL = 2  # index in LEVELS: this blurred table is sampled at the 64 visibility directions
SPECULAR = 0.04  # reflectance of dielectrics at normal incidence
LOBE = 8.0  # sharpness of the lobe of visibility directions around the mirrored one
POLE = 1e-6  # sine of the angle to the poles of a map below which a direction has no azimuth
Color = float | int | Sequence[float | int | jax.Array] | np.ndarray | jax.Array  # one number: grey
SH_BANDS = 9  # spherical harmonics up to degree 2
ODD = (3, 4, 7), (1, 4, 5)  # indices of the harmonics that change sign when the light is mirrored along x, or along y


@cache
def _lobes() -> Float[np.ndarray, "tables rows texels"]:
    """Weights of the texels in the first entry of each row of the tables; the weights of a lobe add up to 1."""
    towards, area = texel_directions(HEIGHT), solid_angles(HEIGHT).reshape(-1)
    cosine = np.maximum(towards[:, 0] @ towards.reshape(-1, 3).T, -1)
    lobes = [np.maximum(cosine, 0)]
    half = np.clip((1 + cosine) / 2, 0, 1)
    for roughness in LEVELS[1:]:
        squared = roughness**4
        lobes.append(squared / (half * (squared - 1) + 1) ** 2 * np.maximum(cosine, 0))
    weights = np.stack(lobes) * area
    return (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)


def light_of(envmap: Float[AnyArray, "height width 3"]) -> Light:
    """The light of a map of any size whose width is twice its height; energy is preserved.  The map may be traced.

    ValueError for another shape.
    """
    xp, shape = array_namespace(envmap), np.shape(envmap)
    if len(shape) != 3 or shape[2] != 3 or shape[1] != 2 * shape[0] or not shape[0]:
        raise UserError(f"light_of: expected a map (height, 2 height, 3), got {shape}")
    if not isinstance(envmap, jax.core.Tracer):
        values = np.asarray(envmap)
        if not (jnp.issubdtype(values.dtype, np.floating) and np.isfinite(values).all()):
            found = f"{values.dtype} from {values.min()} to {values.max()}"
            raise UserError(f"light_of: expected linear radiance in finite floats, got {found}")
    small = resample(envmap if xp is jnp else np.asarray(envmap, np.float32), HEIGHT)
    # lobes are the same along a row: column i of the tables is the first column of the map turned by i texels
    turned = small[:, (np.arange(WIDTH)[:, None] + np.arange(WIDTH)) % WIDTH].reshape(HEIGHT * WIDTH, WIDTH * 3)
    tables = xp.matmul(_lobes(), turned).reshape(-1, HEIGHT, WIDTH, 3)
    return Light(tables=xp.concatenate([tables[:1], small[None], tables[1:]]))


@cache
def room_light() -> Light:
    """The light of the package's room, the default.

    It is read from a file of the package: computing it takes half a second of the time to the first picture.
    """
    with (resources.files("spnr_jax") / "pretrained" / ROOM).open("rb") as file:
        return Light(tables=np.load(file, allow_pickle=False)["tables"])


def ambient(color: Color = (1, 1, 1)) -> Light:
    """The same radiance from all directions."""
    xp = array_namespace(color)
    return light_of(xp.broadcast_to(xp.asarray(color, np.float32), (HEIGHT, WIDTH, 3)))


def look_up_background(light: Light, towards: list[Array]) -> list[Array]:
    """Radiance of the map at unit directions, colours as columns."""
    return look_up(jnp.asarray(light.tables[1]).reshape(-1, 3), towards)


def look_up(tables: Float[Array, "rows 3"], towards: list[Array], first: Array | int = 0) -> list[Array]:
    """Bilinear lookup in flattened tables at unit directions, given and returned as columns.

    `first` is, for each direction, the row at which its table begins.
    """
    x, y, z = towards
    across = safe_sqrt(x * x + z * z)
    aside = across > POLE  # at the poles there is no azimuth, nor a gradient by it
    polar = jnp.arctan2(jnp.where(aside, across, 0), jnp.where(aside, y, jnp.where(y < 0, -1, 1)))
    azimuth = jnp.arctan2(jnp.where(aside, x, 0), jnp.where(aside, -z, 1))
    row, column = polar / jnp.pi * HEIGHT - 0.5, azimuth / (2 * jnp.pi) % 1.0 * WIDTH - 0.5
    above, left = jnp.floor(row), jnp.floor(column)
    down, right = row - above, column - left
    above, left = above.astype(jnp.int32), left.astype(jnp.int32)
    rows = [jnp.clip(above + i, 0, HEIGHT - 1) * WIDTH + first for i in (0, 1)]
    texels = [(left + j) % WIDTH for j in (0, 1)]
    corners = [
        (rows[i] + texels[j], (down if i else 1 - down) * (right if j else 1 - right)) for i in (0, 1) for j in (0, 1)
    ]
    channels = split_columns(jnp.asarray(tables))
    return [reduce(add, (weight * channel[index] for index, weight in corners)) for channel in channels]


def irradiance(light: Light, normal: list[Array]) -> list[Array]:
    """Irradiance / pi of unshadowed surfaces, colours as columns."""
    return look_up(jnp.asarray(light.tables[0]).reshape(-1, 3), normal)


def reflect(light: Light, towards: list[Array], roughness: Array) -> list[Array]:
    """Prefiltered radiance of unshadowed surfaces, interpolated between the two nearest roughnesses."""
    level = clamp(roughness, 0, 1) * (len(LEVELS) - 1)
    below = jnp.clip(jnp.floor(level), 0, len(LEVELS) - 2)
    share, first = level - below, (1 + below.astype(jnp.int32)) * (HEIGHT * WIDTH)
    tables = jnp.asarray(light.tables).reshape(-1, 3)
    smooth, rough = (look_up(tables, towards, first + step * HEIGHT * WIDTH) for step in (0, 1))
    return [(1 - share) * a + share * b for a, b in zip(smooth, rough, strict=True)]


def reflectance(roughness: Array, cosine: Array) -> tuple[Array, Array]:
    """Scale and bias of the reflectance at normal incidence, integrated over the lobe (Karis' fit, 2014)."""
    x, y = 1 - roughness, 0.0425 - 0.0275 * roughness
    z, w = 1.04 - 0.572 * roughness, 0.022 * roughness - 0.04
    grazing = smaller(x * x, 2.0 ** (-9.28 * cosine)) * x + y
    return z - 1.04 * grazing, w + 1.04 * grazing


def gather_irradiance(surfels: Surfels, light: Light) -> Float[Array, "points 3"]:
    """Irradiance / pi of each surfel from the directions that it is visible from."""
    cosines = larger(jnp.einsum("pi,di->pd", surfels.normal, DIRECTIONS, precision="highest"), 0)
    tables = jnp.asarray(light.tables)[1 + BLUR_LEVEL].reshape(-1, 3)
    radiance = jnp.stack(look_up(tables, [jnp.asarray(x) for x in DIRECTIONS.T]), axis=-1)
    return (4 / len(DIRECTIONS)) * jnp.einsum("pd,dc->pc", surfels.visibility * cosines, radiance, precision="highest")


def harmonics(x: Array, y: Array, z: Array) -> list[Array]:
    """Real spherical harmonics of unit directions up to degree 2, without the Condon-Shortley phase.

    Splats have that phase: gaussians.evaluate_harmonics.
    """
    return [
        jnp.full_like(x, 0.282095),
        *(0.488603 * y, 0.488603 * z, 0.488603 * x),
        *(1.092548 * x * y, 1.092548 * y * z, 0.315392 * (3 * z * z - 1), 1.092548 * x * z, 0.546274 * (x * x - y * y)),
    ]


def project_harmonics(light: Light, rotation: Float[AnyArray, "3 3"]) -> Float[Array, "9 3"]:
    """Spherical harmonics of the map over pi, in camera axes (the columns of cam_to_world)."""
    towards = jnp.asarray(texel_directions(HEIGHT).reshape(-1, 3), jnp.float32) @ rotation
    basis = jnp.stack(harmonics(*towards.T)) * jnp.asarray(solid_angles(HEIGHT).reshape(1, -1))
    return jnp.einsum("bt,tc->bc", basis, jnp.asarray(light.tables)[1].reshape(-1, 3), precision="highest") / jnp.pi
