"""Computed environment maps: skies, studios, lamps, and the package's room.

Maps are as in `lighting.py`.  They add and scale; none is normalised.

The room is furnished and has a window and lamps.  It is ray-cast, with one ray per texel from its centre to the walls,
floor and ceiling.  Each of these has its own colour, lit by a diffuse estimate of the light of lamps and window.
"""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float

from spnr_jax.kernels.numerics import array_namespace
from spnr_jax.kernels.records import AnyArray, Light
from spnr_jax.surfels.lighting import Color, light_of, solid_angles, texel_directions

# --- the room ---------------------------------------------------------------------------------------------------------


ROOM_MIN = np.array([-3.2, -1.3, -2.7])  # metres; the object floats at the origin
ROOM_MAX = np.array([3.2, 1.6, 2.7])
AMBIENT = 1.1  # light of more than one bounce, the same everywhere

# centre, normal, half extents along (x, y, z), emitted radiance: a window, two ceiling panels, a floor lamp's shade
LIGHTS = (
    ((3.2, 0.35, 0.2), (-1, 0, 0), (0.0, 0.85, 1.25), (11.0, 12.0, 13.5)),
    ((-0.9, 1.6, -0.9), (0, -1, 0), (0.55, 0.0, 0.55), (15.0, 13.6, 11.4)),
    ((-0.6, 1.6, 1.3), (0, -1, 0), (0.45, 0.0, 0.45), (13.0, 11.6, 9.4)),
    ((-3.2, 0.1, -1.7), (1, 0, 0), (0.0, 0.35, 0.3), (7.0, 5.2, 3.2)),
)
# centre, half extents, linear colour: furniture along the walls, drawn as soft patches of colour
FURNITURE = (
    ((-3.2, -0.8, 0.6), (0.3, 0.5, 1.2), (0.30, 0.06, 0.04)),  # a red sofa
    ((0.6, -0.2, -2.7), (0.7, 1.0, 0.3), (0.16, 0.09, 0.05)),  # a dark bookcase
    ((2.0, -0.75, -2.7), (0.45, 0.5, 0.3), (0.05, 0.17, 0.07)),  # a plant
    ((-1.4, 0.3, 2.7), (0.9, 0.45, 0.3), (0.06, 0.14, 0.30)),  # a blue picture
    ((1.7, -0.6, 2.7), (0.6, 0.65, 0.3), (0.45, 0.36, 0.12)),  # a yellow cabinet
)


def indoor_envmap(height: int = 128) -> np.ndarray:
    """Return the default map (height, 2 * height, 3): a furnished room with a window and lamps, unscaled."""
    fine = room_radiance(texel_directions(2 * height))
    return fine.reshape(height, 2, 2 * height, 2, 3).mean(axis=(1, 3)).astype(np.float32)


def room_radiance(directions: np.ndarray) -> np.ndarray:
    """Return the radiance (*batch, 3) that arrives at the origin of the room from the directions (*batch, 3)."""
    safe = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    distances = np.where(safe > 0, ROOM_MAX / safe, ROOM_MIN / safe)
    axis = distances.argmin(axis=-1)
    positions = directions * distances.min(axis=-1, keepdims=True)
    normals = -np.sign(directions) * (np.arange(3) == axis[..., None])
    radiance = surface_color(positions, axis) * (AMBIENT + irradiance(positions, normals)) / np.pi
    for centre, normal, half, emitted in LIGHTS:
        on_wall = np.abs(np.asarray(normal)) > 0
        inside = soft_box(positions, centre, np.where(on_wall, 0.02, half), softness=0.06)[..., None]
        radiance = radiance * (1 - inside) + np.asarray(emitted) * inside
    return radiance


def surface_color(positions: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the linear diffuse colour (*batch, 3) of the room at positions (*batch, 3) on the walls of `axis`."""
    planks = 0.85 + 0.15 * np.sin(14.0 * positions[..., 2:]) ** 2
    floor = np.array([0.40, 0.27, 0.17]) * planks
    rug = soft_box(positions, (0.0, ROOM_MIN[1], 0.0), (1.5, 0.1, 1.1), softness=0.1)[..., None]
    floor = floor * (1 - rug) + np.array([0.42, 0.40, 0.38]) * rug
    colors = np.where((positions[..., 1:2] < 0), floor, np.array([0.82, 0.81, 0.78]))
    colors = np.where((axis == 0)[..., None], np.array([0.62, 0.55, 0.45]), colors)
    colors = np.where((axis == 2)[..., None], np.array([0.48, 0.53, 0.55]), colors)
    for centre, half, color in FURNITURE:
        patch = soft_box(positions, centre, half, softness=0.08)[..., None]
        colors = colors * (1 - patch) + np.asarray(color) * patch
    return colors


def irradiance(positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the irradiance (*batch, 3) of surface points by the lamps, each approximated by 2 x 2 point lights."""
    total = np.zeros(positions.shape)
    steps = (-0.5, 0.5)
    for centre, normal, half, emitted in LIGHTS:
        sides = [axis for axis in range(3) if half[axis] > 0]
        area = 4 * half[sides[0]] * half[sides[1]]
        for a in steps:
            for b in steps:
                spot = np.array(centre, float)
                spot[sides] += a * half[sides[0]], b * half[sides[1]]
                to_lamp = spot - positions
                squared = (to_lamp**2).sum(-1) + 0.05  # softened: a wall may touch the lamp
                cosines = np.maximum((to_lamp * normals).sum(-1), 0) * np.maximum(-(to_lamp @ np.asarray(normal)), 0)
                total += (cosines / squared**2 * area / 4)[..., None] * np.asarray(emitted)
    return total


def soft_box(positions: np.ndarray, centre, half, softness: float) -> np.ndarray:
    """Return 1 inside the box, 0 outside, (*batch,), with a smooth step of `softness` metres at its faces."""
    depth = (np.asarray(half) - np.abs(positions - np.asarray(centre))) / softness
    ramp = np.clip(0.5 + 0.5 * depth, 0, 1)
    return (ramp * ramp * (3 - 2 * ramp)).prod(-1)


# --- skies and lamps --------------------------------------------------------------------------------------------------


HEIGHT = 128
HORIZON = 0.08  # sine of the elevation over which ground and sky blend
MIDDLE = 1 - 1e-7  # cosine of the angle from a lamp's centre, at most

Angle = float | int | np.floating | jax.Array  # degrees
Map = Float[AnyArray, "height width 3"]


def direction_from_angles(azimuth: Angle, elevation: Angle) -> Float[AnyArray, "3"]:
    """Unit direction from angles in degrees: azimuth 0 is +z, 90 is +x; elevation 90 is straight up (+y)."""
    xp = array_namespace(azimuth, elevation)
    turn, rise = xp.radians(azimuth), xp.radians(elevation)
    return xp.stack([xp.cos(rise) * xp.sin(turn), xp.sin(rise), xp.cos(rise) * xp.cos(turn)])


def gradient(zenith: Color, horizon: Color, ground: Color, height: int = HEIGHT) -> Map:
    """A sky with a gradient from the horizon to the zenith, and a floor of one colour."""
    sine = texel_directions(height)[..., 1:2]
    sky = np.asarray(horizon) + (np.asarray(zenith) - np.asarray(horizon)) * np.clip(sine, 0, 1) ** 0.7
    up = np.clip(0.5 + 0.5 * sine / HORIZON, 0, 1)
    return (np.asarray(ground) * (1 - up) + sky * up).astype(np.float32)


def lamp(azimuth: Angle, elevation: Angle, size: Angle, irradiance: Color, height: int = HEIGHT) -> Map:
    """A round lamp of `size` degrees, at least two texels wide; `irradiance` is that of a surface that faces it.

    Its edge fades over a quarter of its radius.
    """
    xp = array_namespace(azimuth, elevation, size, irradiance)
    radius = xp.radians(xp.maximum(size / 2, 180 / height))
    cosine = xp.clip(texel_directions(height) @ direction_from_angles(azimuth, elevation), -MIDDLE, MIDDLE)
    angle = xp.arccos(cosine)  # never 0, where arccos has no gradient
    ramp = xp.clip((1.125 - angle / radius) * 4, 0, 1)
    disc = ramp * ramp * (3 - 2 * ramp)
    received = xp.sum(disc * xp.maximum(xp.cos(angle), 0) * solid_angles(height))
    return (disc[..., None] * xp.broadcast_to(xp.asarray(irradiance), (1, 1, 3)) / received).astype(np.float32)


def sun(azimuth: Angle, elevation: Angle, size: Angle = 3.0, color: Color = (1, 1, 1)) -> Light:
    """A distant round lamp of `size` degrees; angles as in `Model.camera`; `color` is the irradiance facing it.

    All arguments may be traced.  Visibility has 64 directions, so shadows are never sharper than about 24 degrees.
    """
    return light_of(lamp(azimuth, elevation, size, color))


def studio(height: int = HEIGHT) -> Map:
    """Three softboxes in front of a grey backdrop."""
    grey = gradient((0.25,) * 3, (0.2,) * 3, (0.12,) * 3, height)
    key = lamp(-40, 40, 45, (1.9, 1.85, 1.8), height)
    fill = lamp(70, 15, 60, (0.5, 0.55, 0.6), height)
    return grey + key + fill + lamp(180, 50, 30, (0.9, 0.9, 0.95), height)


def sunset(height: int = HEIGHT) -> Map:
    """A low orange sun in a sky that is blue above and pink at the horizon."""
    sky = gradient((0.16, 0.25, 0.5), (0.8, 0.45, 0.3), (0.12, 0.09, 0.08), height)
    return sky + lamp(60, 8, 40, (0.5, 0.25, 0.1), height) + lamp(60, 8, 3, (2.2, 1.1, 0.4), height)


def overcast(height: int = HEIGHT) -> Map:
    """A white sky, brighter towards the zenith, over a grey street."""
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


def normalise(envmap: Map, white: float | int = 0.6) -> Map:
    """The map scaled to the mean radiance `white`: the average of a white diffuse sphere over all views."""
    mean = np.sum(envmap.mean(axis=-1) * solid_angles(len(envmap))) / (4 * np.pi)
    return (envmap * (white / max(mean, 1e-12))).astype(np.float32)
