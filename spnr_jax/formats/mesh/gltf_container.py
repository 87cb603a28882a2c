"""A glTF 2.0 file as its JSON document and decoded accessors, from .gltf or .glb.

Read here and not through trimesh 5.2, whose reader leaves normalised integers unscaled, sparse accessors zero, drops
triangle fans, and shows a compressed file as vertices at the origin; tests compare the rest with trimesh.
"""

import json
import struct
from pathlib import Path

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset
from spnr_jax.formats.mesh.companions import read_companion
from spnr_jax.formats.mesh.meshopt import unpack

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
MOST_ZEROS = 2**22  # rows that an accessor without a buffer may announce: nothing in the file stands for them
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
GLB_MAGIC, CHUNK_JSON, CHUNK_BIN = b"glTF", 0x4E4F534A, 0x004E4942


class GltfFile:
    """The JSON document of a glTF file (`document`) with access to what its buffers hold."""

    def __init__(self, path: Path):
        data = path.read_bytes()
        self.folder = path.parent
        text, self._binary = _split_glb(data) if data[:4] == GLB_MAGIC else (data, None)
        try:
            self.document = json.loads(text.decode("utf-8-sig"))
        except ValueError as error:
            raise RejectedAsset(f"its glTF header is not JSON, or truncated: {error}") from None
        version = str(self.document.get("asset", {}).get("version", "1.0"))
        if not version.startswith("2."):
            raise RejectedAsset(f"is glTF {version}; only glTF 2.0 can be read: convert it")
        self._buffers: dict[int, bytes] = {}
        self._unpacked: dict[int, bytes] = {}  # buffer views that meshopt packed

    def accessor(self, index: int) -> np.ndarray:
        """Values (count, width) of an accessor: float64 for floats and normalised integers, int64 for other ones."""
        accessor = self.document["accessors"][index]
        dtype, width, count = (
            np.dtype(COMPONENTS[accessor["componentType"]]),
            WIDTHS[accessor["type"]],
            accessor["count"],
        )
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            start = accessor.get("byteOffset", 0)
            values = self._rows(accessor["bufferView"], start, dtype, width, count)
        elif sparse and 0 <= count <= MOST_ZEROS:
            values = np.zeros((count, width), dtype)
        else:
            raise RejectedAsset(f"accessor {index} holds no data: the file is compressed by an extension")
        if sparse:
            at, new = sparse["indices"], sparse["values"]
            index_type, length = np.dtype(COMPONENTS[at["componentType"]]), sparse["count"]
            rows = self._rows(at["bufferView"], at.get("byteOffset", 0), index_type, 1, length)[:, 0]
            values = values.copy()
            values[rows] = self._rows(new["bufferView"], new.get("byteOffset", 0), dtype, width, length)
        return scaled(values, accessor)

    def image_bytes(self, index: int) -> bytes:
        """The encoded file of an image."""
        image = self.document["images"][index]
        return read_companion(self.folder, image["uri"]) if "uri" in image else self.view_bytes(image["bufferView"])

    def view_bytes(self, index: int) -> bytes:
        """What a buffer view holds."""
        return bytes(self._view(index))

    def _rows(self, view_index: int, start: int, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        """Rows (count, width) of a buffer view, read with the view's stride."""
        stride = self.document["bufferViews"][view_index].get("byteStride", dtype.itemsize * width)
        view = self._view(view_index)
        if count and start + (count - 1) * stride + width * dtype.itemsize > len(view):
            raise RejectedAsset(f"buffer view {view_index} is shorter than its accessor says: truncated or broken file")
        return np.ndarray((count, width), dtype, buffer=view, offset=start, strides=(stride, dtype.itemsize))

    def _view(self, index: int) -> memoryview:
        view = self.document["bufferViews"][index]
        extensions = view.get("extensions", {})
        for name in MESHOPT:
            if name in extensions:
                if index not in self._unpacked:
                    self._unpacked[index] = unpack(self._slice(extensions[name]), extensions[name])
                return memoryview(self._unpacked[index])
        return self._slice(view)

    def _slice(self, view: dict) -> memoryview:
        start, length = view.get("byteOffset", 0), view["byteLength"]
        buffer = self._buffer(view["buffer"])
        if min(start, length) < 0 or start + length > len(buffer):
            raise RejectedAsset(
                f"buffer {view['buffer']} has {len(buffer)} bytes where {start + length} are needed: truncated file"
            )
        return memoryview(buffer)[start : start + length]

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = self.document["buffers"][index].get("uri")
            data = self._binary if uri is None else read_companion(self.folder, uri)
            if data is None:
                raise RejectedAsset(f"buffer {index} has no data in the file")
            self._buffers[index] = data
        return self._buffers[index]


def scaled(values: np.ndarray, accessor: dict) -> np.ndarray:
    """Values as their accessor means them: float64 for floats and normalised integers, int64 for other ones."""
    if accessor.get("normalized") and values.dtype.kind in "iu":
        return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1)
    return values.astype(np.float64 if values.dtype.kind == "f" else np.int64)


def _split_glb(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON text and binary chunk (or None) of a GLB file."""
    version, length = struct.unpack_from("<II", data.ljust(12, b"\0"), 4)
    if version != 2:
        raise RejectedAsset(
            f"is a GLB container of version {version}; only version 2 (glTF 2.0) can be read: convert it"
        )
    if length > len(data) or len(data) < 20:
        raise RejectedAsset(f"truncated file: its header says {length} bytes, it has {len(data)}")
    chunks: dict[int, bytes] = {}
    position = 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", data, position)
        if position + 8 + size > length:
            raise RejectedAsset(f"truncated file: a chunk of {size} bytes starts at byte {position} of {length}")
        chunks.setdefault(kind, data[position + 8 : position + 8 + size])
        position += 8 + size
    if CHUNK_JSON not in chunks:
        raise RejectedAsset("is a GLB container without a JSON chunk")
    return chunks[CHUNK_JSON], chunks.get(CHUNK_BIN)
