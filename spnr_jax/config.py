"""All numbers of networks, training and rendering, as frozen dataclasses; `presets.py` holds whole training configs.

Configs are hashable, so they can be static arguments of jit.  All numbers are finite and at least 0.  A wrong value
raises ValueError when the config is made; the message names the field and the value.  Values marked [paper] are in the
paper's supplement; the others are our choice.
"""

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, Literal, get_args, get_origin, get_type_hints

from spnr_jax.errors import UserError, require

Quality = Literal["draft", "balanced", "best", "trained"]
Material = Literal["base_color", "roughness", "metallic"]
MATERIAL_CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}
MOST_LAYERS, MOST_STAGES = 32, 16  # of a network: a damaged file must not cost minutes of tracing
MOST_PIXELS = 2**14  # along a side of a picture
LARGEST = 2**63  # of any number in a config
LEAST_CROP = 16  # pixels along a side: smaller crops of G-buffers have no pixels within their margins


def check(config: Any, positive: Collection[str] = (), shares: Collection[str] = ()) -> None:
    """ValueError for the first field that has the wrong type, is 0 but must be positive, or is a share above 1."""
    of: Any = type(config)
    for name, kind in types_of(of).items():
        value = getattr(config, name)
        words = mismatch(value, kind, name in positive)
        if not words and name in shares and value > 1:
            words = "a share, 0 to 1"
        require(not words, f"{name} must be {words}, got {value}")


@cache
def types_of(kind: Any) -> dict[str, Any]:
    """The type of each field of a config."""
    known = get_type_hints(kind)
    return {f.name: known[f.name] for f in dataclasses.fields(kind)}


def mismatch(value: Any, kind: Any, positive: bool = False) -> str:
    """What the value should have been, by its type; empty if it fits.  An integer fits a float, 0 unless `positive`."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "" if isinstance(value, str) and value in inside else " or ".join([", ".join(inside[:-1]), inside[-1]])
    if origin is tuple:
        if not isinstance(value, tuple):
            return "several values"
        return next(filter(None, (mismatch(x, inside[0], positive) for x in value)), "")
    if kind in (int, float):
        fits = isinstance(value, int | kind) and not isinstance(value, bool) and 0 <= value < LARGEST
        what = "a whole number" if kind is int else "a number"
        return "" if fits and (value or not positive) else f"{what}, {'above' if positive else 'at least'} 0"
    return "" if isinstance(value, kind) else "true or false" if kind is bool else f"of the type {kind.__name__}"


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Samples along each ray."""

    num_coarse: int = 64
    """Stratified samples between entry into and exit from the box [paper]."""
    num_fine: int = 64
    """Samples drawn where the coarse weights are large [paper]; 0: coarse samples only."""
    padding: float = 1e-5
    """Added to each coarse weight: empty rays are sampled evenly, thin parts keep nearly all samples."""
    reach: int = 0
    """Samples lie within this many voxels of a voxel with a point; density is 0 elsewhere.  0: whole box [paper]."""

    def __post_init__(self) -> None:
        check(self, positive=("num_coarse", "padding"))


@dataclass(frozen=True, kw_only=True)
class EncoderConfig:
    """Sizes of PointNet and 3D U-Net, which encode points to a volume (`nn/paper_layers.py`)."""

    materials: tuple[Material, ...] = ("base_color", "roughness", "metallic")
    """Material channels of the points that the network receives."""
    inputs: Literal["plain", "spread"] = "plain"
    """Materials unchanged, or "spread": sRGB as brightness and hue, each channel centred at 0 with a spread near 1."""
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

    def __post_init__(self) -> None:
        positive = "point_widths", "point_features", "num_groups", "volume_resolution", "base_width"
        check(self, positive)
        require(len(self.point_widths) <= MOST_LAYERS, f"point_widths: at most {MOST_LAYERS}, got {self.point_widths}")
        require(len(set(self.materials)) == len(self.materials), f"materials must be distinct, got {self.materials}")
        require(self.num_stages <= MOST_STAGES, f"num_stages must be at most {MOST_STAGES}, got {self.num_stages}")
        step = 2**self.num_stages
        require(
            self.volume_resolution % step == 0,
            f"volume_resolution {self.volume_resolution} cannot be halved {self.num_stages} times; use a multiple of "
            f"{step} or fewer num_stages",
        )
        require(
            self.base_width % self.num_groups == 0,
            f"base_width {self.base_width} must be a multiple of num_groups {self.num_groups}",
        )


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Sizes that all networks have."""

    method: ClassVar[str] = "none"
    """Name of the method, for files and tables."""
    has_discriminator: ClassVar[bool] = False
    """Whether its loss may be adversarial."""
    crops: ClassVar[bool] = False
    """Whether it is trained on crops of views."""

    image_resolution: int = 128
    """Pixels along each side of a training picture."""

    def __post_init__(self) -> None:
        check(self, positive=("image_resolution",))

    @property
    def upsamples(self) -> bool:
        """Whether the volume rendering is smaller than the image."""
        return False

    @property
    def any_size(self) -> bool:
        """Whether it can render pictures of any size; an upsampler has learnt one size."""
        return not self.upsamples


@dataclass(frozen=True, kw_only=True)
class PaperConfig(NetworkConfig):
    """Sizes of the paper's network (`method/paper_method.py`): encoder, sampling, field, upsampler."""

    method: ClassVar[str] = "paper"
    has_discriminator: ClassVar[bool] = True

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    field_width: int = 64
    """Hidden layer of the radiance field."""
    direction_frequencies: int = 4
    """Frequencies of the view direction's encoding; 0 passes the direction itself."""
    sees_direction: bool = True
    """Whether colour and features depend on the view direction."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the convolutions in U-Net, upsampler, discriminator; all else, parameters included, is float32."""
    num_features: int = 32
    """Channels of the rendered feature image; the first three are RGB."""
    render_resolution: int = 64
    """Rays along each side of the volume-rendered image [paper]."""
    resize_resolution: int = 64
    """Bilinear resize of the feature image before the upsampler (64 to 100 for ShapeNet [paper])."""
    upsampler_width: int = 64
    """Channels of the upsampler before its x2; half of it after."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, positive=("field_width", "render_resolution", "resize_resolution", "upsampler_width"))
        require(self.num_features >= 4, f"num_features must be 4 or more, RGB first, got {self.num_features}")
        require(
            self.image_resolution in (self.render_resolution, 2 * self.resize_resolution),
            f"image_resolution {self.image_resolution} must be render_resolution ({self.render_resolution}: no "
            f"upsampler) or twice resize_resolution ({2 * self.resize_resolution})",
        )

    @property
    def bf16(self) -> bool:
        """Whether the convolutions run in bfloat16."""
        return self.precision == "bfloat16"

    @property
    def upsamples(self) -> bool:
        """Whether the graph contains the upsampler."""
        return self.image_resolution != self.render_resolution


@dataclass(frozen=True, kw_only=True)
class SurfelConfig(NetworkConfig):
    """Sizes of our surfel network (`method/surfel_method.py`)."""

    method: ClassVar[str] = "surfels"
    crops: ClassVar[bool] = True

    image_resolution: int = 512
    """Pixels along each side of a picture, by default."""
    widths: tuple[int, ...] = (24, 48, 96, 160, 256)
    """Features of the U-Net's levels, from the G-buffer's resolution downwards."""
    top: int = 24
    """Features of the blocks that double the resolution."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, positive=("widths", "top"))
        require(0 < len(self.widths) <= MOST_LAYERS, f"widths: 1 to {MOST_LAYERS} levels, got {self.widths}")


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
    opacity_l1_weight: float = 0.0
    """L1 between the opacity and the reference's."""
    opacity_weight: float = 0.0
    """Mean squared error between the opacity and the reference's, added to the loss of the image."""
    mse_weight: float = 0.0
    """Mean squared error of the image, added; where L1 is flat, as at outlines, it prefers the mean."""
    condition: bool = True
    """Whether the discriminator gets the true colours at visible input points [paper]; else an empty image and mask."""

    def __post_init__(self) -> None:
        check(self, positive=("r1_interval", "discriminator_width"), shares=("adversarial_start",))


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Adam for both networks, linear warm-up, cosine decay, moving average of the generator's weights."""

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
    """Decay per step of the averaged weights that evaluation uses; ramps up from 0.1 in the first steps."""
    algorithm: Literal["adam", "radam"] = "adam"
    """Adam, or rectified Adam for the generator."""
    decay: Literal["cosine", "exponential"] = "cosine"
    """How the generator's learning rate falls after the warm-up."""
    clip_norm: float = 0.0
    """Largest norm of the generator's gradient; longer gradients are scaled down.  0: no limit."""

    def __post_init__(self) -> None:
        decays = "beta1", "beta1_discriminator", "beta2", "ema_decay"
        check(self, positive=("lr_generator", "lr_discriminator"), shares=decays)
        for name in decays:
            require(getattr(self, name) < 1, f"{name} must be below 1, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A whole training run."""

    preset: str = "abo"
    """Preset that this config started from; stored with the run."""
    model: NetworkConfig = field(default_factory=PaperConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    num_steps: int = 100_000
    """Optimiser steps."""
    batch_objects: int = 8
    """Objects per step; surfels: crops per step."""
    views_per_object: int = 1
    """Views per object and step, which share one encoding; surfels: stored views of a cloud."""
    min_points: int = 512
    """Fewest points of a cloud in a training step."""
    max_points: int = 4096
    """Most points of a cloud in a training step; except for surfels, clouds are padded to it."""
    test_points: int = 1024
    """Points per object in evaluation."""
    seed: int = 0
    """Seed of weights, batches and jitter."""
    crop: int = 0
    """Surfels: pixels along each side of the random crops of G-buffers that the shader trains on.  Others: 0."""
    even_share: float = 0.0
    """Share of the training clouds that are farthest-point sampled instead of random.  Surfels: sampled here.  Other
    networks: the first points of an object, which are even in a data set made with `--spread even`."""

    def __post_init__(self) -> None:
        counts = "num_steps", "batch_objects", "views_per_object", "min_points", "max_points", "test_points"
        check(self, positive=counts, shares=("even_share",))
        require(
            self.loss.adversarial_weight == 0 or self.model.image_resolution >= 24,
            f"image_resolution {self.model.image_resolution} is too small for the discriminator; use at "
            "least 24, or adversarial_weight 0",
        )
        require(
            self.loss.adversarial_weight == 0 or self.model.has_discriminator,
            f"adversarial_weight {self.loss.adversarial_weight}: {self.model.method} has no discriminator; use 0",
        )
        if self.model.crops:
            require(
                LEAST_CROP <= self.crop <= self.model.image_resolution,
                f"crop {self.crop}: {self.model.method} is trained on squares of {LEAST_CROP} to "
                f"{self.model.image_resolution} pixels (its image_resolution)",
            )
        else:
            require(self.crop == 0, f"crop {self.crop}: {self.model.method} is trained on whole views; use 0")
        require(
            self.min_points <= self.max_points,
            f"min_points {self.min_points} must not exceed max_points {self.max_points}",
        )


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Intervals of logging, previews and checkpoints, in steps."""

    log_every: int = 20
    """Steps between rows of metrics.jsonl and TensorBoard."""
    preview_every: int = 500
    """Steps between preview images with validation scores."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        check(self, positive=("log_every", "preview_every", "checkpoint_every"))


@dataclass(frozen=True, kw_only=True)
class Cut:
    """One object of a scene: inside a box, without the dominant plane, one cluster of points, applied in this order."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """Keep only points in this box: xmin ymin zmin xmax ymax zmax, in the file's own units and axes."""
    remove_plane: bool = False
    """Remove the plane that holds most of the surface: floor, table or wall."""
    object: str | None = None
    """Keep only one cluster of points, after the plane is removed: `largest`, or 2 for the second largest, etc."""

    keep_noise: bool = False
    """Keep also points of LAS class 7 or 18 (noise), withheld points, and points with opacity near 0."""

    @property
    def is_given(self) -> bool:
        """Whether anything is cut."""
        return bool(self.crop or self.remove_plane or self.object)

    @property
    def nth(self) -> int | None:
        """Rank of the cluster, 1 for the largest; None: all clusters."""
        return None if self.object is None else 1 if self.object == "largest" else int(self.object)

    def __post_init__(self) -> None:
        """ValueError that names the invalid option."""
        if self.object not in (None, "largest") and not (self.object.isdecimal() and int(self.object) > 0):
            raise UserError(f"--object must be largest or a number from 1, got {self.object!r}")
        if self.crop is None:
            return
        box = tuple(self.crop)
        if len(box) != 6 or not all(map(math.isfinite, box)) or any(a > b for a, b in zip(box, box[3:], strict=False)):
            raise UserError(f"--crop takes xmin ymin zmin xmax ymax zmax, each min up to its max, got {box}")
