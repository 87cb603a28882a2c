"""Training hooks of each method: its batches and its step.

There are two kinds: networks that learn from whole views of clouds (`of_views`: the paper's, the baselines), and the
shader network, which learns from crops of G-buffers (`of_gbuffers`).
"""

from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from spnr_jax.config import SurfelConfig, TrainConfig
from spnr_jax.devices import placement
from spnr_jax.errors import UserError
from spnr_jax.formats.data_sets import Dataset, has_lights
from spnr_jax.kernels.records import Crops, Light
from spnr_jax.surfels import lighting
from spnr_jax.training import adversary, batching, gbuffers, optimisation, shading
from spnr_jax.training.optimisation import TrainState
from spnr_jax.training.weights import Trained, add_densifier, write_weights

ROOM = "procedural room"  # as the generator of data sets calls it


class Work(NamedTuple):
    """What a kind of network gives the loop."""

    batches: Callable[[int], Generator[Any, None, None]]  # from a step on
    step: Callable[[TrainState, Any, int], tuple[TrainState, dict]]  # with the step's number
    finish: Callable[[TrainState], object] = lambda state: None  # called with the last state


def work_of(
    config: TrainConfig,
    dataset: Dataset,
    run: Path,
    mesh: Mesh | None,
    own: range | None,
    light: Light | None,
) -> Work:
    """Hooks of the config's method; the mesh and its share of a batch, or the light, are for one of the kinds each."""
    if isinstance(config.model, SurfelConfig):
        return of_gbuffers(config, dataset, run, light or light_of(dataset))
    return of_views(config, dataset, mesh, own)


def of_views(config: TrainConfig, dataset: Dataset, mesh: Mesh | None, own: range | None) -> Work:
    """Of a network that renders whole views; a mesh's devices share the objects of a batch.

    ValueError where the views have lights of their own: these networks cannot be told which.
    """
    if has_lights(dataset):
        raise UserError(
            f"{dataset.folder}: each view has a light of its own, and preset {config.preset} learns one light alone; "
            "train --preset surfels, or generate the data set without --lights"
        )
    adversarial_from = adversary.first_adversarial_step(config)

    def step(state: Any, batch: Any, number: int) -> tuple[Any, dict]:
        with placement.using(mesh):
            batch = placement.place_batch(batch, mesh, config.batch_objects)
            adversarial = number >= adversarial_from
            return optimisation.jitted_train_step(state, batch, config=config, adversarial=adversarial)

    return Work(partial(batching.batches, dataset, config, own=own), step)


def of_gbuffers(config: TrainConfig, dataset: Dataset, run: Path, light: Light) -> Work:
    """Of the shader network: G-buffers that are missing in the run folder are made first, which takes a while.

    The averaged weights are written to the run folder at the end.  All devices of a process do the same work.
    ValueError where several processes train together: each would do the same work.
    """
    if jax.process_count() > 1:
        raise UserError(f"preset {config.preset} trains in one process; start it without --distributed")
    views = gbuffers.complete(dataset, light, config, run / "gbuffers", add_densifier(config.model, {}))

    def step(state: TrainState, crops: Crops, number: int) -> tuple[TrainState, dict]:
        return shading.jitted_train_step(state, crops, config=config)

    def finish(state: TrainState) -> None:
        variables = placement.on_this_process(optimisation.averaged_variables(state))
        write_weights(run / "weights.npz", Trained(config=config, variables=variables, steps=int(state.step)))

    return Work(partial(gbuffers.batches, views, config), step, finish=finish)


def light_of(dataset: Dataset) -> Light:
    """The light of pictures that have none of their own; ValueError if it is another than the room."""
    described = dataset.settings.get("environment_map")
    name = described.get("name", ROOM) if isinstance(described, dict) else ROOM
    if name != ROOM:
        raise UserError(
            f"{dataset.folder}: lit by {name}, and the command trains in the {ROOM} alone; give the light of that map "
            "to spnr_jax.training.trainer.train"
        )
    return lighting.room_light()
