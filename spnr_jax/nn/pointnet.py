"""PointNet: a feature for each point from its position, its place in its voxel and its materials [paper]."""

import flax.linen as nn
from jaxtyping import Array, Bool, Float

from spnr_jax.nn.normalization import BatchNorm


class PointNet(nn.Module):
    """Shared MLP; each hidden layer is followed by batch normalisation and ReLU, the output is linear."""

    widths: tuple[int, ...]
    num_features: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch points channels"], mask: Bool[Array, "*batch points"], train: bool
    ) -> Float[Array, "*batch points features"]:
        """Features of every point; masked points do not touch the statistics."""
        # one long axis of points: XLA's CPU gradient of a product that sums over several axes takes four times as long
        shape, x, mask = mask.shape, x.reshape(-1, x.shape[-1]), mask.reshape(-1)
        for i, width in enumerate(self.widths):
            x = nn.Dense(width, use_bias=False, name=f"hidden_{i}")(x)
            x = nn.relu(BatchNorm(name=f"norm_{i}")(x, mask, train))
        return nn.Dense(self.num_features, name="out")(x).reshape(*shape, self.num_features)
