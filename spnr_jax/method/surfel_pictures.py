"""How the handle draws with the network over surfels: at a quality, in a light, the package's room without one."""

import dataclasses
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.config import SurfelConfig
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Light, PointCloud, Rendering, Volume
from spnr_jax.method import surfel_renderer
from spnr_jax.surfels.lighting import room_light

_in_box = jax.jit(cameras.in_box)  # compiled whole: each operation alone takes 30 ms at the first call
BALANCED = 0.75  # of the pixels along a side, which are drawn and enlarged: docs/performance.md


def encode_volume(
    variables: dict, cloud: PointCloud, centre: np.ndarray, scale: np.floating, *, config: SurfelConfig
) -> Volume:
    """Volume of a cloud in the box (unbatched)."""
    scene = surfel_renderer.encode(variables, cloud, config=config)
    return Volume(scene=scene, centre=jnp.asarray(centre), scale=jnp.asarray(scale))


def draw(
    variables: dict, volume: Volume, camera: Camera, light: Light | None, *, config: SurfelConfig, quality: str
) -> Rendering:
    """A view, or one axis of views."""
    render = surfel_renderer.render if camera.cam_to_world.ndim == 2 else surfel_renderer.render_views
    inside = _in_box(camera, volume.centre, volume.scale)
    shader, share = _at_quality(variables, quality)
    return _in_units(render(shader, volume.scene, inside, light or room_light(), config=config, share=share), volume)


def draw_each(
    variables: dict,
    volume: Volume,
    views: Sequence[Camera],
    lights: Sequence[Light | None],
    *,
    config: SurfelConfig,
    quality: str,
) -> Iterator[Rendering]:
    """Views one after the other, of common sizes: compiled once and not for most of them."""
    inside = [_in_box(view, volume.centre, volume.scale) for view in views]
    shone = [light or room_light() for light in lights]
    shader, share = _at_quality(variables, quality)
    for drawn in surfel_renderer.render_each(shader, volume.scene, inside, shone, config=config, share=share):
        yield _in_units(drawn, volume)


def _at_quality(variables: dict, quality: str) -> tuple[dict | None, float]:
    """Variables of the CNN, None where the quality leaves it out, and the share of the pixels along a side."""
    return None if quality == "draft" else variables, BALANCED if quality == "balanced" else 1.0


def _in_units(drawn: Rendering, volume: Volume) -> Rendering:
    """What was drawn in the box with its depth in the cloud's units."""
    return dataclasses.replace(drawn, depth=_over(drawn.depth, volume.scale))


@jax.jit
def _over(depth: Float[Array, "*views height width"], scale: Float[Array, ""]) -> Float[Array, "*views height width"]:
    return depth / scale
