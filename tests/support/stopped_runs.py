"""Trainings that a signal stops, those whose steps do nothing, and the rows that runs are compared by."""

import signal

import jax
import numpy as np

from spnr_jax.training import checkpoint, optimisation, trainer

PICTURE = np.random.default_rng(0).random((8, 6, 3)).astype(np.float32)


def without_network(monkeypatch):
    """Makes training a loop around nothing: no weights, steps that change nothing, PICTURE as its previews."""
    empty = dict.fromkeys(optimisation.TrainState.__dataclass_fields__)
    state = optimisation.TrainState(**empty | {"step": jax.numpy.zeros((), int), "key": jax.random.key(0)})
    metrics = {"loss": np.float32(1), "psnr": np.float32(20)}
    monkeypatch.setattr(optimisation, "jitted_create_state", lambda config: state)
    monkeypatch.setattr(optimisation, "jitted_train_step", lambda state, batch, **_: (state, metrics))
    monkeypatch.setattr(trainer, "preview", lambda *_: ({"val_psnr": 20.0}, PICTURE))
    monkeypatch.setattr(checkpoint, "save", lambda run, state: None)
    monkeypatch.setattr(trainer, "write_network", lambda *_: None)


def interrupted(monkeypatch, module, step, number=signal.SIGTERM):
    """Makes the signal arrive while the batch after `step` steps is fetched; `module` holds the method's `batches`."""
    real = module.batches

    def batches(source, config, first):
        for i, batch in enumerate(real(source, config, first), start=first):
            if i + 1 == step:
                signal.raise_signal(number)
            yield batch

    monkeypatch.setattr(module, "batches", batches)


def rows_without_time(run):
    """The rows of a run's log without what a clock decides."""
    return [{k: v for k, v in row.items() if k != "ms_per_step"} for row in trainer.read_rows(run)]
