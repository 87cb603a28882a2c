"""The trained networks of a comparison: run folders, or all that a Table 1 left behind, under their names.

A network is called after its method; where two have the same one, the folder is added.
"""

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import experiments.baselines  # noqa: F401 - registers them
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.methods import METHODS
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.report import label
from spnr_jax.training import weights

FLOORS = tuple(reversed(evaluation.FLOORS))
LABELS = {  # method -> its name in tables and pictures, in their order
    **{name: label(name) for name in ("ours", *METHODS)},
    "poisson": "Poisson",
    "poisson_trimmed": "Poisson, trimmed 0.3",
    **{name: label(name) for name in FLOORS},
}


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where the networks are."""

    runs: tuple[Path, ...] = ()
    """Run folders, files of weights, or `surfels`, the network of the package."""
    table1: Path | None = None
    """Folder of a table that experiments.paper.table1 made; its runs are taken too."""


@dataclass(frozen=True, kw_only=True)
class Network:
    """A trained network, ready to be shown, and what tells it from another one."""

    method: str
    config: TrainConfig
    variables: dict
    steps: int
    checksum: str

    @property
    def has_depth(self) -> bool:
        """Whether it predicts opacity and depth; NPBG predicts colours alone."""
        return self.method != "npbg"

    @property
    def identity(self) -> dict[str, str | int]:
        """Steps, and a checksum of the run's config."""
        return {"steps": self.steps, "config": self.checksum}

    def show(self) -> evaluation.Method:
        """The network as a method of the evaluation."""
        return evaluation.network(self.variables, self.config)


def networks(sources: Sources, dataset: data_sets.Dataset) -> dict[str, Network]:
    """The networks by their names, in the order of Table 1; ValueError if there is none, or of another image size."""
    runs = list(sources.runs)
    if sources.table1 is not None:
        runs += sorted(path.parent for path in sources.table1.glob("runs/*/config.json"))
    if not runs:
        raise UserError("--runs: name at least one run folder, or --table1 with the folder of a table that has some")
    found = [(run, load(run, dataset)) for run in runs]
    found.sort(key=lambda pair: list(LABELS).index(pair[1].method))
    times = Counter(network.method for _, network in found)
    named = {name_of(network.method, run, times[network.method] > 1): network for run, network in found}
    if len(named) < len(runs):
        raise UserError(f"--runs: a run folder is named twice in {', '.join(map(str, runs))}")
    return named


def name_of(method: str, run: Path, shared: bool) -> str:
    """What tables and pictures call a network."""
    whose = ", ".join(part for part in (run.parent.name, run.name) if part)  # results lie in folders of this name
    return f"{LABELS[method]} ({whose})" if shared else LABELS[method]


def load(run: Path, dataset: data_sets.Dataset) -> Network:
    """The averaged network of a run's newest checkpoint or a file of weights, fit for the size of the pictures."""
    trained = weights.read_trained(run, data=dataset.folder)
    config = trained.config
    data_sets.check_renders(data_sets.read_object(dataset, dataset.splits["test"][0]), config)
    place = weights.place(run)
    described = place if place.is_file() else place / "config.json"
    return Network(
        method=config.model.method,
        config=config,
        variables=trained.variables,
        steps=trained.steps,
        checksum=hashlib.sha256(described.read_bytes()).hexdigest(),
    )


def test_objects(dataset: data_sets.Dataset, count: int | None) -> tuple[str, ...]:
    """Test objects, evenly out of the split, or all of them; ValueError if there is none."""
    names = dataset.splits["test"]
    if not names:
        raise UserError(f"{dataset.folder}: the test split is empty; generate more objects")
    if count is not None and count < 1:
        raise UserError(f"--objects: expected 1 or more, got {count}")
    return evaluation.spread(names, count or len(names))
