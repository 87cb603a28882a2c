"""Buffers of vertex indices that meshopt packed (EXT_meshopt_compression, KHR_meshopt_compression).

After the text of the extensions.  A triangle is one byte of code: which of the last 16 edges it shares, and where its
third corner comes from: the next vertex, one of the last 16, or a difference in bytes of its own.  A sequence of
indices is a list of differences to one of two indices before.
"""

from collections import deque

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset

TRIANGLES, SEQUENCE = (0xE0, 0xE1), (0xD0, 0xD1)  # formats 0 and 1
EDGES, VERTICES = 16, 16  # that are remembered
TABLE, SEQUENCE_TAIL = 16, 4  # bytes behind the data
BROKEN = "holds meshopt indices that are cut off or broken"


def decode_triangles(data: bytes, count: int) -> np.ndarray:
    """Indices (count,) int64 of triangles; RejectedAsset where the data is broken."""
    if not data or data[0] not in TRIANGLES or count < 0 or count % 3:
        raise RejectedAsset(BROKEN)
    if 1 + count // 3 + TABLE > len(data):
        raise RejectedAsset(BROKEN)
    reader = _Corners(data, 1 + count // 3, 13 if data[0] & 15 else 15)
    indices: list[int] = []
    for code in data[1 : 1 + count // 3]:
        indices += reader.triangle(code >> 4, code & 15)
    if reader.place != len(data) - TABLE:
        raise RejectedAsset(BROKEN)
    return np.array(indices, np.int64) & 0xFFFFFFFF


def decode_sequence(data: bytes, count: int) -> np.ndarray:
    """Indices (count,) int64 of any primitives; RejectedAsset where the data is broken."""
    if not data or data[0] not in SEQUENCE or not 0 <= count <= len(data) - 1 - SEQUENCE_TAIL:
        raise RejectedAsset(BROKEN)
    last, place, indices = [0, 0], 1, []
    for _ in range(count):
        value, place = _number(data, place, len(data) - SEQUENCE_TAIL)
        base, step = value & 1, value >> 1
        last[base] += step >> 1 ^ -(step & 1)
        indices.append(last[base])
    if place != len(data) - SEQUENCE_TAIL:
        raise RejectedAsset(BROKEN)
    return np.array(indices, np.int64) & 0xFFFFFFFF


def _number(data: bytes, place: int, end: int) -> tuple[int, int]:
    """A number of 7 bits a byte, the lowest first, of at most five bytes, and the place behind it."""
    value = 0
    for i in range(5):
        if place >= end:
            break
        byte = data[place]
        place += 1
        value |= (byte & 127) << 7 * i
        if byte < 128:
            return value, place
    raise RejectedAsset(BROKEN)


class _Corners:
    """The state from one triangle to the next: what was seen last, and where the differences are read."""

    def __init__(self, data: bytes, place: int, recent: int):
        self.data, self.place, self.end = data, place, len(data) - TABLE
        self.recent = recent  # codes below it are remembered vertices; in format 1 the two above are last - 1, last + 1
        self.next = self.last = 0
        self.edges = deque([(-1, -1)] * EDGES, EDGES)  # the oldest first
        self.vertices = deque([-1] * VERTICES, VERTICES)

    def triangle(self, edge: int, corner: int) -> tuple[int, int, int]:
        """The three indices of the next triangle."""
        if edge < 15:
            a, b = self.edges[-1 - edge]
            c = self._third(corner)
            self.edges.append((c, b))
            self.edges.append((a, c))
            return a, b, c
        if corner < 14:
            pair, fresh = self.data[self.end + corner], False
        else:
            if self.place >= self.end:
                raise RejectedAsset(BROKEN)
            pair, fresh = self.data[self.place], corner == 15
            self.place += 1
            if pair == 0:
                self.next = 0
        own = corner >= 14  # only then 15 means a difference; the table has no such entries
        a = self._difference() if fresh else self._next()
        b, new_b = self._other(pair >> 4, own)
        c, new_c = self._other(pair & 15, own)
        self.vertices.append(a)
        self.vertices.extend(corner for corner, new in ((b, new_b), (c, new_c)) if new)
        self.edges.extend(((b, a), (c, b), (a, c)))
        return a, b, c

    def _third(self, code: int) -> int:
        """The corner opposite the edge that is shared."""
        if code == 0:
            c = self._next()
        elif code < self.recent:
            return self.vertices[-1 - code]
        elif code == 15:
            c = self._difference()
        else:
            self.last += 1 if code == 14 else -1
            c = self.last
        self.vertices.append(c)
        return c

    def _other(self, code: int, own: bool) -> tuple[int, bool]:
        """A corner by its four bits, and whether it is to be remembered."""
        if code == 0:
            return self._next(), True
        if code == 15 and own:
            return self._difference(), True
        return self.vertices[-code], False

    def _next(self) -> int:
        self.next += 1
        return self.next - 1

    def _difference(self) -> int:
        step, self.place = _number(self.data, self.place, self.end)
        self.last += step >> 1 ^ -(step & 1)
        return self.last
