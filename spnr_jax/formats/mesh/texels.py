"""Texels: encoded images to linear values, and the lookup that the point sampler and the renderer share.

Conventions (assets.py): row 0 is v = 0, v runs down the rows, texel centres lie at half-integers / size.
The lookup is mitsuba's `bitmap` with `filter_type: bilinear` and the same `wrap_mode`; a test compares the two.
Images larger than MAX_SIZE texels in width or height are box-filtered (in linear values) to at most MAX_SIZE.
KTX2 images with a Basis Universal payload are read by opengl_basisu, an extra.
"""

import io

import numpy as np
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import srgb_to_linear
from spnr_jax.formats.mesh.assets import RejectedAsset, Wrap, extra

KTX2, KTX2_PACKAGE = b"\xabKTX 20\xbb\r\n\x1a\n", "opengl_basisu"
# what readers of images raise on those that break their rules
UNREADABLE = (OSError, SyntaxError, ValueError, LookupError, RuntimeError, Image.DecompressionBombError)
MAX_SIZE = 1024
MOST_PIXELS = 2**26  # of an image file: 8192 x 8192
STRIP = 512  # rows that are converted at a time


SRGB_TABLE = srgb_to_linear(np.arange(256) / 255).astype(np.float32)


def read_image(data: bytes, name: str) -> np.ndarray:
    """Texels (height, width, 4) uint8 of an image file as they are encoded; alpha is 255 where it has none."""
    try:
        if data.startswith(KTX2):
            texture = extra(KTX2_PACKAGE).open(data)
            _check_size(texture.width, texture.height)
            return np.asarray(texture.transcode("rgba8").data, np.uint8)
        with Image.open(io.BytesIO(data)) as image:
            _check_size(image.width, image.height)
            if image.mode.startswith("I"):  # PIL would clip 16-bit grey to 255 instead of scaling it
                return _rgba(Image.fromarray((np.asarray(image) // 257).astype(np.uint8)))
            return _rgba(image)
    except UNREADABLE as error:
        raise RejectedAsset(f"names an image that cannot be read: {name} ({error})") from None


def _check_size(width: int, height: int) -> None:
    """ValueError for more pixels than memory is taken for."""
    if width * height > MOST_PIXELS:
        raise UserError(f"{width} x {height} pixels, more than {MOST_PIXELS}")


def _rgba(image: Image.Image) -> np.ndarray:
    """The pixels (height, width, 4) uint8, converted in strips: PIL takes four times their memory for the whole."""
    pixels = np.empty((image.height, image.width, 4), np.uint8)
    for top in range(0, image.height, STRIP):
        strip = image.crop((0, top, image.width, min(top + STRIP, image.height)))
        pixels[top : top + STRIP] = np.asarray(strip.convert("RGBA"))
    return pixels


def color_texels(encoded: np.ndarray) -> np.ndarray:
    """Linear colours (h, w, 3) float32 of sRGB-encoded texels (h, w, 4) uint8, at most MAX_SIZE a side."""
    return np.stack([shrink(SRGB_TABLE[encoded[..., channel]]) for channel in range(3)], axis=-1)  # one by one: memory


def value_texels(encoded: np.ndarray) -> np.ndarray:
    """Values (h, w) float32 in [0, 1] of linearly encoded texels (h, w) uint8, at most MAX_SIZE a side."""
    return shrink(encoded.astype(np.float32) / 255)


def direction_texels(encoded: np.ndarray) -> np.ndarray:
    """Values (h, w, 3) float32 in [-1, 1] of encoded directions (h, w, 4) uint8, at most MAX_SIZE a side."""
    table = (np.arange(256) / 255 * 2 - 1).astype(np.float32)
    return np.stack([shrink(table[encoded[..., channel]]) for channel in range(3)], axis=-1)


def shrink(texels: np.ndarray) -> np.ndarray:
    """The texture (height, width) or (height, width, c), float32, box-filtered to at most MAX_SIZE texels a side."""
    height, width = texels.shape[:2]
    ratio = MAX_SIZE / max(height, width)
    if ratio >= 1:
        return texels.astype(np.float32)
    return resize(texels, max(1, round(height * ratio)), max(1, round(width * ratio)))


def resize(texels: np.ndarray, height: int | np.integer, width: int | np.integer) -> np.ndarray:
    """The texture resampled with a box filter, float32."""
    channels, size = texels.reshape(*texels.shape[:2], -1), (int(width), int(height))
    resized = [
        np.asarray(Image.fromarray(np.ascontiguousarray(channel)).resize(size, Image.Resampling.BOX))
        for channel in np.moveaxis(channels.astype(np.float32), -1, 0)
    ]
    return np.stack(resized, axis=-1).reshape(height, width, *texels.shape[2:])


def lookup(texels: np.ndarray, texcoords: np.ndarray, wrap: Wrap) -> np.ndarray:
    """Bilinear values (n,) or (n, c) of a texture (height, width) or (height, width, c) at texcoords (n, 2)."""
    size = np.array([texels.shape[1], texels.shape[0]])
    position = np.asarray(texcoords, np.float64) * size - 0.5
    corner = np.floor(position).astype(np.int64)
    weight = position - corner
    (left, top), (right, bottom) = _wrap(corner, size, wrap).T, _wrap(corner + 1, size, wrap).T
    x, y = (weight[:, axis].reshape(-1, *[1] * (texels.ndim - 2)) for axis in (0, 1))
    upper = (1 - x) * texels[top, left] + x * texels[top, right]
    lower = (1 - x) * texels[bottom, left] + x * texels[bottom, right]
    return (1 - y) * upper + y * lower


def _wrap(index: np.ndarray, size: np.ndarray, wrap: Wrap) -> np.ndarray:
    """Texel indices inside [0, size) for any integer indices."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "repeat":
        return index % size
    folded = index % (2 * size)
    return np.minimum(folded, 2 * size - 1 - folded)
