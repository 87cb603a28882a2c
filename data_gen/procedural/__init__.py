"""Procedural objects: eight classes, any number of each, every object a function of its category and seed only.

A family (one file each) draws a sub-style and then all its proportions, parts and finishes from the generator it is
given. Objects stand on y = 0 with y up and face +z; lengths are of the order of 1.
"""

import numpy as np

from data_gen.procedural.cars import car
from data_gen.procedural.chairs import chair
from data_gen.procedural.frames import frame
from data_gen.procedural.lamps import lamp
from data_gen.procedural.parts import assemble
from data_gen.procedural.planes import plane
from data_gen.procedural.shelves import shelf
from data_gen.procedural.sofas import sofa
from data_gen.procedural.tables import table
from spnr_jax.errors import UserError
from spnr_jax.formats.mesh.assets import Asset

FAMILIES = {
    "chair": chair,
    "table": table,
    "sofa": sofa,
    "shelf": shelf,
    "lamp": lamp,
    "frame": frame,
    "car": car,
    "plane": plane,
}
CATEGORIES = tuple(FAMILIES)


def category_of(index: int) -> str:
    """Category of object number `index`: round robin, so that any run of objects is balanced."""
    return CATEGORIES[index % len(CATEGORIES)]


def make(category: str, seed: int) -> Asset:
    """The object of a category and a seed (0, 1, 2, ...): the same bytes in every process and on every machine."""
    if category not in FAMILIES:
        raise UserError(f"category {category!r} is not one of {', '.join(CATEGORIES)}")
    if seed < 0:
        raise UserError(f"seed must be 0 or more, got {seed}")
    rng = np.random.default_rng([CATEGORIES.index(category), seed])
    return assemble(FAMILIES[category](rng), category, {"generator": "procedural", "seed": int(seed)})
