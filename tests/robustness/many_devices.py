"""Take a training step on one of eight virtual devices and on all, and print as JSON how far their gradients lie apart.

In float64 what is left of a right division is rounding at 1e-12, and what is left of a wrong one is what is wrong.  A
process of its own, which XLA_FLAGS shows eight devices.
"""

import dataclasses
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of all tests

import jax
import numpy as np
from support import tiny_dataset, tiny_model

from spnr_jax.config import LossConfig, SamplingConfig
from spnr_jax.devices import placement
from spnr_jax.training import batching, optimisation

NEAR = SamplingConfig(num_coarse=4, num_fine=4, reach=1)
MODELS = {
    "plain": tiny_model.MODEL,
    "near points": dataclasses.replace(tiny_model.MODEL, render_resolution=24, sampling=NEAR),
}
OBJECTS = 8


def gradients_apart(model) -> float:
    """Largest difference of a first step's gradients, over the largest entry of their array."""
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=model, loss=loss, batch_objects=OBJECTS)
    batch, gradients = next(batching.batches(tiny_dataset.dataset(), config, 0)), []

    def precise(tree):
        return jax.tree.map(lambda x: x.astype("float64") if x.dtype == np.float32 else x, tree)

    for mesh in (None, placement.device_mesh()):
        with placement.using(mesh):
            state = precise(optimisation.jitted_create_state(config))
            placed = placement.place_batch(precise(batch), mesh, config.batch_objects)
            state, _ = optimisation.jitted_train_step(state, placed, config=config, adversarial=False)
        gradients.append(jax.device_get(state.generator_optimizer[0].mu))  # of one step their mean is a multiple
    pairs = zip(*map(jax.tree.leaves, gradients), strict=True)
    return max(float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-30)) for a, b in pairs)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps({name: gradients_apart(model) for name, model in MODELS.items()}))
