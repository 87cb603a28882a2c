"""The sizes of the baselines, as frozen dataclasses; the defaults are the published ones."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from spnr_jax.config import MATERIAL_CHANNELS, Material, NetworkConfig, check
from spnr_jax.errors import require


@dataclass(frozen=True, kw_only=True)
class NPBGConfig(NetworkConfig):
    """Sizes of NPBG (`baselines/npbg.py`); the defaults are the published ones."""

    method: ClassVar[str] = "npbg"

    encoder_widths: tuple[int, ...] = (16, 32, 48, 64, 80)
    """Channels at each scale, the finest first; each scale has half the pixels of the one before."""
    decoder_widths: tuple[int, ...] = (48, 24, 12, 6)
    """Channels after each step back up, the coarsest first."""
    near: float = 0.01
    """Points closer to the plane of the eye than this are not drawn."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, positive=("encoder_widths", "decoder_widths", "near"))
        require(
            len(self.encoder_widths) == len(self.decoder_widths) + 1 >= 2,
            f"encoder_widths must have one entry more than decoder_widths, got {self.encoder_widths} and "
            f"{self.decoder_widths}",
        )
        inputs, widths = sum(MATERIAL_CHANNELS.values()) + 1, self.encoder_widths
        require(min(widths[1:]) > inputs, f"encoder_widths must exceed the {inputs} channels of a raster, got {widths}")
        smallest = 2 ** len(self.encoder_widths)  # reflection needs two pixels at the coarsest scale
        require(
            self.image_resolution >= smallest,
            f"image_resolution {self.image_resolution} is too small for {len(self.encoder_widths)} scales; use at "
            f"least {smallest}",
        )

    @property
    def any_size(self) -> bool:
        """It sees all pixels at once, of one size."""
        return False


@dataclass(frozen=True, kw_only=True)
class PointNeRFConfig(NetworkConfig):
    """Sizes of Point-NeRF (`baselines/point_nerf.py`); the defaults are the published ones and the paper's."""

    method: ClassVar[str] = "point_nerf"

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
    ray_chunk: int = 256
    """Rays of an object rendered at once in evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = "num_neighbors", "num_candidates", "num_samples", "width", "color_width", "ray_chunk"
        check(self, positive=(*counts, "radius", "density_scale"), shares=("jitter",))
        require(
            self.num_samples <= self.num_candidates,
            f"num_samples {self.num_samples} must not exceed num_candidates {self.num_candidates}",
        )

    @property
    def per_pixel(self) -> bool:
        """Every ray is rendered by itself."""
        return True


@dataclass(frozen=True, kw_only=True)
class Points2NeRFConfig(NetworkConfig):
    """Sizes of Points2NeRF (`baselines/points2nerf.py`); the defaults are the published ones."""

    method: ClassVar[str] = "points2nerf"

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
    ray_chunk: int = 1024
    """Rays of an object rendered at once in evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = "hidden_width", "code_size", "chunk_size", "chunk_embedding", "nerf_width", "num_samples", "ray_chunk"
        check(self, positive=(*counts, "point_widths", "hypernetwork_widths"))
        require(len(set(self.materials)) == len(self.materials), f"materials must be distinct, got {self.materials}")
        require(
            self.nerf_depth >= 2 and self.nerf_depth % 2 == 0,
            f"nerf_depth must be even and at least 2, got {self.nerf_depth}",
        )

    @property
    def per_pixel(self) -> bool:
        """Every ray is rendered by itself."""
        return True


SIZES: dict[str, type[NetworkConfig]] = {kind.method: kind for kind in (NPBGConfig, PointNeRFConfig, Points2NeRFConfig)}
