"""Every number of a training, as frozen dataclasses (`presets.py` fills them in); the network's: `model_config.py`.

Configs are hashable, so they are static arguments of jit.  A wrong value raises ValueError when the config is made,
naming the field, what came and what is possible.  Marks: [paper] stands in the supplement, the rest is our choice.
"""

from dataclasses import dataclass, field
from typing import Literal

from spnr_jax.errors import require
from spnr_jax.model_config import (
    Count,
    Decay,
    NearPointsConfig,
    NetworkConfig,
    PaperConfig,
    Positive,
    RayNetworkConfig,
    Share,
    Weight,
    Whole,
    check,
    surface_grid,
)


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the losses and the discriminator's regulariser."""

    l1_weight: Weight = 100.0
    """L1 between image and reference [paper: 100; ShapeNet chair 5000]."""
    low_resolution_weight: Weight = 0.5
    """L1 of the volume-rendered RGB, relative to l1_weight."""
    adversarial_weight: Weight = 1.0
    """Adversarial loss [paper: 1]; 0 leaves the discriminator out of the graph."""
    adversarial_start: Share = 0.0
    """Share of the steps that train with L1 alone before the discriminator joins."""
    r1_gamma: Weight = 10.0
    """R1 penalty on the discriminator's gradient at real images; 0 leaves it out."""
    r1_interval: Count = 16
    """Steps between R1 penalties; each is scaled by this number (lazy regularisation)."""
    discriminator_width: Count = 64
    """Channels of the discriminator's first layer."""
    pixel: Literal["l1", "mse"] = "l1"
    """Error of a pixel; the weights named l1 apply to either."""
    masked: bool = False
    """Leave pixels of opacity 0 out of the pixel error: Point-NeRF's rays without a point in reach."""
    opacity_l1_weight: Weight = 0.0
    """L1 of the opacity against the reference's."""
    opacity_weight: Weight = 0.0
    """Mean squared error of the opacity against the reference's, beside the loss of the picture."""
    mse_weight: Weight = 0.0
    """Mean squared error of the picture, in addition; where L1 is flat, as at outlines, it prefers the mean."""
    condition: bool = True
    """Whether the discriminator sees the true colours at visible input points [paper]; else an empty image and mask."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam for both networks, linear warm-up, cosine decay, average of the generator's weights."""

    lr_generator: Positive = 5e-4
    """Peak learning rate of the generator."""
    lr_discriminator: Positive = 2e-4
    """Learning rate of the discriminator."""
    beta1: Decay = 0.9
    """Adam's first moment, generator."""
    beta1_discriminator: Decay = 0.5
    """Adam's first moment, discriminator."""
    beta2: Decay = 0.999
    """Adam's second moment, both."""
    warmup_steps: Whole = 500
    """Steps of linear warm-up of the generator's learning rate."""
    final_lr_scale: Weight = 0.01
    """Learning rate of the last step relative to the peak."""
    ema_decay: Decay = 0.999
    """Decay per step of the averaged generator, which evaluation uses; ramps up from 0 in the first steps."""
    algorithm: Literal["adam", "radam"] = "adam"
    """Adam, or rectified Adam for the generator."""
    decay: Literal["cosine", "exponential"] = "cosine"
    """How the generator's learning rate falls after the warm-up."""
    clip_norm: Weight = 0.0
    """Norm to which the generator's gradient is shortened where it is longer; 0: never."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A whole training run."""

    preset: str = "abo"
    """Name of the preset this config began as; kept with the run."""
    model: NetworkConfig = field(default_factory=PaperConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    num_steps: Count = 100_000
    """Optimiser steps."""
    batch_objects: Count = 8
    """Objects per step."""
    views_per_object: Count = 1
    """Views per object and step; they share one encoded volume."""
    min_points: Count = 512
    """Fewest points drawn per object and step."""
    max_points: Count = 4096
    """Most points drawn per object and step; the padded size of the cloud."""
    test_points: Count = 1024
    """Points per object in evaluation."""
    trains: Literal["network", "refiner"] = "network"
    """What steps change: all, or the refiner alone, on pictures of the network that the run begins with (`--init`)."""
    seed: int = 0
    """Seed of weights, batches and jitter."""
    pixel_stride: Count = 1
    """Train on every n-th row and column of a view, at a random offset."""
    crop: Whole = 0
    """Pixels along each side of the square of a view that is rendered in training, at a random place; 0: all of it."""
    even_share: Share = 0.0
    """Share of the clouds that are spread evenly (farthest-point sampling), not at random: an object's first points in
    a data set of `--spread even`, farthest points of it where the network sees G-buffers."""

    def __post_init__(self) -> None:
        check(self)
        require(
            self.loss.adversarial_weight == 0 or self.model.image_resolution >= 24,
            f"image_resolution {self.model.image_resolution} is too small for the discriminator; use at "
            "least 24, or adversarial_weight 0",
        )
        require(
            self.loss.adversarial_weight == 0 or isinstance(self.model, RayNetworkConfig),
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
        require(
            self.min_points <= self.max_points,
            f"min_points {self.min_points} must not exceed max_points {self.max_points}",
        )
        refines = isinstance(self.model, NearPointsConfig) and self.model.refiner_width > 0 and self.crop > 0
        require(
            self.trains == "network" or (refines and self.loss.adversarial_weight == 0),
            "trains refiner needs a network near points with a refiner_width, a crop, and adversarial_weight 0",
        )
        if isinstance(self.model, NearPointsConfig):
            cells = surface_grid(self.max_points)
            require(
                self.model.surface_cells >= cells,
                f"model.surface_cells {self.model.surface_cells}: with max_points {self.max_points} the network would "
                f"train on a finer grid than it renders smaller clouds with; use at least {cells}",
            )
