"""The loop: stopped anywhere, it goes on to the same numbers; what breaks it is named and leaves a good state."""

import contextlib
import dataclasses
import errno
import os
import re
import shutil
import signal
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import close, same_bits
from support.stopped_runs import interrupted, rows_without_time
from support.tiny_dataset import PLAIN, SCHEDULE

from spnr_jax import cli
from spnr_jax.training import batching, checkpoint, optimisation, trainer, weights


def restored(run):
    return checkpoint.restore(run, PLAIN)


@pytest.fixture
def init():
    """Weights that no training of these tests begins or ends with."""
    trained = weights.read_trained(tiny_dataset.run())
    return dataclasses.replace(trained, variables=jax.tree.map(lambda x: 0.5 * x, trained.variables))


def test_the_first_step_starts_from_the_weights_to_begin_with(init, tmp_path, monkeypatch):
    states, metrics = [], {"loss": np.float32(1), "psnr": np.float32(20)}
    monkeypatch.setattr(
        optimisation, "jitted_train_step", lambda state, *_, **__: (states.append(state) or state, metrics)
    )
    trainer.train(PLAIN, tiny_dataset.dataset(), tmp_path, SCHEDULE, init=init)
    for found in (states[0].generator, states[0].averaged):
        close(found, init.variables["params"], atol=0)


def test_weights_of_another_network_are_refused_in_one_line(init, tmp_path, capsys):
    other = dataclasses.replace(init, variables=jax.tree.map(lambda x: x[..., :1], init.variables))
    work = partial(trainer.train, PLAIN, tiny_dataset.dataset(), tmp_path, SCHEDULE, init=other)
    assert cli.guard(work, "spnr") == 2
    assert "are of another network: shape of" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("end", [None, "", '{"step": 6, "lo'], ids=["damaged", "rows", "half a row"])
def test_what_lies_after_the_newest_good_checkpoint_is_made_again(end, init, tmp_path, capsys):
    """Rows, half rows, and a checkpoint that was emptied; weights to begin with do not count any more."""
    run = shutil.copytree(tiny_dataset.run(), tmp_path / "run")
    if end is None:
        for path in (path for path in (run / "checkpoints" / "6").rglob("*") if path.is_file()):
            path.write_bytes(b"")
    else:
        shutil.rmtree(run / "checkpoints" / "6")
        with (run / "metrics.jsonl").open("a") as file:
            file.write(end)
    trainer.train(PLAIN, tiny_dataset.dataset(), run, SCHEDULE, init=init)
    assert ("checkpoints/6" in capsys.readouterr().out) == (end is None)
    same_bits(restored(run), restored(tiny_dataset.run()))
    assert capsys.readouterr().out == "", "the checkpoint at step 6 is good again"
    assert rows_without_time(run) == rows_without_time(tiny_dataset.run())


def test_previews_and_rows_come_when_the_schedule_says_and_a_finished_run_is_left_alone():
    run, rows = tiny_dataset.run(), trainer.read_rows(tiny_dataset.run())
    assert [row["step"] for row in rows if "loss" in row] == [1, 2, 3, 4, 5, 6]
    assert [row["step"] for row in rows if "val_psnr" in row] == [3, 6]
    assert all(np.isfinite(value) for row in rows for value in row.values())
    assert {path.name for path in (run / "previews").iterdir()} == {"0000003.png", "0000006.png"}
    assert {path.name for path in (run / "checkpoints").iterdir() if path.is_dir()} == {"2", "4", "6"}
    assert any((run / "tensorboard").iterdir())
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    trainer.train(PLAIN, tiny_dataset.dataset(), run, SCHEDULE)
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}


def test_a_finished_run_that_lost_its_weights_gets_them_back(tmp_path):
    run = shutil.copytree(tiny_dataset.run(), tmp_path / "run")
    before = (run / "weights.npz").read_bytes()
    (run / "weights.npz").unlink()
    trainer.train(PLAIN, tiny_dataset.dataset(), run, SCHEDULE)
    assert (run / "weights.npz").read_bytes() == before


def test_a_fresh_state_lies_where_a_restored_one_does_so_that_a_run_that_goes_on_compiles_nothing_anew(tmp_path):
    fresh = trainer.restore_or_init(PLAIN, tmp_path, None, None)
    again = trainer.restore_or_init(PLAIN, tiny_dataset.run(), None, None)
    assert all(jax.tree.leaves(jax.tree.map(lambda x, y: x.committed and x.sharding == y.sharding, fresh, again)))


def test_nan_stops_with_step_and_quantity_and_the_last_checkpoint_is_usable(monkeypatch, tmp_path, capsys):
    real = batching.make_batch

    def make_batch(objects, config, at):
        batch = real(objects, config, at)
        return jax.tree.map(lambda x: x * np.nan if x.dtype == np.float32 else x, batch) if at == 3 else batch

    monkeypatch.setattr(batching, "make_batch", make_batch)
    sparse = trainer.Schedule(log_every=100, preview_every=100, checkpoint_every=2)  # step 4 is never due to be logged
    code = cli.guard(lambda: trainer.train(PLAIN, tiny_dataset.dataset(), tmp_path, sparse), "spnr")
    line = capsys.readouterr().err.splitlines()[-1]
    assert code == 2
    assert re.match(r"spnr: \w+ is nan at step 4; earlier checkpoints are kept", line)
    state = restored(tmp_path)
    assert int(state.step) == 2
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.generator))


def test_the_first_number_that_is_not_finite_is_named_and_means_are_of_the_steps_that_have_a_metric(tmp_path):
    rows = [(1, {"loss": 1.0, "psnr": 2.0}), (2, {"loss": 1.0, "psnr": np.inf}), (3, {"loss": np.nan, "psnr": 1.0})]
    with pytest.raises(trainer.NotFinite, match="psnr is inf at step 2"):
        trainer.check_finite(rows)
    log = trainer.MetricsLog(tmp_path, 0, 2)
    log.step(1, {"loss": 1.0})
    log.step(2, {"loss": 3.0, "discriminator": 5.0})
    row = log.mean()
    log.close()
    assert row.pop("ms_per_step") > 0
    assert row == {"step": 2, "loss": 2.0, "discriminator": 5.0}


def test_steps_that_compile_are_not_timed(monkeypatch, tmp_path):
    clock = [0.0]
    monkeypatch.setattr(trainer.time, "monotonic", lambda: clock[0])
    log = trainer.MetricsLog(tmp_path, 0, 9)
    found = []
    for steps in (("compiled", 1, 1), (1, "compiled", 2, 3), ("compiled",), (4,)):
        for seconds in steps:
            with log.leave_out_compilation(None) if seconds == "compiled" else contextlib.nullcontext():
                clock[0] += 90 if seconds == "compiled" else seconds
                log.step(1, {"loss": 1.0})
        found.append(log.mean().get("ms_per_step"))
    log.close()
    assert found == [1000, 2000, None, 4000]


def test_a_full_disk_is_one_line_and_exit_code_2(monkeypatch, tmp_path, capsys):
    def full(log, row):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "metrics.jsonl"))

    monkeypatch.setattr(trainer.MetricsLog, "write", full)
    code = cli.guard(lambda: trainer.train(PLAIN, tiny_dataset.dataset(), tmp_path, SCHEDULE), "spnr")
    assert code == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == f"spnr: {tmp_path / 'metrics.jsonl'}: No space left on device"


def test_ctrl_c_is_exit_code_130_and_says_how_to_go_on(monkeypatch, tmp_path, capsys):
    interrupted(monkeypatch, batching, 1, signal.SIGINT)
    code = cli.guard(lambda: trainer.train(PLAIN, tiny_dataset.dataset(), tmp_path, SCHEDULE), "spnr")
    assert code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    expected = "spnr: stopped at step 1 of 6; the same command goes on from there"
    assert capsys.readouterr().err.splitlines()[-1] == expected
    assert int(restored(tmp_path).step) == 1


TWICE = """
import hashlib, os, signal, threading, time
from spnr_jax.training.trainer import stop_requests

def press():
    for _ in range(2):
        time.sleep(1)
        os.kill(os.getpid(), signal.SIGINT)

with stop_requests():
    threading.Thread(target=press, daemon=True).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2 * 10**9)  # hears nothing, as a program that compiles
"""


def test_a_second_ctrl_c_ends_the_process_even_while_python_hears_nothing():
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr.split(";")[0]) == (130, "\nstopping after this step")


def test_a_state_that_is_not_finite_is_named_though_every_loss_is(monkeypatch, tmp_path):
    """Training normalises batches with their own statistics: an overflown running variance shows in no loss."""
    fresh = optimisation.jitted_create_state(PLAIN)
    fresh.batch_stats["encoder"]["pointnet"]["norm_0"]["variance"] *= np.inf
    monkeypatch.setattr(optimisation, "jitted_create_state", lambda config: fresh)
    with pytest.raises(trainer.NotFinite, match="batch_stats_encoder_pointnet_norm_0_variance is inf at step 2"):
        trainer.train(PLAIN, tiny_dataset.dataset(), tmp_path, SCHEDULE)
    assert not (tmp_path / "checkpoints").exists()
