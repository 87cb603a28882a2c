"""What scanners do to a clean cloud: noise, outliers, unseen surface, uneven density, colours without materials.

All take and return (positions (n, 3), other columns by name) with a generator of random numbers; lengths are units of
the box whose half diagonal is 1, in which the points have to lie.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from spnr_jax.kernels.facing import seen_from, spacing_of

Points = tuple[np.ndarray, dict[str, np.ndarray]]
Fault = Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], Points]

SCANNER = 2.5  # distance of a virtual scanner from the middle of the box
BEHIND = 3.0  # spacings behind the first of its pixel that a scanner still sees a point
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


def scanned(positions, values, rng, *, scanners: int) -> Points:
    """What scanners in random directions from the middle see."""
    spacing, seen = spacing_of(positions), np.zeros(len(positions), bool)
    for direction in rng.normal(size=(scanners, 3)):
        seen |= seen_from(positions, SCANNER * direction / np.linalg.norm(direction), spacing, BEHIND)
    return positions[seen], {name: column[seen] for name, column in values.items()}


def colours_alone(positions, values, rng) -> Points:
    """Roughness 0.5 and metallic 0 everywhere, as a file without materials is read."""
    flat = {"roughness": 0.5, "metallic": 0.0}
    return positions, values | {name: np.full(len(positions), x, np.float32) for name, x in flat.items()}


def uneven(positions, values, rng) -> Points:
    """A density that falls exponentially in a random direction, to THINNEST."""
    along = positions @ rng.normal(size=3)
    place = (along - along.min()) / max(float(np.ptp(along)), np.finfo(np.float64).tiny)
    kept = rng.uniform(size=len(positions)) < THINNEST**place
    kept[0] = True
    return positions[kept], {name: column[kept] for name, column in values.items()}


def faults(noise: tuple[float, ...], outliers: tuple[float, ...], scanners: tuple[int, ...]) -> dict[str, Fault | None]:
    """Every fault by a name for the row of a table; None leaves the cloud clean."""
    named: dict[str, Fault | None] = {"clean": None}
    named |= {f"noise {sigma:.1%}": partial(noisy, sigma=sigma) for sigma in noise}
    named |= {f"outliers {share:.0%}": partial(with_outliers, share=share) for share in outliers}
    named |= {f"{n} scanner{'s' * (n > 1)}": partial(scanned, scanners=n) for n in scanners}
    return named | {"colours alone": colours_alone, "uneven density": uneven}
