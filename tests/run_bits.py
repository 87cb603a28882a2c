"""Print checksums of a training batch, of the state after a few steps on a data set, and of a picture.

    python run_bits.py DATASET

A process of its own, compiled as users compile.
"""

import dataclasses
import hashlib
import sys
from contextlib import closing

import jax
import numpy as np
import tiny_dataset

from spnr_jax import data, evaluation, training
from spnr_jax.config import LossConfig

CONFIG = dataclasses.replace(
    tiny_dataset.CONFIG, loss=LossConfig(discriminator_width=4, r1_interval=2), num_steps=3, batch_objects=4
)


def checksum(tree) -> str:
    """Of all bits of the tree's arrays."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        key = jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        digest.update(np.asarray(jax.random.key_data(leaf) if key else leaf).tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    dataset = data.open_dataset(sys.argv[1])
    state = training.jitted_create_state(CONFIG)
    with closing(data.batches(dataset, CONFIG, 0)) as batches:
        for batch in batches:
            state, _ = training.jitted_train_step(state, jax.device_put(batch), config=CONFIG, adversarial=True)
    item = data.read_object(dataset, dataset.splits["test"][0])
    cloud = evaluation.test_cloud(item, CONFIG)
    picture = evaluation.render_views(training.averaged_variables(state), CONFIG, cloud, item.camera)
    for name, tree in (("batch", batch), ("state", state), ("picture", picture)):
        print(name, checksum(tree))
