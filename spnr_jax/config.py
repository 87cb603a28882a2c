"""Every number that matters, as frozen dataclasses; a preset is a function that returns one.

Configs are hashable, so they are static arguments of jit.  A wrong value raises ValueError when the config is made,
naming the field, what came and what is possible.  Marks: [paper] stands in the supplement, the rest is our choice.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, get_type_hints

MATERIAL_CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Samples along each ray."""

    num_coarse: int = 64
    """Stratified samples between entry into and exit from the box [paper]."""
    num_fine: int = 64
    """Samples drawn where the coarse weights are large [paper]; 0 renders the coarse samples alone."""
    padding: float = 1e-5
    """Added to each coarse weight before sampling: empty rays are sampled evenly, thin parts keep nearly all."""

    def __post_init__(self) -> None:
        _require(self.num_coarse >= 1, f"num_coarse must be at least 1, got {self.num_coarse}")
        _require(self.num_fine >= 0, f"num_fine must be at least 0, got {self.num_fine}")
        _require(self.padding > 0, f"padding must be positive, got {self.padding}")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Sizes of the generator."""

    materials: tuple[Literal["base_color", "roughness", "metallic"], ...] = ("base_color", "roughness", "metallic")
    """Material channels that the points carry into the network."""
    point_widths: tuple[int, ...] = (64, 128, 256)
    """Hidden layers of the PointNet [paper]."""
    point_features: int = 32
    """Features of a point after the PointNet."""
    volume_resolution: int = 64
    """Voxels along each axis of the box [-1, 1]^3; a multiple of 2 ** num_stages."""
    base_width: int = 16
    """Channels of the volume at full resolution; doubled by each encoder stage [paper]."""
    num_stages: int = 5
    """Encoder stages of the 3D U-Net; each halves the resolution (5: 1/32) [paper]."""
    num_groups: int = 8
    """Groups of each GroupNorm in U-Net and discriminator."""
    field_width: int = 64
    """Hidden layer of the radiance field."""
    num_features: int = 32
    """Channels of the rendered feature image; the first three are RGB."""
    direction_frequencies: int = 4
    """Frequencies of the view direction's encoding; 0 gives the field the bare direction."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    render_resolution: int = 64
    """Rays along each side of the volume-rendered image [paper]."""
    resize_resolution: int = 64
    """Bilinear resize of the feature image before the upsampler (64 to 100 for ShapeNet [paper])."""
    image_resolution: int = 128
    """Output: 2 x resize_resolution, or render_resolution, which builds no upsampler."""
    upsampler_width: int = 64
    """Channels of the upsampler before its x2; half of it after."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Format of the convolutions in U-Net, upsampler and discriminator; all else, parameters too, is float32."""

    def __post_init__(self) -> None:
        step = 2**self.num_stages
        _require(
            self.volume_resolution % step == 0 and self.volume_resolution > 0,
            f"volume_resolution {self.volume_resolution} cannot be halved {self.num_stages} times; use a multiple of "
            f"{step} or fewer num_stages",
        )
        _require(
            self.base_width % self.num_groups == 0 and self.base_width > 0,
            f"base_width {self.base_width} must be a positive multiple of num_groups {self.num_groups}",
        )
        _require(self.num_features >= 3, f"num_features must be at least 3 (RGB), got {self.num_features}")
        _require(
            len(set(self.materials)) == len(self.materials) and set(self.materials) <= set(MATERIAL_CHANNELS),
            f"materials must be distinct names out of {tuple(MATERIAL_CHANNELS)}, got {self.materials}",
        )
        _require(
            self.precision in ("float32", "bfloat16"),
            f"precision must be float32 or bfloat16, got {self.precision}",
        )
        _require(
            self.image_resolution in (self.render_resolution, 2 * self.resize_resolution),
            f"image_resolution {self.image_resolution} must be render_resolution ({self.render_resolution}: no "
            f"upsampler) or twice resize_resolution ({2 * self.resize_resolution})",
        )

    @property
    def num_material_channels(self) -> int:
        """Numbers a point carries besides its position."""
        return sum(MATERIAL_CHANNELS[name] for name in self.materials)

    @property
    def bf16(self) -> bool:
        """Whether the convolutions run in bfloat16."""
        return self.precision == "bfloat16"

    @property
    def upsamples(self) -> bool:
        """Whether the graph contains the upsampler."""
        return self.image_resolution != self.render_resolution


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

    def __post_init__(self) -> None:
        for name in ("l1_weight", "low_resolution_weight", "adversarial_weight", "r1_gamma"):
            _require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")
        _require(
            0 <= self.adversarial_start <= 1, f"adversarial_start is a share of the steps, got {self.adversarial_start}"
        )
        _require(self.r1_interval >= 1, f"r1_interval must be at least 1, got {self.r1_interval}")


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

    def __post_init__(self) -> None:
        for name in ("lr_generator", "lr_discriminator"):
            _require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        _require(0 <= self.ema_decay < 1, f"ema_decay must be in [0, 1), got {self.ema_decay}")
        _require(self.warmup_steps >= 0, f"warmup_steps must not be negative, got {self.warmup_steps}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A whole training run."""

    preset: str = "abo"
    """Name of the preset this config began as; kept with the run."""
    model: ModelConfig = field(default_factory=ModelConfig)
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

    def __post_init__(self) -> None:
        for name in ("num_steps", "batch_objects", "views_per_object", "min_points", "test_points"):
            _require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        _require(
            self.loss.adversarial_weight == 0 or self.model.image_resolution >= 24,
            f"image_resolution {self.model.image_resolution} is too small for the discriminator; use at "
            "least 24, or adversarial_weight 0",
        )
        _require(
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


PRESETS: dict[str, Callable[[], TrainConfig]] = {
    preset.__name__: preset for preset in (abo, shapenet_car, shapenet_plane, shapenet_chair, small, tiny)
}


def to_dict(config: TrainConfig) -> dict:
    """Nested plain dict of a config, for JSON."""
    return dataclasses.asdict(config)


def from_dict(values: dict, kind: type = TrainConfig, path: str = "") -> Any:
    """Config from `to_dict`'s form; an unknown or missing field raises ValueError with its path."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        _require(name in fields, f"unknown config field {path}{name}; known: {', '.join(fields)}")
    for name in fields:
        _require(name in values, f"config field {path}{name} is missing")
    kinds = get_type_hints(kind)
    arguments = {}
    for name, value in values.items():
        if isinstance(value, dict):
            value = from_dict(value, kinds[name], f"{path}{name}.")
        arguments[name] = tuple(value) if isinstance(value, list) else value
    return kind(**arguments)
