"""Packed Gaussian splats as named columns of coloured points: .spz of Niantic, compressed .ply of PlayCanvas.

    .spz    gzip; a header of 16 bytes, then all places (24 bits an axis), all opacities, colours, ...: versions 2 and 3
    .ply    an element `chunk` with the box of each 256 splats, which store their place in it as 11, 10 and 11 bits, and
            their colour and opacity as 8 bits each

What Kerbl et al. 2023 write as .ply is read as any other .ply.  `splat_opacity` is 0 to 1.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns
from spnr_jax.formats.mesh.file_colors import SRGB
from spnr_jax.surfels.gaussians import C0

MAGIC, VERSIONS = b"NGSP", (2, 3)  # of .spz
PACKED = 9 + 1 + 3  # bytes of a splat up to its colour
MOST_BYTES = 2**30  # when unpacked: a small file can announce any number
COLOR_STEP = 0.15  # 255 steps for 1 / COLOR_STEP of a coefficient
CHUNK = 256  # splats
CONVERT = "convert it to .ply, e.g. with SuperSplat (File > Export) or `splat-transform a.spz a.ply`"


def spz_columns(path: Path) -> Columns:
    """The columns of a .spz file; ValueError for other versions than 2 and 3."""
    data = path.read_bytes()
    unpacker = zlib.decompressobj(wbits=31)
    try:
        content = data if data[:4] == MAGIC else unpacker.decompress(data, MOST_BYTES)
    except zlib.error as error:
        raise UserError(f"is a broken .spz file ({error})") from None
    if content[:4] != MAGIC or len(content) < 16:
        raise UserError("is not an .spz file, or its header is cut off")
    version, count = struct.unpack_from("<II", content, 4)
    if version not in VERSIONS or content is data:
        raise UserError(f"is an .spz file of version {version}; versions 2 and 3 can be read: {CONVERT}")
    bits = content[13]
    if 16 + count * PACKED > len(content):
        raise UserError(f"is cut off: its header announces {count} splats, its data holds {(len(content) - 16) // 20}")
    octets = np.frombuffer(content, np.uint8, count * PACKED, 16)
    places = octets[: 9 * count].reshape(count, 3, 3).astype(np.int32)
    fixed = places[..., 0] | places[..., 1] << 8 | places[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1  # the sign
    colors = (octets[10 * count :].reshape(count, 3) / 255 - 0.5) / COLOR_STEP * C0 + 0.5
    columns = dict(zip("xyz", (fixed * 0.5**bits).T, strict=True))
    columns |= dict(zip(SRGB, np.clip(colors, 0, 1).T, strict=True))
    return columns | {"splat_opacity": octets[9 * count : 10 * count] / 255}


def compressed_columns(chunks: Columns, packed: Columns) -> Columns:
    """The columns of a compressed .ply from its elements `chunk` and `vertex`."""
    try:
        place, color = (np.asarray(packed[name], np.uint32) for name in ("packed_position", "packed_color"))
        row = np.arange(len(place)) // CHUNK
        if len(place) and row[-1] >= len(chunks["min_x"]):
            raise UserError(f"has {len(place)} splats in {len(chunks['min_x'])} chunks: broken file")
        columns = {}
        for axis, shift, bits in (("x", 21, 11), ("y", 11, 10), ("z", 0, 11)):
            share = (place >> shift & 2**bits - 1) / (2**bits - 1)
            low, high = (np.asarray(chunks[f"{end}_{axis}"], np.float64)[row] for end in ("min", "max"))
            columns[axis] = low + share * (high - low)
        for name, shift in zip(SRGB, (24, 16, 8), strict=True):
            share = (color >> shift & 255) / 255
            if f"min_{name[0]}" in chunks:
                low, high = (np.asarray(chunks[f"{end}_{name[0]}"], np.float64)[row] for end in ("min", "max"))
                share = low + share * (high - low)
            columns[name] = np.where(np.isfinite(share), np.clip(share, 0, 1), np.nan)
    except KeyError as error:
        raise UserError(f"is a compressed file of splats without the property {error.args[0]}") from None
    return columns | {"splat_opacity": (color & 255) / 255}
