"""Several rays a pixel, averaged as light is: what a picture smaller than those of the training needs.

A network that renders pictures of any size has learnt what a ray of its training sees, a cone of one pixel there.  The
pixels of a smaller picture are wider: each is the mean of the rays that it would have had in the training.
"""

from spnr_jax.kernels.colors import over, srgb_to_linear, unweighted
from spnr_jax.kernels.compositing import WHITE
from spnr_jax.kernels.records import Rendering
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.model_config import NetworkConfig


def rays_per_side(config: NetworkConfig, size: int) -> int:
    """Rays along each side of a pixel of a picture `size` pixels wide, so that they lie as close as in the training."""
    return max(round(config.image_resolution / size), 1) if config.any_size else 1


def averaged(rendering: Rendering, side: int) -> Rendering:
    """The rendering with every square of side x side pixels averaged: the light of the object, its opacity, the depth.

    Colours are averaged as linear light of the object alone and laid on white as sRGB, as the references are.
    """
    opacity, depth = rendering.acc[..., None], rendering.depth[..., None]
    straight = unweighted(rendering.image - (1 - opacity) * WHITE, opacity)
    light, depth, acc = (mean_of_squares(x, side) for x in (opacity * srgb_to_linear(straight), depth, opacity))
    image = over(light, acc, WHITE)
    return Rendering(image=image, image_lr=image, depth=depth[..., 0], acc=acc[..., 0])
