"""A network of the package, made again: data, training, scores, file of weights.

    python -m experiments.packaged.pretrain --meshes DIR --test-list FILE [--network NAME] [--out runs/pretrain]

Two data sets lie below OUT: `procedural`, objects of all classes, and `meshes`, those that the list does not hold out,
each with variants of colour and shape.  `data` joins them by links.  `near_points` is trained on it in five runs of
which each begins where the one before ended: OUT/near_points/run1 with many points an object, the next three with 128
to 2048, the last its refiner alone, on what the network shows.  `near_points_lite` is trained in one run.  The held-out
meshes score it (OUT/NAME/report.html), and OUT/NAME.npz is the file that the package holds.  What is there already is
reused: finished objects, trained steps, pictures.
"""

import dataclasses
import json
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from data_gen.store.layout import SPLITS
from experiments import entry_point
from experiments.packaged.demo import Seconds
from spnr_jax import cli, presets
from spnr_jax.config import SOLID, NearPointsConfig, TrainConfig, surface_grid
from spnr_jax.formats import data_sets as data
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import text_table, write_results
from spnr_jax.training import trainer, weights


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Make a network of the package again."""

    network: Literal["near_points", "near_points_lite"] = "near_points"
    """Which one."""
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
    """Training steps of each run (default: those that the package's network had)."""
    seed: int = 7
    """Seed of the data."""


def main(options: Pretrain) -> None:
    """Runs the parts and says where the results are."""
    cli.set_up_jax()
    out = options.out / options.network
    seconds = Seconds(out / "seconds.json")
    runs = recipe(options)
    parts = data_sets(options, runs[0].model.image_resolution)
    for part in parts:
        print(f"generating {part.out}", flush=True)
        seconds.measure("generate", partial(generate, part))
    dataset = data.open_dataset(joined(options.out / "data", [Path(part.out) for part in parts]))
    trained = None
    for number, config in enumerate(runs, start=1):
        run = out / f"run{number}"
        print(f"training preset {config.preset} for {config.num_steps} steps in {run}", flush=True)
        seconds.measure("train", partial(trainer.train, config, dataset, run, trainer.Schedule(), init=trained))
        trained = weights.read_trained(run)
    file = options.out / f"{options.network}.npz"
    assert trained is not None, "there is at least one run"
    weights.write_weights(file, trained)
    outcome = evaluation.evaluate(file, dataset, "test" if dataset.splits["test"] else "val")
    write_results(out, outcome, dataset.settings, seconds.values)
    print("\n".join(text_table(outcome.summary["methods"])))
    print(f"weights: {file}\nreport:  {out / 'report.html'}")


def recipe(options: Pretrain) -> list[TrainConfig]:
    """The configs of the runs of a network."""
    if options.network == "near_points_lite":
        runs = [presets.near_points_lite()]
    else:
        first = first_run()
        runs = [
            first,
            later(first, steps=9000, seed=first.seed + 1, lr=1.5e-3),
            later(first, steps=6000, seed=first.seed + 2, lr=1e-3),
            dataclasses.replace(later(first, steps=4000, seed=first.seed + 3, lr=1e-3), even_share=0.5),
        ]
        runs.append(refiner_behind(runs[-1]))
    return runs if options.steps is None else [dataclasses.replace(run, num_steps=options.steps) for run in runs]


def first_run() -> TrainConfig:
    """The config of the run that begins with random weights: no refiner, rays of a lattice."""
    tiny = presets.near_points_tiny()
    model = dataclasses.replace(SOLID, refiner_width=0, surface_cells=surface_grid(1024))
    return dataclasses.replace(
        tiny,
        preset="near_points, first run",
        model=model,
        optimizer=presets.LONGER,
        num_steps=11_000,
        min_points=384,
        pixel_stride=4,
    )


def later(config: TrainConfig, steps: int, seed: int, lr: float) -> TrainConfig:
    """The config of a run after the first: few and many points, other batches, a lower learning rate."""
    assert isinstance(config.model, NearPointsConfig)
    most = presets.near_points().max_points
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, surface_cells=surface_grid(most)),
        min_points=presets.near_points().min_points,
        max_points=most,
        optimizer=dataclasses.replace(config.optimizer, lr_generator=lr),
        num_steps=steps,
        seed=seed,
    )


def refiner_behind(config: TrainConfig) -> TrainConfig:
    """The config of the run of a refiner behind the network of a run."""
    preset = presets.near_points()
    assert isinstance(config.model, NearPointsConfig)
    return dataclasses.replace(
        preset,
        preset="near_points, refiner",
        trains="refiner",
        model=dataclasses.replace(config.model, refiner_width=SOLID.refiner_width),
        optimizer=dataclasses.replace(presets.QUICK, final_lr_scale=0.02, beta2=0.99, clip_norm=1.0),
        batch_objects=8,
        crop=config.model.image_resolution // 2,
        even_share=config.even_share,
        seed=config.seed,
    )


def data_sets(options: Pretrain, resolution: int) -> list[GenerateConfig]:
    """The data sets to generate: procedural objects, and meshes if there are any."""
    common = GenerateConfig(
        out="",
        resolution=resolution,
        views=options.views,
        spp=options.spp,
        visibility_grid=1,  # no discriminator looks at the conditions
        spread="even",
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
    entry_point.run(main, Pretrain, "packaged.pretrain")
