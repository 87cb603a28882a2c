"""A method of one's own in one file, as a user writes it: every pixel is the points' mean colour, times a weight."""

from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp

from spnr_jax.config import LossConfig, NetworkConfig, TrainConfig
from spnr_jax.kernels.records import Rendering
from spnr_jax.methods import Method, register


@dataclass(frozen=True, kw_only=True)
class GreyConfig(NetworkConfig):
    method: ClassVar[str] = "grey"

    start: float = 0.5
    """What the mean colour is multiplied with at first."""


class Grey(nn.Module):
    config: GreyConfig

    def setup(self):
        self.weight = self.param("weight", nn.initializers.constant(self.config.start), (3,))

    def encode(self, cloud, train=False):
        return jnp.mean(cloud.base_color, axis=1, where=cloud.mask[..., None])

    def render(self, scene, camera, options=None):
        views = camera.cam_to_world.shape[1]
        color = jnp.broadcast_to((scene * self.weight[None])[:, None], (len(scene), views, 3))
        image = jnp.broadcast_to(color[:, :, None, None], (len(scene), views, camera.height, camera.width, 3))
        return Rendering(image=image, image_lr=image, depth=image[..., 0], acc=jnp.ones_like(image[..., 0]))

    def __call__(self, cloud, camera, key=None, train=False):
        return self.render(self.encode(cloud, train), camera)


def grey() -> TrainConfig:
    loss = LossConfig(l1_weight=1.0, adversarial_weight=0.0, pixel="mse")
    model = GreyConfig(image_resolution=24)
    return TrainConfig(preset="grey", model=model, loss=loss, num_steps=6, max_points=32, min_points=8)


register(Method(config=GreyConfig, network=Grey, presets=(grey,), label="Mean colour"))
