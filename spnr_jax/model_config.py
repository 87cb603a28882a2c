"""The sizes of the package's networks, as frozen dataclasses, and how a render is asked for.

    EncoderConfig      points to a volume, which both networks of rays begin with
    PaperConfig        the paper's network             method/paper_network.py
    NearPointsConfig   the network near points         method/near_points.py
    SurfelConfig       the network over surfels        method/surfel_renderer.py

What a number or a word may be stands in its type (`Limit`, Literal) and is looked at in one place, `check`.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

from spnr_jax.errors import UserError, require

Material = Literal["base_color", "roughness", "metallic"]
MATERIAL_CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}
CELLS = 1.0  # of the grid of nearest points along an axis, per square root of the number of points; 0.75 lost 0.1 dB
MOST_CELLS = 96
MOST_LAYERS = 32  # of a network: a damaged file must not cost minutes of tracing
LARGEST = 2**63  # of any number in a config


@dataclass(frozen=True)
class Limit:
    """What a value must be, besides its type: in words, and as a test."""

    words: str
    holds: Callable[[Any], bool]


Count = Annotated[int, Limit("at least 1", lambda x: x >= 1)]
Whole = Annotated[int, Limit("at least 0", lambda x: x >= 0)]
Stages = Annotated[int, Limit("0 to 16", lambda x: 0 <= x <= 16)]
Weight = Annotated[float, Limit("at least 0", lambda x: x >= 0)]
Positive = Annotated[float, Limit("positive", lambda x: x > 0)]
Share = Annotated[float, Limit("a share, 0 to 1", lambda x: 0 <= x <= 1)]
Decay = Annotated[float, Limit("in [0, 1)", lambda x: 0 <= x < 1)]
Widths = Annotated[tuple[Count, ...], Limit(f"at most {MOST_LAYERS} layers", lambda x: len(x) <= MOST_LAYERS)]
Materials = Annotated[
    tuple[Material, ...], Limit(f"distinct names out of {tuple(MATERIAL_CHANNELS)}", lambda x: len(set(x)) == len(x))
]


def check(record: Any) -> None:
    """ValueError for the first field that its type does not allow, with what came and what is possible."""
    kind_of_record: Any = type(record)
    for name, kind in hints(kind_of_record).items():
        value = getattr(record, name)
        if expected := mismatch(value, kind):
            raise UserError(f"{name} must be {expected}, got {value}")


@cache
def hints(kind: Any) -> dict[str, Any]:
    """Types of a config's fields, with their limits."""
    known = get_type_hints(kind, include_extras=True)
    return {f.name: known[f.name] for f in dataclasses.fields(kind)}


def mismatch(value: Any, kind: Any) -> str:
    """What a value should have been by its type; nothing if it is that.  A whole number will do for a float."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Annotated:
        base, *limits = inside
        return mismatch(value, base) or next((limit.words for limit in limits if not limit.holds(value)), "")
    if origin is Literal:
        return "" if isinstance(value, str) and value in inside else " or ".join([", ".join(inside[:-1]), inside[-1]])
    if origin is tuple:
        if not isinstance(value, tuple):
            return "several values"
        return next(filter(None, (mismatch(x, inside[0]) for x in value)), "")
    if kind is bool:
        return "" if isinstance(value, bool) else "true or false"
    if kind in (int, float):
        fits = isinstance(value, int | kind) and not isinstance(value, bool) and abs(value) < LARGEST
        return "" if fits else {int: "a whole number", float: "a number"}[kind]
    return "" if isinstance(value, kind) else f"of the type {kind.__name__}"


def surface_grid(num_points: int, least: int = 1) -> int:
    """Cells along each axis of the grid of nearest points for so many; a surface's lie in the order of its square.

    Padding counts as points: with the `least` of a training, smaller clouds see the grid that they saw there.
    """
    return min(max(round(CELLS * num_points**0.5), least, 1), MOST_CELLS)


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Samples along each ray."""

    num_coarse: Count = 64
    """Stratified samples between entry into and exit from the box [paper]."""
    num_fine: Whole = 64
    """Samples drawn where the coarse weights are large [paper]; 0 renders the coarse samples alone."""
    padding: Positive = 1e-5
    """Added to each coarse weight before sampling: empty rays are sampled evenly, thin parts keep nearly all."""
    reach: Whole = 0
    """Samples lie within so many voxels of a voxel with a point, and density is 0 elsewhere; 0: all the box [paper]."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How a network of rays is asked for pictures; its sizes and weights stay what they are."""

    sampling: SamplingConfig | None = None
    """Samples of a ray; None: those of the training."""
    rays_per_side: int = 1
    """Rays along each side of a pixel, averaged."""
    refine: bool = True
    """Whether a network that has a refiner uses it."""
    block: int | None = None
    """Rays rendered at once, which bounds the memory; None: as many as suit a picture of the network."""


AS_TRAINED = RenderOptions()


@dataclass(frozen=True, kw_only=True)
class EncoderConfig:
    """Sizes of PointNet and 3D U-Net, which make a volume of points (`nn/encoder.py`)."""

    materials: Materials = ("base_color", "roughness", "metallic")
    """Material channels that the points carry into the network."""
    inputs: Literal["plain", "spread"] = "plain"
    """Materials as they are, or spread: sRGB as brightness and hue, each channel around 0 with a spread near 1."""
    point_widths: Widths = (64, 128, 256)
    """Hidden layers of the PointNet [paper]."""
    point_features: Count = 32
    """Features of a point after the PointNet."""
    point_norm: Literal["batch", "layer"] = "batch"
    """Normalisation in the PointNet: batch norm over the points [paper], or layer norm of each point."""
    scatter: Literal["mean", "max", "trilinear"] = "mean"
    """How the features of points meet in a voxel (`voxels.spread`)."""
    volume_resolution: Whole = 64
    """Voxels along each axis of the box [-1, 1]^3; a multiple of 2 ** num_stages."""
    base_width: Whole = 16
    """Channels of the volume at full resolution; doubled by each encoder stage [paper]."""
    num_stages: Stages = 5
    """Encoder stages of the 3D U-Net; each halves the resolution (5: 1/32) [paper]."""
    num_groups: Count = 8
    """Groups of each GroupNorm in U-Net and discriminator."""
    skip: Literal["add", "concat"] = "add"
    """How the U-Net's encoder joins its decoder: added to a stage's output [paper], or as input of its convolution."""

    def __post_init__(self) -> None:
        check(self)
        step = 2**self.num_stages
        require(
            self.volume_resolution % step == 0 and self.volume_resolution > 0,
            f"volume_resolution {self.volume_resolution} cannot be halved {self.num_stages} times; use a multiple of "
            f"{step} or fewer num_stages",
        )
        require(
            self.base_width % self.num_groups == 0 and self.base_width > 0,
            f"base_width {self.base_width} must be a positive multiple of num_groups {self.num_groups}",
        )


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """What training and rendering ask of the sizes of any network."""

    method: ClassVar[str] = "none"
    """What the network is, for files and tables."""

    image_resolution: Count = 128
    """Pixels along each side of the pictures of the training."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def upsamples(self) -> bool:
        """Whether what is rendered along rays is smaller than the image."""
        return False

    @property
    def per_pixel(self) -> bool:
        """Whether a pixel does not depend on its neighbours, so that a lattice of them can be trained on."""
        return False

    @property
    def any_size(self) -> bool:
        """Whether pictures of any size can be rendered: an upsampler has learnt one."""
        return not self.upsamples


@dataclass(frozen=True, kw_only=True)
class RayNetworkConfig(NetworkConfig):
    """What both networks of rays have: an encoder, samples along rays, a field."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    field_width: Count = 64
    """Hidden layer of the radiance field."""
    direction_frequencies: Whole = 4
    """Frequencies of the view direction's encoding; 0 gives the field the bare direction."""
    sees_direction: bool = True
    """Whether colour and features depend on the view direction."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Format of the convolutions in U-Net, refiner, upsampler, discriminator; all else, parameters too, is float32."""

    @property
    def bf16(self) -> bool:
        """Whether the convolutions run in bfloat16."""
        return self.precision == "bfloat16"


@dataclass(frozen=True, kw_only=True)
class PaperConfig(RayNetworkConfig):
    """Sizes of the paper's network."""

    method: ClassVar[str] = "paper"

    num_features: Annotated[int, Limit("4 or more, RGB first", lambda x: x >= 4)] = 32
    """Channels of the rendered feature image; the first three are RGB."""
    render_resolution: Count = 64
    """Rays along each side of the volume-rendered image [paper]."""
    resize_resolution: Count = 64
    """Bilinear resize of the feature image before the upsampler (64 to 100 for ShapeNet [paper])."""
    upsampler_width: Count = 64
    """Channels of the upsampler before its x2; half of it after."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.image_resolution in (self.render_resolution, 2 * self.resize_resolution),
            f"image_resolution {self.image_resolution} must be render_resolution ({self.render_resolution}: no "
            f"upsampler) or twice resize_resolution ({2 * self.resize_resolution})",
        )

    @property
    def upsamples(self) -> bool:
        """Whether the graph contains the upsampler."""
        return self.image_resolution != self.render_resolution

    @property
    def per_pixel(self) -> bool:
        """The upsampler mixes pixels."""
        return not self.upsamples


@dataclass(frozen=True, kw_only=True)
class NearPointsConfig(RayNetworkConfig):
    """Sizes of the network near points: a ray a pixel, samples near the points alone."""

    method: ClassVar[str] = "near_points"

    encoder: EncoderConfig = field(default_factory=lambda: EncoderConfig(point_norm="layer"))
    sampling: SamplingConfig = field(default_factory=lambda: SamplingConfig(num_coarse=32, num_fine=0, reach=1))
    num_neighbors: Count = 6
    """Nearest points whose planes and materials a sample sees (`kernels/surface.py`)."""
    surface_cells: Whole = 0
    """Lowest resolution of the grid of nearest points; presets set it so that small clouds get the grid of training."""
    color: Literal["free", "lit"] = "lit"
    """Radiance: free RGB, or predicted light on the materials of the nearest points (`nn/surface_field.py`)."""
    refiner_width: Whole = 0
    """Channels of the 2D CNN that refines the rendered picture (`nn/refiner.py`); 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.sampling.reach == 1, f"reach {self.sampling.reach}: nothing is known far from points; use reach 1")

    @property
    def per_pixel(self) -> bool:
        """A refiner mixes pixels."""
        return not self.refiner_width


SOLID = NearPointsConfig(
    encoder=EncoderConfig(volume_resolution=32, base_width=8, num_stages=3, num_groups=1, point_norm="layer"),
    sampling=SamplingConfig(num_coarse=16, num_fine=0, reach=1),
    surface_cells=surface_grid(2048),
    refiner_width=32,
)
"""Sizes of the package's network `small`."""


@dataclass(frozen=True, kw_only=True)
class SurfelConfig(NetworkConfig):
    """Our network over the G-buffer of surfels (`method/surfel_renderer.py`)."""

    method: ClassVar[str] = "surfels"

    image_resolution: Count = 512
    """Pixels along each side of a picture where no other size is asked for."""
    widths: Annotated[Widths, Limit("at least one", lambda x: len(x) > 0)] = (24, 48, 96, 160)
    """Features of the U-Net's levels, at the resolution of the points first."""
    top: Count = 24
    """Features of the blocks that double the resolution."""
    solid: bool = False
    """Whether the network of rays `SOLID` tells where an object of few points is solid (`method/solid.py`)."""
