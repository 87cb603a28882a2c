"""Every network of the comparison with few weights, for the pixels and points of `tiny_dataset`."""

import dataclasses

from experiments.baselines.npbg import NPBGConfig
from experiments.baselines.point_nerf import PointNeRFConfig
from experiments.baselines.points2nerf import Points2NeRFConfig
from spnr_jax.config import LossConfig, NetworkConfig, OptimizerConfig
from support import tiny_dataset

SIZE = tiny_dataset.SIZE
POINT_NERF = PointNeRFConfig(
    radius=0.25,
    num_neighbors=4,
    num_candidates=24,
    num_samples=5,
    width=8,
    color_width=6,
    feature_frequencies=2,
    offset_frequencies=2,
    direction_frequencies=1,
    density_scale=3.0,
    image_resolution=8,
    ray_chunk=20,
)
BASELINE = dataclasses.replace(
    tiny_dataset.CONFIG,
    loss=LossConfig(l1_weight=0.0, mse_weight=1.0, adversarial_weight=0.0),
    optimizer=OptimizerConfig(lr_generator=1e-2, warmup_steps=2, ema_decay=0.9),
)
RASTERS = NPBGConfig(encoder_widths=(8, 9, 10), decoder_widths=(5, 4), image_resolution=16)
HYPER = Points2NeRFConfig(
    kl_weight=0.01,
    materials=("base_color", "metallic"),
    point_widths=(8, 6),
    hidden_width=7,
    code_size=5,
    hypernetwork_widths=(6, 9),
    chunk_size=48,
    chunk_embedding=3,
    frequencies=2,
    nerf_width=8,
    nerf_depth=2,
    num_samples=4,
    image_resolution=8,
)
NETWORKS: dict[str, NetworkConfig] = {
    f"{model.method}_tiny": dataclasses.replace(model, image_resolution=SIZE) for model in (RASTERS, POINT_NERF, HYPER)
}
SHRUNKEN = {"tiny": dataclasses.replace(BASELINE, model=tiny_dataset.CONFIG.model)} | {
    name: dataclasses.replace(BASELINE, preset=name, model=model) for name, model in NETWORKS.items()
}
