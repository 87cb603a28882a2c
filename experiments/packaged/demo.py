"""The whole way in minutes: generate objects, train two networks, score both on objects they never saw, report.

    python -m experiments.packaged.demo [--out runs/demo] [--meshes DIR]

    OUT/data/  ours/  paper/       the data set, and the runs of our network and of the paper's
    OUT/metrics.json  report.html  both beside the trivial renderers

Both networks see the same evenly spread points, and train for as many steps.  What is there already is reused: finished
objects, trained steps.  The seconds of each part are those of the run that did it.
"""

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from data_gen.make.generate import generate
from data_gen.plan.tasks import GenerateConfig
from experiments import entry_point
from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import describe_split, text_table, write_results
from spnr_jax.training import trainer
from spnr_jax.training.weights import read_trained

POINTS = 2048  # of an object; of evenly spread ones the first 1024, which a test sees, are evenly spread, too


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Generate a data set, train our network and the paper's on it and report on unseen objects."""

    out: Path = Path("runs/demo")
    """Folder of data set, runs, metrics.json and report.html."""
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
    steps: int = 800  # after half as many the paper's network has not learnt hues
    """Training steps of each network."""
    seed: int = 0
    """Seed of data and training."""


def main(demo: Demo) -> None:
    """Runs the parts and says where the results are."""
    seconds = Seconds(demo.out / "seconds.json")
    generation = generation_of(demo)
    configs = configs_of(demo)
    print(f"1/4 generating the data set in {generation.out}", flush=True)
    seconds.measure("generate", lambda: generate(generation))

    dataset = data_sets.open_dataset(generation.out)
    for number, (name, config) in enumerate(configs.items(), start=2):
        run = demo.out / name
        print(f"{number}/4 training {name}, preset {config.preset}, for {config.num_steps} steps in {run}", flush=True)
        seconds.measure(PARTS[name], partial(trainer.train, config, dataset, run, trainer.Schedule()))

    print("4/4 evaluating on the test split", flush=True)
    start = time.monotonic()
    runs = {name: demo.out / name for name in configs}
    trained = {name: read_trained(run) for name, run in runs.items()}
    outcome = evaluation.compare(trained, dataset)
    parts = {**seconds.values, "evaluate": time.monotonic() - start}
    parts["total"] = sum(parts.values())
    parts = {name: round(value, 1) for name, value in parts.items()}
    write_results(demo.out, outcome, dataset.settings, parts)
    print(f"{len(dataset.splits['test'])} {describe_split(outcome.summary)}")
    print("\n".join(text_table(outcome.summary["methods"])))
    print(f"metrics: {demo.out / 'metrics.json'}\nreport:  {demo.out / 'report.html'}")


PARTS = {"ours": "train", "paper": "train paper"}  # network -> its part in the seconds


def generation_of(demo: Demo) -> GenerateConfig:
    """What the generator is asked for."""
    return GenerateConfig(
        out=demo.out / "data",
        objects=demo.objects if demo.objects is not None else None if demo.meshes else 240,
        meshes=demo.meshes,
        test_list=demo.test_list,
        views=demo.views,
        points=POINTS,
        spread="even",
        spp=demo.spp,
        visibility_grid=2,
        test_fraction=0.1 if demo.meshes is None else 0.2,
        seed=demo.seed,
    )


def configs_of(demo: Demo) -> dict[str, TrainConfig]:
    """The network over surfels and the paper's, ours first."""
    presets_of = {"ours": presets.surfels_tiny(), "paper": presets.tiny()}
    return {
        name: dataclasses.replace(config, seed=demo.seed, num_steps=demo.steps, even_share=1.0)
        for name, config in presets_of.items()
    }


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


if __name__ == "__main__":
    entry_point.run(main, Demo, "packaged.demo")
