"""The layers of the paper's network: PointNet, scatter, 3D U-Net, field, upsampler, discriminator [paper].

encoder         PointNet on every point, mean per voxel, 3D U-Net
U-Net           each encoder stage (a stride-2 convolution and one at stride 1) halves the resolution and doubles the
                channels, a decoder stage is nearest x2 and a convolution; skip connections are additions [paper].
                GroupNorm and ReLU follow each convolution; none is transposed.  With bf16 the convolutions after the
                stem run in bfloat16; the stem's scattered sums, normalisation and parameters stay float32
field           density and colour at a place from the volume's feature there: one hidden layer with softplus, density =
                softplus(raw - 1) (a ReLU can die early in training); features depend on the view direction.  All
                features but RGB are linear in the hidden layer, and so is compositing: the hidden layer is composited,
                and `decode` applies the linear part once per ray instead of once per sample
upsampler       feature image to an image of twice the size; it learns what to add to the bilinear RGB
discriminator   PatchGAN on image patches and the true colours at the visible input points
"""

from functools import partial
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spnr_jax.config import EncoderConfig
from spnr_jax.kernels import voxels
from spnr_jax.kernels.imaging import WHITE, linear_to_srgb, resize_bilinear
from spnr_jax.kernels.numerics import per_feature, softplus
from spnr_jax.kernels.records import PointCloud
from spnr_jax.kernels.voxels import scatter_conv
from spnr_jax.nn.convolution import BatchNorm, GroupNorm, conv, kernel_init, upsample_conv

# --- encoding ---------------------------------------------------------------------------------------------------------


def encode_direction(
    directions: Float[Array, "*batch channels"], num_frequencies: int
) -> Float[Array, "*batch encoding"]:
    """[d, sin(d), cos(d), sin(2 d), cos(2 d), ...] of unit directions or other numbers up to 1."""
    return jnp.concatenate([directions, *waves(directions, num_frequencies)], axis=-1)


def waves(x: Float[Array, "*batch channels"], num_frequencies: int) -> list[Float[Array, "*batch channels"]]:
    """[sin(x), cos(x), sin(2 x), cos(2 x), ...]."""
    return [of(x * 2**k) for k in range(num_frequencies) for of in (jnp.sin, jnp.cos)]


# --- PointNet and scatter ---------------------------------------------------------------------------------------------


# columns: mean of R, G, B; green to red; blue to yellow; about the inverse of their spread over the training's points
BRIGHTNESS_AND_HUE = np.array(
    [[4 / 3] * 3, np.array([10, -10, 0]) / 2**0.5, np.array([10, 10, -20]) / 6**0.5], np.float32
).T


class PointNet(nn.Module):
    """Shared MLP; each hidden layer is followed by batch normalisation [paper] and ReLU, the output is linear."""

    widths: tuple[int, ...]
    num_features: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch points channels"], mask: Bool[Array, "*batch points"], train: bool
    ) -> Float[Array, "*batch points features"]:
        """Features of every point; masked points do not affect the statistics of a batch."""
        # one long axis of points: XLA's CPU gradient of a product that sums over several axes takes four times as long
        shape, x, mask = mask.shape, x.reshape(-1, x.shape[-1]), mask.reshape(-1)
        for i, width in enumerate(self.widths):
            x = nn.Dense(width, use_bias=False, name=f"hidden_{i}")(x)
            x = nn.relu(BatchNorm(name=f"norm_{i}")(x, mask, train))
        return nn.Dense(self.num_features, name="out")(x).reshape(*shape, self.num_features)


def whiten_materials(material: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
    """A material in [0, 1], centred at 0; base colours (linear RGB) become sRGB brightness and two axes of hue.

    Unchanged, hues are a twentieth of the variance between points, and a stem with few channels learns to drop them.
    """
    if material.shape[-1] == 1:
        return 2 * material - 1
    return jnp.matmul(linear_to_srgb(material) - 0.5, jnp.asarray(BRIGHTNESS_AND_HUE), precision="highest")


class Encoder(nn.Module):
    """PointNet, scatter and 3D U-Net; with bf16, the convolutions of the U-Net run in bfloat16."""

    config: EncoderConfig
    bf16: bool = False

    def setup(self) -> None:
        """The two networks."""
        c = self.config
        self.pointnet = PointNet(c.point_widths, c.point_features)
        self.unet = UNet3D(c.volume_resolution, c.base_width, c.num_stages, c.num_groups, self.bf16)

    def __call__(self, cloud: PointCloud, train: bool = False) -> Float[Array, "objects d d d features"]:
        """Feature volume of each object, (z, y, x)."""
        positions, mask = jnp.asarray(cloud.positions), jnp.asarray(cloud.mask)
        contribute = partial(voxels.mean_contributions, resolution=self.config.volume_resolution)
        return self.unet(*jax.vmap(contribute)(positions, self.point_features(cloud, train), mask))

    def point_features(self, cloud: PointCloud, train: bool = False) -> Float[Array, "objects points features"]:
        """Features of each point from the PointNet."""
        return self.pointnet(self.point_inputs(cloud), jnp.asarray(cloud.mask), train)

    def point_inputs(self, cloud: PointCloud) -> Float[Array, "objects points channels"]:
        """Position, offset from the centre of the own voxel, and the materials that the network is built for."""
        _, offset = voxels.locate(jnp.asarray(cloud.positions), self.config.volume_resolution)
        materials = [getattr(cloud, name) for name in self.config.materials]
        materials = [m[..., None] if m.ndim < cloud.positions.ndim else m for m in materials]
        if self.config.inputs == "spread":
            materials = [whiten_materials(m) for m in materials]
        inputs = jnp.concatenate([cloud.positions, offset, *materials], axis=-1)
        return jnp.where(cloud.mask[..., None], inputs, 0.0)


# --- 3D U-Net ---------------------------------------------------------------------------------------------------------


class Stem(nn.Module):
    """First convolution, from the occupied voxels alone: the scattered grid is never built."""

    features: int
    resolution: int
    num_groups: int

    @nn.compact
    def __call__(
        self, rows: Int[Array, "objects points"], values: Float[Array, "objects points channels"]
    ) -> Float[Array, "objects d d d features"]:
        """Convolution of the volumes that `values` sum to at the flattened voxels `rows`."""
        kernel = self.param("kernel", kernel_init, (3, 3, 3, values.shape[-1], self.features))
        x = jax.vmap(lambda r, v: scatter_conv(r, v, kernel, self.resolution))(rows, values)
        return nn.relu(GroupNorm(self.num_groups, name="norm")(x))


class Block(nn.Module):
    """3^3 convolution, GroupNorm, ReLU; at half the resolution (down), the same, or twice (up)."""

    features: int
    kind: Literal["down", "same", "up"]
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "objects *space channels"]) -> Float[Array, "objects *out_space features"]:
        """The block's output."""
        kernel = self.param("kernel", kernel_init, (3, 3, 3, x.shape[-1], self.features))
        if self.kind == "up":
            x = upsample_conv(x, kernel, self.bf16)
        else:
            x = conv(x, kernel, stride=2 if self.kind == "down" else 1, bf16=self.bf16)
        return nn.relu(GroupNorm(self.num_groups, name="norm")(x))


class UNet3D(nn.Module):
    """Encoder and decoder; the output has the resolution and width of the stem."""

    resolution: int
    base_width: int
    num_stages: int
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(
        self, rows: Int[Array, "objects points"], values: Float[Array, "objects points channels"]
    ) -> Float[Array, "objects d d d features"]:
        """Feature volume of each object from its scattered points (in the form of `voxels.scatter_conv`)."""
        x = Stem(self.base_width, self.resolution, self.num_groups, name="stem")(rows, values)
        skips, width = [], self.base_width
        for i in range(self.num_stages):
            skips.append(x)
            width *= 2
            x = Block(width, "down", self.num_groups, self.bf16, name=f"down_{i}")(x)
            x = Block(width, "same", self.num_groups, self.bf16, name=f"same_{i}")(x)
        for i in range(self.num_stages):
            width //= 2
            x = Block(width, "up", self.num_groups, self.bf16, name=f"up_{i}")(x) + skips.pop()
        return x


# --- field ------------------------------------------------------------------------------------------------------------


class RadianceField(nn.Module):
    """Density and colour of samples; `view` and `decode` are the parts that a ray needs once."""

    width: int
    num_features: int
    direction_frequencies: int
    sees_direction: bool = True

    def setup(self) -> None:
        """Layers: hidden -> [density, rgb], direction -> features, hidden -> the features after rgb."""
        self.hidden = nn.Dense(self.width)
        self.head = nn.Dense(4)
        self.direction = nn.Dense(self.num_features, use_bias=False)
        self.features = nn.Dense(self.num_features - 3, use_bias=False)
        self.feature_bias = self.param("feature_bias", nn.initializers.zeros, (self.num_features - 3,))

    def view(self, directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays features"]:
        """Contribution of the view direction to each feature; 0 if the field does not see it."""
        if not self.sees_direction:
            return jnp.zeros((*directions.shape[:-1], self.num_features), directions.dtype)
        return self.direction(encode_direction(directions, self.direction_frequencies))

    def __call__(
        self, x: Float[Array, "*rays samples channels"], view: Float[Array, "*rays features"]
    ) -> tuple[Float[Array, "*rays samples"], tuple[Array, Array]]:
        """Density, and the emitted values of each sample: RGB in (0, 1) and hidden layer (*rays, samples, ...)."""
        # one long axis of samples: XLA's CPU gradient of a product that sums over several axes takes four times as long
        hidden = softplus(self.hidden(x.reshape(-1, x.shape[-1])))
        out = self.head(hidden).reshape(*x.shape[:-1], 4)
        rgb = nn.sigmoid(out[..., 1:] + view[..., None, :3])
        return softplus(out[..., 0] - 1), (rgb, hidden.reshape(*x.shape[:-1], self.width))

    def decode(
        self, emitted: tuple[Array, Array], acc: Float[Array, "*rays"], view: Float[Array, "*rays features"]
    ) -> Float[Array, "*rays features"]:
        """Features of a ray, RGB on white and the rest on zero, from the composited values and the opacity."""
        rgb, hidden = emitted
        rest = self.features(hidden) + acc[..., None] * (per_feature(self.feature_bias, view) + view[..., 3:])
        return jnp.concatenate([rgb + (1 - acc[..., None]) * WHITE, rest], axis=-1)


# --- upsampler --------------------------------------------------------------------------------------------------------


SLOPE = 0.2


class Upsampler(nn.Module):
    """Two convolutions at the low resolution, nearest x2, two at the high one; the last starts at zero."""

    width: int
    bf16: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch 2*height 2*width 3"]:
        """Image of twice the size; the first three features are RGB."""
        y = x
        for i, features in enumerate((self.width, self.width, self.width // 2, 3)):
            init = nn.initializers.zeros if i == 3 else kernel_init
            kernel = self.param(f"kernel_{i}", init, (3, 3, y.shape[-1], features))
            y = upsample_conv(y, kernel, self.bf16) if i == 2 else conv(y, kernel, bf16=self.bf16)
            y = y + per_feature(self.param(f"bias_{i}", nn.initializers.zeros, (features,)), y)
            y = y if i == 3 else nn.leaky_relu(y, SLOPE)
        return y + resize_bilinear(jnp.asarray(x[..., :3]), 2 * x.shape[1], 2 * x.shape[2])


# --- discriminator ----------------------------------------------------------------------------------------------------


class Discriminator(nn.Module):
    """4x4 convolutions, three of stride 2 and two of stride 1; GroupNorm on all but the first and the last."""

    width: int
    num_groups: int
    bf16: bool = False

    @nn.compact
    def __call__(
        self,
        image: Float[Array, "batch height width 3"],
        condition: Float[Array, "batch height width 3"],
        condition_mask: Bool[Array, "batch height width"],
    ) -> Float[Array, "batch rows columns 1"]:
        """Logit of each patch: positive for patches that look like a reference image."""
        x = jnp.concatenate([image, condition, condition_mask[..., None].astype(image.dtype)], axis=-1)
        widths = [self.width * 2**i for i in range(4)]
        for i, features in enumerate([*widths, 1]):
            kernel = self.param(f"kernel_{i}", kernel_init, (4, 4, x.shape[-1], features))
            x = conv(x, kernel, stride=2 if i < 3 else 1, bf16=self.bf16)
            if i in (0, 4):
                x = x + per_feature(self.param(f"bias_{i}", nn.initializers.zeros, (features,)), x)
            else:
                x = GroupNorm(self.num_groups, name=f"norm_{i}")(x)
            if i < 4:
                x = nn.leaky_relu(x, SLOPE)
        return x
