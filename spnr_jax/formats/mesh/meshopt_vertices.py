"""Buffers of vertices that meshopt packed (EXT_meshopt_compression, KHR_meshopt_compression), and their filters.

After the text of the two extensions (format 0 and 1).  Elements come in blocks.  In a block every byte of the element
has its own stream of differences to the element before, in groups of 16 of 0 to 8 bits each; the largest value that
the bits can say stands for a byte that follows.  Where a group lies depends on all before it, so the places are found
one by one and the differences of all groups at once.  Nothing is made room for before the data is seen to be there.
"""

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset

FORMATS = (0xA0, 0xA1)
GROUP = 16
MOST_IN_BLOCK, BLOCK_BYTES = 256, 8192
MOST_BYTES = 2**30  # of what is unpacked: zeros take next to nothing
TAIL = (32, 24)  # bytes at least behind the blocks, by format
WIDTHS = ((0, 2, 4, 8), (0, 1, 2, 4), (1, 2, 4, 8))  # bits of a difference by a group's mode: format 0; 1, control 0, 1
ZEROS, PLAIN = 2, 3  # control: no data, all bytes as they are
# by width: which differences of a byte of packed ones are followed by a byte, as a count
_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
ESCAPES = {1: _BITS.sum(axis=1), 2: (_BITS[:, 0::2] & _BITS[:, 1::2]).sum(axis=1)}
ESCAPES[4] = (np.arange(256) >> 4 == 15).astype(int) + (np.arange(256) & 15 == 15)
ESCAPE_COUNTS = {bits: counts.tolist() for bits, counts in ESCAPES.items()}


def decode_vertices(data: bytes, count: int, stride: int) -> np.ndarray:
    """The elements (count, stride) uint8; RejectedAsset where the data is broken."""
    if not data or data[0] not in FORMATS:
        raise RejectedAsset("holds meshopt vertices of an unknown format")
    if not 0 < stride <= 256 or stride % 4 or not 0 <= count * stride <= MOST_BYTES:
        raise RejectedAsset(f"holds {count} meshopt vertices of {stride} bytes: broken file")
    version = data[0] & 15
    tail = stride + (stride // 4 if version else 0)
    end = len(data) - max(tail, TAIL[version])
    if end < 1:
        raise RejectedAsset("holds meshopt vertices that are cut off")
    last = np.frombuffer(data, np.uint8, stride, len(data) - tail)
    channels = data[len(data) - tail + stride :] if version else bytes(stride // 4)
    size = min(BLOCK_BYTES // stride & ~(GROUP - 1), MOST_IN_BLOCK)
    packed, blocks, place = np.frombuffer(data, np.uint8), [], 1
    for first in range(0, count, size):
        differences, place = _block(data, packed, place, end, min(size, count - first), stride, version)
        blocks.append(_summed(differences, last, channels))
        last = blocks[-1][-1]
    if place != end:
        raise RejectedAsset("holds meshopt vertices with bytes that nothing uses: broken file")
    return np.concatenate(blocks) if blocks else np.zeros((0, stride), np.uint8)


def _block(
    data: bytes, packed: np.ndarray, place: int, end: int, count: int, stride: int, version: int
) -> tuple[np.ndarray, int]:
    """Differences (count, stride) uint8 of the block that begins at a place, and the place behind it."""
    groups = -(-count // GROUP)
    controls = data[place : place + stride // 4] if version else b""
    place += len(controls)
    differences = np.zeros((stride, groups * GROUP), np.uint8)
    found: dict[int, list[tuple[int, int]]] = {1: [], 2: [], 4: [], 8: []}  # by bits: (row of a group, its place)
    for byte in range(stride):
        control = controls[byte // 4] >> byte % 4 * 2 & 3 if version and byte // 4 < len(controls) else 0
        if control == PLAIN and place + count <= end:
            differences[byte, :count] = packed[place : place + count]
        if control in (ZEROS, PLAIN):
            place += count if control == PLAIN else 0
            continue
        head, place = place, place + -(-groups // 4)
        for group in range(groups):
            if place > end:
                raise RejectedAsset("holds meshopt vertices that are cut off")
            bits = WIDTHS[control + version][data[head + group // 4] >> group % 4 * 2 & 3]
            if bits:
                found[bits].append((byte * groups + group, place))
                length = GROUP * bits // 8
                if bits < 8:
                    escapes = ESCAPE_COUNTS[bits]
                    place += sum(escapes[value] for value in data[place : place + length])
                place += length
    if place > end:
        raise RejectedAsset("holds meshopt vertices that are cut off")
    rows = differences.reshape(-1, GROUP)
    for bits, places in found.items():
        if places:
            row, at = np.array(places).T
            rows[row] = _groups(packed, at, bits)
    return differences[:, :count].T, place


def _groups(packed: np.ndarray, place: np.ndarray, bits: int) -> np.ndarray:
    """Differences (n, 16) of the groups of so many bits at some places."""
    length = GROUP * bits // 8
    raw = packed[place[:, None] + np.arange(length)]
    if bits == 8:
        return raw
    each = np.unpackbits(raw, axis=1, bitorder="little" if bits == 1 else "big").reshape(len(raw), GROUP, bits)
    values = (each << np.arange(bits - 1, -1, -1, dtype=np.uint8)).sum(axis=-1).astype(np.uint8)
    escaped = values == 2**bits - 1
    behind = place[:, None] + length + np.cumsum(escaped, axis=1) - 1
    values[escaped] = packed[behind[escaped]]
    return values


def _summed(differences: np.ndarray, last: np.ndarray, channels: bytes) -> np.ndarray:
    """Elements (n, stride) of zigzag or XOR differences, four bytes after four as their channel says."""
    elements = np.empty(differences.shape, np.uint8)
    for i, channel in enumerate(channels):
        here = slice(4 * i, 4 * i + 4)
        kind = channel & 3
        if kind == 3:
            raise RejectedAsset("holds meshopt vertices of an unknown kind of difference")
        dtype = np.dtype(("<u1", "<u2", "<u4")[kind])
        steps = np.ascontiguousarray(differences[:, here]).view(dtype)
        start = np.ascontiguousarray(last[here]).view(dtype)
        if kind == 2:
            turn = np.uint32(channel >> 4)
            turned = steps >> turn | steps << (np.uint32(32) - turn) if turn else steps
            values = np.bitwise_xor.accumulate(np.concatenate([start[None], turned]), axis=0)[1:]
        else:
            signed = steps >> dtype.type(1) ^ (dtype.type(0) - (steps & dtype.type(1)))
            values = start + np.cumsum(signed, axis=0, dtype=dtype)
        elements[:, here] = np.ascontiguousarray(values).view(np.uint8)
    return elements


def unfiltered(elements: np.ndarray, kind: str) -> np.ndarray:
    """The elements (count, stride) uint8 as a filter of the extension says that they are meant."""
    count, stride = elements.shape
    if kind == "NONE":
        return elements
    widths = {"OCTAHEDRAL": (4, 8), "COLOR": (4, 8), "QUATERNION": (8,), "EXPONENTIAL": range(4, 257, 4)}
    if kind not in widths or stride not in widths[kind]:
        raise RejectedAsset(f"holds meshopt vertices of {stride} bytes with the filter {kind!r:.40}: broken file")
    if kind == "EXPONENTIAL":
        words = np.ascontiguousarray(elements).view("<i4")
        return np.ldexp((words << 8 >> 8).astype("<f4"), words >> 24).astype("<f4").view(np.uint8)
    signed = np.ascontiguousarray(elements).view("<i1" if stride == 4 else "<i2")
    largest = 127 if stride == 4 else 32767
    decode = {"OCTAHEDRAL": _octahedral, "QUATERNION": _quaternions, "COLOR": _colors}[kind]
    return decode(signed, largest).reshape(count, 4).astype(signed.dtype).view(np.uint8)


def _octahedral(values: np.ndarray, largest: int) -> np.ndarray:
    """Unit vectors times `largest`, and the fourth value as it is."""
    x, y = values[:, :2].T / np.where(values[:, 2] == 0, 1, values[:, 2]).astype(np.float64)
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    x, y = x - np.where(x >= 0, fold, -fold), y - np.where(y >= 0, fold, -fold)
    vectors = np.stack([x, y, z], axis=-1)
    vectors *= largest / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.rint(vectors), values[:, 3:]], axis=-1)


def _quaternions(values: np.ndarray, largest: int) -> np.ndarray:
    """Unit quaternions times `largest` of their three smaller components and the place of the fourth."""
    three = values[:, :3] * (np.sqrt(0.5) / (values[:, 3:] | 3))
    whole = np.sqrt(np.maximum(1 - (three**2).sum(axis=-1, keepdims=True), 0))
    found = np.empty((len(values), 4))
    places = (values[:, 3:] & 3) + np.array([1, 2, 3, 0])
    np.put_along_axis(found, places % 4, np.rint(np.concatenate([three, whole], axis=-1) * largest), axis=1)
    return found


def _colors(values: np.ndarray, largest: int) -> np.ndarray:
    """RGB and alpha, unsigned, of luma, two differences of colour, and alpha with a bit that gives the scale."""
    whole = 2 * largest + 1
    luma, alpha = (values[:, i].astype(np.int64) & whole for i in (0, 3))
    orange, green = values[:, 1].astype(np.int64), values[:, 2].astype(np.int64)
    scale = 2 ** np.frexp(np.maximum(alpha, 1))[1].astype(np.int64) - 1
    alpha = alpha & (scale >> 1)
    parts = [luma + orange - green, luma + green, luma - orange - green, alpha << 1 | alpha & 1]
    return np.rint(np.stack(parts, axis=-1) * (whole / scale)[:, None]).astype(np.int64)
