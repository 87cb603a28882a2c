"""A drive that is away for a moment costs a pause; what stays broken ends the training with one line, and no thread."""

import errno
import os
import re
import threading
from contextlib import closing
from pathlib import Path

import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.stopped_runs import without_network

from spnr_jax import cli
from spnr_jax.formats import data_sets
from spnr_jax.training import batching, trainer

CONFIG = tiny_dataset.CONFIG
RETRIES = len(data_sets.PAUSES)
RARELY = trainer.Schedule(log_every=99, preview_every=99, checkpoint_every=99)


@pytest.fixture(autouse=True)
def pauses(monkeypatch):
    """Pauses of no length, but as many."""
    monkeypatch.setattr(data_sets, "PAUSES", (0.0,) * RETRIES)


def failing(monkeypatch, times, number, name="001.png"):
    """Makes reading files of this name fail so many times with an error of the system; the thread of each try.

    Readers that an earlier test has left behind may still try: a test counts the tries of its own thread.
    """
    real, tries = Path.read_bytes, []

    def read_bytes(path):
        if path.name == name:
            tries.append(threading.current_thread())
            if len(tries) <= times:
                raise OSError(number, os.strerror(number), str(path))
        return real(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    return tries


def last_line(capsys):
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("number", data_sets.PASSING)
def test_a_drive_that_is_away_for_a_moment_changes_no_bit(number, monkeypatch):
    with closing(batching.batches(tiny_dataset.dataset(), CONFIG, 0)) as batches:
        expected = next(batches)
    tries = failing(monkeypatch, RETRIES, number)
    with closing(batching.batches(tiny_dataset.dataset(), CONFIG, 0)) as batches:
        same_bits(next(batches), expected)
    assert len(tries) > RETRIES


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES])
def test_an_error_that_does_not_pass_is_not_tried_again(number, monkeypatch):
    tries = failing(monkeypatch, 99, number)
    with pytest.raises(ValueError, match="cannot be read"):
        data_sets.read_object(tiny_dataset.dataset(), "chair")
    assert tries.count(threading.current_thread()) == 1


@pytest.fixture
def stepless(monkeypatch):
    """The reader alone is tested."""
    without_network(monkeypatch)


def test_an_error_in_a_reading_thread_ends_the_training_with_one_line(stepless, monkeypatch, tmp_path, capsys):
    tries = failing(monkeypatch, 99, errno.EIO)
    code = cli.guarded(lambda: trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, RARELY), "spnr")
    assert code == 2
    assert re.match(r"spnr: .*001\.png: cannot be read \(.*Input/output error", last_line(capsys))
    assert tries
    assert threading.main_thread() not in tries, "the files were read in threads"


@pytest.mark.parametrize("error", [MemoryError, SystemExit, RuntimeError])
def test_whatever_ends_a_reading_thread_ends_the_training(error, stepless, monkeypatch, tmp_path):
    """Threads are part of the training's process: none can die and leave it waiting."""

    def make_batch(*_):
        raise error("the thread is over")

    monkeypatch.setattr(batching, "make_batch", make_batch)
    with pytest.raises(error, match="the thread is over"):
        trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, RARELY)
