"""Scores of pictures in a light: of one picture, of its shadows, and of what changes from one light to the next.

Pictures are sRGB on white with their opacity, references RGBA with straight alpha, all float in [0, 1]; nothing is
rescaled.  Logarithms are natural, of linear light not below DARK: one neper is a factor of 2.7.

Shadows: log(picture / the same without shadows), a pixel's mean over colours, beside the same of the reference.  So
what a material or a normal gets wrong cancels, and what is left is how much each says that the geometry keeps away.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from spnr_jax.kernels.colors import srgb_to_linear
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.scoring.flip import flip
from spnr_jax.scoring.picture_scores import sharpness

DARK = 1e-3  # linear light below which the logarithm is not taken
SOLID = 0.9  # opacity of ours from which on a pixel's colour is compared with that of another picture of ours
OPAQUE = 0.999  # opacity of the reference from which on a pixel is inside
CLIPPED = 0.995  # sRGB from which on a pixel says "at least"


class OnWhite(NamedTuple):
    """A picture on white and its opacity."""

    image: Float[np.ndarray, "height width 3"]
    opacity: Float[np.ndarray, "height width"]


Pair = tuple[OnWhite, OnWhite]


def on_white(rgba: Float[np.ndarray, "height width 4"]) -> OnWhite:
    """A picture with straight alpha, on white."""
    alpha = rgba[..., 3:]
    return OnWhite(rgba[..., :3] * alpha + 1 - alpha, rgba[..., 3])


def reduced(picture: OnWhite, size: int) -> OnWhite:
    """The picture with so many pixels along each side, each the mean of a square."""
    side = len(picture.image) // size
    whole = np.concatenate([picture.image, picture.opacity[..., None]], axis=-1)
    whole = np.asarray(mean_of_squares(jnp.asarray(whole), side)) if side > 1 else whole
    return OnWhite(whole[..., :3], whole[..., 3])


def scores(picture: OnWhite, reference: Float[np.ndarray, "height width 4"]) -> list[float]:
    """PSNR, PSNR inside, FLIP on white, and the root mean square of the ratio of linear light inside, in nepers."""
    found, white = sharpness(*picture, reference), on_white(reference).image
    inside = reference[..., 3] > OPAQUE
    ours, theirs = (np.log(np.maximum(_linear(x), DARK)) for x in (picture.image, white))
    error = float(np.sqrt(np.mean((ours - theirs)[inside] ** 2))) if inside.any() else 0.0
    return [found.psnr, found.psnr_inside, float(flip(jnp.asarray(picture.image), jnp.asarray(white))), error]


def shadow_scores(pictures: Pair, references: Pair) -> list[float]:
    """Correlation of the picture's shadows with the reference's, and their root mean square difference, in nepers.

    A pair is a picture without shadows, then the same with them.  The correlation is NaN where one of the two has no
    shadows at all.
    """
    return change_scores(pictures, references)[:2]


def change_scores(pictures: Pair, references: Pair) -> list[float]:
    """How well the change from a picture to the next is that of the references, in log light.

    The correlation, the root mean square difference in nepers, and that as a share of the references' own change: 1 is
    what a picture that never changes has.  NaN where there is nothing to tell it by.
    """
    clear = _clear(references, OPAQUE) & _clear(pictures, SOLID)
    if not clear.any():
        return [float("nan")] * 3
    found, expected = ((_log_light(after) - _log_light(before))[clear] for before, after in (pictures, references))
    error, size = (float(np.sqrt(np.mean(x**2))) for x in (found - expected, expected))
    told = min(found.std(), expected.std()) > 1e-6
    correlation = float(np.corrcoef(found, expected)[0, 1]) if told else float("nan")
    return [correlation, error, error / size if size > 1e-6 else float("nan")]


def _clear(pair: Pair, solid: float) -> Bool[np.ndarray, "height width"]:
    """Where both pictures are solid and not clipped."""
    return np.logical_and.reduce([(x.opacity > solid) & (_straight(x).max(axis=-1) < CLIPPED) for x in pair])


def _straight(picture: OnWhite) -> Float[np.ndarray, "height width 3"]:
    """Colours without the white behind them."""
    alpha = np.maximum(picture.opacity, 1e-3)[..., None]
    return np.clip((picture.image - 1 + picture.opacity[..., None]) / alpha, 0, 1)


def _log_light(picture: OnWhite) -> Float[np.ndarray, "height width"]:
    return np.log(np.maximum(_linear(_straight(picture)).mean(axis=-1), DARK))


def _linear(image: np.ndarray) -> np.ndarray:
    return np.asarray(srgb_to_linear(jnp.asarray(image)))
