"""The published baselines that the trainer knows beside our own network: each config, and the module of it."""

import flax.linen as nn

from spnr_jax.baselines.npbg import NPBG
from spnr_jax.baselines.point_nerf import PointNeRF
from spnr_jax.baselines.points2nerf import Points2NeRF
from spnr_jax.model_config import NPBGConfig, PointNeRFConfig, Points2NeRFConfig

NETWORKS: dict[type, type[nn.Module]] = {
    NPBGConfig: NPBG,
    PointNeRFConfig: PointNeRF,
    Points2NeRFConfig: Points2NeRF,
}
