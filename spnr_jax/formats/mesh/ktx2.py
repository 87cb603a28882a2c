"""KTX2 images with a Basis Universal payload (KHR_texture_basisu), through opengl_basisu, an extra."""

import importlib.util

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.draco import MISSING

IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
PACKAGE = "opengl_basisu"


def available() -> bool:
    """Whether the package that decodes them is installed."""
    return importlib.util.find_spec(PACKAGE) is not None


def decode(data: bytes, name: str, most_pixels: int) -> np.ndarray:
    """Texels (height, width, 4) uint8 of the largest image, as they were encoded."""
    try:
        import opengl_basisu  # an extra: only here
    except ImportError:
        raise RejectedAsset(f"its image {name} " + MISSING.format(package=PACKAGE)) from None
    try:
        texture = opengl_basisu.open(data)
        if texture.width * texture.height > most_pixels:  # before memory is taken for them
            raise RejectedAsset(f"{texture.width} x {texture.height} pixels, more than {most_pixels}")
        return np.asarray(texture.transcode("rgba8").data, np.uint8)
    except (ValueError, LookupError, RuntimeError) as error:
        raise RejectedAsset(f"names an image that cannot be read: {name} ({error})") from None
