"""The presets: functions that return a TrainConfig; `spnr train --preset` takes their names.

First the paper's network in its published sizes and in smaller ones, then our surfel network.  The package's network
has the shape of the preset `surfels`; how it was trained: docs/lab/surfels.md.
"""

import dataclasses
from collections.abc import Callable

from spnr_jax.config import (
    EncoderConfig,
    LossConfig,
    OptimizerConfig,
    PaperConfig,
    SamplingConfig,
    SurfelConfig,
    TrainConfig,
)

PAPER = EncoderConfig(inputs="spread", num_groups=1)  # paper's encoder, changed to learn hues
SHADED = LossConfig(l1_weight=1.0, mse_weight=5.0, adversarial_weight=0.0, opacity_weight=1.0, opacity_l1_weight=0.3)
QUICK = OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995)


def abo() -> TrainConfig:
    """Paper sizes for Amazon Berkeley Objects, 128 px.  `spnr train --preset abo DATA RUN`; meant for one GPU."""
    return TrainConfig(preset="abo", model=PaperConfig(encoder=PAPER), loss=LossConfig(adversarial_start=0.1))


def shapenet_car() -> TrainConfig:
    """Paper sizes for ShapeNet cars, 200 px.  `spnr train --preset shapenet_car DATA RUN`; meant for one GPU."""
    model = PaperConfig(encoder=PAPER, resize_resolution=100, image_resolution=200)
    return TrainConfig(preset="shapenet_car", model=model, loss=LossConfig(adversarial_start=0.1))


def shapenet_plane() -> TrainConfig:
    """Paper sizes for ShapeNet planes, 200 px.  `spnr train --preset shapenet_plane DATA RUN`; meant for one GPU."""
    return dataclasses.replace(shapenet_car(), preset="shapenet_plane")


def shapenet_chair() -> TrainConfig:
    """Paper sizes for ShapeNet chairs, 200 px, L1 weight 5000.  `spnr train --preset shapenet_chair DATA RUN`."""
    loss = LossConfig(l1_weight=5000.0, adversarial_start=0.1)
    return dataclasses.replace(shapenet_car(), preset="shapenet_chair", loss=loss)


def small() -> TrainConfig:
    """Half the paper's volume, a quarter of its samples, 128 px, hours on a CPU.  `spnr train --preset small ...`."""
    return TrainConfig(
        preset="small",
        model=PaperConfig(
            encoder=dataclasses.replace(PAPER, volume_resolution=32, num_stages=4),
            sampling=SamplingConfig(num_coarse=16, num_fine=16),
        ),
        loss=LossConfig(adversarial_start=0.85, discriminator_width=32),
        optimizer=OptimizerConfig(lr_generator=1e-3, warmup_steps=200),
        num_steps=9000,
        batch_objects=4,
        max_points=2048,
    )


def tiny() -> TrainConfig:
    """64 px, trains to a recognisable image in minutes on two CPU cores.  `spnr train --preset tiny DATA RUN`."""
    return TrainConfig(
        preset="tiny",
        model=PaperConfig(
            encoder=dataclasses.replace(PAPER, volume_resolution=32, base_width=12, num_stages=3),
            sampling=SamplingConfig(num_coarse=16, num_fine=16),
            render_resolution=32,
            resize_resolution=32,
            image_resolution=64,
        ),
        loss=LossConfig(adversarial_start=0.85, discriminator_width=16),
        optimizer=QUICK,
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
    )


def surfels() -> TrainConfig:
    """Our surfel network, for pictures of any size.  `spnr train --preset surfels DATA RUN`.

    DATA is from `spnr-data generate --resolution 512 --points 65536`.  Some hours on two CPU cores, of which the first
    are for the G-buffers, which take some 10 MB of disk per cloud.  Expected figures: docs/lab/surfels.md.
    """
    return TrainConfig(
        preset="surfels",
        model=SurfelConfig(),
        loss=SHADED,
        optimizer=OptimizerConfig(
            lr_generator=1.5e-3, beta2=0.99, warmup_steps=200, final_lr_scale=0.02, clip_norm=1.0
        ),
        num_steps=10_000,
        views_per_object=2,
        min_points=256,
        max_points=65_536,
        test_points=4096,
        crop=96,
        even_share=0.6,
    )


def surfels_tiny() -> TrainConfig:
    """Our surfel network, narrower; minutes on two CPU cores.  `spnr train --preset surfels_tiny DATA RUN`.

    For pictures of 64 px: it is not trained to double a resolution, which larger pictures need.
    """
    return TrainConfig(
        preset="surfels_tiny",
        model=SurfelConfig(image_resolution=64, widths=(16, 32, 64), top=16),
        loss=SHADED,
        optimizer=QUICK,
        num_steps=1200,
        views_per_object=4,
        min_points=256,
        max_points=1024,
        crop=32,
    )


PAPERS = (abo, shapenet_car, shapenet_plane, shapenet_chair, small, tiny)
PRESETS: dict[str, Callable[[], TrainConfig]] = {preset.__name__: preset for preset in (*PAPERS, surfels, surfels_tiny)}
"""By name; `methods.register` adds the presets of your own methods."""
