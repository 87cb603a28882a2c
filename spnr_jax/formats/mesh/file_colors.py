"""One reading of the colours in files, of points and of meshes alike: their names, their range and their curve.

Colours are sRGB unless the name says that they are linear.  The range is that of the type for 8-bit integers; of other
numbers it is the first of 1, 255, 1023, 4095 and 65535 that nearly all of them keep to: some writers put 8-bit or
12-bit colours into 16-bit fields, or 0 to 255 into floats, and a single stray value must not turn the rest black.
"""

from collections.abc import Mapping

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.mesh.texels import srgb_to_linear

LINEAR = ("base_color_r", "base_color_g", "base_color_b")
SRGB = ("red", "green", "blue")
LINEAR_NAMES = (
    LINEAR,
    ("base_color_red", "base_color_green", "base_color_blue"),
    ("basecolor_r", "basecolor_g", "basecolor_b"),
    ("albedo_r", "albedo_g", "albedo_b"),
)
SRGB_NAMES = (
    SRGB,
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("diffuse_r", "diffuse_g", "diffuse_b"),
    ("rf", "gf", "bf"),
    ("color_r", "color_g", "color_b"),
    ("color_red", "color_green", "color_blue"),
)
PACKED = ("rgb", "rgba")  # 0xAARRGGBB in one number, or in the bits of a float
SCALES = (255.0, 1023.0, 4095.0, 65535.0)
ROUNDING = 1e-4  # values this far outside [0, 1] are taken for rounded ones
STRAYS, LEAST = 1000, 100  # one value of so many may leave the range, of so many at least
DARK, MOSTLY = 0.03, 0.98  # sRGB that looks black; share of the colours that is worth a line
Columns = Mapping[str, np.ndarray]


def find(columns: Columns, groups: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """The first group of names that are all there; none if there is no such group."""
    return next((group for group in groups if set(group) <= columns.keys()), ())


def colors_of(columns: Columns) -> tuple[np.ndarray, list[str]] | None:
    """Linear colours (n, 3) of named columns and lines about how they were read; None if no names are those of colours.

    ValueError for values that are no colours.
    """
    if group := find(columns, LINEAR_NAMES):
        return linear_colors(_channels(columns, group), " ".join(group), linear=True)
    if group := find(columns, SRGB_NAMES):
        return linear_colors(_channels(columns, group), " ".join(group))
    if packed := next((name for name in PACKED if name in columns), None):
        return linear_colors(unpack(columns[packed])[:, :3], packed)
    return None


def _channels(columns: Columns, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([columns[name] for name in names], axis=-1)


def unpack(packed: np.ndarray) -> np.ndarray:
    """Red, green, blue and alpha (n, 4) uint8 of numbers (n,) 0xAARRGGBB, or of floats that have their bits."""
    if packed.dtype.kind == "f":
        known = packed[np.isfinite(packed)]
        whole = packed.itemsize == 8 and len(known) == len(packed) and bool(((known % 1 == 0) & (known >= 0)).all())
        bits = packed.astype(np.int64).astype(np.uint32) if whole else packed.astype(np.float32).view(np.uint32)
    elif packed.dtype.itemsize >= 4:
        bits = packed.astype(np.int64).astype(np.uint32)
    else:
        raise UserError(f"has packed colours of {packed.dtype.itemsize} bytes; expected one 4-byte number")
    return np.stack([(bits >> shift & 255).astype(np.uint8) for shift in (16, 8, 0, 24)], axis=-1)


def linear_colors(channels: np.ndarray, name: str, *, linear: bool = False) -> tuple[np.ndarray, list[str]]:
    """Linear colours (n, 3) in [0, 1] of what a file holds (n, 3), and lines that say how they were read."""
    if not len(channels):
        return np.zeros(channels.shape), []
    brightest, darkest = channels.max(axis=-1), channels.min(axis=-1)
    strays = max(1, len(channels) // STRAYS) if len(channels) >= LEAST else 0
    highest = np.partition(brightest, -1 - strays)[-1 - strays]
    lowest = np.partition(darkest, strays)[strays]
    white = full_scale(channels.dtype, float(highest), linear)
    values = channels / white
    if not (lowest / white >= -ROUNDING and highest / white <= 1 + max(ROUNDING, 1.5 / 255 if white == 255 else 0)):
        raise UserError(
            f"has {name} from {lowest / white:g} to {highest / white:g}; expected 0 to 1 (colours: or 0 to 255)"
        )
    lines = [] if linear else [f"{name} taken as sRGB in 0..{white:g}"]
    if outside := int(np.count_nonzero((values > 1 + ROUNDING).any(axis=-1) | (values < -ROUNDING).any(axis=-1))):
        lines.append(f"{outside:,} of {len(values):,} colours lie outside of 0..{white:g} and are cut off there")
    values = np.clip(values, 0, 1)
    if len(values) >= LEAST:
        lines += _extremes(values, name)
    return values if linear else srgb_to_linear(values), lines


def _extremes(values: np.ndarray, name: str) -> list[str]:
    """A line where nearly all colours say the same: 0, next to black, or full."""
    for word, share in (
        ("0", np.mean(~values.any(axis=-1))),
        ("nearly black", np.mean(values.max(axis=-1) < DARK)),
    ):
        if share > MOSTLY:
            return [f"{share:.0%} of {name} are {word}: the picture will be black"]
    return []


def full_scale(kind: np.dtype, highest: float, linear: bool = False) -> float:
    """The value that means full, of colours of this type and up to this value."""
    if kind.kind == "u" and kind.itemsize == 1:
        return 255.0
    whole = kind.kind == "u" and kind.itemsize == 2
    if not whole and (linear or highest <= 1 + ROUNDING):
        return 1.0
    if kind.kind == "f" and highest < 2:
        raise UserError(f"has colours up to {highest:g}: neither 0 to 1 nor 0 to 255")
    # 256 where colours were multiplied by it, not by 255
    return next((scale for scale in SCALES if highest <= scale + 1), SCALES[-1])
