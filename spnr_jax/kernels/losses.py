"""Training losses; each function returns a mean over all elements of its input."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.numerics import check_alike


def l1(image: Float[Array, "*shape"], reference: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Mean absolute difference.  ValueError for different shapes or whole numbers."""
    check_alike("l1", image, reference)
    return jnp.mean(jnp.abs(image - reference))


def mse(image: Float[Array, "*shape"], reference: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Mean squared difference.  ValueError for different shapes or whole numbers."""
    check_alike("mse", image, reference)
    return jnp.mean((image - reference) ** 2)


def generator_adversarial(fake_logits: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Non-saturating logistic loss of the generator, mean softplus(-D(fake))."""
    return jnp.mean(jax.nn.softplus(-fake_logits))


def discriminator_adversarial(
    real_logits: Float[Array, "*shape"], fake_logits: Float[Array, "*shape"]
) -> Float[Array, ""]:
    """Logistic loss of the discriminator, mean softplus(-D(real)) + mean softplus(D(fake))."""
    return jnp.mean(jax.nn.softplus(-real_logits)) + jnp.mean(jax.nn.softplus(fake_logits))


def r1(
    discriminator: Callable[[Float[Array, "batch height width 3"]], Array],
    image: Float[Array, "batch height width 3"],
) -> Float[Array, ""]:
    """Half the mean over images of |gradient of the summed logits by the image|^2 (Mescheder et al. 2018, eq. 9)."""
    gradient = jax.grad(lambda x: jnp.sum(discriminator(x)))(image)
    return 0.5 * jnp.mean(jnp.sum(gradient**2, axis=(1, 2, 3)))


def area_downsample(
    image: Float[Array, "*batch height width features"], size: int
) -> Float[Array, "*batch {size} {size} features"]:
    """Image averaged over equal squares; a pixel that straddles a border counts by the share covered."""

    def coverage(n: int) -> Float[Array, "size n"]:
        start = jnp.arange(size, dtype=jnp.float32)[:, None] * (n / size)
        cell = jnp.arange(n, dtype=jnp.float32)[None]
        return jnp.clip(jnp.minimum(start + n / size, cell + 1) - jnp.maximum(start, cell), 0) * (size / n)

    rows, columns = coverage(image.shape[-3]), coverage(image.shape[-2])
    return jnp.einsum("yh,...hwc,xw->...yxc", rows, image, columns, precision="highest")
