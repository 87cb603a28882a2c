"""Figure 2 of the supplement, colour variants of objects, and what training with them changes.

    python -m experiments.paper.fig2 --out DIR [--data DIR] [--steps N] [--seeds 0 1 2]

    OUT/data/                                    the data set, where --data names none
    OUT/runs/with_SEED/  OUT/runs/without_SEED/  run folders; finished ones are only read
    OUT/variants.png                             training objects beside their colour variants
    OUT/results.json  table.md                   scores of both trainings, and their differences with intervals
    OUT/differences.png  gallery.png             the differences, and pictures of unseen objects

Two trainings of as many steps: one on the training objects and their variants, one on the objects alone, which it sees
the more often.  Test objects have no variants.  A data set with variants comes from `spnr-data generate DIR
--colour-variants 5`; without --data one of procedural objects is generated, as `make demo` makes its own.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from experiments import entry_point
from experiments.comparison import figures, variants
from experiments.comparison.variants import Budget, Variant
from spnr_jax import cli
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png, write_whole
from spnr_jax.scoring import evaluation

QUICK_OBJECTS, QUICK_VARIANTS = 12, 2
MOST_SHOWN = 5  # variants of an object in the picture


@dataclass(frozen=True, kw_only=True)
class Fig2:
    """Show colour variants, and compare training with and without them."""

    out: Path
    """Folder of runs and results; the same command goes on there."""
    data: Path | None = None
    """Data set whose training objects have colour variants, as `spnr-data generate DIR --colour-variants 5` makes it
    (default: generate one in OUT/data)."""
    generated: int = 240
    """Procedural objects to generate, without --data (12 with --quick)."""
    colour_variants: int = 5
    """Variants of each training object to generate [paper: 5], without --data (2 with --quick)."""
    budget: tyro.conf.OmitArgPrefixes[Budget] = field(default_factory=Budget)

    def __post_init__(self) -> None:
        at_least(self, 1, "generated", "colour_variants")


def main(options: Fig2) -> None:
    """Generates and trains what is missing, scores both trainings, writes tables and pictures."""
    cli.set_up_jax()
    folder = options.data or options.out / "data"
    if options.data is None:
        print(f"generating the data set in {folder}", flush=True)
        generate(generation(options, folder))
    dataset = data_sets.open_dataset(folder)
    runs = trainings(options, dataset)
    variants.study(options.out, "fig2", runs, "without", options.budget, dataset)
    write_whole(options.out / "variants.png", variants_picture(dataset, options.budget.shown))


def generation(options: Fig2, folder: Path) -> GenerateConfig:
    """The data set of procedural objects with colour variants."""
    return GenerateConfig(
        out=folder,
        objects=QUICK_OBJECTS if options.budget.quick else options.generated,
        colour_variants=QUICK_VARIANTS if options.budget.quick else options.colour_variants,
        resolution=options.budget.config().model.image_resolution,
        views=3 if options.budget.quick else 10,
        spp=4 if options.budget.quick else 24,
        visibility_grid=2,
        test_fraction=0.2 if options.budget.quick else 0.1,
    )


def trainings(options: Fig2, dataset: data_sets.Dataset) -> list[Variant]:
    """The training without variants, and that with them; ValueError if the data set has none."""
    plain, config = variants.without_colour_variants(dataset), options.budget.config()
    if plain.splits == dataset.splits:
        raise UserError(
            f"{dataset.folder}: the training objects have no colour variants; generate a data set with "
            "`spnr-data generate DIR --colour-variants 5`, or leave out --data"
        )
    return [
        Variant(name="without", label="Without variants", config=config, dataset=plain),
        Variant(name="with", label="With variants", config=config, dataset=dataset),
    ]


def variants_picture(dataset: data_sets.Dataset, num_objects: int) -> bytes:
    """PNG: a row a training object, itself and its variants; each seen by its camera that is nearest to the object's.

    The view of an object is the one that its variants come nearest to: cameras are random, and each has its own.
    """
    found: dict[str, list[str]] = {}
    for name in sorted(dataset.splits["train"]):
        if name != variants.original(name):
            found.setdefault(variants.original(name), []).append(name)
    rows, most = [], min(MOST_SHOWN, max(map(len, found.values())))
    for product in evaluation.spread(tuple(p for p in found if len(found[p]) >= most), num_objects):
        items = [data_sets.read_object(dataset, name) for name in (product, *found[product][:most])]
        views = nearest_views([np.asarray(item.camera.cam_to_world)[..., 3] for item in items])
        images = [data_sets.on_white(item.images[view]) for item, view in zip(items, views, strict=True)]
        rows.append((product, images))
    heads = ["Object", *(f"Variant {i + 1}" for i in range(most))]
    return png(figures.grid([images for _, images in rows], heads, [product for product, _ in rows], 128))


def nearest_views(eyes: list[np.ndarray]) -> list[int]:
    """A view of each object such that those of the others look from nearest to that of the first; eyes (views, 3)."""
    directions = [eye / np.linalg.norm(eye, axis=-1, keepdims=True) for eye in eyes]
    closeness = [directions[0] @ other.T for other in directions[1:]]
    view = int(np.argmax(sum(near.max(axis=1) for near in closeness)))
    return [view, *(int(np.argmax(near[view])) for near in closeness)]


if __name__ == "__main__":
    entry_point.run(main, Fig2, "paper.fig2")
