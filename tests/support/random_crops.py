"""A batch of crops for the training of the surfel network, of random numbers."""

import jax
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.kernels.records import Crops
from spnr_jax.nn import shader
from spnr_jax.training import gbuffers


def random_crops(config: TrainConfig, doublings: int, seed: int = 0) -> Crops:
    """A batch of the shapes that `gbuffers.make_batch` makes."""
    rng = np.random.default_rng(seed)
    count = config.batch_objects
    size, margin = (-(-config.crop * n[doublings] // gbuffers.SIZES[0]) for n in (gbuffers.SIZES, gbuffers.MARGINS))
    inner = size - 2 * margin
    large = inner << doublings
    crops = Crops(
        seen=rng.random((count, size, size, shader.NUM_FEATURES), np.float32),
        maps=rng.random((count, inner, inner, shader.NUM_MAPS), np.float32),
        ambient=rng.random((count, 9, 3), np.float32),
        target=rng.integers(0, 256, (count, large, large, 4), np.uint8),
        doublings=doublings,
        margin=margin,
    )
    return jax.device_put(crops)
