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

from spnr_jax.config import LossConfig
from spnr_jax.formats import data_sets
from spnr_jax.method.model import render_views
from spnr_jax.training import batching, optimisation
from support import tiny_dataset

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
    dataset = data_sets.open_dataset(sys.argv[1])
    state = optimisation.jitted_create_state(CONFIG)
    with closing(batching.batches(dataset, CONFIG, 0)) as batches:
        for batch in batches:
            state, _ = optimisation.jitted_train_step(state, jax.device_put(batch), config=CONFIG, adversarial=True)
    item = data_sets.read_object(dataset, dataset.splits["test"][0])
    cloud = data_sets.test_cloud(item, CONFIG)
    picture = render_views(optimisation.averaged_variables(state), CONFIG.model, cloud, item.camera)
    for name, tree in (("batch", batch), ("state", state), ("picture", picture)):
        print(name, checksum(tree))
