"""The paper's data sets as defaults of `spnr-data generate`: `spnr-data generate OUT --preset NAME --root DIR`.

Image size, views and test objects are the paper's; samples per pixel and the number of validation objects (none: the
paper names none) are choices. Where a folder holds another number of usable objects than the paper used, the test
split keeps its size and the rest train; `--train-objects` caps them.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import tyro

from data_gen.plan.tasks import GenerateConfig, Preset

# (training objects with their colour variants, test objects) of the paper
PAPER_COUNTS: dict[Preset, tuple[int, int]] = {
    "abo": (16161, 200),
    "shapenet_car": (1127, 128),
    "shapenet_plane": (3627, 406),
    "shapenet_chair": (4882, 105),
}
# 128 samples: 40 dB against 4096 over the object's own pixels (median; docs/lab/making_data.md)
COMMON = GenerateConfig(out=tyro.MISSING, val_fraction=0.0, views=10, spp=128)


def abo(out: Path) -> GenerateConfig:
    """Amazon Berkeley Objects at 128 x 128.

    Of 7,953 products 200 test and the others train, with as many colour variants of theirs, drawn by the seed from
    five each, as make 16,161. (All five of each would be 46,518; how the paper came to 16,161 it does not say.)
    """
    train, test = PAPER_COUNTS["abo"]
    made = replace(COMMON, out=out, preset="abo", colour_variants=5, resolution=128)
    return replace(made, train_objects=train, test_objects=test)


def shapenet(out: Path, preset: Preset) -> GenerateConfig:
    """A class of ShapeNetCore at 200 x 200, without colour variants."""
    return replace(COMMON, out=out, preset=preset, test_objects=PAPER_COUNTS[preset][1], resolution=200)


PRESETS: dict[str, Callable[[Path], GenerateConfig]] = {
    "abo": abo,
    **{name: partial(shapenet, preset=name) for name in PAPER_COUNTS if name != "abo"},
}
