"""NPBG as adapted by the paper: points drawn at five resolutions, and a U-Net that fills in the picture.

    cloud -> rasters of one pixel per point, at 1, 1/2, 1/4, 1/8, 1/16 of the image -> gated U-Net -> image

Neural point-based graphics (Aliev et al., 2020) learns a descriptor for every point of one scene; here a point carries
its materials, so that one network serves all objects, and a mask channel says where there is a point.  Pixels without
one hold a learnt vector.  Nothing is differentiated through the geometry.  Opacity and depth are those of the finest
raster: dots, not a surface.

Pixel (row, column) of a raster is the half-open square (column, column + 1] x (row, row + 1]; of the points that fall
into it the one with the smallest camera depth shows, and of equally deep ones the first.
"""

from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.config import (
    MATERIAL_CHANNELS,
    LossConfig,
    NetworkConfig,
    OptimizerConfig,
    TrainConfig,
    check,
)
from spnr_jax.errors import require
from spnr_jax.kernels import cameras
from spnr_jax.kernels.imaging import average_pool, resize_bilinear
from spnr_jax.kernels.numerics import per_feature
from spnr_jax.kernels.records import Camera, Key, PointCloud, Rendering
from spnr_jax.nn.convolution import conv


@dataclass(frozen=True, kw_only=True)
class NPBGConfig(NetworkConfig):
    """Sizes of NPBG; the defaults are the published ones."""

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


def published_config(size: int) -> TrainConfig:
    """The published training, for pictures of 128 (ABO) or 200 pixels (ShapeNet); meant for one GPU."""
    return TrainConfig(
        preset=f"npbg, {size} px, as published",
        model=NPBGConfig(image_resolution=size),
        loss=LossConfig(l1_weight=1.0, adversarial_weight=0.0),
        optimizer=OptimizerConfig(lr_generator=1e-4, warmup_steps=0, final_lr_scale=1.0),
        num_steps=40_000,  # 20 epochs of 16,161 objects
    )


def npbg_tiny() -> TrainConfig:
    """The same network at 64 px, learning rate 20 times as high.

    `spnr train --methods experiments.baselines --preset npbg_tiny DATA RUN`
    """
    return TrainConfig(
        preset="npbg_tiny",
        model=NPBGConfig(image_resolution=64),
        loss=LossConfig(l1_weight=1.0, adversarial_weight=0.0),
        optimizer=OptimizerConfig(lr_generator=2e-3, warmup_steps=100, ema_decay=0.995),
        num_steps=3000,
        batch_objects=4,
        max_points=1024,
    )


def visible_points(
    positions: Float[Array, "points 3"], mask: Bool[Array, " points"], camera: Camera, near: float
) -> Int[Array, "height width"]:
    """Index of the point that each pixel of the camera shows, -1 where there is none."""
    pixels, _ = cameras.project(camera, positions)
    offset = positions - camera.cam_to_world[None, :, 3]
    depth = -jnp.einsum("ni,i->n", offset, camera.cam_to_world[:, 2], precision="highest")  # from the plane of the eye
    place = jnp.ceil(pixels) - 1  # on a border between pixels the one before it: exact halves round down
    limit = per_feature(jnp.array([camera.width, camera.height], jnp.float32), place)
    drawn = mask & (depth > near) & jnp.all((place >= 0) & (place < limit), axis=-1)
    place = jnp.where(drawn[:, None], place, 0).astype(jnp.int32)
    nowhere = camera.height * camera.width
    flat = jnp.where(drawn, place[:, 1] * camera.width + place[:, 0], nowhere)
    nearest = jnp.full(nowhere + 1, jnp.inf).at[flat].min(depth)
    shown = drawn & (depth == nearest[flat])
    count = len(positions)
    index = jnp.full(nowhere + 1, count).at[jnp.where(shown, flat, nowhere)].min(jnp.arange(count))
    index = index[:nowhere].reshape(camera.height, camera.width)
    return jnp.where(index < count, index, -1)


def raster(
    cloud: PointCloud, camera: Camera, background: Float[Array, " channels"], near: float
) -> tuple[Float[Array, "height width channels+1"], Float[Array, "height width"]]:
    """Materials of the visible point and the mask at each pixel, and the point's distance (infinity without one)."""
    positions = jax.lax.stop_gradient(jnp.asarray(cloud.positions))
    index = visible_points(positions, jnp.asarray(cloud.mask), camera, near)
    seen = index >= 0
    materials = jnp.concatenate([cloud.base_color, cloud.roughness[:, None], cloud.metallic[:, None]], axis=-1)
    values = jnp.where(seen[..., None], materials[jnp.maximum(index, 0)], background[None, None])
    _, distances = cameras.project(camera, positions)
    distance = jnp.where(seen, distances[jnp.maximum(index, 0)], jnp.inf)
    return jnp.concatenate([values, seen[..., None].astype(values.dtype)], axis=-1), distance


class GatedConv(nn.Module):
    """ELU of one 3 x 3 convolution times the sigmoid of another, over reflected borders."""

    width: int

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width in"]) -> Float[Array, "batch height width {self.width}"]:
        """Same size, `width` channels; starts as the published network's convolutions do."""
        bound = (9 * x.shape[-1]) ** -0.5

        def uniform(key, shape):
            return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

        kernel = self.param("kernel", uniform, (3, 3, x.shape[-1], 2 * self.width))
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="reflect")
        both = conv(padded, kernel, padding=0)
        both = both + per_feature(self.param("bias", uniform, (2 * self.width,)), both)
        features, gate = jnp.split(both, 2, axis=-1)
        return nn.elu(features) * nn.sigmoid(gate)


def half(x: Float[Array, "batch height width c"]) -> Float[Array, "batch h w c"]:
    """Averages over squares of 2 x 2 pixels; an odd side is first made even by a bilinear resize."""
    height, width = (side // 2 for side in x.shape[1:3])
    if x.shape[1:3] != (2 * height, 2 * width):
        x = resize_bilinear(x, 2 * height, 2 * width)
    return average_pool(x, 2)


class RefinementNet(nn.Module):
    """U-Net of gated convolutions that takes in a raster at each scale."""

    encoder_widths: tuple[int, ...]
    decoder_widths: tuple[int, ...]

    @nn.compact
    def __call__(self, rasters: list[Float[Array, "batch _ _ channels"]]) -> Float[Array, "batch _ _ 3"]:
        """Image at the size of the first raster; no activation at the end."""
        x = GatedConv(self.encoder_widths[0], name="stem")(rasters[0])
        skips = []
        for i, (image, width) in enumerate(zip(rasters[1:], self.encoder_widths[1:], strict=True), start=1):
            skips.append(x)
            x = GatedConv(width - image.shape[-1], name=f"down_{i}")(half(x))
            x = jnp.concatenate([x, image], axis=-1)
        x = GatedConv(self.encoder_widths[-1], name="centre")(x)
        for i, (skip, width) in enumerate(zip(reversed(skips), self.decoder_widths, strict=True)):
            x = jnp.concatenate([resize_bilinear(x, *skip.shape[1:3]), skip], axis=-1)
            x = GatedConv(width, name=f"up_{len(skips) - i}")(x)
        return nn.Dense(3, bias_init=nn.initializers.constant(0.5), name="out")(x)


class NPBG(nn.Module):
    """Pictures from the points themselves: there is nothing to encode."""

    config: NPBGConfig

    def setup(self) -> None:
        """The network, and the materials of pixels without a point."""
        self.network = RefinementNet(self.config.encoder_widths, self.config.decoder_widths)
        self.background = self.param("background", nn.initializers.zeros, (5,))

    def encode(self, cloud: PointCloud, train: bool = False) -> PointCloud:
        """The cloud."""
        return cloud

    def render(self, cloud: PointCloud, camera: Camera) -> Rendering:
        """Views of each cloud; nothing is random."""
        scales = range(len(self.config.encoder_widths))
        rasters, distances = zip(*(self.rasters(cloud, camera, 2**i) for i in scales), strict=True)
        flat = [x.reshape(-1, *x.shape[2:]) for x in rasters]
        image = self.network(flat).reshape(*rasters[0].shape[:-1], 3)
        rays = cameras.camera_rays(camera)
        _, far, _ = cameras.intersect_box(rays.origins, rays.directions)
        seen = jnp.isfinite(distances[0])
        return Rendering(image=image, depth=jnp.where(seen, distances[0], far), acc=seen.astype(image.dtype))

    def rasters(
        self, cloud: PointCloud, camera: Camera, shrink: int
    ) -> tuple[Float[Array, "objects views h w channels"], Float[Array, "objects views h w"]]:
        """What `raster` makes of every view at 1 / shrink of the camera's size, rounded down."""
        camera = cameras.resize(camera, camera.height // shrink, camera.width // shrink)

        def view(cloud, camera):
            return raster(cloud, camera, self.background, self.config.near)

        return jax.vmap(jax.vmap(view, in_axes=(None, 0)))(cloud, camera)

    def __call__(self, cloud: PointCloud, camera: Camera, key: Key | None = None, train: bool = False) -> Rendering:
        """Views of each cloud from its cameras."""
        return self.render(self.encode(cloud, train), camera)
