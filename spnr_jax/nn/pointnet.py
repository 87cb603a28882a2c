"""PointNet: a feature for each point from its position, its place in its voxel and its materials [paper]."""

from typing import Literal

import flax.linen as nn
from jaxtyping import Array, Bool, Float

from spnr_jax.nn.normalization import BatchNorm


class PointNet(nn.Module):
    """Shared MLP; each hidden layer is followed by normalisation and ReLU, the output is linear.

    `norm` is "batch" [paper], or "layer", which knows no statistics of other points.
    """

    widths: tuple[int, ...]
    num_features: int
    norm: Literal["batch", "layer"] = "batch"

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch points channels"], mask: Bool[Array, "*batch points"], train: bool
    ) -> Float[Array, "*batch points features"]:
        """Features of every point; masked points do not touch the statistics of a batch."""
        # one long axis of points: XLA's CPU gradient of a product that sums over several axes takes four times as long
        shape, x, mask = mask.shape, x.reshape(-1, x.shape[-1]), mask.reshape(-1)
        for i, width in enumerate(self.widths):
            x = nn.Dense(width, use_bias=False, name=f"hidden_{i}")(x)
            name = f"norm_{i}"
            x = nn.relu(BatchNorm(name=name)(x, mask, train) if self.norm == "batch" else nn.LayerNorm(name=name)(x))
        return nn.Dense(self.num_features, name="out")(x).reshape(*shape, self.num_features)
