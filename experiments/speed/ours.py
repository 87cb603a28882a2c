"""Our side of the benchmark: one mode of a preset with the twin's sizes, as the package's jitted functions run it.

The function "near points" is another one than the twin's: samples lie within one voxel of a voxel with a point, and
there are half as many of them (tiny: one pass of 16).
"""

import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np

from experiments.speed import bench_scene, twin_layout, worker
from spnr_jax.config import RayNetworkConfig, TrainConfig
from spnr_jax.devices import allocator
from spnr_jax.errors import UserError
from spnr_jax.kernels.records import Batch
from spnr_jax.method import inference
from spnr_jax.presets import PRESETS
from spnr_jax.training import adversary, optimisation

NUM_GROUPS, DISCRIMINATOR_WIDTH = 8, 64  # the twin's, for every preset
WIDTHS = {"tiny": 8, "small": 16, "abo": 16}  # the twin's channels of the volume, and coarse and fine samples
SAMPLES = {"tiny": (16, 16), "small": (32, 32), "abo": (64, 64)}
NEAR_POINTS = {"tiny": (16, 0), "small": (16, 16), "abo": (32, 32)}  # coarse and fine samples


def main() -> None:
    """Serves the mode of the spec."""
    allocator.keep_arrays()
    worker.serve(make)


def make(spec: dict) -> tuple[Callable[[], object], dict]:
    """(function to time, facts); in the mode "parity" nothing is timed, and the facts are the differences."""
    facts = {"software": f"jax {jax.__version__}, jaxlib {jaxlib.__version__}, numpy {np.__version__}"}
    config = twin_sized(spec["preset"], spec["mode"], spec["batch"])
    if spec["mode"] == "parity":
        with np.load(spec["parity"], allow_pickle=False) as arrays:
            return lambda: None, facts | {"differences": differences(config, dict(arrays))}
    if spec["function"] == "near points":
        config = near_points(config)
    if spec.get("bf16"):
        config = in_bf16(config)
    run = function(config, batch(config), spec["mode"])
    start = time.perf_counter()
    run()
    first = time.perf_counter() - start
    compile_s = first - 1e-3 * min(worker.turn(run, seconds=0))
    return run, facts | {"compile_s": round(compile_s, 2)}


def twin_sized(preset: str, mode: str = "train", objects: int = 1) -> TrainConfig:
    """The preset with the sizes of the twin, without R1; "train_l1" has no discriminator."""
    config = PRESETS[preset]()
    assert isinstance(config.model, RayNetworkConfig)
    coarse, fine = SAMPLES[preset]
    encoder = dataclasses.replace(
        config.model.encoder, base_width=WIDTHS[preset], num_groups=NUM_GROUPS, inputs="plain"
    )
    sampling = dataclasses.replace(config.model.sampling, num_coarse=coarse, num_fine=fine)
    loss = dataclasses.replace(
        config.loss,
        adversarial_weight=0.0 if mode == "train_l1" else 1.0,
        adversarial_start=0.0,
        r1_gamma=0.0,
        discriminator_width=DISCRIMINATOR_WIDTH,
    )
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, encoder=encoder, sampling=sampling),
        loss=loss,
        batch_objects=objects,
        views_per_object=1,
        min_points=bench_scene.NUM_POINTS,
        max_points=bench_scene.NUM_POINTS,
    )


def in_bf16(config: TrainConfig) -> TrainConfig:
    """The config whose convolutions run in bfloat16."""
    assert isinstance(config.model, RayNetworkConfig)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, precision="bfloat16"))


def near_points(config: TrainConfig) -> TrainConfig:
    """The config that evaluates the field near points alone."""
    assert isinstance(config.model, RayNetworkConfig)
    coarse, fine = NEAR_POINTS[config.preset]
    sampling = dataclasses.replace(config.model.sampling, num_coarse=coarse, num_fine=fine, reach=1)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, sampling=sampling))


def batch(config: TrainConfig) -> Batch:
    """The benchmark's scene on the device."""
    found = bench_scene.arrays(config.batch_objects, config.model.image_resolution, config.max_points)
    return jax.device_put(twin_layout.batch(found))


def function(config: TrainConfig, batch: Batch, mode: str) -> Callable[[], object]:
    """One step, one encoding of the batch, or one view of each of its volumes; returns when it is done."""
    state = optimisation.jitted_create_state(config)
    if mode.startswith("train"):

        def step() -> None:
            nonlocal state
            state, metrics = optimisation.jitted_train_step(state, batch, config=config, adversarial=mode == "train")
            jax.block_until_ready((state, metrics))

        return step
    variables, cloud = optimisation.averaged_variables(state), batch.cloud
    if mode == "encode":
        return lambda: jax.block_until_ready(inference.jitted_encode(variables, cloud, config=config.model))
    volume = inference.jitted_encode(variables, cloud, config=config.model)
    return lambda: jax.block_until_ready(inference.jitted_render(variables, volume, batch.camera, config=config.model))


def differences(config: TrainConfig, arrays: twin_layout.Arrays) -> dict[str, float]:
    """Norm of the difference from each output of the twin, relative to its norm, under the twin's weights.

    ValueError if the twin has other sizes than the config.
    """
    theirs = twin_layout.train_config(arrays)
    ours = config.model, config.loss.discriminator_width
    if ours != (theirs.model, theirs.loss.discriminator_width):
        raise UserError(f"{config.preset}: the twin has other sizes ({theirs.model}) than ours ({config.model})")
    inputs = jax.device_put(twin_layout.batch(arrays))
    params, statistics = twin_layout.generator(arrays)
    variables = {"params": params, "batch_stats": statistics}
    volume = inference.jitted_encode(variables, inputs.cloud, config=config.model)
    image = inference.jitted_render(variables, volume, inputs.camera, config=config.model).image[:, 0]
    judge = jax.jit(adversary.discriminator_of(config).apply)
    params = {"params": twin_layout.discriminator(arrays)}
    logits = judge(params, image, inputs.condition[:, 0], inputs.condition_mask[:, 0])
    stages = {"volume": volume.volume, "image": image, "logits": logits}
    return {
        name: distance(stages[name.split("/")[1]], np.moveaxis(array, 1, -1))
        for name, array in arrays.items()
        if name.split("/")[-1] in stages
    }


def distance(ours: jax.Array, theirs: np.ndarray) -> float:
    """Norm of the difference over the norm of theirs."""
    if ours.shape != theirs.shape:
        raise UserError(f"the twin's output has shape {theirs.shape}, ours {ours.shape}")
    return float(jnp.linalg.norm((ours - theirs).ravel()) / np.linalg.norm(theirs))


if __name__ == "__main__":
    main()
