"""Render, and take a training step, on one of eight virtual devices and on all; print how far they lie apart, as JSON.

    renderings  largest difference of a picture, a depth or an opacity
    gradients   largest difference of a first step's gradients, relative to the largest entry of the array
    blocks      of rays near points that were rendered: on one device, and on each of the eight

A process of its own, which XLA_FLAGS shows eight devices.
"""

import dataclasses
import json
from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp

from experiments import distributed_gradients
from experiments.distributed_rendering import counting
from spnr_jax.config import LossConfig
from spnr_jax.devices import placement
from spnr_jax.method import inference, renderer
from spnr_jax.model_config import SamplingConfig
from support import tiny_dataset, tiny_model

PLUS = dataclasses.replace(
    tiny_model.PLUS,
    image_resolution=24,
    render_resolution=24,
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
    found = {"renderings": {}, "gradients": {}, "blocks": {}}
    for name, model in MODELS.items():
        found["renderings"][name] = rendered(model, SIZES[name])
        found["gradients"][name] = trained(model)
    found["blocks"] = blocks()
    print(json.dumps(found))


def inputs(model, size: int):
    """Variables of a network, an object as it encodes it, cameras."""
    cloud, camera = jax.tree.map(lambda x: x[:1], (tiny_model.cloud(), tiny_model.camera(size, target=0.013)))
    variables = tiny_model.wobbled(jax.jit(inference.network(model).init)(jax.random.key(0), cloud, camera), 4)
    return variables, inference.jitted_encode(variables, cloud, config=model), camera


def rendered(model, size: int) -> float:
    """Largest difference between the renderings of one device and of all."""
    arguments = inputs(model, size)
    render = partial(inference.jitted_render, config=model, ray_chunk=16)
    one, all_of_them = render(*arguments), placement.by_all_devices(render, *arguments)
    assert all_of_them.image.sharding.device_set == one.image.sharding.device_set
    return max(float(jnp.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (one, all_of_them)), strict=True))


def trained(model) -> float:
    """Largest relative difference between the gradients of one device and of four pairs, in the first step."""
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0)
    config = dataclasses.replace(tiny_dataset.CONFIG, model=model, loss=loss, batch_objects=8)
    found = distributed_gradients.apart(config, tiny_dataset.dataset(), placement.device_mesh(depth=2))
    return found["gradients"]


def blocks() -> list[list[int]]:
    """How many blocks of four rays one device renders, and each of eight."""
    counts = []
    with counting() as ran, mock.patch.object(renderer, "CPU_BLOCK", 4):
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
