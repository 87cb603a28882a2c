"""Memory of each device in a training step whose volume is cut along one axis: what XLA lays out, nothing is run.

    python -m experiments.distributed_memory RESOLUTION DEVICES    one line of JSON; a process of its own, as it must be

The paper's network (preset `abo`) with another resolution of the volume and one object, without the discriminator.
Convolutions are XLA's own, the form of a GPU: the sums of 2D convolutions that a CPU is given take more memory.
"""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments.virtual_devices import in_child
from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.devices import placement
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels.records import Batch, Camera, PointCloud
from spnr_jax.model_config import ModelConfig
from spnr_jax.nn import convolution
from spnr_jax.training import optimisation

RESOLUTIONS, DEVICES = (128, 256), (1, 2, 4, 8)
MIB = 2**20
# the optimisation of the machine code takes no part in what lies in memory
UNOPTIMISED = "--xla_backend_optimization_level=0"


def measured(place: Path) -> dict[str, dict[str, float]]:
    """MiB of each device by resolution and devices, kept in a file as they come."""
    found = json.loads(place.read_text()) if place.is_file() else {}
    for resolution in map(str, RESOLUTIONS):
        for devices in map(str, DEVICES):
            row = found.setdefault(resolution, {})
            if devices not in row:
                row[devices] = in_child(__name__, int(devices), [resolution, devices], UNOPTIMISED) / MIB
                write_whole(place, (json.dumps(found, indent=1) + "\n").encode())
                print(f"{resolution}^3 voxels on {devices}: {row[devices]:.0f} MiB each", flush=True)
    return found


def config(resolution: int) -> TrainConfig:
    """The paper's, for one object without the discriminator, with another volume.

    It is halved four times, not five, so that eight devices divide the coarsest grid of 128^3.
    """
    abo = presets.abo()
    assert isinstance(abo.model, ModelConfig)
    return dataclasses.replace(
        abo,
        model=dataclasses.replace(abo.model, volume_resolution=resolution, num_stages=4),
        loss=dataclasses.replace(abo.loss, adversarial_weight=0.0),
        batch_objects=1,
    )


def batch_shapes(config: TrainConfig) -> Batch:
    """The shapes of a batch."""
    objects, views, points, size = 1, config.views_per_object, config.max_points, config.model.image_resolution

    def shape(*axes: int, kind=jnp.float32):
        return jax.ShapeDtypeStruct((objects, *axes), kind)

    scalars, image = shape(points), shape(views, size, size, 3)
    cloud = PointCloud(
        positions=shape(points, 3),
        base_color=shape(points, 3),
        roughness=scalars,
        metallic=scalars,
        mask=shape(points, kind=jnp.bool_),
    )
    return Batch(
        cloud=cloud,
        camera=Camera(cam_to_world=shape(views, 3, 4), intrinsics=shape(views, 3, 3), height=size, width=size),
        image=image,
        alpha=shape(views, size, size),
        condition=image,
        condition_mask=shape(views, size, size, kind=jnp.bool_),
    )


def bytes_a_device(resolution: int) -> int:
    """Arguments, results and temporary arrays of one device in a step, the volume cut among all of them."""
    convolution._conv3d_cpu = convolution._native  # the form of a GPU
    asked, mesh = config(resolution), placement.device_mesh(jax.device_count())

    def lying(tree, sharding):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)

    state = jax.eval_shape(lambda: optimisation.create_state(asked))
    with placement.using(mesh):
        lowered = optimisation.jitted_train_step.lower(
            lying(state, placement.replicated(mesh)),
            lying(batch_shapes(asked), placement.by_object(mesh)),
            config=asked,
            adversarial=False,
        )
        memory = lowered.compile().memory_analysis()
    assert memory is not None
    used = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return used - memory.alias_size_in_bytes


if __name__ == "__main__":
    print(json.dumps(bytes_a_device(int(sys.argv[1]))))
