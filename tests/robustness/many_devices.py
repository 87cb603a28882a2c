"""Train on one of eight virtual devices and on all, and print as JSON how far gradients and weights lie apart.

In float64 what is left of a right division is rounding at 1e-12, and what is left of a wrong one is what is wrong.  A
process of its own, which XLA_FLAGS shows eight devices.
"""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of all tests

import jax
import numpy as np
from support import tiny_dataset, tiny_model
from support.tiny_baselines import SHRUNKEN

from spnr_jax.config import LossConfig, SamplingConfig
from spnr_jax.devices import programs
from spnr_jax.training import batching, optimisation, trainer

MODEL = dataclasses.replace(tiny_model.MODEL, sampling=SamplingConfig(num_coarse=4, num_fine=4, reach=1))
OBJECTS = 8


def gradients_apart() -> float:
    """Largest difference of a first step's gradients, over the largest entry of their array."""
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=MODEL, loss=loss, batch_objects=OBJECTS)
    batch, gradients = next(batching.batches(tiny_dataset.dataset(), config, 0)), []

    def precise(tree):
        return jax.tree.map(lambda x: x.astype("float64") if x.dtype == np.float32 else x, tree)

    for mesh in (None, programs.device_mesh()):
        with programs.use_mesh(mesh):
            state = precise(optimisation.jitted_create_state(config))
            placed = programs.place_batch(precise(batch), mesh)
            state, _ = optimisation.jitted_train_step(state, placed, config=config, adversarial=False)
        gradients.append(jax.device_get(state.generator_optimizer[0].mu))  # of one step their mean is a multiple
    pairs = zip(*map(jax.tree.leaves, gradients), strict=True)
    return max(float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-30)) for a, b in pairs)


def weights_apart(folder: Path) -> float:
    """Relative distance of the weights after two steps on one device, and after one on it and one on all."""
    config = dataclasses.replace(SHRUNKEN["points2nerf_tiny"], batch_objects=OBJECTS, num_steps=2)  # compiles quickly
    schedule = trainer.Schedule(log_every=1, preview_every=2, checkpoint_every=1)
    whole = trainer.train(config, tiny_dataset.dataset(), folder / "one", schedule)
    ignored = shutil.ignore_patterns("2", "weights.npz")
    shutil.copytree(folder / "one", folder / "all", ignore=ignored)
    mesh = programs.device_mesh()
    state = trainer.train(config, tiny_dataset.dataset(), folder / "all", schedule, mesh)
    pairs = list(zip(*(jax.tree.leaves(jax.device_get(x.generator)) for x in (state, whole)), strict=True))
    return float((sum(np.sum((a - b) ** 2) for a, b in pairs) / sum(np.sum(b**2) for _, b in pairs)) ** 0.5)


if __name__ == "__main__":
    apart = weights_apart(Path(sys.argv[1]))
    jax.config.update("jax_enable_x64", True)
    print(json.dumps({"gradients": gradients_apart(), "trained": apart}))
