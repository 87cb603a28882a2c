"""Killed, without room or beside another one, a training loses nothing, and says in one line what is wrong.

    make chaos        100 kills

One training is killed at random moments, again and again, and has to end with the bits and the rows of one that was
left alone.  A fork server, which has imported everything and touched no device, starts each process in milliseconds.
"""

import dataclasses
import multiprocessing
import os
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.stopped_runs import rows_without_time
from support.tiny_dataset import CONFIG

from spnr_jax import cli
from spnr_jax.training import checkpoint, trainer

KILLS = int(os.environ.get("CHAOS_KILLS", "2"))
STEPS = max(24, KILLS)
CHECKPOINT_EVERY, LONGEST_DELAY = 8, 0.3  # seconds: a checkpoint takes some tenths
LIMIT = 300.0  # seconds after which a process hangs
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["spnr_jax.training.trainer", "spnr_jax.cli", "orbax.checkpoint.v1", "tensorboardX"])
OPTIONS = (  # few weights; the discriminator joins before the second kill
    "--point-widths 8 --point-features 4 --volume-resolution 8 --base-width 4 --num-stages 1 --num-groups 2"
    " --field-width 8 --num-features 5 --direction-frequencies 1 --num-coarse 4 --num-fine 4 --render-resolution 24"
    " --image-resolution 24 --discriminator-width 8 --adversarial-start 0.25 --r1-gamma 0 --lr-generator 1e-2"
    " --warmup-steps 2 --batch-objects 2 --min-points 8 --max-points 32 --test-points 24"
    f" --log-every 2 --checkpoint-every {CHECKPOINT_EVERY} --preview-every 1000000 --num-steps {STEPS}"
)


def _child(run: Path, data: Path, cache: Path) -> None:
    """The process: what it says goes to a file."""
    with run.with_name(f"{run.name}.txt").open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    from tqdm import tqdm

    tqdm.set_lock(threading.RLock())  # its own is a semaphore between processes, which a killed one would leave behind
    jax.config.update("jax_compilation_cache_dir", str(cache))
    cli.main(["train", str(data), str(run), *OPTIONS.split()])
    sys.exit(0)


def train(run: Path, kill_from: float | None = None, delay: float = 0.0) -> int:
    """Exit code of `spnr train` in a process that is killed so many seconds after it wrote the row of a step."""
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # the server hands it on
    given = run, tiny_dataset.dataset().folder, run.parent / "compiled"
    process, end = SERVER.Process(target=_child, args=given), time.monotonic() + LIMIT
    process.start()
    while process.is_alive():
        assert time.monotonic() < end, "it hangs"
        if kill_from is not None and any(row["step"] >= kill_from for row in trainer.read_rows(run)):
            time.sleep(delay)
            process.kill()
        process.join(0.01)
    return process.exitcode


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The run of a training that nothing happened to."""
    run = tmp_path_factory.mktemp("chaos") / "whole"
    assert train(run) == 0, run.with_name("whole.txt").read_text()
    return run


@pytest.mark.ci
def test_a_training_that_was_killed_ends_with_the_same_bits_and_rows(whole):
    rng, run = np.random.default_rng(0), whole.with_name("killed")
    for step in np.sort(rng.uniform(0, STEPS - CHECKPOINT_EVERY, KILLS)):
        assert train(run, step, rng.uniform(0, LONGEST_DELAY)) == -9, run.with_name("killed.txt").read_text()
    assert train(run) == 0, run.with_name("killed.txt").read_text()
    (config, state), (expected_config, expected) = checkpoint.load_run(run), checkpoint.load_run(whole)
    assert config == expected_config
    same_bits(state, expected)
    assert rows_without_time(run) == rows_without_time(whole)
    assert f"step {STEPS // 4}: the discriminator joins" in whole.with_name("whole.txt").read_text()


def test_a_second_training_in_one_folder_is_refused_until_the_first_is_over(tmp_path, capsys):
    with checkpoint.lock_run(tmp_path):
        code = cli.guard(lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE), "spnr")
    assert code == 2
    assert capsys.readouterr().err.startswith(f"spnr: {tmp_path}: another process trains in this folder")
    assert not (tmp_path / "config.json").exists()
    with checkpoint.lock_run(tmp_path):
        pass


@pytest.mark.ci
def test_a_checkpoint_that_cannot_be_written_is_one_line_with_the_disks_reason(whole, tmp_path):
    _, state = checkpoint.load_run(whole)
    (tmp_path / "checkpoints").write_text("a file where the folder should be")
    with pytest.raises(ValueError, match=r"checkpoints/40 cannot be written \(.*\); earlier ones are kept") as error:
        checkpoint.save(tmp_path, dataclasses.replace(state, step=jax.numpy.full_like(state.step, 40)))
    assert "\n" not in str(error.value)
