"""The light of every picture: one environment map, scaled so that a white diffuse sphere averages 0.6 linear.

Conventions: a map is (height, 2 * height, 3) float32, linear radiance, latitude-longitude as Mitsuba reads it.
Row 0 is straight up (+y); column c of w looks along azimuth phi = 2 pi (c + 0.5) / w, where the direction is
(sin phi, 0, -cos phi) on the horizon: phi = 0 is -z, phi = 90 degrees is +x.
The default map is a room, made by casting one ray per texel from its middle to the walls, floor and ceiling; each
surface shows its own colour under a diffuse estimate of what the lamps and the window throw on it.
"""

from pathlib import Path

import numpy as np

from data_gen.render.variant import mitsuba_module, threads
from data_gen.render.views import ViewConfig, make_sensor, spread_viewpoints
from spnr_jax.errors import UserError

WHITE_SPHERE_RADIANCE = 0.6  # far enough below 1 that white objects keep their shading against the white background

ROOM_MIN = np.array([-3.2, -1.3, -2.7])  # metres; the object floats at the origin
ROOM_MAX = np.array([3.2, 1.6, 2.7])
AMBIENT = 1.1  # light that has bounced more than once, the same everywhere

# centre, normal, half extents along (x, y, z), emitted radiance: a window, two ceiling panels, a floor lamp's shade
LIGHTS = (
    ((3.2, 0.35, 0.2), (-1, 0, 0), (0.0, 0.85, 1.25), (11.0, 12.0, 13.5)),
    ((-0.9, 1.6, -0.9), (0, -1, 0), (0.55, 0.0, 0.55), (15.0, 13.6, 11.4)),
    ((-0.6, 1.6, 1.3), (0, -1, 0), (0.45, 0.0, 0.45), (13.0, 11.6, 9.4)),
    ((-3.2, 0.1, -1.7), (1, 0, 0), (0.0, 0.35, 0.3), (7.0, 5.2, 3.2)),
)
# centre, half extents, linear colour: things that stand before the walls, seen as soft patches of colour
FURNITURE = (
    ((-3.2, -0.8, 0.6), (0.3, 0.5, 1.2), (0.30, 0.06, 0.04)),  # a red sofa
    ((0.6, -0.2, -2.7), (0.7, 1.0, 0.3), (0.16, 0.09, 0.05)),  # a dark bookcase
    ((2.0, -0.75, -2.7), (0.45, 0.5, 0.3), (0.05, 0.17, 0.07)),  # a plant
    ((-1.4, 0.3, 2.7), (0.9, 0.45, 0.3), (0.06, 0.14, 0.30)),  # a blue picture
    ((1.7, -0.6, 2.7), (0.6, 0.65, 0.3), (0.45, 0.36, 0.12)),  # a yellow cabinet
)


def indoor_envmap(height: int = 128) -> np.ndarray:
    """Return the default map (height, 2 * height, 3): a furnished room with a window and lamps, unscaled."""
    fine = room_radiance(map_directions(2 * height))
    return fine.reshape(height, 2, 2 * height, 2, 3).mean(axis=(1, 3)).astype(np.float32)


def map_directions(height: int) -> np.ndarray:
    """Return the unit directions (height, 2 * height, 3) through the middles of a map's texels."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    horizontal = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height))
    return np.stack([horizontal * np.sin(phi), up, -horizontal * np.cos(phi)], axis=-1)


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
    """Return the light (*batch, 3) that the lamps throw on surface points, each lamp taken as 2 x 2 spots."""
    total = np.zeros(positions.shape)
    steps = (-0.5, 0.5)
    for centre, normal, half, emitted in LIGHTS:
        sides = [axis for axis in range(3) if half[axis] > 0]
        area = 4 * half[sides[0]] * half[sides[1]]
        for a in steps:
            for b in steps:
                spot = np.array(centre, float)
                spot[sides] += a * half[sides[0]], b * half[sides[1]]
                towards = spot - positions
                squared = (towards**2).sum(-1) + 0.05  # softened: a wall may touch the lamp
                cosines = np.maximum((towards * normals).sum(-1), 0) * np.maximum(-(towards @ np.asarray(normal)), 0)
                total += (cosines / squared**2 * area / 4)[..., None] * np.asarray(emitted)
    return total


def soft_box(positions: np.ndarray, centre, half, softness: float) -> np.ndarray:
    """Return 1 inside the box, 0 outside, (*batch,), passing smoothly over `softness` metres at its faces."""
    depth = (np.asarray(half) - np.abs(positions - np.asarray(centre))) / softness
    ramp = np.clip(0.5 + 0.5 * depth, 0, 1)
    return (ramp * ramp * (3 - 2 * ramp)).prod(-1)


def load_envmap(path: Path) -> np.ndarray:
    """Return an environment map file (.hdr, .exr) as (height, width, 3) float32, unscaled; ValueError if unusable."""
    mi = mitsuba_module()
    if not Path(path).is_file():
        raise UserError(f"environment map {path}: no such file; give a latitude-longitude .hdr or .exr")
    try:
        with threads(2):  # with a single thread the OpenEXR reader waits for itself for ever (Mitsuba 3.9)
            bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise UserError(f"environment map {path}: not a readable .hdr or .exr ({str(error).splitlines()[0]})") from None
    radiance = np.array(bitmap, dtype=np.float32)
    if not np.isfinite(radiance).all() or radiance.min() < 0 or radiance.max() <= 0:
        raise UserError(f"environment map {path}: expected finite radiance >= 0 with some light in it")
    return radiance


def scaled_to_white(envmap: np.ndarray, target: float = WHITE_SPHERE_RADIANCE) -> np.ndarray:
    """Return the map times the factor that makes a white diffuse sphere average `target`, measured by rendering it."""
    return (envmap * (target / white_sphere_radiance(envmap))).astype(np.float32)


def white_sphere_radiance(envmap: np.ndarray, num_views: int = 32, spp: int = 64, seed: int = 0) -> float:
    """Return the mean linear radiance of a white diffuse sphere over views that surround it evenly."""
    mi = mitsuba_module()
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
            "light": {"type": "envmap", "bitmap": mi.Bitmap(envmap)},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        }
    )
    config = ViewConfig(resolution=16, spp=spp)
    radiance, coverage = 0.0, 0.0
    for view, cam_to_world in enumerate(spread_viewpoints(num_views, config.distance)):
        sensor = make_sensor(cam_to_world, config, config.resolution)
        image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed * num_views + view), dtype=np.float64)
        radiance += image[..., :3].mean(-1).sum()
        coverage += image[..., 3].sum()
    return float(radiance / coverage)
