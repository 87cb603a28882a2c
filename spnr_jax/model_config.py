"""The sizes of every network that the package can train, as frozen dataclasses: ours, and the baselines.

Besides its fields, a network's config says how it is trained and rendered, as class attributes:
    upsamples   whether the volume rendering is smaller than the image
    ray_chunk   rays of an object rendered at once, which bounds the memory; None renders whole images
    per_pixel   whether a pixel does not depend on its neighbours, so that a lattice of them can be trained on
    any_size    whether pictures of any size can be rendered
A network is found by its config (`inference.network`); METHODS are the names that tell the configs apart in JSON.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from spnr_jax.errors import UserError

Material = Literal["base_color", "roughness", "metallic"]
MATERIAL_CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}
CELLS = 1.0  # of the grid of nearest points along an axis, per square root of the number of points; 0.75 lost 0.1 dB
MOST_CELLS = 96
NUM_TOLD = 13  # numbers of a ray for the refiner (`nn/surface_field.told`)
MOST_LAYERS = 32  # of a PointNet: a damaged file must not cost minutes of tracing


def added(default: Any) -> Any:
    """A field that files written before it existed lack; they mean its default."""
    return field(default=default, metadata={"added": True})


def require(condition: bool, message: str) -> None:
    """ValueError with the message, unless the condition holds."""
    if not condition:
        raise UserError(message)


def surface_grid(num_points: int, least: int = 1) -> int:
    """Cells along each axis of the grid of nearest points for so many; a surface's lie in the order of its square.

    Padding counts as points: with the `least` of a training, smaller clouds see the grid that they saw there.
    """
    return min(max(round(CELLS * num_points**0.5), least, 1), MOST_CELLS)


def check_materials(materials: tuple[str, ...]) -> None:
    """ValueError unless these are distinct material channels."""
    require(
        len(set(materials)) == len(materials) and set(materials) <= set(MATERIAL_CHANNELS),
        f"materials must be distinct names out of {tuple(MATERIAL_CHANNELS)}, got {materials}",
    )


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """Samples along each ray."""

    num_coarse: int = 64
    """Stratified samples between entry into and exit from the box [paper]."""
    num_fine: int = 64
    """Samples drawn where the coarse weights are large [paper]; 0 renders the coarse samples alone."""
    padding: float = 1e-5
    """Added to each coarse weight before sampling: empty rays are sampled evenly, thin parts keep nearly all."""
    reach: int = added(0)
    """Samples lie within so many voxels of a voxel with a point, and density is 0 elsewhere; 0: all the box [paper]."""

    def __post_init__(self) -> None:
        require(self.reach >= 0, f"reach must not be negative, got {self.reach}")
        require(self.num_coarse >= 1, f"num_coarse must be at least 1, got {self.num_coarse}")
        require(self.num_fine >= 0, f"num_fine must be at least 0, got {self.num_fine}")
        require(self.padding > 0, f"padding must be positive, got {self.padding}")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Sizes of the generator."""

    ray_chunk: ClassVar[int | None] = 1024  # about 80 MB at 128 samples

    materials: tuple[Material, ...] = ("base_color", "roughness", "metallic")
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
    precision: Literal["float32", "bfloat16"] = added("float32")
    """Format of the convolutions in U-Net, upsampler and discriminator; all else, parameters too, is float32."""
    scatter: Literal["mean", "max", "trilinear"] = added("mean")
    """How the features of points meet in a voxel (`voxels.spread`)."""
    skip: Literal["add", "concat"] = added("add")
    """How the U-Net's encoder joins its decoder: added to a stage's output [paper], or as input of its convolution."""
    sees_direction: bool = added(True)
    """Whether colour and features depend on the view direction."""
    num_neighbors: int = added(0)
    """Nearest points whose planes and materials a sample sees (`surface.py`); 0: the volume's feature alone [paper]."""
    surface_cells: int = added(0)
    """Cells along each axis of the grid of nearest points, at least; the presets' is that of the training's clouds."""
    color: Literal["free", "lit"] = added("free")
    """Radiance: free RGB [paper], or predicted light on the materials of the nearest points (`nn/surface_field.py`)."""
    point_norm: Literal["batch", "layer"] = added("batch")
    """Normalisation in the PointNet: over points [paper] or over the features of one."""
    refiner_width: int = added(0)
    """Channels of the CNN that looks over the rendered picture (`nn/refiner.py`); 0: none."""

    def __post_init__(self) -> None:
        require(0 <= self.num_stages <= 16, f"num_stages must be 0 to 16, got {self.num_stages}")
        sizes = ("point_features", "num_groups", "field_width", "render_resolution", "resize_resolution")
        for name in (*sizes, "image_resolution", "upsampler_width"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        require(
            len(self.point_widths) <= MOST_LAYERS,
            f"point_widths must name at most {MOST_LAYERS} layers, got {len(self.point_widths)}",
        )
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
        if self.num_neighbors:
            features, names = (3 + NUM_TOLD, "RGB and what rays tell the refiner") if self.refiner_width else (3, "RGB")
            require(
                self.num_features == features,
                f"num_features must be {features}, {names}, for a network that sees the nearest points, got "
                f"{self.num_features}",
            )
        else:
            require(self.num_features >= 4, f"num_features must be 4 or more, RGB first, got {self.num_features}")
        check_materials(self.materials)
        require(
            self.precision in ("float32", "bfloat16"),
            f"precision must be float32 or bfloat16, got {self.precision}",
        )
        require(
            self.scatter in ("mean", "max", "trilinear"), f"scatter must be mean, max or trilinear, got {self.scatter}"
        )
        require(self.skip in ("add", "concat"), f"skip must be add or concat, got {self.skip}")
        require(
            self.sees_direction in (True, False), f"sees_direction must be true or false, got {self.sees_direction}"
        )
        require(self.color in ("free", "lit"), f"color must be free or lit, got {self.color}")
        require(self.point_norm in ("batch", "layer"), f"point_norm must be batch or layer, got {self.point_norm}")
        for name in ("num_neighbors", "surface_cells", "refiner_width"):
            require(getattr(self, name) >= 0, f"{name} must not be negative, got {getattr(self, name)}")
        require(
            self.num_neighbors > 0 or self.color == "free", "color lit needs the nearest points; use num_neighbors 6"
        )
        require(
            self.refiner_width == 0 or self.num_neighbors > 0,
            "a refiner looks over pictures rendered near the points; use num_neighbors 6, or refiner_width 0",
        )
        require(
            self.refiner_width == 0 or self.sampling.num_fine == 0,
            "a refiner looks over coarse samples; use num_fine 0",
        )
        require(
            self.num_neighbors == 0 or (not self.upsamples and self.sampling.reach == 1),
            "a network that sees the nearest points renders every pixel, near the points alone; use reach 1 and "
            f"render_resolution {self.image_resolution}, or num_neighbors 0",
        )
        require(
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

    @property
    def per_pixel(self) -> bool:
        """Whether a pixel does not depend on its neighbours: upsampler and refiner mix them."""
        return not self.upsamples and not self.refiner_width

    @property
    def any_size(self) -> bool:
        """Whether pictures of any size can be rendered: the upsampler has learnt one."""
        return not self.upsamples


@dataclass(frozen=True, kw_only=True)
class NPBGConfig:
    """Sizes of NPBG (`baselines/npbg.py`); the defaults are the published ones."""

    upsamples: ClassVar[bool] = False
    ray_chunk: ClassVar[int | None] = None
    per_pixel: ClassVar[bool] = False
    any_size: ClassVar[bool] = False

    encoder_widths: tuple[int, ...] = (16, 32, 48, 64, 80)
    """Channels at each scale, the finest first; each scale has half the pixels of the one before."""
    decoder_widths: tuple[int, ...] = (48, 24, 12, 6)
    """Channels after each step back up, the coarsest first."""
    near: float = 0.01
    """Points closer to the plane of the eye than this are not drawn."""
    image_resolution: int = 128
    """Pixels along each side of the image."""

    def __post_init__(self) -> None:
        require(
            len(self.encoder_widths) == len(self.decoder_widths) + 1 >= 2,
            f"encoder_widths must have one entry more than decoder_widths, got {self.encoder_widths} and "
            f"{self.decoder_widths}",
        )
        inputs, widths = sum(MATERIAL_CHANNELS.values()) + 1, self.encoder_widths
        require(min(widths[1:]) > inputs, f"encoder_widths must exceed the {inputs} channels of a raster, got {widths}")
        require(min(*widths, *self.decoder_widths) >= 1, f"decoder_widths must be positive, got {self.decoder_widths}")
        require(self.near > 0, f"near must be positive, got {self.near}")
        smallest = 2 ** len(self.encoder_widths)  # reflection needs two pixels at the coarsest scale
        require(
            self.image_resolution >= smallest,
            f"image_resolution {self.image_resolution} is too small for {len(self.encoder_widths)} scales; use at "
            f"least {smallest}",
        )


@dataclass(frozen=True, kw_only=True)
class PointNeRFConfig:
    """Sizes of Point-NeRF (`baselines/point_nerf.py`); the defaults are the published ones and the paper's."""

    upsamples: ClassVar[bool] = False
    per_pixel: ClassVar[bool] = True
    any_size: ClassVar[bool] = True

    radius: float = 0.1
    """Reach of a point [paper], in units of the box [-1, 1]^3 whose object has a half-diagonal of 1."""
    num_neighbors: int = 8
    """Nearest points inside the radius that a shading point sees [paper]."""
    num_candidates: int = 400
    """Even steps along each ray, of which those within reach of a point can be shaded."""
    num_samples: int = 64
    """Shading points of a ray: the first candidates within reach [paper]."""
    jitter: float = 0.3
    """How far a candidate moves in training, as a share of a step."""
    width: int = 256
    """Hidden layers of the MLPs that see a neighbour."""
    color_width: int = 128
    """Hidden layers of the MLP that sees the averaged feature and the view direction."""
    feature_frequencies: int = 3
    """Frequencies of the encoding of the materials."""
    offset_frequencies: int = 5
    """Frequencies of the encoding of the offset from neighbour to shading point."""
    direction_frequencies: int = 4
    """Frequencies of the encoding of the view direction."""
    density_scale: float = 1.0
    """Density of one unit of the network's output, per unit of the box; 1 as published, where it learns slowly."""
    image_resolution: int = 128
    """Pixels along each side of the image."""
    ray_chunk: int | None = 256
    """Rays of an object rendered at once in evaluation."""

    def __post_init__(self) -> None:
        counts = ("num_neighbors", "num_candidates", "num_samples", "width", "color_width", "image_resolution")
        for name in (*counts, "feature_frequencies", "offset_frequencies", "direction_frequencies", "ray_chunk"):
            require((getattr(self, name) or 0) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")
        require(self.radius > 0, f"radius must be positive, got {self.radius}")
        require(self.density_scale > 0, f"density_scale must be positive, got {self.density_scale}")
        require(0 <= self.jitter <= 1, f"jitter is a share of a step, got {self.jitter}")
        require(
            self.num_samples <= self.num_candidates,
            f"num_samples {self.num_samples} must not exceed num_candidates {self.num_candidates}",
        )


@dataclass(frozen=True, kw_only=True)
class Points2NeRFConfig:
    """Sizes of Points2NeRF (`baselines/points2nerf.py`); the defaults are the published ones."""

    upsamples: ClassVar[bool] = False
    per_pixel: ClassVar[bool] = True
    any_size: ClassVar[bool] = True

    mode: Literal["faithful", "fixed"] = "faithful"
    """The published code's arithmetic, or that of a variational autoencoder over finite intervals."""
    initialization: Literal["published", "scaled"] = "published"
    """How the weights start: as published, or scaled so that signals keep their size on the way to the picture."""
    kl_weight: float = 1.0
    """Weight of the KL term, a sum over the code, beside the mean squared error of a pixel."""
    materials: tuple[Material, ...] = ("base_color",)
    """Material channels that the points carry into the encoder."""
    point_widths: tuple[int, ...] = (64, 128, 256, 512, 512)
    """Layers of the MLP that sees each point."""
    hidden_width: int = 512
    """Hidden layer after the maximum over the points."""
    code_size: int = 4096
    """Numbers in an object's code."""
    hypernetwork_widths: tuple[int, ...] = (4096, 8192)
    """Hidden layers of the hypernetwork."""
    chunk_size: int = 16384
    """Weights that the hypernetwork writes at once."""
    chunk_embedding: int = 8
    """Numbers that tell the hypernetwork which chunk it writes."""
    frequencies: int = 10
    """Frequencies of the encoding of a position in the NeRF."""
    nerf_width: int = 256
    """Hidden layers of the NeRF."""
    nerf_depth: int = 8
    """Hidden layers of the NeRF after its first one, and after the encoded position joins again, together."""
    num_samples: int = 256
    """Stratified samples along each ray."""
    image_resolution: int = 128
    """Pixels along each side of the image."""
    ray_chunk: int | None = 1024
    """Rays of an object rendered at once in evaluation."""

    def __post_init__(self) -> None:
        check_materials(self.materials)
        require(self.mode in ("faithful", "fixed"), f"mode must be faithful or fixed, got {self.mode}")
        require(
            self.initialization in ("published", "scaled"),
            f"initialization must be published or scaled, got {self.initialization}",
        )
        require(self.kl_weight >= 0, f"kl_weight must not be negative, got {self.kl_weight}")
        require(
            self.nerf_depth >= 2 and self.nerf_depth % 2 == 0,
            f"nerf_depth must be even and at least 2, got {self.nerf_depth}",
        )
        require(self.frequencies >= 0, f"frequencies must not be negative, got {self.frequencies}")
        for name in ("hidden_width", "code_size", "chunk_size", "chunk_embedding", "nerf_width", "num_samples"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class SurfelConfig:
    """Our network over the G-buffer of surfels (`method/surfel_renderer.py`)."""

    image_resolution: int = 512
    """Pixels along each side of a picture where no other size is asked for."""
    widths: tuple[int, ...] = (24, 48, 96, 160)
    """Features of the U-Net's levels, at the resolution of the points first."""
    top: int = 24
    """Features of the blocks that double the resolution."""

    ray_chunk: ClassVar[int | None] = None
    upsamples: ClassVar[bool] = False
    per_pixel: ClassVar[bool] = False
    any_size: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require(self.image_resolution >= 1, f"image_resolution must be at least 1, got {self.image_resolution}")
        require(len(self.widths) > 0 and min(self.widths) >= 1, f"widths must be positive, got {self.widths}")
        require(self.top >= 1, f"top must be at least 1, got {self.top}")


NetworkConfig = ModelConfig | SurfelConfig | NPBGConfig | PointNeRFConfig | Points2NeRFConfig
METHODS: dict[str, type[NetworkConfig]] = {
    "ours": ModelConfig,
    "surfels": SurfelConfig,
    "npbg": NPBGConfig,
    "point_nerf": PointNeRFConfig,
    "points2nerf": Points2NeRFConfig,
}


def kind_of(config: NetworkConfig) -> str:
    """What a network is, for tables: `surfels`, `near_points`, `paper` (a volume and rays alone), or a baseline."""
    if isinstance(config, ModelConfig):
        return "near_points" if config.num_neighbors else "paper"
    return next(name for name, kind in METHODS.items() if isinstance(config, kind))
