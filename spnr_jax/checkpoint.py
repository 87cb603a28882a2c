"""Run folders on disk: the config, and checkpoints of the training state through Orbax.

    RUN/config.json          the TrainConfig
    RUN/checkpoints/STEP/    one state; appears complete or not at all

The newest readable checkpoint counts: a broken one is named and the one before it is taken.
"""

import json
import logging
from collections.abc import Callable
from pathlib import Path

import jax

from spnr_jax import training
from spnr_jax.config import TrainConfig, from_dict, to_dict

KEPT = 3  # newest checkpoints that stay


def write_config(run: Path, config: TrainConfig) -> None:
    """Makes the run folder hold this config; ValueError if it holds the run of another one."""
    path = run / "config.json"
    if path.exists() and (run / "checkpoints").is_dir():  # without a checkpoint there is nothing to protect
        stored = to_dict(read_config(run))
        changed = _differences(stored, json.loads(json.dumps(to_dict(config))))
        if changed:
            raise ValueError(
                f"{run} holds a run with another config ({'; '.join(changed[:4])}); choose a new run folder"
            )
        return
    run.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial")
    temporary.write_text(json.dumps(to_dict(config), indent=2) + "\n")
    temporary.replace(path)


def _differences(stored: dict, wanted: dict, path: str = "") -> list[str]:
    changed = []
    for name in (name for name in wanted if name in stored):  # of another method the name says it all
        old, value = stored[name], wanted[name]
        if isinstance(value, dict):
            changed += _differences(old, value, f"{path}{name}.")
        elif json.loads(json.dumps(old)) != value:
            changed.append(f"{path}{name} {old} there, {value} asked")
    return changed


def read_config(run: Path | str) -> TrainConfig:
    """The config of a run folder; ValueError if there is none or it is not of this version."""
    path = Path(run) / "config.json"
    if not path.is_file():
        raise ValueError(f"{run}: not a run folder (config.json is missing); train one with `spnr train DATA {run}`")
    try:
        return from_dict(json.loads(path.read_text()))
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not a config of this version ({error}); train a new run") from None


def _checkpointer(run: Path, *, writing: bool):
    logging.getLogger("absl").setLevel(logging.ERROR)  # one line a save is not for the user's terminal
    from orbax.checkpoint import v1 as ocp  # two seconds of import that rendering from Python need not pay

    return ocp.training.Checkpointer(
        (run / "checkpoints").absolute(),
        preservation_policy=ocp.training.preservation_policies.LatestN(KEPT),
        cleanup_tmp_directories=writing,  # a reader must not remove what a running training is writing
    )


def save(run: Path, state: training.TrainState) -> None:
    """Writes the state as the run's newest checkpoint and removes those that are too old."""
    with _checkpointer(run, writing=True) as checkpointer:
        # a damaged checkpoint of this step, which an earlier run left, makes place
        checkpointer.save(int(state.step), state, force=True, overwrite=True)


def restore(run: Path, config: TrainConfig, say: Callable[[str], None] = print) -> training.TrainState | None:
    """The newest readable state of a run, None if it has none; `say` gets a line for each broken checkpoint."""
    folder = run / "checkpoints"
    if not folder.is_dir():
        return None
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    like = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
        jax.eval_shape(lambda: training.create_state(config)),
    )
    with _checkpointer(run, writing=False) as checkpointer:
        steps = sorted((c.step for c in checkpointer.checkpoints), reverse=True)
        for step in steps:
            try:
                state = checkpointer.load(step, like)
                jax.block_until_ready(state)
            except Exception as error:  # noqa: BLE001 - Orbax and tensorstore raise many kinds for a damaged file
                say(f"checkpoint {folder / str(step)} is damaged ({_first_line(error)}); trying the one before")
                continue
            if int(state.step) == step:
                return state
            say(f"checkpoint {folder / str(step)} holds step {int(state.step)}; trying the one before")
    if steps:
        raise ValueError(
            f"{run / 'checkpoints'}: no checkpoint of this run can be read; remove the folder to start again"
        )
    return None


def load_run(
    run: Path | str, say: Callable[[str], None] = print, data: Path | str = "DATA"
) -> tuple[TrainConfig, training.TrainState]:
    """Config and newest readable state of a run; ValueError, with what to do, if it has no state (`data` is named)."""
    run = Path(run)
    config = read_config(run)
    state = restore(run, config, say)
    if state is None:
        raise ValueError(f"{run}: the run has no checkpoint yet; go on with `spnr train {data} {run}`")
    return config, state


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:160]
