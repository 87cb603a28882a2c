"""The whole way in minutes: generate objects, train `tiny`, score it on objects it never saw, write the report.

    python -m experiments.packaged.demo [--out runs/demo] [--meshes DIR]

What is there already is reused: finished objects, trained steps.  The seconds of each part are those of the run that
did the work.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from experiments import command
from spnr_jax import cli, presets
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.results import write_results
from spnr_jax.training import trainer


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Generate a data set, train the tiny preset on it and report on unseen objects."""

    out: Path = Path("runs/demo")
    """Folder of data set, run, metrics.json and report.html."""
    meshes: Path | None = None
    """Folder of .glb, .gltf, .obj and .ply files to use instead of procedural objects."""
    test_list: Path | None = None
    """Text file with the ids of the meshes to hold out (default: drawn by the seed)."""
    objects: int | None = None
    """Procedural objects (default: 240, or none with --meshes; both together if given)."""
    views: int = 10
    """Views per object."""
    spp: int = 24
    """Samples per pixel of the references."""
    steps: int | None = None
    """Training steps (default: the preset's)."""
    seed: int = 0
    """Seed of data and training."""


def main(demo: Demo) -> None:
    """Runs the three parts and says where the results are."""
    cli.set_up_jax()
    seconds = Seconds(demo.out / "seconds.json")
    objects = demo.objects if demo.objects is not None else None if demo.meshes else 240
    generation = GenerateConfig(
        out=demo.out / "data",
        objects=objects,
        meshes=demo.meshes,
        test_list=demo.test_list,
        views=demo.views,
        spp=demo.spp,
        visibility_grid=2,
        test_fraction=0.1 if demo.meshes is None else 0.2,
        seed=demo.seed,
    )
    print(f"1/3 generating the data set in {generation.out}", flush=True)
    seconds.measure("generate", lambda: generate(generation))

    tiny = presets.tiny()
    tiny = dataclasses.replace(tiny, seed=demo.seed, num_steps=tiny.num_steps if demo.steps is None else demo.steps)
    dataset, run = data_sets.open_dataset(generation.out), demo.out / "run"
    print(f"2/3 training preset {tiny.preset} for {tiny.num_steps} steps in {run}", flush=True)
    seconds.measure("train", lambda: trainer.train(tiny, dataset, run, trainer.Schedule()))

    print("3/3 evaluating on objects that the network never saw", flush=True)
    start = time.monotonic()
    outcome = evaluation.evaluate(run, dataset)
    parts = {**install_seconds(), **seconds.values, "evaluate": time.monotonic() - start}
    parts["total"] = sum(parts.values())
    parts = {name: round(value, 1) for name, value in parts.items()}
    write_results(demo.out, outcome, dataset.settings, trainer.read_rows(run), parts)
    for method, values in outcome.summary["methods"].items():
        print(f"{method:8s} PSNR {values['psnr']:6.2f} dB   SSIM {values['ssim']:.3f}   IoU {values['iou']:.3f}")
    print(f"metrics: {demo.out / 'metrics.json'}\nreport:  {demo.out / 'report.html'}")


class Seconds:
    """Seconds that each part took in all calls together, kept in a file."""

    def __init__(self, path: Path) -> None:
        """Reads what earlier calls wrote."""
        self._path = path
        self.values: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}

    def measure(self, part: str, work: Callable[[], Any]) -> Any:
        """Does the work, adds its time and returns its result; one that had nothing left to do (10 s) adds nothing."""
        start = time.monotonic()
        try:
            return work()
        finally:
            spent = time.monotonic() - start
            if part not in self.values or spent > 10:
                self.values[part] = self.values.get(part, 0.0) + spent
                write_whole(self._path, json.dumps(self.values).encode())


def install_seconds() -> dict[str, float]:
    """Seconds that `make` took to install the environment, if it did."""
    note = Path(sys.prefix) / "install_seconds"
    return {"install": float(note.read_text())} if note.is_file() else {}


if __name__ == "__main__":
    command.run(main, Demo, "packaged.demo")
