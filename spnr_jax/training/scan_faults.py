"""Faults of scans, simulated in training clouds: noise, outliers, hidden surface, uneven density, no materials.

The functions take and return (positions (n, 3), other columns by name) with a generator of random numbers.  Lengths are
in units of the box whose half diagonal is 1; the points must lie in it.  `random_scan` draws several.
"""

import functools
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from spnr_jax.surfels.normals import find_visible, measure_spacing

Points = tuple[np.ndarray, dict[str, np.ndarray]]
Fault = Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], Points]

SCANNER = 2.5  # distance of a virtual scanner from the middle of the box
BEHIND = 3.0  # spacings behind the first point of a pixel within which points are visible
BALLS = 0.03, 0.15  # radii of holes
SHADED = 0.2, 0.7  # largest share of a colour that shading removes
NOISE, OUTLIERS = (0.001, 0.02), (0.002, 0.05)  # of random scans, drawn from the logarithm
MISREGISTERED, COLOR_NOISE = 0.004, 0.08  # at most
THINNEST = 0.1  # density at one end of a cloud of uneven density, over that at the other


def add_noise(positions, values, rng, *, sigma: float) -> Points:
    """Normally distributed errors of this standard deviation along each axis."""
    return positions + sigma * rng.normal(size=positions.shape), values


def add_outliers(positions, values, rng, *, share: float) -> Points:
    """A share of outliers, uniform in the bounding box, with the columns of random points."""
    count = round(share * len(positions))
    low, high = positions.min(axis=0), positions.max(axis=0)
    copied = rng.integers(len(positions), size=count)
    return (
        np.concatenate([positions, rng.uniform(low, high, (count, 3))]),
        {name: np.concatenate([column, column[copied]]) for name, column in values.items()},
    )


def simulate_scanners(positions, values, rng, *, scanners: int) -> Points:
    """The points that scanners in random directions see."""
    spacing, visible = measure_spacing(cKDTree(positions)), np.zeros(len(positions), bool)
    for direction in rng.normal(size=(scanners, 3)):
        visible |= find_visible(positions, SCANNER * direction / np.linalg.norm(direction), spacing, BEHIND)
    return positions[visible], {name: column[visible] for name, column in values.items()}


def misregister(positions, values, rng, *, sigma: float) -> Points:
    """Two misaligned scans: the points on one side of a random plane are shifted together."""
    apart = positions @ rng.normal(size=3) > 0
    return positions + apart[:, None] * sigma * rng.normal(size=3), values


def drop_balls(positions, values, rng, *, balls: int) -> Points:
    """The points outside of balls around random points."""
    middles, radii = positions[rng.integers(len(positions), size=balls)], rng.uniform(*BALLS, balls)
    kept = (((positions[:, None] - middles) ** 2).sum(axis=-1) > radii**2).all(axis=1)
    kept[0] = True
    return positions[kept], {name: column[kept] for name, column in values.items()}


def add_color_noise(positions, values, rng, *, sigma: float) -> Points:
    """Normally distributed errors of the base colours."""
    color = values["base_color"]
    return positions, values | {"base_color": np.clip(color + sigma * rng.normal(size=color.shape), 0, 1)}


def bake_light(positions, values, rng) -> Points:
    """Base colours shaded by a lamp, as in a photograph; unchanged without normals."""
    if "normals" not in values:
        return positions, values
    lamp = rng.normal(size=3)
    cosine = np.abs(values["normals"] @ lamp) / np.linalg.norm(lamp)
    shade = 1 - rng.uniform(*SHADED) * (1 - cosine)
    return positions, values | {"base_color": values["base_color"] * shade[:, None]}


def drop_materials(positions, values, rng) -> Points:
    """Roughness 0.5 and metallic 0, both unknown, as in a file without materials."""
    flat = {"roughness": 0.5, "metallic": 0.0, "materials_known": 0.0}
    return positions, values | {name: np.full(len(positions), x, np.float32) for name, x in flat.items()}


def thin_unevenly(positions, values, rng) -> Points:
    """Density that falls exponentially along a random direction, to THINNEST."""
    along = positions @ rng.normal(size=3)
    fraction = (along - along.min()) / max(float(np.ptp(along)), np.finfo(np.float64).tiny)
    kept = rng.uniform(size=len(positions)) < THINNEST**fraction
    kept[0] = True
    return positions[kept], {name: column[kept] for name, column in values.items()}


SCANS: tuple[tuple[float, Callable[[np.random.Generator], Fault]], ...] = (
    # of a random scan: the chance of each fault, and how it is drawn
    (0.15, lambda rng: bake_light),
    (0.4, lambda rng: functools.partial(simulate_scanners, scanners=int(rng.integers(3, 9)))),
    (0.2, lambda rng: thin_unevenly),
    (0.15, lambda rng: functools.partial(drop_balls, balls=int(rng.integers(1, 5)))),
    (0.15, lambda rng: functools.partial(misregister, sigma=rng.uniform(0, MISREGISTERED))),
    (0.75, lambda rng: functools.partial(add_noise, sigma=float(np.exp(rng.uniform(*np.log(NOISE)))))),
    (0.35, lambda rng: functools.partial(add_outliers, share=float(np.exp(rng.uniform(*np.log(OUTLIERS)))))),
    (0.5, lambda rng: functools.partial(add_color_noise, sigma=rng.uniform(0, COLOR_NOISE))),
    (0.5, lambda rng: drop_materials),
)


def random_scan(positions, values, rng) -> Points:
    """The points after several faults, each drawn or not."""
    chosen = [draw for chance, draw in SCANS if rng.random() < chance]
    for fault in [draw(rng) for draw in chosen]:
        positions, values = fault(positions, values, rng)
    return positions, values
