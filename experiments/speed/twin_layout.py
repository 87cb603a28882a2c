"""The sizes of the PyTorch twin, and a batch of its arrays (images channel-first), in this project's records."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spnr_jax.config import EncoderConfig, LossConfig, OptimizerConfig, PaperConfig, SamplingConfig, TrainConfig
from spnr_jax.kernels.records import Batch, Camera, PointCloud

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Config:
    """The twin's sizes, losses and learning rates; those of the preset `abo` where nothing else is said."""

    points: int = 1024
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 32
    grid: int = 64
    base: int = 16
    stages: int = 5
    groups: int = 8
    field_hidden: int = 64
    features: int = 32
    dir_freqs: int = 4
    render: int = 64
    coarse: int = 64
    fine: int = 64
    pdf_pad: float = 1e-5
    up_width: int = 64
    disc_width: int = 64
    l1_weight: float = 100.0
    lowres_weight: float = 0.5
    adv_weight: float = 1.0
    r1_gamma: float = 10.0
    r1_every: int = 0  # 0: no R1
    lr_g: float = 2e-4
    lr_d: float = 2e-4


PRESETS = {
    "abo": Config(),
    "small": Config(grid=32, stages=4, coarse=32, fine=32),
    "tiny": Config(grid=32, base=8, stages=3, coarse=16, fine=16, render=32),
}


def train_config(c: Config, objects: int = 1) -> TrainConfig:
    """Our config of these sizes."""
    encoder = EncoderConfig(
        point_widths=tuple(c.point_widths),
        point_features=c.point_features,
        volume_resolution=c.grid,
        base_width=c.base,
        num_stages=c.stages,
        num_groups=c.groups,
    )
    model = PaperConfig(
        encoder=encoder,
        field_width=c.field_hidden,
        num_features=c.features,
        direction_frequencies=c.dir_freqs,
        sampling=SamplingConfig(num_coarse=c.coarse, num_fine=c.fine, padding=c.pdf_pad),
        render_resolution=c.render,
        resize_resolution=c.render,
        image_resolution=2 * c.render,
        upsampler_width=c.up_width,
    )
    loss = LossConfig(
        l1_weight=c.l1_weight,
        low_resolution_weight=c.lowres_weight,
        adversarial_weight=c.adv_weight,
        r1_gamma=c.r1_gamma if c.r1_every else 0.0,
        r1_interval=max(c.r1_every, 1),
        discriminator_width=c.disc_width,
    )
    optimizer = OptimizerConfig(lr_generator=c.lr_g, lr_discriminator=c.lr_d)
    return TrainConfig(
        model=model,
        loss=loss,
        optimizer=optimizer,
        batch_objects=objects,
        min_points=c.points,
        max_points=c.points,
    )


def batch(arrays: Arrays) -> Batch:
    """The batch of pos mat c2w focal target cond mask: one view of each object, every point real."""
    positions, materials = arrays["pos"], arrays["mat"]
    cloud = PointCloud(
        positions=positions,
        base_color=materials[..., :3],
        roughness=materials[..., 3],
        metallic=materials[..., 4],
        mask=np.ones(positions.shape[:2], bool),
    )
    images = {k: np.moveaxis(arrays[k], 1, -1)[:, None] for k in ("target", "cond", "mask")}
    size = images["target"].shape[-2]
    focal = arrays["focal"][:, None] * size / 2
    intrinsics = np.zeros((*focal.shape, 3, 3), np.float32)
    intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
    intrinsics[..., 0, 2] = intrinsics[..., 1, 2] = size / 2
    intrinsics[..., 2, 2] = 1
    camera = Camera(cam_to_world=arrays["c2w"][:, None], intrinsics=intrinsics, height=size, width=size)
    return Batch(
        cloud=cloud,
        camera=camera,
        image=images["target"],
        alpha=np.ones_like(images["mask"][..., 0]),  # the twin has no loss of opacity
        condition=images["cond"],
        condition_mask=images["mask"][..., 0] > 0.5,
    )
