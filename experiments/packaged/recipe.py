"""Trains the package's networks from scratch: data, the densifier, then the shader on densified clouds.

    python -m experiments.packaged.recipe --meshes MESHES --test-list TEST --out runs/weights [--share 0.1]

    OUT/data/         pictures of meshes, of their variants and of procedural objects (`spnr-data generate`)
    OUT/densifier/    records of points, checkpoint and weights of the densifier
    OUT/run/          training run of the shader: weights.npz, and the densifier.npz that it was trained with
    OUT/scores.json   PSNR, inside and outline of test objects: without networks, without learned points, with both

Each part continues where it stopped.  `spnr render cloud.ply --run OUT/run` uses the result.
"""

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from experiments import entry_point
from experiments.comparison.contenders import draw_volume
from experiments.comparison.view_scores import measure_sharpness
from experiments.packaged import densifier_training
from experiments.packaged.demo import Seconds
from spnr_jax import presets
from spnr_jax.config import Quality
from spnr_jax.errors import require_within
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels.cloud_arrays import farthest_points
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.model import Model
from spnr_jax.training import trainer
from spnr_jax.training.weights import load

PROCEDURAL, VARIANTS = 240, 2  # procedural objects; variants of each mesh (stretched, with new colours)
DENSIFIER_STEPS, STEPS = 7_000, 10_000
COUNTS = (256, 1024, 4096, 16_384)  # numbers of points in the scores
PARTS: tuple[tuple[str, bool, Quality], ...] = (
    ("discs and light alone", False, "draft"),
    ("no learned points", False, "best"),
    ("both networks", True, "best"),
)
COLUMNS = ("psnr", "psnr_inside", "outline_rmse", "holes")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Train the networks of the package from meshes."""

    meshes: Path | None = None
    """Folder of .glb, .gltf, .obj and .ply files that are trained on beside the procedural objects (default: none)."""
    test_list: Path | None = None
    """Text file with the ids of the test meshes: neither network is trained on them, the last part scores them."""
    maps: Path | None = None
    """Folder of environment maps that light a fifth of the views (default: only the room, skies and lamps)."""
    out: Path = Path("runs/weights")
    """Output folder."""
    share: float = 1.0
    """Share of the objects and of the steps: 0.1 for a trial."""
    workers: int | None = None
    """Rendering processes (default: one per CPU core)."""
    seed: int = 0
    """Seed of the data and of the shader's training; the densifier's is fixed."""

    def __post_init__(self) -> None:
        require_within(self, 0.01, 1, "share")  # of two procedural objects one is left to train on


def main(recipe: Recipe) -> None:
    """Runs each part in turn and prints its time."""
    seconds = Seconds(recipe.out / "seconds.json")
    seconds.measure("data", lambda: generate(generation_of(recipe)))
    dataset = data_sets.open_dataset(recipe.out / "data")
    seconds.measure("densifier", lambda: train_densifier(recipe, dataset))
    run = recipe.out / "run"
    run.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(recipe.out / "densifier" / "densifier.npz", run / "densifier.npz")
    config = dataclasses.replace(presets.surfels(), num_steps=scale(recipe, STEPS), seed=recipe.seed)
    seconds.measure("shader", lambda: trainer.train(config, dataset, run, trainer.Schedule()))
    rows = score(run, dataset)
    write_whole(recipe.out / "scores.json", (json.dumps(rows, indent=1) + "\n").encode())
    spent = ", ".join(f"{part} {value:.0f} s" for part, value in seconds.values.items())
    print(f"weights: {run / 'weights.npz'} and densifier.npz; {spent}")


def scale(recipe: Recipe, count: int) -> int:
    """This share of a number, at least one."""
    return max(round(recipe.share * count), 1)


def generation_of(recipe: Recipe) -> GenerateConfig:
    """The configuration of the data generator: views of 512 px, each in its own light."""
    lights = ("room", "room", "room", "random") + ((str(recipe.maps),) if recipe.maps else ())
    return GenerateConfig(
        out=recipe.out / "data",
        meshes=recipe.meshes,
        test_list=recipe.test_list,
        test_objects=None if recipe.test_list else scale(recipe, 16),
        objects=scale(recipe, PROCEDURAL),
        colour_variants=scale(recipe, VARIANTS) if recipe.meshes else 0,
        reshape_variants=recipe.meshes is not None,
        resolution=512,
        views=4,
        points=65_536,
        spp=25,
        visibility_grid=1,
        lights=lights,
        val_fraction=0.03,
        workers=recipe.workers,
        seed=recipe.seed,
    )


def train_densifier(recipe: Recipe, dataset: data_sets.Dataset) -> None:
    """Trains the densifier on meshes and its own procedural objects, without those of the test split."""
    options = densifier_training.Options(
        meshes=recipe.meshes,
        left_out=frozenset(dataset.splits["test"]),
        out=recipe.out / "densifier",
        objects=scale(recipe, PROCEDURAL),
        steps=scale(recipe, DENSIFIER_STEPS),
    )
    densifier_training.make_records(options)
    densifier_training.train(options)


def score(run: Path, dataset: data_sets.Dataset) -> dict[str, dict[str, float]]:
    """Mean scores of the test objects, a row for each number of points and each of PARTS; prints each row."""
    model, rows = load(run), {}
    for count in COUNTS:
        found: dict[str, list[list[float]]] = {}
        for name in dataset.splits["test"]:
            item = data_sets.read_object(dataset, name)
            even = farthest_points(np.asarray(item.cloud.positions), count, 0)
            cloud = jax.tree.map(lambda x, even=even: np.asarray(x)[even], item.cloud)
            cloud = dataclasses.replace(cloud, normals=None)
            for label, densify, quality in PARTS:
                found.setdefault(f"{count} points, {label}", []).append(
                    score_object(model, item, cloud, densify, quality)
                )
        for label, values in found.items():
            rows[label] = dict(zip(COLUMNS, np.nanmean(values, axis=0).round(4).tolist(), strict=True))
            print(label, rows[label], flush=True)
    return rows


def score_object(
    model: Model, item: data_sets.ObjectData, cloud: PointCloud, densify: bool, quality: Quality
) -> list[float]:
    """The scores COLUMNS of an object, means over its views, each in its own light."""
    pictures = draw_volume(model, model.encode(cloud, densify=densify), item, quality)
    drawn = zip(np.clip(pictures.image, 0, 1), pictures.acc, item.images, strict=True)
    found = [[getattr(one, name) for name in COLUMNS] for one in (measure_sharpness(*view) for view in drawn)]
    return np.nanmean(found, axis=0).tolist()


if __name__ == "__main__":
    entry_point.run(main, Recipe, "packaged.recipe")
