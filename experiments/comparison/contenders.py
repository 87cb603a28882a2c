"""Who draws objects in a comparison: trained networks and trivial renderers.

A network is called after its method; where two have the same one, the folder is added.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import experiments.baselines  # noqa: F401 - registers them
from experiments.comparison.study_objects import each_view
from spnr_jax.config import Quality, TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels.records import Light, Volume
from spnr_jax.method.model import Model
from spnr_jax.methods import METHODS, method_of
from spnr_jax.scoring import evaluation
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.scoring.report import label
from spnr_jax.training import weights

LABELS = {  # method -> its name in tables and pictures, in their order
    **{name: label(name) for name in ("ours", *METHODS)},
    "poisson": "Poisson",
    "poisson_trimmed": "Poisson, trimmed 0.3",
    **{name: label(name) for name in reversed(evaluation.FLOORS)},
}


def nothing(_: ObjectData) -> None:
    """What is done once for an object by who draws it from its points alone."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """Draws all views of an object from what `encode` makes of it once; `identity` tells it from another one."""

    draw: Callable[[Any, ObjectData], Pictures]
    encode: Callable[[ObjectData], Any] = nothing
    identity: dict[str, Any] = field(default_factory=dict)
    compiles: bool = False
    """Whether its first call is slower than those after it."""
    has_opacity: bool = True

    def show(self, item: ObjectData) -> Pictures:
        """The pictures."""
        return evaluation.on_host(self.draw(self.encode(item), item))


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

    def as_method(self) -> Method:
        """The network as it was trained, with steps and a checksum of the run's config."""
        return of_network(self.config, self.variables, steps=self.steps, config=self.checksum)


def networks(runs: Sequence[Path], dataset: Dataset) -> dict[str, Network]:
    """The networks by their names, in the order of Table 1; ValueError if there is none, or of another image size.

    Runs are folders, files of weights, or `surfels`, the network of the package.
    """
    if not runs:
        raise UserError("--runs: name at least one run folder")
    found = [(run, read_network(run, dataset)) for run in runs]
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


def read_network(run: Path, dataset: Dataset) -> Network:
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


def of_network(training: TrainConfig, variables: dict, **identity: Any) -> Method:
    """A network as it was trained; NPBG predicts colours alone."""
    show = evaluation.network(variables, training)
    return Method(
        draw=lambda _, item: show(item.cloud, item.camera),
        identity=identity,
        compiles=True,
        has_opacity=training.model.method != "npbg",
    )


def of_model(model: Model, quality: Quality = "best") -> Method:
    """A network through its handle, at a quality; each view in its own light, where it has one."""
    return Method(
        encode=lambda item: model.encode(item.cloud),
        draw=lambda volume, item: draw_volume(model, volume, item, quality),
        compiles=True,
    )


def draw_volume(
    model: Model, volume: Volume, item: ObjectData, quality: Quality = "best", lights: list[Light] | None = None
) -> Pictures:
    """The views of an object whose volume there is, in its own lights where none are given."""
    found = list(model.render_each(volume, each_view(item), quality, lights or item.own_lights))
    return Pictures(
        image=np.stack([np.asarray(one.image) for one in found]), acc=np.stack([np.asarray(one.acc) for one in found])
    )


def of_runs(runs: tuple[str, ...]) -> dict[str, tuple[Model, Quality]]:
    """The networks of runs at their best; of those over surfels also discs and light alone, without the network."""
    found: dict[str, tuple[Model, Quality]] = {}
    for run in runs:
        model = weights.load(run)
        found[run] = (model, "best")
        if method_of(model.config).takes_light:
            found[f"{run}, discs and light alone"] = (model, "draft")
    return found


def of_floor(name: str, factor: float = 1.0) -> Method:
    """A trivial renderer with the radius of its points, in point spacings."""
    show = evaluation.floor(name, factor)
    return Method(
        draw=lambda _, item: show(item.cloud, item.camera),
        identity={"radius factor": factor},
        compiles=True,
        has_opacity=name != "white",
    )


def floors(names: tuple[str, ...], dataset: Dataset, config: TrainConfig) -> dict[str, Method]:
    """The trivial renderers among these names, with the radius that is best on training objects."""
    wanted = [name for name in reversed(evaluation.FLOORS) if name in names]
    return {
        name: of_floor(name, 1.0 if name == "white" else evaluation.choose_radius(dataset, config, name))
        for name in wanted
    }


def of_rgba(rgba: np.ndarray) -> Pictures:
    """8-bit straight-alpha pictures on white, and their opacity."""
    return Pictures(image=data_sets.on_white(rgba), acc=rgba[..., 3].astype(np.float32) / 255)
