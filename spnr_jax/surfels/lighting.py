"""Distant light and the part of it that reaches a surface: every function here is linear in the environment map.

tables    irradiance by normal, and the map blurred by the GGX lobes of LEVELS by mirrored direction (split-sum
          approximation, Karis 2013), 32 x 64 texels each
arriving  light that each surfel receives: irradiance from the directions that the surfel is visible from
"""

from functools import cache, reduce
from importlib import resources
from operator import add

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import clamp, columns, larger, namespace, root, smaller
from spnr_jax.kernels.records import AnyArray, Light, Surfels
from spnr_jax.surfels import skies
from spnr_jax.surfels.sides import DIRECTIONS
from spnr_jax.surfels.skies import SCALE, directions, indoor_envmap, resample, solid_angles

HEIGHT, WIDTH = 32, 64  # of a table
ROOM = "room_light.npz"
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of roughness
TOLD = 2  # the level whose values at the directions of the visibility stand for what comes from there
SPECULAR = 0.04  # reflectance of what is not metal, seen from straight above
LOBE = 8.0  # of the directions around the mirrored one whose visibility counts
POLE = 1e-6  # sine of the angle to straight up or down within which a direction has no azimuth
SH_BANDS = 9  # spherical harmonics up to degree 2
ODD = (3, 4, 7), (1, 4, 5)  # of them, those that change their sign when the light is mirrored along x, or along y


@cache
def _lobes() -> Float[np.ndarray, "tables texels texels"]:
    """Weights of the texels in each entry of the tables, those of a lobe adding up to 1."""
    towards, area = directions(HEIGHT).reshape(-1, 3).astype(np.float32), solid_angles(HEIGHT).reshape(-1)
    cosine = np.maximum(towards @ towards.T, -1)
    lobes = [np.maximum(cosine, 0)]
    half = np.clip((1 + cosine) / 2, 0, 1)
    for roughness in LEVELS[1:]:
        squared = roughness**4
        lobes.append(squared / (half * (squared - 1) + 1) ** 2 * np.maximum(cosine, 0))
    weights = np.stack(lobes) * area
    return weights / weights.sum(axis=-1, keepdims=True)


def light_of(envmap: Float[AnyArray, "height width 3"]) -> Light:
    """The light of a map of any size whose width is twice its height; energy is kept.  Of a traced map a traced one."""
    xp = namespace(envmap)
    small = resample(envmap if xp is jnp else np.asarray(envmap, np.float32), HEIGHT)
    tables = xp.matmul(_lobes(), small.reshape(-1, 3)).reshape(-1, HEIGHT, WIDTH, 3)
    return Light(tables=xp.concatenate([tables[:1], small[None], tables[1:]]))


@cache
def room_light() -> Light:
    """The light of the package's room, which pictures have where no other is asked for.

    Kept in a file of the package: making it takes 1.4 s of a first picture.
    """
    with (resources.files("spnr_jax") / "pretrained" / ROOM).open("rb") as file:
        return Light(tables=np.load(file, allow_pickle=False)["tables"])


def make_room_light() -> Light:
    """What the file of `room_light` holds, made anew."""
    return light_of(SCALE * indoor_envmap())


def sun(azimuth: skies.Angle, elevation: skies.Angle, size: skies.Angle = 3.0, color: skies.Color = (1, 1, 1)) -> Light:
    """A round lamp far away: degrees as `Model.camera` counts them, `size` across, irradiance of what faces it.

    Each of these may be traced.  Shadows come from 64 directions, so they are never sharper than some ten degrees.
    """
    return light_of(skies.lamp(azimuth, elevation, size, color))


def ambient(color: skies.Color = (1, 1, 1)) -> Light:
    """The same radiance from everywhere."""
    xp = namespace(color)
    return light_of(xp.broadcast_to(xp.asarray(color, np.float32), (HEIGHT, WIDTH, 3)))


def background(light: Light, towards: list[Array]) -> list[Array]:
    """Radiance of the map itself at unit directions, colours as columns."""
    return look_up(jnp.asarray(light.tables[1]).reshape(-1, 3), towards)


def look_up(tables: Float[Array, "rows 3"], towards: list[Array], first: Array | int = 0) -> list[Array]:
    """Bilinear values of flattened tables at unit directions, given and returned as columns.

    `first` is the row at which a table begins, for each direction.
    """
    x, y, z = towards
    across = root(x * x + z * z)
    aside = across > POLE  # straight up and down there is no azimuth, nor a gradient by it
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
    channels = columns(jnp.asarray(tables))
    return [reduce(add, (weight * channel[index] for index, weight in corners)) for channel in channels]


def irradiance(light: Light, normal: list[Array]) -> list[Array]:
    """Irradiance over pi of unshadowed surfaces, colours as columns."""
    return look_up(jnp.asarray(light.tables[0]).reshape(-1, 3), normal)


def reflect(light: Light, towards: list[Array], roughness: Array) -> list[Array]:
    """Radiance that unshadowed surfaces mirror: between the tables of the two nearest roughnesses."""
    level = clamp(roughness, 0, 1) * (len(LEVELS) - 1)
    below = jnp.clip(jnp.floor(level), 0, len(LEVELS) - 2)
    share, first = level - below, (1 + below.astype(jnp.int32)) * (HEIGHT * WIDTH)
    tables = jnp.asarray(light.tables).reshape(-1, 3)
    smooth, rough = (look_up(tables, towards, first + step * HEIGHT * WIDTH) for step in (0, 1))
    return [(1 - share) * a + share * b for a, b in zip(smooth, rough, strict=True)]


def reflectance(roughness: Array, cosine: Array) -> tuple[Array, Array]:
    """Factor and summand of the reflectance at normal incidence, integrated over the lobe (Karis' fit, 2014)."""
    one = [r * s + o for r, s, o in ((roughness, -1, 1), (roughness, -0.0275, 0.0425))]
    two = [r * s + o for r, s, o in ((roughness, -0.572, 1.04), (roughness, 0.022, -0.04))]
    grazing = smaller(one[0] ** 2, 2.0 ** (-9.28 * cosine)) * one[0] + one[1]
    return two[0] - 1.04 * grazing, two[1] + 1.04 * grazing


def arriving(surfels: Surfels, light: Light) -> Float[Array, "points 3"]:
    """Irradiance over pi at each surfel through the directions that see it."""
    cosines = larger(jnp.einsum("pi,di->pd", surfels.normal, DIRECTIONS, precision="highest"), 0)
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


def project_harmonics(light: Light, rotation: Float[AnyArray, "3 3"]) -> Float[Array, "9 3"]:
    """Spherical harmonics of the map over pi in the axes of a camera, columns of cam_to_world."""
    towards = jnp.asarray(directions(HEIGHT).reshape(-1, 3), jnp.float32) @ rotation
    basis = jnp.stack(harmonics(*towards.T)) * jnp.asarray(solid_angles(HEIGHT).reshape(1, -1))
    return jnp.einsum("bt,tc->bc", basis, jnp.asarray(light.tables)[1].reshape(-1, 3), precision="highest") / jnp.pi
