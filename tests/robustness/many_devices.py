"""Take a training step on one of eight virtual devices and on all, and print how far they lie apart, as JSON.

    python many_devices.py [float64]      with float64 only the gradients of the paper's network, in that precision

    gradients   largest difference of a first step's gradients, relative to the largest entry of the array
    blocks      of rays near points of eight objects that were rendered: on one device, and on each of the eight

A process of its own, which XLA_FLAGS shows eight devices.
"""

import dataclasses
import json
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of all tests

import jax
import jax.numpy as jnp
import numpy as np
from support import tiny_baselines, tiny_dataset, tiny_model

from spnr_jax.config import LossConfig, SamplingConfig
from spnr_jax.devices import placement
from spnr_jax.method import inference
from spnr_jax.method import paper_method as marching
from spnr_jax.training import batching, optimisation

NEAR_POINTS = dataclasses.replace(
    tiny_model.MODEL,
    render_resolution=24,
    sampling=SamplingConfig(num_coarse=4, num_fine=4, reach=1),
)
MODELS = {
    "plain": tiny_model.MODEL,
    "near points": NEAR_POINTS,
    "Point-NeRF": dataclasses.replace(tiny_baselines.POINT_NERF, image_resolution=24),
}
OBJECTS = 8


def main() -> None:
    """Compares, and prints."""
    if "float64" in sys.argv:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(gradients_apart(MODELS["plain"], "float64")))
        return
    gradients = {name: gradients_apart(MODELS[name], "float32") for name in ("near points", "Point-NeRF")}
    print(json.dumps({"gradients": gradients, "blocks": blocks()}))


def gradients_apart(model, precision: str) -> float:
    """Largest difference of the gradients of one device and of eight, over the largest entry of their array.

    In float64 what is left of a right division is rounding at 1e-12, and what is left of a wrong one is what is wrong.
    """
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=model, loss=loss, batch_objects=OBJECTS)
    batch, gradients = next(batching.batches(tiny_dataset.dataset(), config, 0)), []

    def precise(tree):
        return jax.tree.map(lambda x: x.astype(precision) if x.dtype == np.float32 else x, tree)

    for mesh in (None, placement.device_mesh()):
        with placement.using(mesh):
            state = precise(optimisation.jitted_create_state(config))
            placed = placement.place_batch(precise(batch), mesh, config.batch_objects)
            state, _ = optimisation.jitted_train_step(state, placed, config=config, adversarial=False)
        gradients.append(jax.device_get(state.generator_optimizer[0].mu))  # of one step their mean is a multiple
    pairs = zip(*map(jax.tree.leaves, gradients), strict=True)
    return max(float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-30)) for a, b in pairs)


def blocks() -> list[list[int]]:
    """How many blocks of four rays one device renders of eight objects like one another, and each of eight devices."""
    march, counts = marching.march, []
    one = jax.tree.map(lambda x: x[:1], (tiny_model.cloud(), tiny_model.camera(9, target=0.013)))
    variables = tiny_model.wobbled(jax.jit(inference.network(NEAR_POINTS).init)(jax.random.key(0), *one), 4)
    inputs = jax.tree.map(lambda x: jnp.concatenate([x] * OBJECTS), one)
    for mesh in (None, placement.device_mesh()):
        found: Counter[int] = Counter()

        def counted(*arguments, found=found, mesh=mesh):
            device = 0 if mesh is None else jax.lax.axis_index(placement.OBJECTS)
            jax.debug.callback(lambda i: found.update([int(i)]), device)
            return march(*arguments)

        with mock.patch.object(marching, "march", counted), mock.patch.object(marching, "CPU_BLOCK", 4):
            with placement.using(mesh):
                cloud, camera = placement.place_batch(inputs, mesh, OBJECTS)
                render = jax.jit(partial(inference.render, config=NEAR_POINTS))
                jax.block_until_ready(render(variables, inference.encode(variables, cloud, config=NEAR_POINTS), camera))
            jax.effects_barrier()
        counts.append([count for _, count in sorted(found.items())])
    return counts


if __name__ == "__main__":
    main()
