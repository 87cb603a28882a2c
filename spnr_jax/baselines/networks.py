"""The published baselines that the trainer knows beside our own networks: the module of each, by its name."""

from typing import Any

from spnr_jax.baselines.npbg import NPBG
from spnr_jax.baselines.point_nerf import PointNeRF
from spnr_jax.baselines.points2nerf import Points2NeRF

NETWORKS: dict[str, Any] = {"npbg": NPBG, "point_nerf": PointNeRF, "points2nerf": Points2NeRF}
