"""Gaussian splats as files: .ply of Kerbl et al. 2023 and .spz of Niantic, written and read; compressed .ply, read.

    .ply    x y z, nx ny nz (0), f_dc_0..2, f_rest_* (red, then green, then blue), opacity logits, log scales,
            rotation w x y z, all float32; axes right, down, forward
    .spz    gzip; a header of 16 bytes, then all positions (24-bit fixed point), all opacities (8 bits), colours, log
            scales, rotations (32 bits), spherical harmonics; axes right, up, back.  Versions 2 and 3 are read
    .ply    of PlayCanvas: an element `chunk` with the box of each 256 splats; positions in it have 11, 10 and 11 bits

The first two are marked as anti-aliased (Mip-Splatting: splats widened to a pixel lose opacity).  Splats are passed in
with y up and z towards the viewer, in any unit; a note becomes a comment of the .ply.  Read as coloured points.
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
LEAST_OPACITY, MOST_OPACITY = 1e-4, 1 - 1e-4  # bounds that keep logits finite
RENDER_MODE = "SplatRenderMode: mip"  # comment of a .ply that marks it as anti-aliased
# of .spz: first bytes, versions that are read (the last is written), header flag, bytes of the header
MAGIC, VERSIONS, ANTIALIASED, HEAD = b"NGSP", (2, 3), 1, 16
FRACTION_BITS = 24 - 2  # of a position in .spz; fewer if positions are larger than 1
SCALE_STEP, LEAST_SCALE = 16, -10  # of .spz: steps per unit of log scale, smallest log scale
HARMONIC_BITS = (5, 4)  # of .spz: for coefficients of degree 1, and above
PACKED = 9 + 1 + 3  # bytes of a splat's position, opacity and colour
MOST_BYTES = 2**30  # when unpacked: a small file can declare any size
CHUNK = 256  # splats
PACKED_BITS = {  # of a compressed .ply: property, first bit, number of bits
    **{"x": ("packed_position", 21, 11), "y": ("packed_position", 11, 10), "z": ("packed_position", 0, 11)},
    **{name: ("packed_color", 24 - 8 * i, 8) for i, name in enumerate((*SRGB, "splat_opacity"))},
}
COLOR_STEP = 0.15  # of .spz: octet = 255 (COLOR_STEP * coefficient + 0.5)
CONVERT = "convert it to .ply, e.g. with SuperSplat (File > Export) or `splat-transform a.spz a.ply`"


def write_splats(path: str | Path, gaussians: Gaussians, note: str = "") -> int:
    """Writes a file of its suffix's kind, atomically; returns its size in bytes.  ValueError for other suffixes."""
    path = Path(path)
    check_suffix(path)
    content = ply_of(gaussians, note) if path.suffix.lower() == ".ply" else spz_of(gaussians)
    write_whole(path, content)
    return len(content)


def check_suffix(path: Path) -> None:
    """ValueError unless the path has a suffix of splats and can be written."""
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(
            f"{path}: splats are written as {' or '.join(SUFFIXES)}, not {path.suffix or 'without a suffix'}"
        )
    check_place(path)


def turn_half(gaussians: Gaussians) -> Gaussians:
    """The splats rotated by 180 degrees about x: from axes right, up, back to right, down, forward, or back."""
    harmonics, (w, x, y, z) = np.asarray(gaussians.harmonics, np.float32), np.asarray(gaussians.rotation, np.float32).T
    return Gaussians(
        scale=gaussians.scale,
        opacity=gaussians.opacity,
        position=np.asarray(gaussians.position, np.float32) * np.array([1, -1, -1], np.float32),
        rotation=np.stack([-x, w, -z, y], axis=-1),
        harmonics=harmonics * half_turn_signs(degree_of(harmonics.shape[1])).astype(np.float32)[:, None],
    )


def ply_of(gaussians: Gaussians, note: str = "") -> bytes:
    """The splats as a .ply file."""
    splats = turn_half(gaussians)
    opacity = np.clip(np.asarray(splats.opacity, np.float64), LEAST_OPACITY, MOST_OPACITY)
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(opacity), -1)
    columns = {
        **{"x y z": splats.position, "nx ny nz": np.zeros_like(splats.position)},
        "f_dc_0 f_dc_1 f_dc_2": splats.harmonics[:, 0],
        " ".join(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        "opacity": np.log(opacity / (1 - opacity))[:, None],
        "scale_0 scale_1 scale_2": np.log(np.asarray(splats.scale)),
        "rot_0 rot_1 rot_2 rot_3": splats.rotation,
    }
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {x}" for x in (RENDER_MODE, *note.splitlines()))]
    properties = [f"property float {name}" for name in " ".join(columns).split()]
    header += [f"element vertex {len(opacity)}", *properties, "end_header"]
    rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    return ("\n".join(header) + "\n").encode("ascii", "replace") + rows.tobytes()


def fits_spz(gaussians: Gaussians) -> bool:
    """Whether a .spz file can hold the positions, and the widths of most splats: 0.00005 to 380 units."""
    widths = np.log(np.asarray(gaussians.scale, np.float64).max(axis=1))
    held = 0 < np.median(widths) - LEAST_SCALE < 255 / SCALE_STEP
    return bool(held and np.abs(gaussians.position).max() < 2**23)


def spz_of(gaussians: Gaussians) -> bytes:
    """The splats as a .spz file; ValueError if it cannot hold ones of this size."""
    if not fits_spz(gaussians):
        width, far = np.median(np.asarray(gaussians.scale).max(axis=1)), np.abs(gaussians.position).max()
        found = f"splats {width:.2g} units wide, up to {far:.2g} from the origin"
        raise UserError(f"a .spz file cannot hold {found}: write a .ply, or choose another unit")
    names = "position", "scale", "rotation", "opacity", "harmonics"
    position, scale, rotation, opacity, harmonics = (np.asarray(getattr(gaussians, x), np.float64) for x in names)
    bits = int(np.clip(FRACTION_BITS - np.ceil(np.log2(max(np.abs(position).max(), 1e-6))), 0, 31))
    fixed = np.clip(np.round(position * 2.0**bits), -(2**23), 2**23 - 1).astype("<i4")
    step = 2.0 ** (8 - np.where(np.arange(harmonics.shape[1] - 1) < 3, *HARMONIC_BITS))[:, None]
    parts = [
        MAGIC + struct.pack("<2I4B", VERSIONS[-1], len(position), degree_of(harmonics.shape[1]), bits, ANTIALIASED, 0),
        fixed.view(np.uint8).reshape(len(position), 3, 4)[..., :3].tobytes(),
        _bytes(opacity * 255),
        _bytes(harmonics[:, 0] * COLOR_STEP * 255 + 127.5),
        _bytes((np.log(scale) - LEAST_SCALE) * SCALE_STEP),
        _smallest_three(rotation),
        # rounded to the middle of a step, as by the format's reference writer
        _bytes(np.round((harmonics[:, 1:] * 128 + 128) / step) * step),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def _bytes(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _smallest_three(rotation: Float[np.ndarray, "splats 4"]) -> bytes:
    """Rotations in 32 bits: index of the largest of x y z w, then sign and nine bits of each of the others."""
    quaternion = rotation[:, [1, 2, 3, 0]]
    largest = np.abs(quaternion).argmax(axis=1)
    quaternion = quaternion * np.where(np.take_along_axis(quaternion, largest[:, None], 1) < 0, -1, 1)
    sizes = np.minimum(np.floor(511 * np.abs(quaternion) * np.sqrt(2) + 0.5), 511).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for i, size in enumerate(sizes.T):
        packed = np.where(largest == i, packed, packed << 10 | (quaternion[:, i] < 0).astype(np.uint32) << 9 | size)
    return packed.astype("<u4").tobytes()


def spz_columns(path: Path) -> Columns:
    """The columns of a .spz file of version 2 or 3; ValueError for others."""
    content = path.read_bytes()
    with refusing("is a broken .spz file"):
        if content[:4] != MAGIC:
            packed = zlib.decompressobj(wbits=31)
            content = packed.decompress(content, MOST_BYTES)
            if not packed.eof:
                raise UserError(f"is cut off, or larger than {MOST_BYTES:,} bytes")
    if content[:4] != MAGIC or len(content) < HEAD:
        raise UserError("is not an .spz file, or its header is cut off")
    version, count, bits = struct.unpack_from("<4x2IxB", content)
    if version not in VERSIONS:
        raise UserError(f"is an .spz file of version {version}; versions 2 and 3 can be read: {CONVERT}")
    if HEAD + count * PACKED > len(content):
        raise UserError(f"is cut off: its header announces {count} splats, its data has {len(content) - HEAD} bytes")
    octets = np.frombuffer(content, np.uint8, count * PACKED, HEAD)
    places = octets[: 9 * count].reshape(count, 3, 3).astype(np.int32)
    fixed = places[..., 0] | places[..., 1] << 8 | places[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1  # the sign
    colors = (octets[10 * count :].reshape(count, 3) / 255 - 0.5) / COLOR_STEP * C0 + 0.5
    columns = np.concatenate([fixed * 0.5**bits, np.clip(colors, 0, 1), octets[9 * count : 10 * count, None] / 255], 1)
    return dict(zip((*"xyz", *SRGB, "splat_opacity"), columns.T, strict=True))


def unpack_columns(chunks: Columns, packed: Columns) -> Columns:
    """The columns of a compressed .ply, from its elements `chunk` and `vertex`."""
    columns = {}
    with refusing("is a broken file of compressed splats"):
        for name, (source, shift, size) in PACKED_BITS.items():
            columns[name] = (np.asarray(packed[source], np.uint32) >> shift & 2**size - 1) / (2**size - 1)
            if size > 8 or f"min_{name[0]}" in chunks:
                chunk = np.arange(len(columns[name])) // CHUNK
                low, high = (np.asarray(chunks[f"{end}_{name[0]}"], np.float64)[chunk] for end in ("min", "max"))
                columns[name] = low + columns[name] * (high - low)
            if size == 8:
                columns[name] = np.clip(columns[name], 0, 1)
    return columns
