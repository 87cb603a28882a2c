"""The paper's data sets as defaults of `spnr-data generate`, one function each.

Image size, views and test objects are the paper's; samples per pixel and the number of validation objects (none: the
paper names none) are choices. Where a folder holds another number of usable objects than the paper used, the test
split keeps its size and the rest train; `--train-objects` caps them.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from data_gen.plan.tasks import Category, GenerateConfig, Preset

# 40 dB against 4096 samples over the object's own pixels (median; docs/lab/making_data.md)
SAMPLES = 128
# (training objects with their colour variants, test objects) of the paper
PAPER_COUNTS: dict[Preset, tuple[int, int]] = {
    "abo": (16161, 200),
    "shapenet_car": (1127, 128),
    "shapenet_plane": (3627, 406),
    "shapenet_chair": (4882, 105),
}
SHAPENET: dict[Category, Preset] = {"car": "shapenet_car", "plane": "shapenet_plane", "chair": "shapenet_chair"}


def abo(out: Path) -> GenerateConfig:
    """Amazon Berkeley Objects at 128 x 128: `spnr-data generate OUT --preset abo --root DIR`.

    Of 7,953 products 200 test and the others train, with as many colour variants of theirs, drawn by the seed from
    five each, as make 16,161. (All five of each would be 46,518; how the paper came to 16,161 it does not say.)
    """
    train, test = PAPER_COUNTS["abo"]
    return GenerateConfig(
        out=out,
        preset="abo",
        source="abo",
        colour_variants=5,
        train_objects=train,
        test_objects=test,
        val_fraction=0.0,
        resolution=128,
        views=10,
        spp=SAMPLES,
    )


def shapenet(out: Path, category: Category) -> GenerateConfig:
    """A class of ShapeNetCore at 200 x 200, without colour variants.

    `spnr-data generate OUT --preset shapenet_car --root DIR`, or shapenet_plane, or shapenet_chair.
    """
    return GenerateConfig(
        out=out,
        preset=SHAPENET[category],
        source="shapenet",
        category=category,
        test_objects=PAPER_COUNTS[SHAPENET[category]][1],
        val_fraction=0.0,
        resolution=200,
        views=10,
        spp=SAMPLES,
    )


PRESETS: dict[str, Callable[[Path], GenerateConfig]] = {
    "abo": abo,
    **{preset: partial(shapenet, category=category) for category, preset in SHAPENET.items()},
}
