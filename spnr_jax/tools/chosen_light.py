"""The light that options ask for, the networks that take one, and the light's map behind a picture."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.errors import UserError
from spnr_jax.formats.light_files import read_light
from spnr_jax.kernels.cameras import camera_rays
from spnr_jax.kernels.colors import linear_to_srgb
from spnr_jax.kernels.records import Camera, Light, Rendering
from spnr_jax.method.model import Model
from spnr_jax.methods import method_of
from spnr_jax.surfels.lighting import background, sun
from spnr_jax.tools.light_options import Lighting

SUN = (1.6, 1.5, 1.35)  # irradiance over pi of what faces the sun of --sun, slightly warm


def light_of_options(options: Lighting, read: Callable[[str], Light] = read_light) -> Light:
    """The light that the options ask for; `read` gives that of a map by its name."""
    parts = [read(options.light or "room").turned(options.light_yaw)] if options.light or not options.sun else []
    parts += [sun(*options.sun, color=SUN)] if options.sun else []
    return 2.0**options.exposure * reduce(add, parts)


def takes_light(model: Model) -> bool:
    """Whether the network draws in any light."""
    return method_of(model.config).takes_light


def check_takes_light(model: Model, asked: Sequence[str], run: Path | None) -> None:
    """ValueError, naming the options, where something is asked of the light and the network takes none."""
    if asked and not takes_light(model):
        raise UserError(
            f"{', '.join(asked)}: the network of --run {run} knows the light of its training alone; "
            f"leave {'it' if len(asked) == 1 else 'them'} out, or --run"
        )


def before(wanted: str, rendering: Rendering, camera: Camera, light: Light | None) -> Rendering:
    """The picture before what is wanted behind it: white, as it is, or the map of the light."""
    if wanted == "white" or light is None:
        return rendering
    behind = np.asarray(_behind(light, camera))
    image = np.asarray(rendering.image) + (1 - np.asarray(rendering.acc))[..., None] * (behind - 1)
    return dataclasses.replace(rendering, image=image)


@jax.jit
def _behind(light: Light, camera: Camera) -> Float[Array, "height width 3"]:
    """The light's map as a camera sees it, sRGB."""
    towards = list(jnp.moveaxis(camera_rays(camera).directions, -1, 0))
    return linear_to_srgb(jnp.minimum(jnp.stack(background(light, towards), axis=-1), 1))
