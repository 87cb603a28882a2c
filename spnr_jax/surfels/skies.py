"""Environment maps that are computed: skies, studios, lamps, and random ones to learn from.

Conventions of maps: `envmaps.py`.  Maps add up and scale; none is normalised.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from spnr_jax.kernels.numerics import namespace
from spnr_jax.kernels.records import AnyArray
from spnr_jax.surfels.envmaps import directions, solid_angles
from spnr_jax.surfels.room import indoor_envmap

HEIGHT = 128
HORIZON = 0.08  # sine of the elevation over which ground and sky pass into each other
MIDDLE = 1 - 1e-7  # cosine of the angle from a lamp's middle, at most
MOST_LAMPS = 4  # of a random map

Color = Sequence[float | int] | np.ndarray | jax.Array
Angle = float | int | np.floating | jax.Array  # degrees
Map = Float[AnyArray, "height width 3"]


def towards(azimuth: Angle, elevation: Angle) -> Float[AnyArray, "3"]:
    """Unit direction to a place of the sky, in degrees: azimuth 0 is +z, 90 is +x, elevation 90 straight up (+y)."""
    xp = namespace(azimuth, elevation)
    turn, rise = xp.radians(azimuth), xp.radians(elevation)
    return xp.stack([xp.cos(rise) * xp.sin(turn), xp.sin(rise), xp.cos(rise) * xp.cos(turn)])


def gradient(zenith: Color, horizon: Color, ground: Color, height: int = HEIGHT) -> Map:
    """Sky from the horizon to straight above, and a floor of one colour."""
    sine = directions(height)[..., 1:2]
    sky = np.asarray(horizon) + (np.asarray(zenith) - np.asarray(horizon)) * np.clip(sine, 0, 1) ** 0.7
    up = np.clip(0.5 + 0.5 * sine / HORIZON, 0, 1)
    return (np.asarray(ground) * (1 - up) + sky * up).astype(np.float32)


def lamp(azimuth: Angle, elevation: Angle, size: Angle, irradiance: Color, height: int = HEIGHT) -> Map:
    """A round lamp `size` degrees across, by what it throws on a surface that faces it; at least two texels wide.

    Its edge is a quarter of its radius wide.
    """
    xp = namespace(azimuth, elevation, size, irradiance)
    radius = xp.radians(xp.maximum(size / 2, 180 / height))
    cosine = xp.clip(directions(height) @ towards(azimuth, elevation), -MIDDLE, MIDDLE)
    angle = xp.arccos(cosine)  # of no middle exactly, where it has no gradient
    ramp = xp.clip((1.125 - angle / radius) * 4, 0, 1)
    disc = ramp * ramp * (3 - 2 * ramp)
    held = xp.sum(disc * xp.maximum(xp.cos(angle), 0) * solid_angles(height))
    return (disc[..., None] * xp.asarray(irradiance)[None, None] / held).astype(np.float32)


def studio(height: int = HEIGHT) -> Map:
    """Three softboxes before a grey backdrop."""
    grey = gradient((0.25,) * 3, (0.2,) * 3, (0.12,) * 3, height)
    key = lamp(-40, 40, 45, (1.9, 1.85, 1.8), height)
    fill = lamp(70, 15, 60, (0.5, 0.55, 0.6), height)
    return grey + key + fill + lamp(180, 50, 30, (0.9, 0.9, 0.95), height)


def sunset(height: int = HEIGHT) -> Map:
    """A low orange sun in a sky that is blue above and pink at the horizon."""
    sky = gradient((0.16, 0.25, 0.5), (0.8, 0.45, 0.3), (0.12, 0.09, 0.08), height)
    return sky + lamp(60, 8, 40, (0.5, 0.25, 0.1), height) + lamp(60, 8, 3, (2.2, 1.1, 0.4), height)


def overcast(height: int = HEIGHT) -> Map:
    """A white sky, brighter above, over a grey street."""
    return gradient((0.95, 0.98, 1.05), (0.5, 0.52, 0.55), (0.15, 0.14, 0.13), height)


def night(height: int = HEIGHT) -> Map:
    """A dark blue sky, a warm street lamp and a cold one."""
    sky = gradient((0.01, 0.015, 0.04), (0.03, 0.03, 0.06), (0.015, 0.012, 0.01), height)
    return sky + lamp(-35, 50, 10, (0.9, 0.6, 0.25), height) + lamp(130, 25, 14, (0.15, 0.25, 0.45), height)


NAMED: dict[str, Callable[[int], Map]] = {
    "room": indoor_envmap,
    "studio": studio,
    "sunset": sunset,
    "overcast": overcast,
    "night": night,
}


def random_map(generator: np.random.Generator, height: int = HEIGHT) -> Map:
    """A sky of random colours with up to MOST_LAMPS lamps, from broad glows to suns of three degrees."""

    def colour(brightness: float, tint: float) -> np.ndarray:
        return brightness * np.exp(tint * generator.standard_normal(3))

    above, around, below = np.exp(generator.normal(-1, 0.7, 3))
    whole = gradient(colour(above, 0.3), colour(around, 0.3), colour(below, 0.3), height)
    for _ in range(generator.integers(0, MOST_LAMPS + 1)):
        rise = np.degrees(np.arcsin(generator.uniform(-0.4, 1)))
        size = np.exp(generator.uniform(np.log(3), np.log(90)))
        power = np.exp(generator.normal(-0.3, 0.7))
        whole = whole + lamp(generator.uniform(0, 360), rise, size, colour(power, 0.2), height)
    return whole


def normalised(envmap: Map, white: float | int = 0.6) -> Map:
    """The map scaled so that a white diffuse sphere, seen from all around, averages `white`: its mean radiance."""
    mean = np.sum(envmap.mean(axis=-1) * solid_angles(len(envmap))) / (4 * np.pi)
    return (envmap * (white / max(mean, 1e-12))).astype(np.float32)
