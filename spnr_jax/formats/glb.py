"""Binary glTF: a document and the bytes that its only buffer holds, in one file."""

import json
from collections.abc import Mapping

import numpy as np

JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
TYPES = {"f": ("<f4", 5126), "u": ("<u4", 5125)}  # by kind of number: as it is stored, and the specification's number
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class Buffer:
    """What the buffer of a document holds: arrays and other bytes, each at a multiple of 4."""

    def __init__(self) -> None:
        """An empty one."""
        self._views: list[dict] = []
        self._accessors: list[dict] = []
        self._content = bytearray()

    def view(self, data: bytes, **more: int) -> int:
        """Number of a new view, of these bytes; `more` is what else is to stand in it."""
        self._views.append({"buffer": 0, "byteOffset": len(self._content), "byteLength": len(data), **more})
        self._content += data + bytes(-len(data) % 4)
        return len(self._views) - 1

    def accessor(self, array: np.ndarray, ends: bool = False, **more: int) -> int:
        """Number of a new accessor, of numbers (n,) or rows (n, k); with `ends` it has their least and largest."""
        stored, number = TYPES[array.dtype.kind]
        view = self.view(np.ascontiguousarray(array, stored).tobytes(), **more)
        kind = {"componentType": number, "count": len(array), "type": KINDS[array.size // len(array)]}
        bounds = {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()} if ends else {}
        self._accessors.append({"bufferView": view, **kind, **bounds})
        return len(self._accessors) - 1

    def attributes(self, arrays: Mapping[str, np.ndarray], **more: int) -> dict[str, int]:
        """Numbers of new accessors for the attributes of a primitive."""
        return {name: self.accessor(array, name == "POSITION", **more) for name, array in arrays.items()}

    def glb(self, document: dict) -> bytes:
        """The .glb of a document that lacks what the buffer knows."""
        own = {"accessors": self._accessors, "bufferViews": self._views}
        text = json.dumps(document | own | {"buffers": [{"byteLength": len(self._content)}]}).encode()
        text += b" " * (-len(text) % 4)
        body = _chunk(JSON_CHUNK, text) + _chunk(BINARY_CHUNK, bytes(self._content))
        return b"glTF" + np.array([2, 12 + len(body)], "<u4").tobytes() + body


def _chunk(kind: bytes, data: bytes) -> bytes:
    return np.array([len(data)], "<u4").tobytes() + kind + data
