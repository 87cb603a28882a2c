"""Killed, without room or beside another one, a training loses nothing, and says in one line what is wrong.

    make chaos        100 kills

One training is killed at random moments of random phases, again and again, and has to end with the bits, the batches
and the rows of one that was left alone.
"""

import errno
import os
from itertools import pairwise

import numpy as np
import pytest
from killable import (
    CHECKPOINT_EVERY,
    Training,
    batches,
    checkpoint_steps,
    different,
    rows,
)
from support import tiny_dataset
from support.tiny_dataset import CONFIG

from spnr_jax import cli
from spnr_jax.training import checkpoint, trainer

KILLS = int(os.environ.get("CHAOS_KILLS", "1"))  # of each phase
STEPS = max(40, 4 * KILLS)
PHASES = ("start", "step", "row", "checkpoint")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """(training, run folder, how it ended) of a training that nothing happened to, its programs compiled before."""
    folder = tmp_path_factory.mktemp("chaos")
    training = Training(data=tiny_dataset.dataset().folder, num_steps=STEPS, cache=folder / "compiled")
    first, second = (training.run(folder / name) for name in ("compiling", "whole"))
    assert first.code == second.code == 0, first.output + second.output
    assert not different(folder / "compiling", folder / "whole"), "the same command, the same bits"
    return training, folder / "whole", second


def seconds_of(events, phase):
    """Median duration of a phase."""
    return float(
        np.median([after.seconds - event.seconds for event, after in pairwise(events) if event.phase == phase])
    )


@pytest.mark.ci
def test_a_training_that_was_killed_ends_with_the_same_bits_data_and_rows(alone, tmp_path):
    training, whole, reference = alone
    rng, run, trials = np.random.default_rng(0), tmp_path / "killed", []
    phases, unfinished, again = rng.permutation(PHASES * KILLS), 0, 0
    for phase, moment in zip(phases, np.sort(rng.uniform(0, STEPS - CHECKPOINT_EVERY, len(phases))), strict=True):
        delay = rng.uniform(0, seconds_of(reference.events, phase))
        due = lambda event, phase=phase, delay=delay, moment=moment: (  # noqa: E731
            delay if event.phase == phase and (phase == "start" or event.step >= moment) else None
        )
        trials.append(training.run(run, aim=due))
        assert trials[-1].code == -9, f"the kill came too late: {trials[-1].output}"
        newest = (checkpoint_steps(run) or [0])[0]
        unfinished += any(not path.name.isdigit() for path in (run / "checkpoints").glob("*"))
        again += trials[-1].events[-1].step - newest if trials[-1].events[-1].step else 0
    trials.append(training.run(run))
    assert trials[-1].code == 0, trials[-1].output
    assert not different(run, whole)
    assert batches(*trials) == batches(reference)
    assert rows(run) == rows(whole)
    print(f"\n{len(phases)} kills, {unfinished} with half a checkpoint, {again} steps trained again", end="")


def test_a_second_training_in_one_folder_is_refused_until_the_first_is_over(tmp_path, capsys):
    with checkpoint.alone(tmp_path):
        code = cli.guard(lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE), "spnr")
    assert code == 2
    assert capsys.readouterr().err.startswith(f"spnr: {tmp_path}: another process trains in this folder")
    assert not (tmp_path / "config.json").exists()
    with checkpoint.alone(tmp_path):
        pass


@pytest.mark.ci
def test_a_checkpoint_that_cannot_be_written_is_one_line_with_the_disks_reason(alone, tmp_path):
    _, state = checkpoint.load_run(alone[1])
    (tmp_path / "checkpoints").write_text("a file where the folder should be")
    with pytest.raises(ValueError, match=r"checkpoints/40 cannot be written \(.*\); the one before is kept") as error:
        checkpoint.save(tmp_path, state)
    assert "\n" not in str(error.value)


def test_a_write_that_does_not_say_where_is_given_the_run_folder(tmp_path, monkeypatch, capsys):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trainer, "restore_or_init", full)
    work = lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE)  # noqa: E731
    assert cli.guard(work, "spnr") == 2
    assert capsys.readouterr().err == f"spnr: {tmp_path}: No space left on device\n"
