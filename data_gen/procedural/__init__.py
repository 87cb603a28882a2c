"""Procedural objects: eight classes, any number of each, every object a function of its category and seed only.

A family (one file each) draws a sub-style and then all its proportions, parts and finishes from the generator it is
given. Objects stand on y = 0 with y up and face +z; lengths are of the order of 1.
"""

from collections.abc import Callable

import numpy as np

from data_gen.procedural import chairs, frames, lamps, planes, shelves, sofas
from data_gen.procedural.cars import car
from data_gen.procedural.parts import Piece, assemble
from data_gen.procedural.tables import table
from spnr_jax.formats.assets import Asset


def draw_style(styles: dict[Callable, float]) -> Callable[..., list[Piece]]:
    """A family that draws one of its builders, each as often as its number says."""
    return lambda rng: rng.choice(list(styles), p=list(styles.values()))(rng)


FAMILIES: dict[str, Callable[..., list[Piece]]] = {
    "chair": draw_style(chairs.STYLES),
    "table": table,
    "sofa": draw_style(sofas.STYLES),
    "shelf": draw_style(shelves.STYLES),
    "lamp": draw_style(lamps.STYLES),
    "frame": draw_style(frames.STYLES),
    "car": car,
    "plane": draw_style(planes.STYLES),
}
CATEGORIES = tuple(FAMILIES)


def category_of(index: int) -> str:
    """Category of object number `index`: round robin, so that any run of objects is balanced."""
    return CATEGORIES[index % len(CATEGORIES)]


def make(category: str, seed: int) -> Asset:
    """The object of a category and a seed (0, 1, 2, ...): the same bytes in every process and on every machine."""
    rng = np.random.default_rng([CATEGORIES.index(category), seed])
    return assemble(FAMILIES[category](rng), category, {"generator": "procedural", "seed": int(seed)})
