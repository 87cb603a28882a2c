"""The presets: functions that return a TrainConfig, named as `spnr train --preset` takes them.

Ours first, in the paper's sizes and smaller ones, then the baselines.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

from spnr_jax.config import LossConfig, OptimizerConfig, TrainConfig
from spnr_jax.model_config import (
    NUM_TOLD,
    ModelConfig,
    NPBGConfig,
    PointNeRFConfig,
    Points2NeRFConfig,
    SamplingConfig,
    SurfelConfig,
    surface_grid,
)


def abo() -> TrainConfig:
    """Paper sizes for Amazon Berkeley Objects, 128 px.  `spnr train --preset abo DATA RUN`; meant for one GPU."""
    return TrainConfig(preset="abo", loss=LossConfig(adversarial_start=0.1))


def _shapenet(name: str, l1_weight: float = 100.0) -> TrainConfig:
    return TrainConfig(
        preset=name,
        model=ModelConfig(resize_resolution=100, image_resolution=200),
        loss=LossConfig(l1_weight=l1_weight, adversarial_start=0.1),
    )


def shapenet_car() -> TrainConfig:
    """Paper sizes for ShapeNet cars, 200 px.  `spnr train --preset shapenet_car DATA RUN`; meant for one GPU."""
    return _shapenet("shapenet_car")


def shapenet_plane() -> TrainConfig:
    """Paper sizes for ShapeNet planes, 200 px.  `spnr train --preset shapenet_plane DATA RUN`; meant for one GPU."""
    return _shapenet("shapenet_plane")


def shapenet_chair() -> TrainConfig:
    """Paper sizes for ShapeNet chairs, 200 px, L1 weight 5000.  `spnr train --preset shapenet_chair DATA RUN`."""
    return _shapenet("shapenet_chair", l1_weight=5000.0)


def small() -> TrainConfig:
    """A quarter of the paper's compute, 128 px.  `spnr train --preset small DATA RUN`; hours on a CPU."""
    return TrainConfig(
        preset="small",
        model=ModelConfig(volume_resolution=32, num_stages=4, sampling=SamplingConfig(num_coarse=32, num_fine=32)),
        loss=LossConfig(adversarial_start=0.5, discriminator_width=32),
        optimizer=OptimizerConfig(lr_generator=1e-3, warmup_steps=200),
        num_steps=20_000,
        batch_objects=4,
        views_per_object=2,
        max_points=2048,
    )


def tiny() -> TrainConfig:
    """64 px, trains to a recognisable image in minutes on two CPU cores.  `spnr train --preset tiny DATA RUN`."""
    return TrainConfig(
        preset="tiny",
        model=ModelConfig(
            volume_resolution=32,
            base_width=8,
            num_stages=3,
            num_groups=1,
            sampling=SamplingConfig(num_coarse=16, num_fine=16),
            render_resolution=32,
            resize_resolution=32,
            image_resolution=64,
        ),
        loss=LossConfig(adversarial_start=0.85, discriminator_width=16),
        optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995),
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
    )


FEW_SAMPLES = 8  # of a ray near points: a picture takes less time than the paper's network, docs/ablations.md
PACKAGE_SAMPLES = 16  # of the package's network `small`


def _plus(preset: TrainConfig, name: str, pixel_stride: int, num_coarse: int) -> TrainConfig:
    """The preset's network and training with light on the materials of the nearest points: a ray a pixel, no GAN."""
    assert isinstance(preset.model, ModelConfig)
    model = dataclasses.replace(
        preset.model,
        num_features=3,
        num_neighbors=6,
        surface_cells=surface_grid(preset.max_points),
        color="lit",
        point_norm="layer",
        sees_direction=False,
        sampling=SamplingConfig(num_coarse=num_coarse, num_fine=0, reach=1),
        render_resolution=preset.model.image_resolution,
    )
    loss = LossConfig(l1_weight=1.0, mse_weight=1.0, adversarial_weight=0.0, opacity_weight=1.0)
    return dataclasses.replace(preset, preset=name, model=model, loss=loss, pixel_stride=pixel_stride)


def plus_abo() -> TrainConfig:
    """Light on materials, a volume of the paper's size, 128 px.  `spnr train --preset plus_abo DATA RUN`; one GPU."""
    return _plus(abo(), "plus_abo", pixel_stride=2, num_coarse=32)


def plus_shapenet() -> TrainConfig:
    """The same at 200 px.  `spnr train --preset plus_shapenet DATA RUN`; meant for one GPU."""
    return _plus(shapenet_car(), "plus_shapenet", pixel_stride=2, num_coarse=32)


def packaged(config: TrainConfig, num_samples: int) -> TrainConfig:
    """The config of a network near points as the package has them: seeing the view direction, with so many samples."""
    assert isinstance(config.model, ModelConfig)
    sampling = dataclasses.replace(config.model.sampling, num_coarse=num_samples)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, sampling=sampling, sees_direction=True))


def of_any_density(config: TrainConfig) -> TrainConfig:
    """The config of a network near points with 128 to 2048 points an object, on their grid."""
    assert isinstance(config.model, ModelConfig)
    most = 2048
    model = dataclasses.replace(config.model, surface_cells=surface_grid(most))
    return dataclasses.replace(config, model=model, min_points=128, max_points=most)


def plus_lite() -> TrainConfig:
    """The package's network `tiny`: half the sizes of plus_small's.  `spnr train --preset plus_lite DATA RUN`."""
    small = of_any_density(packaged(plus_small(), FEW_SAMPLES))
    assert isinstance(small.model, ModelConfig)
    model = dataclasses.replace(
        small.model, point_widths=(32, 64, 128), point_features=16, volume_resolution=16, field_width=32
    )
    return dataclasses.replace(small, preset="plus_lite", model=model, num_steps=5000)


def plus_refined() -> TrainConfig:
    """The package's network `small`: plus_small's with a refiner.  `spnr train --preset plus_refined --init small ...`.

    Without --init, begin with a run of `plus_small --sees-direction`: a lattice of rays is quicker to learn from.
    """
    return with_refiner(of_any_density(packaged(plus_small(), PACKAGE_SAMPLES)))


def with_refiner(config: TrainConfig) -> TrainConfig:
    """The config of a network near points with a refiner, which sees crops."""
    assert isinstance(config.model, ModelConfig)
    return dataclasses.replace(
        config,
        preset="plus_refined",
        model=dataclasses.replace(config.model, refiner_width=32, num_features=3 + NUM_TOLD),
        loss=dataclasses.replace(config.loss, mse_weight=4.0, opacity_weight=2.0),
        num_steps=20_000,
        pixel_stride=1,
        crop=config.model.image_resolution // 2,
    )


def plus_small() -> TrainConfig:
    """plus_tiny's network at 128 px, for longer.  `spnr train --preset plus_small DATA RUN`."""
    small = _plus(tiny(), "plus_small", pixel_stride=4, num_coarse=FEW_SAMPLES)
    assert isinstance(small.model, ModelConfig)
    return dataclasses.replace(
        small,
        model=dataclasses.replace(small.model, render_resolution=128, image_resolution=128),
        optimizer=dataclasses.replace(small.optimizer, ema_decay=0.999),
        num_steps=11_000,
        min_points=384,
    )


def plus_tiny() -> TrainConfig:
    """Light on materials, 64 px, minutes on two CPU cores.  `spnr train --preset plus_tiny DATA RUN`."""
    return _plus(tiny(), "plus_tiny", pixel_stride=2, num_coarse=FEW_SAMPLES)


def surfels() -> TrainConfig:
    """Our network over G-buffers of surfels, pictures of any size.  `spnr train --preset surfels DATA RUN`.

    DATA of `spnr-data generate` with --resolution 512 --points 65536.  Some hours on two CPU cores, the first of them
    for the G-buffers, which take some 10 MB of disk a cloud.  Expected figures: see docs/model_card.md.
    """
    return TrainConfig(
        preset="surfels",
        model=SurfelConfig(),
        loss=LossConfig(
            l1_weight=1.0, mse_weight=5.0, adversarial_weight=0.0, opacity_weight=1.0, opacity_l1_weight=0.3
        ),
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


def _baseline_loss(pixel: Literal["l1", "mse"], masked: bool = False) -> LossConfig:
    return LossConfig(l1_weight=1.0, adversarial_weight=0.0, pixel=pixel, masked=masked)


def npbg_abo() -> TrainConfig:
    """NPBG as adapted, paper sizes, 128 px.  `spnr train --preset npbg_abo DATA RUN`; meant for one GPU."""
    return TrainConfig(
        preset="npbg_abo",
        model=NPBGConfig(),
        loss=_baseline_loss("l1"),
        optimizer=OptimizerConfig(lr_generator=1e-4, warmup_steps=0, final_lr_scale=1.0),
        num_steps=40_000,  # 20 epochs of 16,161 objects
    )


def npbg_shapenet() -> TrainConfig:
    """NPBG as adapted, 200 px.  `spnr train --preset npbg_shapenet DATA RUN`; meant for one GPU."""
    return dataclasses.replace(npbg_abo(), preset="npbg_shapenet", model=NPBGConfig(image_resolution=200))


def npbg_tiny() -> TrainConfig:
    """The same network at 64 px, learning rate 20 times as high.  `spnr train --preset npbg_tiny DATA RUN`."""
    return TrainConfig(
        preset="npbg_tiny",
        model=NPBGConfig(image_resolution=64),
        loss=_baseline_loss("l1"),
        optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995),
        num_steps=3000,
        batch_objects=4,
        max_points=1024,
    )


def point_nerf_abo() -> TrainConfig:
    """Point-NeRF as adapted, 128 px, 1024 rays a step.  `spnr train --preset point_nerf_abo DATA RUN`; one GPU."""
    return TrainConfig(
        preset="point_nerf_abo",
        model=PointNeRFConfig(),
        loss=_baseline_loss("mse", masked=True),
        optimizer=OptimizerConfig(lr_generator=5e-4, warmup_steps=0, decay="exponential"),
        num_steps=1_000_000,
        batch_objects=1,
        pixel_stride=4,
    )


def point_nerf_shapenet() -> TrainConfig:
    """Point-NeRF as adapted, 200 px.  `spnr train --preset point_nerf_shapenet DATA RUN`; meant for one GPU."""
    model = PointNeRFConfig(image_resolution=200)
    return dataclasses.replace(point_nerf_abo(), preset="point_nerf_shapenet", model=model, pixel_stride=5)


def point_nerf_tiny() -> TrainConfig:
    """Narrower, fewer samples, denser, 64 px, minutes on two cores.  `spnr train --preset point_nerf_tiny DATA RUN`."""
    return TrainConfig(
        preset="point_nerf_tiny",
        model=PointNeRFConfig(
            num_candidates=80,
            num_samples=24,
            width=64,
            color_width=32,
            density_scale=20.0,  # at the published 1 the objects are still fog after 1200 steps
            image_resolution=64,
            ray_chunk=1024,
        ),
        loss=_baseline_loss("mse", masked=True),
        optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995),
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
        pixel_stride=4,
    )


def points2nerf_shapenet() -> TrainConfig:
    """Points2NeRF as published, 200 px, 1600 rays a step.  `spnr train --preset points2nerf_shapenet DATA RUN`.

    190 million parameters, meant for one GPU; the authors report two weeks and more per class.
    """
    return TrainConfig(
        preset="points2nerf_shapenet",
        model=Points2NeRFConfig(image_resolution=200),
        loss=_baseline_loss("mse"),
        optimizer=OptimizerConfig(
            lr_generator=5e-5, warmup_steps=0, algorithm="radam", decay="exponential", final_lr_scale=0.135
        ),
        num_steps=2_254_000,  # 2000 epochs of 1127 cars, the learning rate times 0.999 after each
        batch_objects=1,
        pixel_stride=5,
    )


def points2nerf_abo() -> TrainConfig:
    """The same at 128 px, 1024 rays a step.  `spnr train --preset points2nerf_abo DATA RUN`; meant for one GPU."""
    model = Points2NeRFConfig(image_resolution=128)
    return dataclasses.replace(points2nerf_shapenet(), preset="points2nerf_abo", model=model, pixel_stride=4)


def points2nerf_tiny() -> TrainConfig:
    """A hundredth of the size, 64 px, minutes on two cores.  `spnr train --preset points2nerf_tiny DATA RUN`.

    The encoder sees all materials, as our network does.  The KL weight, 2 * 0.05^2 over an object's 768 numbers in a
    step, is that of pixels with a Gaussian error of 0.05; at 1, beside a mean of squares, the code would say nothing.
    """
    return TrainConfig(
        preset="points2nerf_tiny",
        model=Points2NeRFConfig(
            mode="fixed",
            initialization="scaled",
            kl_weight=6.5e-6,
            materials=("base_color", "roughness", "metallic"),
            point_widths=(64, 128, 256),
            hidden_width=256,
            code_size=128,
            hypernetwork_widths=(256, 512),
            chunk_size=2048,
            frequencies=6,
            nerf_width=64,
            nerf_depth=4,
            num_samples=24,
            image_resolution=64,
        ),
        loss=_baseline_loss("mse"),
        optimizer=OptimizerConfig(lr_generator=3e-3, warmup_steps=30, ema_decay=0.995, algorithm="radam"),
        num_steps=1200,
        batch_objects=4,
        max_points=1024,
        pixel_stride=4,
    )


OURS = (abo, shapenet_car, shapenet_plane, shapenet_chair, small, tiny)
PLUS = (plus_abo, plus_lite, plus_refined, plus_shapenet, plus_small, plus_tiny)
BASELINES = (
    *(npbg_abo, npbg_shapenet, npbg_tiny),
    *(point_nerf_abo, point_nerf_shapenet, point_nerf_tiny),
    *(points2nerf_abo, points2nerf_shapenet, points2nerf_tiny),
)
PRESETS: dict[str, Callable[[], TrainConfig]] = {
    preset.__name__: preset for preset in (*OURS, *PLUS, surfels, *BASELINES)
}
