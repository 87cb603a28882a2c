"""Gaussian splats as files: .ply of Kerbl et al. 2023 and .spz of Niantic, written and read; compressed .ply, read.

    .ply    x y z, nx ny nz (0), f_dc_0..2, f_rest_* (all of red, then green, then blue), opacity before the logistic
            function, logarithms of the scales, rotation w x y z, all float32; axes right, down, forward
    .spz    gzip; a header of 16 bytes, then all places (24-bit fixed point an axis), all opacities (8 bits), colours,
            logarithms of scales, rotations (32 bits), harmonics; axes right, up, back.  Versions 2 and 3 are read
    .ply    of PlayCanvas: an element `chunk` with the box of each 256 splats, which store their place in it as 11, 10
            and 11 bits, and their colour and opacity as 8 bits each

The first two say that splats which a viewer widens to a pixel lose opacity for it (anti-aliasing, mip).  Splats go in
with y up and z towards the viewer, in any unit.  A note, which names the cloud, the network and the light, becomes a
comment of the .ply; a .spz has no place for one.  What is read are coloured points; `splat_opacity` is 0 to 1.
"""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.columns import SRGB, Columns
from spnr_jax.formats.images import check_place, write_whole
from spnr_jax.kernels.records import Gaussians
from spnr_jax.surfels.gaussians import C0, degree_of, half_turn_signs

SUFFIXES = (".ply", ".spz")
LEAST_OPACITY, MOST_OPACITY = 1e-4, 1 - 1e-4  # that the logistic function is inverted for
VERSION, ANTIALIASED = 3, 1  # of .spz; the last is a flag
RENDER_MODE = "SplatRenderMode: mip"  # comment of a .ply: what a viewer widens it makes fainter
FRACTION_BITS = 24 - 2  # at most of a place in .spz; fewer where places lie further from the origin than 1
SCALE_STEP, LEAST_SCALE = 16, -10  # of .spz: steps for each e-fold, logarithm of the smallest
HARMONIC_BITS = (5, 4)  # of .spz: of the coefficients of degree 1, and above
MAGIC, VERSIONS = b"NGSP", (2, 3)  # of .spz
PACKED = 9 + 1 + 3  # bytes of a splat up to its colour
MOST_BYTES = 2**30  # when unpacked: a small file can announce any number
COLOR_STEP = 0.15  # 255 steps for 1 / COLOR_STEP of a coefficient
CHUNK = 256  # splats
CONVERT = "convert it to .ply, e.g. with SuperSplat (File > Export) or `splat-transform a.spz a.ply`"


def write_splats(path: Path, gaussians: Gaussians, note: str = "") -> int:
    """Writes a file of the kind that its suffix says, in one piece; its size in bytes.  ValueError for others."""
    check_suffix(path)
    content = ply_of(gaussians, note) if path.suffix.lower() == ".ply" else spz_of(gaussians)
    write_whole(path, content)
    return len(content)


def check_suffix(path: Path) -> None:
    """ValueError unless the path is that of a file of splats, where one can be written."""
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"{path}: splats are written as {' or '.join(SUFFIXES)}, not {path.suffix or 'a folder'}")
    check_place(path)


def turn_half(gaussians: Gaussians) -> Gaussians:
    """The splats half a turn around the x axis: axes right, up, back become right, down, forward, and back again."""
    position, rotation, harmonics = (
        np.asarray(x, np.float32) for x in (gaussians.position, gaussians.rotation, gaussians.harmonics)
    )
    w, x, y, z = rotation.T
    signs = half_turn_signs(degree_of(harmonics.shape[1])).astype(np.float32)
    return Gaussians(
        scale=gaussians.scale,
        opacity=gaussians.opacity,
        position=position * np.array([1, -1, -1], np.float32),
        rotation=np.stack([-x, w, -z, y], axis=-1),
        harmonics=harmonics * signs[:, None],
    )


def ply_of(gaussians: Gaussians, note: str = "") -> bytes:
    """The splats as a .ply file."""
    splats = turn_half(gaussians)
    harmonics = np.asarray(splats.harmonics)
    opacity = np.clip(np.asarray(splats.opacity, np.float64), LEAST_OPACITY, MOST_OPACITY)
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(opacity), -1)
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest.shape[1]))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    parts = [
        splats.position,
        np.zeros_like(splats.position),
        harmonics[:, 0],
        rest,
        np.log(opacity / (1 - opacity))[:, None],
    ]
    parts += [np.log(np.asarray(splats.scale)), splats.rotation]
    header = ["ply", "format binary_little_endian 1.0", f"comment {RENDER_MODE}"]
    header += [f"comment {line}" for line in note.splitlines()]
    header += [f"element vertex {len(opacity)}", *(f"property float {name}" for name in names), "end_header"]
    return ("\n".join(header) + "\n").encode("ascii", "replace") + np.concatenate(parts, axis=1).astype("<f4").tobytes()


def spz_of(gaussians: Gaussians) -> bytes:
    """The splats as a .spz file."""
    position, harmonics = np.asarray(gaussians.position, np.float64), np.asarray(gaussians.harmonics, np.float64)
    bits = int(np.clip(FRACTION_BITS - np.ceil(np.log2(max(np.abs(position).max(), 1e-6))), 0, 31))
    fixed = np.clip(np.round(position * 2.0**bits), -(2**23), 2**23 - 1).astype("<i4")
    places = fixed.view(np.uint8).reshape(len(position), 3, 4)[..., :3]
    header = MAGIC + np.array([VERSION, len(position)], "<u4").tobytes()
    header += bytes([degree_of(harmonics.shape[1]), bits, ANTIALIASED, 0])
    parts = [
        places,
        _bytes(np.asarray(gaussians.opacity, np.float64) * 255),
        _bytes(harmonics[:, 0] * COLOR_STEP * 255 + 127.5),
        _bytes((np.log(np.asarray(gaussians.scale, np.float64)) - LEAST_SCALE) * SCALE_STEP),
        _smallest_three(np.asarray(gaussians.rotation, np.float64)),
        _harmonic_bytes(harmonics[:, 1:]),
    ]
    return gzip.compress(header + b"".join(part.tobytes() for part in parts), mtime=0)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _harmonic_bytes(rest: Float[np.ndarray, "splats coefficients 3"]) -> np.ndarray:
    """Bytes whose lowest bits are those of the middle of a step, as the format's own writer rounds them."""
    bits = np.where(np.arange(rest.shape[1]) < 3, *HARMONIC_BITS)
    step = 2.0 ** (8 - bits)[None, :, None]
    return _bytes(np.minimum(np.round((rest * 128 + 128) / step) * step, 255))


def _smallest_three(rotation: Float[np.ndarray, "splats 4"]) -> np.ndarray:
    """Rotations as 32 bits: which of x y z w is largest, and sign and nine bits of each of the others."""
    quaternion = rotation[:, [1, 2, 3, 0]]
    largest = np.abs(quaternion).argmax(axis=1)
    quaternion = quaternion * np.where(np.take_along_axis(quaternion, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for i in range(4):
        value = quaternion[:, i]
        size = np.minimum(np.floor(511 * np.abs(value) * np.sqrt(2) + 0.5), 511).astype(np.uint32)
        packed = np.where(largest == i, packed, packed << 10 | (value < 0).astype(np.uint32) << 9 | size)
    return packed.astype("<u4")


def spz_columns(path: Path) -> Columns:
    """The columns of a .spz file; ValueError for other versions than 2 and 3."""
    data = path.read_bytes()
    unpacker = zlib.decompressobj(wbits=31)
    with refusing("is a broken .spz file"):
        content = data if data[:4] == MAGIC else unpacker.decompress(data, MOST_BYTES)
    if content[:4] != MAGIC or len(content) < 16:
        raise UserError("is not an .spz file, or its header is cut off")
    version, count = struct.unpack_from("<II", content, 4)
    if version not in VERSIONS:
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


def decompress_columns(chunks: Columns, packed: Columns) -> Columns:
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
