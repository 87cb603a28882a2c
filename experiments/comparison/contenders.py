"""The methods of a comparison: trained networks and trivial renderers."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import experiments.baselines  # noqa: F401 - registers them
from experiments.comparison.study_objects import each_view
from spnr_jax.config import Quality, TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData
from spnr_jax.kernels.records import Encoded
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
    **{name: label(name) for name in reversed(evaluation.TRIVIAL)},
}


@dataclass(frozen=True, kw_only=True)
class Method:
    """Draws all views of an object from what `encode` makes of it once."""

    draw: Callable[[Any, ObjectData], Pictures]
    encode: Callable[[ObjectData], Any] = lambda _: None
    compiles: bool = False
    """Whether its first call is slower than those after it."""
    has_opacity: bool = True
    radius: float | None = None
    """Of the points of a trivial renderer, in point spacings."""

    def show(self, item: ObjectData) -> Pictures:
        """The pictures."""
        return evaluation.to_numpy(self.draw(self.encode(item), item))


def of_network(training: TrainConfig, variables: dict) -> Method:
    """A network as it was trained; NPBG predicts colours alone."""
    show = evaluation.make_method(variables, training)
    return Method(draw=draw_with(show), has_opacity=training.model.method != "npbg")


def draw_with(show: evaluation.Draw) -> Callable[[Any, ObjectData], Pictures]:
    """A method of the evaluation, which encodes nothing beforehand, as `Method.draw`."""
    return lambda _, item: show(item)


def of_model(model: Model, quality: Quality = "best") -> Method:
    """A network through its handle, at a quality; each view in its own light, where it has one."""
    return Method(
        encode=lambda item: model.encode(item.cloud),
        draw=lambda volume, item: draw_volume(model, volume, item, quality),
        compiles=True,
    )


def draw_volume(model: Model, volume: Encoded, item: ObjectData, quality: Quality = "best") -> Pictures:
    """The views of an object whose volume there is, each in its own light, where it has one."""
    found = list(model.render_each(volume, each_view(item), quality, item.own_lights))
    image, acc, depth = (np.stack([np.asarray(getattr(one, x)) for one in found]) for x in ("image", "acc", "depth"))
    return Pictures(image=image, acc=acc, depth=depth)


def of_runs(runs: tuple[str, ...]) -> dict[str, tuple[Model, Quality]]:
    """The networks of runs at their best; of those over surfels also discs and light alone, without the network."""
    found: dict[str, tuple[Model, Quality]] = {}
    for run in runs:
        model = weights.load(run)
        found[run] = (model, "best")
        if method_of(model.config).takes_light:
            found[f"{run}, discs and light alone"] = (model, "draft")
    return found


def checksums(runs: tuple[str, ...]) -> dict[str, str]:
    """SHA-256 of each run's weights: a run that was trained further is another network."""
    arrays = {run: map(np.asarray, jax.tree.leaves(weights.load(run).params)) for run in runs}
    return {run: hashlib.sha256(b"".join(x.tobytes() for x in leaves)).hexdigest() for run, leaves in arrays.items()}


def trivial_ones(names: tuple[str, ...], dataset: Dataset, config: TrainConfig) -> dict[str, Method]:
    """The trivial renderers among these names, with the radius that is best on training objects."""
    found = {}
    for name in (name for name in reversed(evaluation.TRIVIAL) if name in names):
        radius = None if name == "white" else evaluation.choose_radius(dataset, config, name)
        found[name] = Method(draw=draw_with(evaluation.make_trivial(name, radius or 1.0)), radius=radius)
    return found


def of_rgba(rgba: np.ndarray) -> Pictures:
    """8-bit straight-alpha pictures on white, and their opacity."""
    return Pictures(image=data_sets.on_white(rgba), acc=rgba[..., 3].astype(np.float32) / 255)
