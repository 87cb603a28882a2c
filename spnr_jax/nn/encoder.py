"""From points to a feature volume: PointNet on every point, mean per voxel, 3D U-Net [paper]."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from spnr_jax.config import EncoderConfig
from spnr_jax.kernels import voxels
from spnr_jax.kernels.colors import linear_to_srgb
from spnr_jax.kernels.records import PointCloud
from spnr_jax.nn.normalization import BatchNorm
from spnr_jax.nn.unet3d import UNet3D

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
        """Features of every point; masked points do not touch the statistics of a batch."""
        # one long axis of points: XLA's CPU gradient of a product that sums over several axes takes four times as long
        shape, x, mask = mask.shape, x.reshape(-1, x.shape[-1]), mask.reshape(-1)
        for i, width in enumerate(self.widths):
            x = nn.Dense(width, use_bias=False, name=f"hidden_{i}")(x)
            x = nn.relu(BatchNorm(name=f"norm_{i}")(x, mask, train))
        return nn.Dense(self.num_features, name="out")(x).reshape(*shape, self.num_features)


def spread_out(material: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
    """Values around 0 of a material in [0, 1]: of base colours (linear RGB) the sRGB brightness and two axes of hue.

    As they are, hues are a twentieth of what varies between points, and a stem of few channels learns to drop them.
    """
    if material.shape[-1] == 1:
        return 2 * material - 1
    return jnp.matmul(linear_to_srgb(material) - 0.5, jnp.asarray(BRIGHTNESS_AND_HUE), precision="highest")


class Encoder(nn.Module):
    """The paper's network begins with it; with bf16 the convolutions of the U-Net run in bfloat16."""

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
        spread = partial(voxels.spread, resolution=self.config.volume_resolution)
        return self.unet(*jax.vmap(spread)(positions, self.point_features(cloud, train), mask))

    def point_features(self, cloud: PointCloud, train: bool = False) -> Float[Array, "objects points features"]:
        """What the PointNet makes of each point."""
        return self.pointnet(self.point_inputs(cloud), jnp.asarray(cloud.mask), train)

    def point_inputs(self, cloud: PointCloud) -> Float[Array, "objects points channels"]:
        """Position, offset from the centre of the own voxel, and the materials that the network is built for."""
        _, offset = voxels.locate(jnp.asarray(cloud.positions), self.config.volume_resolution)
        materials = [getattr(cloud, name) for name in self.config.materials]
        materials = [m[..., None] if m.ndim < cloud.positions.ndim else m for m in materials]
        if self.config.inputs == "spread":
            materials = [spread_out(m) for m in materials]
        inputs = jnp.concatenate([cloud.positions, offset, *materials], axis=-1)
        return jnp.where(cloud.mask[..., None], inputs, 0.0)
