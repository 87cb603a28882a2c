"""Print the checksum of one picture of the `tiny` network for each number of rays at a time that is given."""

import hashlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax import presets
from spnr_jax.config import RenderOptions
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Scene
from spnr_jax.method import inference

MODEL = presets.tiny().model

weights = inference.network(MODEL).init(jax.random.key(0), *inference.example_inputs(presets.tiny().model))
leaves, form = jax.tree.flatten(weights)  # the fresh ones render a nearly uniform fog
leaves = [x + 0.2 * jax.random.normal(jax.random.key(i), x.shape) for i, x in enumerate(leaves)]
volume = jax.random.normal(jax.random.key(1), (1, *[MODEL.encoder.volume_resolution] * 3, MODEL.encoder.base_width))
scene = Scene(volume=volume, occupied=volume[..., 0] > 0)
pose = cameras.look_at(jnp.array([[1.0, 1.0, 2.5]]), jnp.zeros((1, 3)), jnp.array([[0.0, 1.0, 0.0]]))
camera = jax.tree.map(lambda x: x[None], cameras.pinhole(pose, 0.7, 128, 128))
for chunk in map(int, sys.argv[1:]):
    picture = inference.jitted_render(
        jax.tree.unflatten(form, leaves), scene, camera, config=MODEL, options=RenderOptions(block=chunk)
    )
    print(hashlib.sha256(np.asarray(picture.image).tobytes()).hexdigest())
