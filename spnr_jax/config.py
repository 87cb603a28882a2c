"""Every number that matters, as frozen dataclasses; a preset is a function that returns one.

Configs are hashable, so they are static arguments of jit.  A wrong value raises ValueError when the config is made,
naming the field, what came and what is possible.  Marks: [paper] stands in the supplement, the rest is our choice.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, get_type_hints

from spnr_jax.model_config import (
    METHODS,
    ModelConfig,
    NetworkConfig,
    NPBGConfig,
    PointNeRFConfig,
    Points2NeRFConfig,
    SamplingConfig,
    added,
    require,
)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the losses and the discriminator's regulariser."""

    l1_weight: float = 100.0
    """L1 between image and reference [paper: 100; ShapeNet chair 5000]."""
    low_resolution_weight: float = 0.5
    """L1 of the volume-rendered RGB, relative to l1_weight."""
    adversarial_weight: float = 1.0
    """Adversarial loss [paper: 1]; 0 leaves the discriminator out of the graph."""
    adversarial_start: float = 0.0
    """Share of the steps that train with L1 alone before the discriminator joins."""
    r1_gamma: float = 10.0
    """R1 penalty on the discriminator's gradient at real images; 0 leaves it out."""
    r1_interval: int = 16
    """Steps between R1 penalties; each is scaled by this number (lazy regularisation)."""
    discriminator_width: int = 64
    """Channels of the discriminator's first layer."""
    pixel: Literal["l1", "mse"] = added("l1")
    """Error of a pixel; the weights named l1 apply to either."""
    masked: bool = added(False)
    """Leave pixels of opacity 0 out of the pixel error: Point-NeRF's rays without a point in reach."""
    condition: bool = added(True)
    """Whether the discriminator sees the true colours at visible input points [paper]; else an empty image and mask."""

    def __post_init__(self) -> None:
        for name in ("l1_weight", "low_resolution_weight", "adversarial_weight", "r1_gamma"):
            require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")
        require(
            0 <= self.adversarial_start <= 1, f"adversarial_start is a share of the steps, got {self.adversarial_start}"
        )
        require(self.pixel in ("l1", "mse"), f"pixel must be l1 or mse, got {self.pixel}")
        require(self.condition in (True, False), f"condition must be true or false, got {self.condition}")
        require(self.r1_interval >= 1, f"r1_interval must be at least 1, got {self.r1_interval}")


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam for both networks, linear warm-up, cosine decay, average of the generator's weights."""

    lr_generator: float = 5e-4
    """Peak learning rate of the generator."""
    lr_discriminator: float = 2e-4
    """Learning rate of the discriminator."""
    beta1: float = 0.9
    """Adam's first moment, generator."""
    beta1_discriminator: float = 0.5
    """Adam's first moment, discriminator."""
    beta2: float = 0.999
    """Adam's second moment, both."""
    warmup_steps: int = 500
    """Steps of linear warm-up of the generator's learning rate."""
    final_lr_scale: float = 0.01
    """Learning rate of the last step relative to the peak."""
    ema_decay: float = 0.999
    """Decay per step of the averaged generator, which evaluation uses; ramps up from 0 in the first steps."""
    algorithm: Literal["adam", "radam"] = added("adam")
    """Adam, or rectified Adam for the generator."""
    decay: Literal["cosine", "exponential"] = added("cosine")
    """How the generator's learning rate falls after the warm-up."""

    def __post_init__(self) -> None:
        for name in ("lr_generator", "lr_discriminator"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        require(0 <= self.ema_decay < 1, f"ema_decay must be in [0, 1), got {self.ema_decay}")
        require(self.warmup_steps >= 0, f"warmup_steps must not be negative, got {self.warmup_steps}")
        require(self.algorithm in ("adam", "radam"), f"algorithm must be adam or radam, got {self.algorithm}")
        require(self.decay in ("cosine", "exponential"), f"decay must be cosine or exponential, got {self.decay}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A whole training run."""

    preset: str = "abo"
    """Name of the preset this config began as; kept with the run."""
    model: NetworkConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    num_steps: int = 100_000
    """Optimiser steps."""
    batch_objects: int = 8
    """Objects per step."""
    views_per_object: int = 1
    """Views per object and step; they share one encoded volume."""
    min_points: int = 512
    """Fewest points drawn per object and step."""
    max_points: int = 4096
    """Most points drawn per object and step; the padded size of the cloud."""
    test_points: int = 1024
    """Points per object in evaluation."""
    seed: int = 0
    """Seed of weights, batches and jitter."""
    pixel_stride: int = added(1)
    """Every so many-th row and column of a view is rendered in training, from a random first one on."""

    def __post_init__(self) -> None:
        for name in ("num_steps", "batch_objects", "views_per_object", "min_points", "test_points", "pixel_stride"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        require(
            self.loss.adversarial_weight == 0 or self.model.image_resolution >= 24,
            f"image_resolution {self.model.image_resolution} is too small for the discriminator; use at "
            "least 24, or adversarial_weight 0",
        )
        require(
            self.loss.adversarial_weight == 0 or isinstance(self.model, ModelConfig),
            f"adversarial_weight {self.loss.adversarial_weight}: the discriminator judges our network alone; use 0",
        )
        require(
            self.pixel_stride == 1 or (self.model.per_pixel and self.model.image_resolution % self.pixel_stride == 0),
            f"pixel_stride {self.pixel_stride} needs a network whose pixels do not depend on their neighbours and an "
            f"image_resolution that it divides ({self.model.image_resolution}); use 1",
        )
        require(
            self.min_points <= self.max_points,
            f"min_points {self.min_points} must not exceed max_points {self.max_points}",
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
BASELINES = (
    *(npbg_abo, npbg_shapenet, npbg_tiny),
    *(point_nerf_abo, point_nerf_shapenet, point_nerf_tiny),
    *(points2nerf_abo, points2nerf_shapenet, points2nerf_tiny),
)
PRESETS: dict[str, Callable[[], TrainConfig]] = {preset.__name__: preset for preset in (*OURS, *BASELINES)}


def to_dict(config: TrainConfig) -> dict:
    """Nested plain dict of a config, for JSON; `model.method` names the network."""
    values = dataclasses.asdict(config)
    method = next(name for name, kind in METHODS.items() if isinstance(config.model, kind))
    return values | {"model": {"method": method} | values["model"]}


def from_dict(values: dict, kind: type = TrainConfig, path: str = "") -> Any:
    """Config from `to_dict`'s form; an unknown or missing field raises ValueError with its path."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        require(name in fields, f"unknown config field {path}{name}; known: {', '.join(fields)}")
    for name, f in fields.items():
        require(name in values or "added" in f.metadata, f"config field {path}{name} is missing")
    kinds = get_type_hints(kind)
    arguments = {}
    for name, value in values.items():
        if isinstance(value, dict):
            inner, value = _network_kind(value, path) if kinds[name] == NetworkConfig else (kinds[name], value)
            value = from_dict(value, inner, f"{path}{name}.")
        arguments[name] = tuple(value) if isinstance(value, list) else value
    return kind(**arguments)


def _network_kind(values: dict, path: str) -> tuple[type, dict]:
    """Class of a network's config and its fields; files from before there were baselines name no method."""
    method = values.get("method", "ours")
    require(method in METHODS, f"{path}model.method {method} is not one of {', '.join(METHODS)}")
    return METHODS[method], {name: value for name, value in values.items() if name != "method"}
