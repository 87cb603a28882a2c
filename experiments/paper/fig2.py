"""Figure 2 of the supplement, colour variants of objects, and what training with them changes.

    python -m experiments.paper.fig2 --data DIR --out DIR [--steps N] [--seed 0]

    OUT/runs/with/  OUT/runs/without/            run folders; finished ones are only read
    OUT/variants.png                             training objects beside their colour variants
    OUT/results.json  table.md                   scores of both trainings, and their differences with intervals
    OUT/gallery.png                              pictures of unseen objects

Two trainings of as many steps: one on the training objects and their variants, one on the objects alone, which it sees
the more often.  Test objects have no variants.  `spnr-data generate DIR --colour-variants 5` makes such a data set.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from experiments import entry_point
from experiments.comparison import figures, variants
from experiments.comparison.variants import Budget, Variant
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png, write_whole
from spnr_jax.scoring import evaluation

MOST_SHOWN = 5  # variants of an object in the picture


@dataclass(frozen=True, kw_only=True)
class Fig2:
    """Show colour variants, and compare training with and without them."""

    data: Path
    """Data set whose training objects have colour variants."""
    out: Path
    """Folder of runs and results; the same command goes on there."""
    budget: tyro.conf.OmitArgPrefixes[Budget] = field(default_factory=Budget)


def main(options: Fig2) -> None:
    """Trains what is not trained, scores both trainings, writes tables and pictures."""
    dataset = data_sets.open_dataset(options.data)
    runs = trainings(options, dataset)
    variants.study(options.out, "fig2", runs, "with", options.budget, dataset)
    write_whole(options.out / "variants.png", variants_picture(dataset, options.budget.shown))


def trainings(options: Fig2, dataset: data_sets.Dataset) -> list[Variant]:
    """The training without variants, and that with them; ValueError if the data set has none."""
    train, config = dataset.splits["train"], options.budget.config()
    alone = tuple(name for name in train if name == original(name))
    if alone == train:
        raise UserError(
            f"{dataset.folder}: the training objects have no colour variants; generate a data set with "
            "`spnr-data generate DIR --colour-variants 5`"
        )
    plain = dataclasses.replace(dataset, splits=dataset.splits | {"train": alone})
    return [
        Variant(name="without", label="Without variants", config=config, dataset=plain),
        Variant(name="with", label="With variants", config=config, dataset=dataset),
    ]


def original(name: str) -> str:
    """The object that a variant was made of (these are called ID--1, ID--2, ...), or the object itself."""
    return name.partition("--")[0]


def variants_picture(dataset: data_sets.Dataset, num_objects: int) -> bytes:
    """PNG: a row a training object, itself and its variants; each seen by its camera that is nearest to the object's.

    The view of an object is the one that its variants come nearest to: cameras are random, and each has its own.
    """
    found: dict[str, list[str]] = {}
    for name in sorted(dataset.splits["train"]):
        if name != original(name):
            found.setdefault(original(name), []).append(name)
    rows, most = [], min(MOST_SHOWN, max(map(len, found.values())))
    for product in evaluation.pick_evenly(tuple(p for p in found if len(found[p]) >= most), num_objects):
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
