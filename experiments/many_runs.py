"""M training runs at once: the same `optimisation.train_step` in three forms, and how far their results lie apart.

    loop   M calls of the jitted step, one run after the other: what everybody does
    vmap   one program, `jax.vmap` over states and batches
    map    one program, `jax.lax.map` over them: one run after the other, without Python in between

A run is a seed: of weights, jitter, and the order of its data.  States and batches of all runs are one tree with an
axis of runs first; `step` alone is shared, so that what depends on it (R1 every so many steps) stays a branch.

On a CPU networks of dense layers lose and gain little, and those of convolutions lose: under vmap a convolution has a
kernel for each run, which makes it a grouped one, and inside the loop of `map` its gradient is slow, several to tens
of times the loop's time (measured on single convolutions).
"""

import dataclasses
import io
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels.records import Batch
from spnr_jax.training import batching, optimisation
from spnr_jax.training.optimisation import TrainState

Form = Literal["loop", "vmap", "map"]
FORMS: tuple[Form, ...] = ("loop", "vmap", "map")
OF_A_RUN = tuple(f.name for f in dataclasses.fields(TrainState) if f.name != "step")
AXES: Any = TrainState(step=None, **dict.fromkeys(OF_A_RUN, 0))  # type: ignore[arg-type]
Step = Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]]


def create(config: TrainConfig, seeds: Sequence[int]) -> TrainState:
    """Fresh states of a run for each seed, as `optimisation.create_state` makes them; compiled once."""
    states = [optimisation.jitted_create_state(config, jnp.uint32(seed)) for seed in seeds]
    return stack(states)


def stack(states: Sequence[TrainState]) -> TrainState:
    """Several states of one step as one tree."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *map(without_key, states))
    return with_key(dataclasses.replace(stacked, step=jnp.copy(states[0].step)))


def unstack(states: TrainState) -> list[TrainState]:
    """The state of each run, with arrays of its own: a state that is donated must not share any."""
    plain = without_key(states)
    parts = {name: getattr(plain, name) for name in OF_A_RUN}
    return [
        with_key(TrainState(step=jnp.copy(states.step), **jax.tree.map(lambda x, i=i: x[i], parts)))
        for i in range(len(plain.key))
    ]


def without_key(state: TrainState) -> TrainState:
    """The state with its key as plain numbers, which may be copied and sliced: they are not drawn from."""
    return dataclasses.replace(state, key=jax.random.key_data(state.key))


def with_key(state: TrainState) -> TrainState:
    """The inverse of `without_key`."""
    return dataclasses.replace(state, key=jax.random.wrap_key_data(jnp.asarray(state.key)))


def batches(dataset: data_sets.Dataset, config: TrainConfig, seeds: Sequence[int], first: int) -> Iterator[Batch]:
    """Of each step from `first` on the batches of all runs, each the one that the run alone would see."""
    read = batching.cached_reader(dataset, config, batching.CACHE_BYTES)
    configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
    for step in range(first, config.num_steps):
        made = []
        for one in configs:
            names = batching.object_names(dataset.splits["train"], one, step)
            made.append(batching.make_batch([read(name) for name in names], one, step))
        yield jax.device_put(jax.tree.map(lambda *x: np.stack(x), *made))


def form_step(form: Form, config: TrainConfig, adversarial: bool) -> Step:
    """One step of all runs in a form: from its states and batches (`entered`) to its states and stacked metrics."""
    one = partial(optimisation.train_step, config=config, adversarial=adversarial)
    if form == "vmap":
        return jax.jit(jax.vmap(one, in_axes=(AXES, 0), out_axes=(AXES, 0)), donate_argnums=0)
    if form == "map":
        return jax.jit(partial(mapped, one), donate_argnums=0)

    def loop(states: list[TrainState], batch: list[Batch]) -> tuple[list[TrainState], dict[str, jax.Array]]:
        step = partial(optimisation.jitted_train_step, config=config, adversarial=adversarial)
        found = [step(state, piece) for state, piece in zip(states, batch, strict=True)]
        return [state for state, _ in found], jax.tree.map(lambda *x: jnp.stack(x), *(m for _, m in found))

    return loop


def mapped(one: Step, states: TrainState, batch: Batch) -> tuple[TrainState, dict[str, jax.Array]]:
    """One step of every run, one after the other inside the program."""
    parts = {name: getattr(states, name) for name in OF_A_RUN}

    def run(inputs: tuple[dict, Batch]):
        state, metrics = one(TrainState(step=states.step, **inputs[0]), inputs[1])
        return {name: getattr(state, name) for name in OF_A_RUN}, metrics

    parts, metrics = jax.lax.map(run, (parts, batch))
    return TrainState(step=states.step + 1, **parts), metrics


def entered_states(form: Form, states: TrainState) -> Any:
    """A copy of stacked states as the form takes them: steps are donated what they are given."""
    return unstack(states) if form == "loop" else with_key(jax.tree.map(jnp.copy, without_key(states)))


def entered_batch(form: Form, batch: Batch) -> Any:
    """Stacked batches as the form takes them."""
    if form != "loop":
        return batch
    return [jax.tree.map(lambda x, i=i: x[i], batch) for i in range(len(batch.image))]


def left(form: Form, states: Any) -> TrainState:
    """The states of a form, stacked."""
    return stack(states) if form == "loop" else states


def apart(found: TrainState, expected: TrainState) -> dict[str, float]:
    """Relative error ||a - b|| / ||b|| of each parameter array of each run: the largest and the median one."""
    errors = []
    for a, b in zip(jax.tree.leaves(found.generator), jax.tree.leaves(expected.generator), strict=True):
        a, b = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (a, b))
        size = np.linalg.norm(b, axis=1)
        errors.append(np.linalg.norm(a - b, axis=1) / np.where(size > 0, size, 1))
    return {"largest": float(np.max(errors)), "median": float(np.median(errors))}


def save(place: Path, states: TrainState, losses: np.ndarray) -> None:
    """Writes states and losses (steps, runs) as one file."""
    stream = io.BytesIO()
    np.savez(stream, losses, *map(np.asarray, jax.tree.leaves(without_key(states))))
    write_whole(place, stream.getvalue())


def restore(place: Path, like: TrainState) -> tuple[TrainState, np.ndarray] | None:
    """What `save` wrote, None where nothing is."""
    if not place.is_file():
        return None
    with np.load(place, allow_pickle=False) as arrays:
        losses, *leaves = (arrays[name] for name in arrays.files)
    structure = jax.tree.structure(without_key(like))
    return with_key(jax.tree.unflatten(structure, map(jnp.asarray, leaves))), losses
