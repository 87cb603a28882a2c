"""Run folders on disk: the config, and checkpoints of the training state through Orbax.

    RUN/config.json          the TrainConfig
    RUN/data.txt             a checksum of the data set's settings and training objects, files included; and its light
    RUN/checkpoints/STEP/    one state; appears complete or not at all
    RUN/training.lock        empty; locked while a process trains there

The newest readable checkpoint counts: if one is damaged, a message names it and the previous one is used.
"""

import json
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
from flax.traverse_util import flatten_dict

from spnr_jax.config import TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import UserError, first_line
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset
from spnr_jax.formats.images import check_place, write_whole
from spnr_jax.methods import UnknownMethod, from_dict, to_dict
from spnr_jax.training import optimisation

KEPT = 3  # newest checkpoints that stay


@contextmanager
def lock_run(run: Path) -> Iterator[None]:
    """Locks the run folder, which is created, for training; ValueError if another process trains in it.

    The operating system releases the lock when the process exits, however it exits.
    """
    import fcntl  # Windows has none

    check_place(run / "config.json")
    run.mkdir(parents=True, exist_ok=True)
    with (run / "training.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"{run}: another process trains in this folder; wait for it or choose a new one") from None
        yield


def write_config(run: Path, config: TrainConfig) -> None:
    """Makes the run folder hold this config; ValueError if it holds the run of another one."""
    path = run / "config.json"
    if path.exists() and (run / "checkpoints").is_dir():  # without a checkpoint there is nothing to protect
        stored, wanted = (flatten_dict(to_dict(x), sep=".") for x in (read_config(run), config))
        both = [name for name in wanted if name in stored]  # fields of another method are not compared
        changed = [f"{x} {stored[x]} there, {wanted[x]} asked" for x in both if stored[x] != wanted[x]]
        if changed:
            raise UserError(
                f"{run} holds a run with another config ({'; '.join(changed[:4])}); choose a new run folder"
            )
        return
    write_whole(path, (json.dumps(to_dict(config), indent=2) + "\n").encode())


def record_data(run: Path, dataset: Dataset) -> bool:
    """Writes checksum and light of the data set to the run folder; False if its checkpoints began with another one."""
    path, now = run / "data.txt", f"{data_sets.checksum(dataset, 'train')}\n{dataset.light}\n"
    before = path.read_text() if path.is_file() else ""
    if before != now:
        write_whole(path, now.encode())
    # without a light: of an earlier version
    return before == now or "\n" not in before or not (run / "checkpoints").is_dir()


def read_light(run: Path) -> str | None:
    """Name of the light of the data set that a run was last trained on, None if it is not recorded."""
    path = run / "data.txt"
    lines = path.read_text().splitlines() if path.is_file() else []
    return lines[1] if len(lines) > 1 else None


def check_no_data(run: Path) -> None:
    """UserError for the folder of a data set."""
    if (run / "dataset.json").is_file():
        raise UserError(f"{run}: a data set, where a run folder is expected")


def read_config(run: Path | str) -> TrainConfig:
    """The config of a run folder; ValueError if there is none or it is not of this version."""
    path = Path(run) / "config.json"
    if Path(run).is_file():
        raise UserError(f"{run}: a file; expected a run folder, a file of weights (.npz) or the name surfels")
    check_no_data(Path(run))
    if not path.is_file():
        raise UserError(f"{run}: not a run folder (config.json is missing); train one with `spnr train DATA {run}`")
    try:
        return from_dict(json.loads(path.read_text()))
    except UnknownMethod as error:
        raise UserError(f"{path}: {error}") from None
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        raise UserError(f"{path}: not a config of this version ({error}); train a new run") from None


def _checkpointer(run: Path, *, writing: bool):
    logging.getLogger("absl").setLevel(logging.CRITICAL)  # silences a line per save, and call stacks of errors
    from orbax.checkpoint import v1 as ocp  # imported here: it takes two seconds

    return ocp.training.Checkpointer(
        (run / "checkpoints").absolute(),
        preservation_policy=ocp.training.preservation_policies.LatestN(KEPT),
        cleanup_tmp_directories=writing,  # a reader must not remove what a running training is writing
    )


def save(run: Path, state: optimisation.TrainState) -> None:
    """Writes the state as the run's newest checkpoint and removes old ones; ValueError if that fails."""
    step = int(state.step)
    try:
        with _checkpointer(run, writing=True) as checkpointer:
            # overwrites a damaged checkpoint of this step from an earlier run
            checkpointer.save(step, state, force=True, overwrite=True)
    except (OSError, ValueError) as error:  # tensorstore raises ValueError for the disk's errors, too
        number = re.search(r"os_error_code='(\d+)'", str(error))
        reason = os.strerror(int(number[1])) if number else first_line(error)
        raise UserError(
            f"checkpoint {run / 'checkpoints' / str(step)} cannot be written ({reason}); earlier ones are kept: mend "
            "this, and the same command goes on from there"
        ) from None
    runtime.trim_memory()


def restore(
    run: Path,
    config: TrainConfig,
    say: Callable[[str], object] = print,
    sharding: jax.sharding.Sharding | None = None,
) -> optimisation.TrainState | None:
    """The newest readable state of a run, None if it has none; `say` gets a line for each broken checkpoint.

    The state is placed by `sharding`, by default on the first device.
    """
    folder = run / "checkpoints"
    if not folder.is_dir():
        return None
    sharding = sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
        jax.eval_shape(lambda: optimisation.create_state(config)),
    )
    with _checkpointer(run, writing=False) as checkpointer:
        steps = sorted((c.step for c in checkpointer.checkpoints), reverse=True)
        for step in steps:
            try:
                state = checkpointer.load(step, like)
                jax.block_until_ready(state)
            except Exception as error:  # noqa: BLE001 - Orbax and tensorstore raise many kinds for a damaged file
                words = f"is damaged or of another version ({first_line(error)}); trying the one before"
                say(f"checkpoint {folder / str(step)} {words}")
                continue
            return state
    if steps:
        raise UserError(
            f"{run / 'checkpoints'}: no checkpoint of this run can be read; remove the folder to start again"
        )
    return None


def load_run(run: Path | str, say: Callable[[str], None] = print) -> tuple[TrainConfig, optimisation.TrainState]:
    """Config and newest readable state of a run; ValueError, with what to do, if it has no state."""
    run = Path(run)
    config = read_config(run)
    state = restore(run, config, say)
    if state is None:
        raise UserError(f"{run}: the run has no checkpoint yet; go on with `spnr train DATA {run}`")
    return config, state
