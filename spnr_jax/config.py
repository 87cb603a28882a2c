"""Every number that matters, as frozen dataclasses (`presets.py` fills them in).

Configs are hashable, so they are static arguments of jit.  A wrong value raises ValueError when the config is made,
naming the field, what came and what is possible.  Marks: [paper] stands in the supplement, the rest is our choice.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from spnr_jax.model_config import METHODS, ModelConfig, NetworkConfig, added, require, surface_grid

LARGEST = 2**63  # of any number in a config


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
    opacity_l1_weight: float = added(0.0)
    """L1 of the opacity against the reference's."""
    opacity_weight: float = added(0.0)
    """Mean squared error of the opacity against the reference's, beside the loss of the picture."""
    mse_weight: float = added(0.0)
    """Mean squared error of the picture beside the weighted one: what L1 leaves undecided at an outline is averaged."""
    condition: bool = added(True)
    """Whether the discriminator sees the true colours at visible input points [paper]; else an empty image and mask."""

    def __post_init__(self) -> None:
        weights = ("l1_weight", "low_resolution_weight", "adversarial_weight", "mse_weight", "r1_gamma")
        for name in (*weights, "opacity_weight", "opacity_l1_weight"):
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
    clip_norm: float = added(0.0)
    """Norm to which the generator's gradient is shortened where it is longer; 0: never."""

    def __post_init__(self) -> None:
        for name in ("lr_generator", "lr_discriminator"):
            require(getattr(self, name) > 0, f"{name} must be positive, got {getattr(self, name)}")
        require(0 <= self.ema_decay < 1, f"ema_decay must be in [0, 1), got {self.ema_decay}")
        require(self.clip_norm >= 0, f"clip_norm must not be negative, got {self.clip_norm}")
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
    crop: int = added(0)
    """Pixels along each side of the square of a view that is rendered in training, at a random place; 0: all of it."""
    even_share: float = added(0.0)
    """Share of the clouds that are evenly spread, not random points: an object's first ones in a data set of `--spread
    even`, or farthest points where the network sees G-buffers."""

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
            self.crop == 0 or (self.model.any_size and 1 <= self.crop <= self.model.image_resolution),
            f"crop {self.crop} needs a network that renders pictures of any size, and at most its image_resolution "
            f"({self.model.image_resolution}) pixels; use 0",
        )
        require(
            self.crop == 0 or self.pixel_stride == 1, f"pixel_stride {self.pixel_stride} and crop {self.crop}: use one"
        )
        require(0 <= self.even_share <= 1, f"even_share is a share of the clouds, got {self.even_share}")
        require(
            self.min_points <= self.max_points,
            f"min_points {self.min_points} must not exceed max_points {self.max_points}",
        )
        if isinstance(self.model, ModelConfig) and self.model.num_neighbors:
            cells = surface_grid(self.max_points)
            require(
                self.model.surface_cells >= cells,
                f"model.surface_cells {self.model.surface_cells}: with max_points {self.max_points} the network would "
                f"train on a finer grid than it renders smaller clouds with; use at least {cells}",
            )


def to_dict(config: TrainConfig) -> dict:
    """Nested plain dict of a config, for JSON; `model.method` names the network."""
    values = dataclasses.asdict(config)
    method = next(name for name, kind in METHODS.items() if isinstance(config.model, kind))
    return values | {"model": {"method": method} | values["model"]}


def from_dict(values: dict, kind: type = TrainConfig, path: str = "") -> Any:
    """Config from `to_dict`'s form; a field unknown, missing or of another type raises ValueError with its path."""
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
        value = tuple(value) if isinstance(value, list) else value
        require(_fits(value, kinds[name]), f"config field {path}{name} holds {value!r}, which is of another type")
        arguments[name] = value
    return kind(**arguments)


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is what an annotation says; numbers are finite, and a whole number will do for a float."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return any(_fits(value, other) for other in inside)
    if origin is Literal:
        return isinstance(value, str) and value in inside
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(entry, inside[0]) for entry in value)
    if kind in (int, float):
        number = isinstance(value, int) or (kind is float and isinstance(value, float) and math.isfinite(value))
        return number and not isinstance(value, bool) and abs(value) < LARGEST
    return isinstance(value, kind)


def _network_kind(values: dict, path: str) -> tuple[type, dict]:
    """Class of a network's config and its fields; files from before there were baselines name no method."""
    method = values.get("method", "ours")
    require(method in METHODS, f"{path}model.method {method} is not one of {', '.join(METHODS)}")
    return METHODS[method], {name: value for name, value in values.items() if name != "method"}
