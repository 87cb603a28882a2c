"""Training of the shader network in seconds: one ball of 40 points, its G-buffers of 12 pixels, few features."""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from spnr_jax.config import LossConfig, OptimizerConfig, SurfelConfig, TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.method import surfel_method
from spnr_jax.surfels import lighting
from spnr_jax.training import checkpoint, gbuffers, optimisation, trainer, weights
from support import tiny_dataset
from support.laws import numbers
from support.stopped_runs import PICTURE

SIZE = 48
CONFIG = TrainConfig(
    preset="surfels",
    model=SurfelConfig(image_resolution=SIZE, widths=(4, 6), top=4),
    loss=LossConfig(l1_weight=1.0, mse_weight=5.0, adversarial_weight=0.0, opacity_weight=1.0, opacity_l1_weight=0.3),
    optimizer=OptimizerConfig(lr_generator=1e-2, beta2=0.99, warmup_steps=2, ema_decay=0.9, clip_norm=1.0),
    num_steps=4,
    batch_objects=2,
    views_per_object=2,
    min_points=32,
    max_points=40,
    test_points=32,
    crop=16,
    even_share=0.5,
)
PACKAGED = weights.packaged_file
SCHEDULE = trainer.Schedule(log_every=1, preview_every=100, checkpoint_every=2)
NAME = "ball_000000"
LIGHT = lighting.light_of(np.random.default_rng(0).random((4, 8, 3), np.float32))


@functools.cache
def dataset() -> data_sets.Dataset:
    """One ball to learn from, one to look at."""
    splits = {"train": (NAME,), "val": ("ball_000001",), "test": ()}
    return data_sets.open_dataset(tiny_dataset.write_dataset(tiny_dataset.folder() / "lit", splits, SIZE))


@functools.cache
def views() -> list[gbuffers.KeptView]:
    """The views of the ball's clouds, in a folder that a test copies to change it."""
    return gbuffers.make_missing(dataset(), LIGHT, CONFIG, tiny_dataset.folder() / "gbuffers", {})


@functools.cache
def run() -> Path:
    """A finished run of CONFIG, whose clouds are learnt from as they are: densifier and preview take long to trace."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfel_method, "densify_sparse", lambda variables, cloud, *_: cloud)
        patch.setattr(trainer, "preview", lambda *_: ({"val_psnr": 20.0}, PICTURE))
        trainer.train(CONFIG, dataset(), tiny_dataset.folder() / "shaded", SCHEDULE, light=LIGHT)
    return tiny_dataset.folder() / "shaded"


@functools.cache
def untrained() -> Path:
    """A run folder with random weights (fresh ones end in zeros): for what asks whether it runs, not how well."""
    folder, state = tiny_dataset.folder() / "fresh_surfels", optimisation.jitted_create_state(CONFIG)
    checkpoint.write_config(folder, CONFIG)
    averaged = jax.tree.map(lambda x: x + 0.02 * numbers(0, *x.shape), state.averaged)
    checkpoint.save(folder, dataclasses.replace(state, averaged=averaged))
    return folder


def shipped(name: str = weights.PACKAGED) -> Path:
    """The package's files of weights, but for its network: that is `untrained`."""
    return untrained() if name == weights.PACKAGED else PACKAGED(name)
