"""Simulated faults of scans: noise, outliers, unseen surface, uneven density, colours without materials.

All functions take and return (positions (n, 3), other columns by name) with a generator of random numbers.  Lengths are
in units of the box whose half diagonal is 1; the points must lie in it.  `random_scan` draws several.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from spnr_jax.surfels.normals import find_visible, spacing_of

Points = tuple[np.ndarray, dict[str, np.ndarray]]
Fault = Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], Points]

SCANNER = 2.5  # distance of a virtual scanner from the middle of the box
BEHIND = 3.0  # spacings behind the first of its pixel that a scanner still sees a point
BALLS = 0.03, 0.15  # radii of what is left out
SHADED = 0.2, 0.7  # of a colour that a lamp's direction takes away at most
NOISE, OUTLIERS = (0.001, 0.02), (0.002, 0.05)  # of random scans, drawn from the logarithm
MISREGISTERED, COLOUR_NOISE = 0.004, 0.08  # at most
THINNEST = 0.1  # density at one end of a cloud of uneven density, over that at the other


def noisy(positions, values, rng, *, sigma: float) -> Points:
    """Normally distributed errors of this standard deviation along each axis."""
    return positions + sigma * rng.normal(size=positions.shape), values


def with_outliers(positions, values, rng, *, share: float) -> Points:
    """So many more points, uniform in the bounding box, with the columns of points drawn at random."""
    count = round(share * len(positions))
    low, high = positions.min(axis=0), positions.max(axis=0)
    copied = rng.integers(len(positions), size=count)
    return (
        np.concatenate([positions, rng.uniform(low, high, (count, 3))]),
        {name: np.concatenate([column, column[copied]]) for name, column in values.items()},
    )


def scan(positions, values, rng, *, scanners: int) -> Points:
    """What scanners in random directions from the middle see."""
    spacing, seen = spacing_of(positions), np.zeros(len(positions), bool)
    for direction in rng.normal(size=(scanners, 3)):
        seen |= find_visible(positions, SCANNER * direction / np.linalg.norm(direction), spacing, BEHIND)
    return positions[seen], {name: column[seen] for name, column in values.items()}


def misregister(positions, values, rng, *, sigma: float) -> Points:
    """Two scans that do not quite meet: the points on one side of a random plane are moved together."""
    apart = positions @ rng.normal(size=3) > 0
    return positions + apart[:, None] * sigma * rng.normal(size=3), values


def drop_balls(positions, values, rng, *, balls: int) -> Points:
    """Nothing is left in balls around random points."""
    middles, radii = positions[rng.integers(len(positions), size=balls)], rng.uniform(*BALLS, balls)
    kept = (((positions[:, None] - middles) ** 2).sum(axis=-1) > radii**2).all(axis=1)
    kept[0] = True
    return positions[kept], {name: column[kept] for name, column in values.items()}


def colour_noise(positions, values, rng, *, sigma: float) -> Points:
    """Normally distributed errors of the base colours."""
    color = values["base_color"]
    return positions, values | {"base_color": np.clip(color + sigma * rng.normal(size=color.shape), 0, 1)}


def colours_in_light(positions, values, rng) -> Points:
    """Base colours darkened as a lamp in a grey room would, as a photograph has them; as they are without normals."""
    if "normals" not in values:
        return positions, values
    lamp = rng.normal(size=3)
    cosine = np.abs(values["normals"] @ lamp) / np.linalg.norm(lamp)
    shade = 1 - rng.uniform(*SHADED) * (1 - cosine)
    return positions, values | {"base_color": values["base_color"] * shade[:, None]}


def colours_alone(positions, values, rng) -> Points:
    """Roughness 0.5 and metallic 0 everywhere and not known, as a file without materials is read."""
    flat = {"roughness": 0.5, "metallic": 0.0, "materials_known": 0.0}
    return positions, values | {name: np.full(len(positions), x, np.float32) for name, x in flat.items()}


def uneven(positions, values, rng) -> Points:
    """A density that falls exponentially in a random direction, to THINNEST."""
    along = positions @ rng.normal(size=3)
    place = (along - along.min()) / max(float(np.ptp(along)), np.finfo(np.float64).tiny)
    kept = rng.uniform(size=len(positions)) < THINNEST**place
    kept[0] = True
    return positions[kept], {name: column[kept] for name, column in values.items()}


SCANS: tuple[tuple[float, Callable[[np.random.Generator], Fault]], ...] = (
    # of a random scan: the chance of each fault, and how it is drawn
    (0.15, lambda rng: colours_in_light),
    (0.4, lambda rng: partial(scan, scanners=int(rng.integers(3, 9)))),
    (0.2, lambda rng: uneven),
    (0.15, lambda rng: partial(drop_balls, balls=int(rng.integers(1, 5)))),
    (0.15, lambda rng: partial(misregister, sigma=rng.uniform(0, MISREGISTERED))),
    (0.75, lambda rng: partial(noisy, sigma=float(np.exp(rng.uniform(*np.log(NOISE)))))),
    (0.35, lambda rng: partial(with_outliers, share=float(np.exp(rng.uniform(*np.log(OUTLIERS)))))),
    (0.5, lambda rng: partial(colour_noise, sigma=rng.uniform(0, COLOUR_NOISE))),
    (0.5, lambda rng: colours_alone),
)


def random_scan(positions, values, rng) -> Points:
    """The points after several faults, each drawn or not."""
    chosen = [draw for chance, draw in SCANS if rng.random() < chance]
    for fault in [draw(rng) for draw in chosen]:
        positions, values = fault(positions, values, rng)
    return positions, values
