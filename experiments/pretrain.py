"""The network in the package, made again: data, training, scores, file of weights.

    python -m experiments.pretrain --meshes DIR --test-list FILE [--out runs/pretrain]

Two data sets lie below OUT: `procedural`, objects of all classes, and `meshes`, those that the list does not hold out,
each with variants of colour and shape.  `data` joins them by links.  The preset plus_small trains on it in OUT/first;
OUT/run begins where that ended and goes on with from 128 to 2048 points an object.  The held-out meshes score it
(OUT/report.html), and OUT/pretrained.npz is the file that the package holds.  What is there already is reused: finished
objects, trained steps.
"""

import dataclasses
import json
import os
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from data_gen.generate import generate
from data_gen.plan import GenerateConfig
from data_gen.records import SPLITS
from experiments.demo import Seconds
from spnr_jax import cli, data, evaluation, presets, trainer, weights
from spnr_jax.config import TrainConfig
from spnr_jax.images import write_whole
from spnr_jax.model_config import ModelConfig, surface_grid
from spnr_jax.results import text_table, write_results

MOST_POINTS = 2048  # of an object in the second run


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Make the network in the package again."""

    meshes: Path | None = None
    """Folder of .glb, .gltf, .obj and .ply files that train beside the procedural objects (default: none)."""
    test_list: Path | None = None
    """Text file with the ids of the meshes to hold out (default: drawn by the seed)."""
    out: Path = Path("runs/pretrain")
    """Folder of data sets, run, report and weights."""
    objects: int = 2400
    """Procedural objects."""
    variants: int = 24
    """Variants of each training mesh: base colours rotated, turned, mirrored, stretched, roughness bent."""
    views: int = 4
    """Views per object."""
    spp: int = 24
    """Samples per pixel of the references."""
    steps: int | None = None
    """Training steps of the first run (default: the preset's)."""
    more_steps: int = 9000
    """Training steps of the second run."""
    seed: int = 7
    """Seed of the data."""


def main(options: Pretrain) -> None:
    """Runs the parts and says where the results are."""
    cli.enable_compilation_cache()
    seconds = Seconds(options.out / "seconds.json")
    config = presets.plus_small()
    if options.steps is not None:
        config = dataclasses.replace(config, num_steps=options.steps)
    parts = data_sets(options, config.model.image_resolution)
    for part in parts:
        print(f"generating {part.out}", flush=True)
        seconds.measure("generate", partial(generate, part))
    dataset = data.open_dataset(joined(options.out / "data", [Path(part.out) for part in parts]))
    first, run = options.out / "first", options.out / "run"
    seconds.measure("train", partial(train, config, dataset, first, None))
    seconds.measure("train", partial(train, of_any_density(config, options.more_steps), dataset, run, first))
    weights.write_weights(options.out / "pretrained.npz", weights.read_trained(run))
    outcome = evaluation.evaluate(options.out / "pretrained.npz", dataset, "test" if dataset.splits["test"] else "val")
    write_results(options.out, outcome, dataset.settings, trainer.read_rows(run), seconds.values)
    print("\n".join(text_table(outcome.summary["methods"])))
    print(f"weights: {options.out / 'pretrained.npz'}\nreport:  {options.out / 'report.html'}")


def train(config: TrainConfig, dataset: data.Dataset, run: Path, before: Path | None) -> None:
    """Trains a run, from the weights that the run before it ended with."""
    print(f"training preset {config.preset} for {config.num_steps} steps in {run}", flush=True)
    init = None if before is None else weights.read_trained(before)
    trainer.train(config, dataset, run, trainer.Schedule(), init=init)


def of_any_density(config: TrainConfig, steps: int) -> TrainConfig:
    """The config of the second run: few and many points, other batches, a lower learning rate."""
    assert isinstance(config.model, ModelConfig)
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, surface_cells=surface_grid(MOST_POINTS)),
        optimizer=dataclasses.replace(config.optimizer, lr_generator=1.5e-3),
        num_steps=steps,
        min_points=128,
        max_points=MOST_POINTS,
        seed=config.seed + 1,
    )


def data_sets(options: Pretrain, resolution: int) -> list[GenerateConfig]:
    """The data sets to generate: procedural objects, and meshes if there are any."""
    common = GenerateConfig(
        out="",
        resolution=resolution,
        views=options.views,
        spp=options.spp,
        visibility_grid=1,  # no discriminator looks at the conditions
        seed=options.seed,
    )
    procedural = dataclasses.replace(
        common, out=options.out / "procedural", objects=options.objects, test_fraction=0.0, val_fraction=0.01
    )
    if options.meshes is None:
        return [procedural]
    meshes = dataclasses.replace(
        common,
        out=options.out / "meshes",
        meshes=options.meshes,
        test_list=options.test_list,
        colour_variants=options.variants,
        reshape_variants=True,
        val_fraction=0.04,
    )
    return [procedural, meshes]


def joined(folder: Path, parts: list[Path]) -> Path:
    """The folder of one data set of all objects of the parts, as links to theirs."""
    (folder / "objects").mkdir(parents=True, exist_ok=True)
    for part in parts:
        for source in sorted((part / "objects").iterdir()):
            link = folder / "objects" / source.name
            if not link.is_symlink():
                link.symlink_to(os.path.relpath(source, link.parent))
    for split in SPLITS:
        names = sorted(name for part in parts for name in (part / "splits" / f"{split}.txt").read_text().split())
        write_whole(folder / "splits" / f"{split}.txt", "".join(f"{name}\n" for name in names).encode())
    described = {part.name: json.loads((part / "dataset.json").read_text()) for part in parts}
    description = next(iter(described.values())) | {"parts": described}
    write_whole(folder / "dataset.json", (json.dumps(description, indent=1) + "\n").encode())
    return folder


if __name__ == "__main__":
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    sys.exit(cli.guarded(lambda: main(tyro.cli(Pretrain, prog="python -m experiments.pretrain")), "pretrain"))
