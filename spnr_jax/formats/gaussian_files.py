"""Gaussian splats as files: .ply of Kerbl et al. 2023 and .spz of Niantic (version 3).

    .ply    x y z, nx ny nz (0), f_dc_0..2, f_rest_* (all of red, then green, then blue), opacity before the logistic
            function, logarithms of the scales, rotation w x y z, all float32; axes right, down, forward
    .spz    gzip; 24-bit fixed-point places, 8 bits of opacity, colour, logarithms of scales and harmonics, 32 of the
            rotation; axes right, up, back

Both say that splats which a viewer widens to a pixel lose opacity for it (anti-aliasing, mip).

Splats go in with y up and z towards the viewer, in any unit.  A note, which names the cloud, the network and the light,
becomes a comment of the .ply; a .spz has no place for one.
"""

import gzip
from pathlib import Path

import numpy as np
from jaxtyping import Float

from spnr_jax.errors import UserError
from spnr_jax.formats.images import check_place, write_whole
from spnr_jax.formats.splat_files import COLOR_STEP, MAGIC
from spnr_jax.kernels.records import Gaussians
from spnr_jax.surfels.gaussians import degree_of, half_turn_signs

SUFFIXES = (".ply", ".spz")
LEAST_OPACITY, MOST_OPACITY = 1e-4, 1 - 1e-4  # that the logistic function is inverted for
VERSION, ANTIALIASED = 3, 1  # of .spz; the last is a flag
RENDER_MODE = "SplatRenderMode: mip"  # comment of a .ply: what a viewer widens it makes fainter
FRACTION_BITS = 24 - 2  # at most of a place in .spz; fewer where places lie further from the origin than 1
SCALE_STEP, LEAST_SCALE = 16, -10  # of .spz: steps for each e-fold, logarithm of the smallest
HARMONIC_BITS = (5, 4)  # of .spz: of the coefficients of degree 1, and above


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
