"""The training loop: reads batches, takes steps, and writes metrics, previews and checkpoints.

    RUN/config.json  data.txt  metrics.jsonl  tensorboard/  previews/STEP.png  checkpoints/STEP/

A run continues from its newest readable checkpoint; the rows of metrics.jsonl after it are dropped, because they will
be written again.  A loss that is not finite stops the run and names the step; the last checkpoint stays.
"""

import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

from spnr_jax.config import Schedule, TrainConfig
from spnr_jax.devices import programs, runtime
from spnr_jax.errors import STOPPED, UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import png, to_uint8, write_whole
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Light
from spnr_jax.method.model import render_views
from spnr_jax.methods import method_of
from spnr_jax.training import checkpoint, optimisation
from spnr_jax.training.weights import Trained, add_companions, keep_companions, write_weights

PREVIEWED = 6  # objects of a preview
NETWORK = "weights.npz"  # of a finished run
GOES_ON = "the same command goes on from there"


class NotFinite(UserError):
    """A loss is NaN or infinite; the message names step and quantity."""


def train(
    config: TrainConfig,
    dataset: data_sets.Dataset,
    run: Path,
    schedule: Schedule,
    mesh: Mesh | None = None,
    init: Trained | None = None,
    light: Light | None = None,
) -> optimisation.TrainState:
    """The state after the config's last step; continues a run folder from its newest checkpoint.

    A new run starts from random weights, or from `init`.  `mesh` divides batches among devices.  `light` is that of the
    data set's pictures, if it is not the room.
    """
    runtime.limit_arenas()
    checkpoint.check_no_data(run)
    programs.check_divides(mesh, config.batch_objects)
    # before the run folder is made: data that do not suit leave nothing
    batches_from = method_of(config.model).prepare(config, dataset, run, light=light)
    with checkpoint.lock_run(run), ExitStack() as stack:
        checkpoint.write_config(run, config)
        if not checkpoint.record_data(run, dataset):
            tqdm.write(f"{run} was trained on another data set than {dataset.folder}, and goes on with this one")
        state = restore_or_init(config, run, mesh, init)
        if (first := int(state.step)) >= config.num_steps:
            if not (run / NETWORK).exists():
                write_network(run, config, state)
            return state
        batches = stack.enter_context(closing(batches_from(first)))  # may take long: a stop ends it at once
        requests = stack.enter_context(stop_requests())
        log = stack.enter_context(closing(MetricsLog(run, first, config.num_steps)))
        joins = optimisation.first_adversarial_step(config)
        compiled: set[Any] = set()
        for done, batch in enumerate(batches, start=first + 1):
            if first < joins == done - 1:
                tqdm.write(f"step {joins}: the discriminator joins; the training step is compiled anew")
            # another program compiles in its first step, which is left out of the time per step
            program = done > joins, jax.tree.structure(batch), tuple(np.shape(x) for x in jax.tree.leaves(batch))
            with nullcontext() if program in compiled else log.leave_out_compilation(state):
                state, metrics = take_step(state, batch, config, mesh, adversarial=done > joins)
                log.step(done, metrics)
            compiled.add(program)
            last, stopping = done == config.num_steps, bool(requests)
            save = last or stopping or done % schedule.checkpoint_every == 0
            if save or done % schedule.log_every == 0:
                log.write(log.mean())
            if save:
                check_state(state)
            if last or done % schedule.preview_every == 0:
                with log.pause():
                    scores, picture = preview(state, config, dataset, run, light)
                    runtime.trim_memory()
                log.write({"step": done, **scores}, picture)
            if last:
                write_network(run, config, state)
            if save:  # after the rows up to this step: a continued run does not write them again
                with log.pause():
                    checkpoint.save(run, state)
            if stopping and not last:
                raise KeyboardInterrupt(f"stopped at step {done} of {config.num_steps}; {GOES_ON}")
    return state


def take_step(
    state: optimisation.TrainState, batch: Any, config: TrainConfig, mesh: Mesh | None, *, adversarial: bool
) -> tuple[optimisation.TrainState, dict]:
    """The state after a batch that is divided among the devices, and metrics."""
    with programs.use_mesh(mesh):
        batch = programs.place_batch(batch, mesh)
        return optimisation.jitted_train_step(state, batch, config=config, adversarial=adversarial)


def restore_or_init(config: TrainConfig, run: Path, mesh: Mesh | None, init: Trained | None) -> optimisation.TrainState:
    """The state to continue from (the newest checkpoint, or before the first step), and a message about it.

    A new run keeps the companion networks of its initial weights.
    """
    with programs.use_mesh(mesh):
        sharding = None if mesh is None else NamedSharding(mesh, PartitionSpec())  # every device holds it whole
        if (state := checkpoint.restore(run, config, tqdm.write, sharding)) is None:
            state = new_state(config, init)
            if init is not None:
                keep_companions(run, init, tqdm.write)
        # as restored states are: else the step would be compiled once more for a run that goes on
        state = jax.device_put(state, sharding or jax.local_devices()[0])
    if (step := int(state.step)) >= config.num_steps:
        tqdm.write(f"{run} is finished: {step} steps")
    elif step:
        unused = "" if init is None else "; the initial weights are for a new run, and not used"
        tqdm.write(f"resuming {run} at step {step} of {config.num_steps}{unused}")
    return state


def new_state(config: TrainConfig, init: Trained | None) -> optimisation.TrainState:
    """The state before the first step."""
    state = optimisation.jitted_create_state(config)
    return state if init is None else optimisation.init_from(state, init.variables)


def write_network(run: Path, config: TrainConfig, state: optimisation.TrainState) -> None:
    """Writes the averaged weights to RUN/NETWORK, and a message if they overflow float16."""
    variables = programs.on_first_device(optimisation.averaged_variables(state))
    try:
        write_weights(run / NETWORK, Trained(config=config, variables=variables, steps=int(state.step)))
    except UserError as error:
        tqdm.write(str(error))


def check_finite(rows: list[tuple[int, dict]]) -> list[tuple[int, dict]]:
    """The rows; NotFinite for the first one with a value that is not finite."""
    for step, metrics in rows:
        for name, value in metrics.items():
            if not math.isfinite(value):
                raise NotFinite(
                    f"{name} is {float(value)} at step {step}; earlier checkpoints are kept. Try a lower learning rate "
                    "or check the data with `spnr-data check`"
                )
    return rows


def check_state(state: optimisation.TrainState) -> None:
    """NotFinite for the first array with a value that is not finite: such a state is not saved.

    A running variance can overflow while every loss is finite, because each batch is normalised with its own variance.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and not (finite := np.isfinite(leaf)).all():
            name = jax.tree_util.keystr(path, simple=True, separator="_")
            check_finite([(int(state.step), {name: np.asarray(leaf)[~finite][0]})])


@contextmanager
def stop_requests() -> Iterator[list[int]]:
    """A list that is filled on Ctrl-C or SIGTERM: the loop then finishes its step, saves and stops.

    A second one ends the process at once, also while a step is compiled, when Python hears no signal: a thread does.
    """
    requests, heard = list[int](), (signal.SIGINT, signal.SIGTERM)
    previous = {s: signal.signal(s, lambda number, _: requests.append(number)) for s in heard}
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    wakened = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)

    def hear() -> None:
        for count, _ in enumerate(number for number in iter(lambda: os.read(reader, 1), b"") if number[0] in heard):
            if count:
                os._exit(STOPPED)
            os.write(2, b"\nstopping after this step; once more stops at once, at the last checkpoint\n")
        os.close(reader)

    threading.Thread(target=hear, daemon=True).start()
    try:
        yield requests
    finally:
        signal.set_wakeup_fd(wakened)
        os.close(writer)
        for number, handler in previous.items():
            signal.signal(number, handler)


def preview(
    state: optimisation.TrainState,
    config: TrainConfig,
    dataset: data_sets.Dataset,
    run: Path,
    light: Light | None = None,
) -> tuple[dict[str, float], np.ndarray]:
    """PSNR of the averaged network on a few objects of validation, or else of training; references above renderings."""
    names = (dataset.splits["val"] or dataset.splits["train"])[:PREVIEWED]
    variables = programs.on_first_device(optimisation.averaged_variables(state))
    variables = add_companions(config.model, variables, run)
    columns, scores = [], []
    for name in names:
        item = data_sets.read_object(dataset, name)
        cloud = replace(data_sets.first_points(item, config.test_points), normals=None)  # as `evaluate` does
        rendering = render_views(variables, config.model, cloud, item.camera, item.own_lights or light)
        image, reference = np.clip(np.asarray(rendering.image), 0, 1), data_sets.on_white(item.images)
        scores.append(np.asarray(psnr(jnp.asarray(image), jnp.asarray(reference))))
        columns.append(np.concatenate([reference[0], image[0]]))
    picture = np.concatenate(columns, axis=1)
    write_whole(run / "previews" / f"{int(state.step):07d}.png", png(picture))
    kind = "val" if dataset.splits["val"] else "train"
    return {f"{kind}_psnr": float(np.mean(np.concatenate(scores)))}, picture


# --- the record of a run ----------------------------------------------------------------------------------------------


class MetricsLog:
    """metrics.jsonl, TensorBoard and progress bar of a run; rows after `first_step` from an earlier run are dropped."""

    def __init__(self, run: Path, first_step: int, num_steps: int) -> None:
        """Opens the files for appending."""
        from tensorboardX import SummaryWriter

        path = run / "metrics.jsonl"
        kept = [row for row in read_rows(run) if row["step"] <= first_step]
        write_whole(path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._file = path.open("a")
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=first_step + 1)
        self._bar = tqdm(total=num_steps, initial=first_step, unit="step", mininterval=1)
        self._compiling_steps, self._since = 0, time.monotonic()
        self._pending: list[tuple[int, dict]] = []

    def step(self, done: int, metrics: dict) -> None:
        """Keeps a step's metrics for the next row."""
        self._pending.append((done, metrics))
        self._bar.update()

    @contextmanager
    def leave_out_compilation(self, state: Any) -> Iterator[None]:
        """A step that compiles, taken inside: it is waited for, and does not count as step time."""
        jax.block_until_ready(state)
        with self.pause():
            yield
            jax.block_until_ready(self._pending[-1])
        self._compiling_steps += 1
        if self._compiling_steps == len(self._pending):  # the wait for the first batch is no step, either
            self._since = time.monotonic()

    def mean(self) -> dict[str, int | float]:
        """The row for the steps since the last one: means over the steps that have a metric; NotFinite if not finite.

        The discriminator's metrics may start between two rows.
        """
        rows, self._pending = check_finite(jax.device_get(self._pending)), []
        done, newest = rows[-1]
        row = {"step": done} | {name: float(np.mean([m[name] for _, m in rows if name in m])) for name in newest}
        now = time.monotonic()
        if timed := len(rows) - self._compiling_steps:
            row["ms_per_step"] = round(1000 * (now - self._since) / timed, 2)
        self._compiling_steps, self._since = 0, now
        self._bar.set_postfix({n: f"{newest[n]:.2f}" for n in ("loss", "psnr") if n in newest}, refresh=False)
        return row

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Time spent inside does not count as step time."""
        begin = time.monotonic()
        yield
        self._since += time.monotonic() - begin

    def write(self, row: dict[str, int | float], picture: np.ndarray | None = None) -> None:
        """Appends a row and flushes it to disk; TensorBoard gets its entries as scalars and the picture."""
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())  # flushed to disk: after a power cut, no checkpoint may be newer than the rows
        for name, value in row.items():
            if name != "step":
                self._board.add_scalar(name, value, row["step"])
        if picture is not None:
            self._board.add_image("preview", to_uint8(picture), row["step"], dataformats="HWC")

    def close(self) -> None:
        """Closes the files."""
        self._bar.close()
        self._file.close()
        self._board.close()


def read_rows(run: Path) -> list[dict]:
    """Rows of a run's metrics.jsonl up to the first broken line (after a crash)."""
    path = run / "metrics.jsonl"
    rows: list[dict] = []
    for line in path.read_text(errors="replace").splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(row, dict) or not all(isinstance(value, int | float) for value in row.values()):
            break
        rows.append(row)
    return rows
