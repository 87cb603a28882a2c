"""Render, and take a training step, on one of eight virtual devices and on all; print how far they lie apart, as JSON.

    python many_devices.py [float64]      with float64 only the gradients of the plain network, in that precision

    renderings  largest difference of a picture, a depth or an opacity, and of all but a fiftieth of the numbers
    gradients   largest difference of a first step's gradients, relative to the largest entry of the array
    blocks      of rays near points that were rendered: on one device, and on each of the eight

A process of its own, which XLA_FLAGS shows eight devices.
"""

import dataclasses
import json
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of all tests

import jax
import numpy as np
from support import tiny_dataset, tiny_model

from spnr_jax.config import LossConfig, RenderOptions, SamplingConfig
from spnr_jax.devices import placement
from spnr_jax.devices.placement import DEPTH, OBJECTS
from spnr_jax.method import inference
from spnr_jax.method import march as marching
from spnr_jax.training import batching, optimisation

PLUS = dataclasses.replace(
    tiny_model.PLUS,
    image_resolution=24,
    sampling=SamplingConfig(num_coarse=4, num_fine=4, reach=1),
)
MODELS = {
    "plain": tiny_model.MODEL,
    "near points": PLUS,
    "Point-NeRF": dataclasses.replace(tiny_model.POINT_NERF, image_resolution=24),
}
SIZES = {"plain": 16, "near points": 9, "Point-NeRF": 9}  # of pictures: their rays are no multiple of 8, 16 rows are


def main() -> None:
    """Compares, and prints."""
    if "float64" in sys.argv:
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(gradients_apart(MODELS["plain"], "float64")))
        return
    found = {
        "renderings": {name: rendered(model, SIZES[name]) for name, model in MODELS.items()},
        "gradients": {name: gradients_apart(model, "float32") for name, model in MODELS.items()},
        "blocks": blocks(),
    }
    print(json.dumps(found))


def inputs(model, size: int):
    """Variables of a network, an object as it encodes it, cameras."""
    cloud, camera = jax.tree.map(lambda x: x[:1], (tiny_model.cloud(), tiny_model.camera(size, target=0.013)))
    variables = tiny_model.wobbled(jax.jit(inference.network(model).init)(jax.random.key(0), cloud, camera), 4)
    return variables, inference.jitted_encode(variables, cloud, config=model), camera


def rendered(model, size: int) -> tuple[float, float]:
    """Largest difference between the renderings of one device and of all, and that of all but a fiftieth of them.

    What a sample near points sees jumps at the borders of the nearest-point grid: on some processors a rounding of its
    place moves a pixel by 1e-3.
    """
    arguments = inputs(model, size)
    render = partial(inference.jitted_render, config=model, options=RenderOptions(block=16))
    one, all_of_them = render(*arguments), placement.by_all_devices(render, *arguments)
    assert all_of_them.image.sharding.device_set == one.image.sharding.device_set
    apart = [np.abs(np.asarray(a - b)) for a, b in zip(*map(jax.tree.leaves, (one, all_of_them)), strict=True)]
    return max(float(x.max()) for x in apart), max(float(np.quantile(x, 0.98)) for x in apart)


def gradients_apart(model, precision: str) -> float:
    """Largest difference of the gradients of one device and of four pairs, over the largest entry of their array.

    In float64 what is left of a right division is rounding at 1e-12, and what is left of a wrong one is what is wrong.
    """
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=model, loss=loss, batch_objects=8)
    batch, gradients = next(batching.batches(tiny_dataset.dataset(), config, 0)), []

    def precise(tree):
        return jax.tree.map(lambda x: x.astype(precision) if x.dtype == np.float32 else x, tree)

    for mesh in (None, placement.device_mesh(depth=2)):
        with placement.using(mesh):
            state = precise(optimisation.jitted_create_state(config))
            placed = placement.placed(precise(batch), mesh, config.batch_objects)
            state, _ = optimisation.jitted_train_step(state, placed, config=config, adversarial=False)
        gradients.append(jax.device_get(state.generator_optimizer[0].mu))  # of one step their mean is a multiple
    pairs = zip(*map(jax.tree.leaves, gradients), strict=True)
    return max(float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-30)) for a, b in pairs)


@contextmanager
def counting() -> Iterator[Counter[int]]:
    """While it lasts programs are compiled that count the blocks of rays near points which each device renders."""
    found: Counter[int] = Counter()
    march = marching.march

    def counted(*arguments):
        divided = jax.sharding.get_abstract_mesh().manual_axes
        device = jax.lax.axis_index((OBJECTS, DEPTH)) if divided else 0
        jax.debug.callback(lambda i: found.update([int(i)]), device)
        return march(*arguments)

    with mock.patch.object(marching, "march", counted):
        yield found


def blocks() -> list[list[int]]:
    """How many blocks of four rays one device renders, and each of eight."""
    counts = []
    with counting() as ran, mock.patch.object(marching, "CPU_BLOCK", 4):
        arguments = inputs(PLUS, SIZES["near points"])
        render = jax.jit(partial(inference.render, config=PLUS))
        for run in (render, partial(placement.by_all_devices, render)):
            ran.clear()
            jax.block_until_ready(run(*arguments))
            jax.effects_barrier()
            counts.append([count for _, count in sorted(ran.items())])
    return counts


if __name__ == "__main__":
    main()
