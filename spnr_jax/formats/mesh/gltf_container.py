"""A glTF 2.0 file, .gltf or .glb: its JSON document, its accessors decoded, what Draco and meshopt packed unpacked.

Read here and not through trimesh 5.2, whose reader leaves normalised integers unscaled, sparse accessors zero, drops
triangle fans, and shows a compressed file as vertices at the origin; tests compare the rest with trimesh.  DracoPy
(KHR_draco_mesh_compression) and meshoptimizer (EXT_, KHR_meshopt_compression) are extras.
"""

import json
import struct
from pathlib import Path

import numpy as np

from spnr_jax.formats.mesh.assets import RejectedAsset, extra, read_companion

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
MOST_ZEROS = 2**22  # rows that an accessor without a buffer may announce: nothing in the file stands for them
DRACO, MESHOPT = "KHR_draco_mesh_compression", ("EXT_meshopt_compression", "KHR_meshopt_compression")
FILTERS = {  # of meshopt: the library's function, and the widths of a vertex
    "OCTAHEDRAL": ("decode_filter_oct", (4, 8)),
    "QUATERNION": ("decode_filter_quat", (8,)),
    "EXPONENTIAL": ("decode_filter_exp", range(4, 257, 4)),
}
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
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count, sparse = accessor["count"], accessor.get("sparse")
        if "bufferView" in accessor:
            values = self._rows(accessor, dtype, width, count)
        elif sparse and 0 <= count <= MOST_ZEROS:
            values = np.zeros((count, width), dtype)
        else:
            raise RejectedAsset(f"accessor {index} holds no data: the file is compressed by an extension")
        if sparse:
            index_type = np.dtype(COMPONENTS[sparse["indices"]["componentType"]])
            rows = self._rows(sparse["indices"], index_type, 1, sparse["count"])[:, 0]
            values = values.copy()
            values[rows] = self._rows(sparse["values"], dtype, width, sparse["count"])
        return decode_accessor(values, accessor)

    def image_bytes(self, index: int) -> bytes:
        """The encoded file of an image."""
        image = self.document["images"][index]
        return read_companion(self.folder, image["uri"]) if "uri" in image else bytes(self.view(image["bufferView"]))

    def view(self, index: int) -> memoryview:
        """What a buffer view holds."""
        view = self.document["bufferViews"][index]
        extensions = view.get("extensions", {})
        packed = next((extensions[name] for name in MESHOPT if name in extensions), None)
        if packed is None:
            return self._slice(view)
        if index not in self._unpacked:
            self._unpacked[index] = unpack(self._slice(packed), packed)
        return memoryview(self._unpacked[index])

    def _rows(self, place: dict, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        """Rows (count, width) from a place in a buffer view on, read with the view's stride."""
        index, start = place["bufferView"], place.get("byteOffset", 0)
        stride = self.document["bufferViews"][index].get("byteStride", dtype.itemsize * width)
        view = self.view(index)
        if count and start + (count - 1) * stride + width * dtype.itemsize > len(view):
            raise RejectedAsset(f"buffer view {index} is shorter than its accessor says: truncated or broken file")
        return np.ndarray((count, width), dtype, buffer=view, offset=start, strides=(stride, dtype.itemsize))

    def _slice(self, view: dict) -> memoryview:
        start, length, number = view.get("byteOffset", 0), view["byteLength"], view["buffer"]
        if number not in self._buffers:
            uri = self.document["buffers"][number].get("uri")
            data = self._binary if uri is None else read_companion(self.folder, uri)
            if data is None:
                raise RejectedAsset(f"buffer {number} has no data in the file")
            self._buffers[number] = data
        buffer = self._buffers[number]
        if min(start, length) < 0 or start + length > len(buffer):
            raise RejectedAsset(
                f"buffer {number} has {len(buffer)} bytes where {start + length} are needed: truncated file"
            )
        return memoryview(buffer)[start : start + length]


def decode_accessor(values: np.ndarray, accessor: dict) -> np.ndarray:
    """Values as their accessor means them: float64 for floats and normalised integers, int64 for other ones."""
    if accessor.get("normalized") and values.dtype.kind in "iu":
        return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1)
    return values.astype(np.float64 if values.dtype.kind == "f" else np.int64)


def decode_mesh(data: memoryview, ids: dict[str, int]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns by name (v, width), of attributes of a Draco mesh by their unique ids, and vertex indices (3 f,) int64.

    Values are as they were before they were packed: whole numbers are not normalised.  The library holds what a mesh
    announces against the size of its data before it makes room for it.
    """
    draco = extra("DracoPy")
    try:
        mesh = draco.decode(bytes(data))
    except (draco.FileTypeException, ValueError, RuntimeError, MemoryError) as error:
        raise RejectedAsset(f"holds a Draco mesh that is broken or cut off ({error})") from None
    columns = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
    faces = getattr(mesh, "faces", None)
    if faces is None:
        raise RejectedAsset("holds Draco points where triangles are needed: broken file")
    if lost := [name for name, number in ids.items() if number not in columns]:
        raise RejectedAsset(f"has no {lost[0]:.40} in its Draco mesh: broken file")
    found = {name: columns[number].reshape(len(columns[number]), -1) for name, number in ids.items()}
    return found, np.asarray(faces, np.int64).reshape(-1)


def unpack(data: memoryview, packed: dict) -> bytes:
    """The bytes of a buffer view that meshopt packed, as its extension describes them."""
    meshopt = extra("meshoptimizer")
    mode, count, stride, kind = packed["mode"], packed["count"], packed["byteStride"], packed.get("filter", "NONE")
    try:
        if mode != "ATTRIBUTES":
            decode = {"TRIANGLES": meshopt.decode_index_buffer, "INDICES": meshopt.decode_index_sequence}[mode]
            return decode(count, 4, data).astype({2: "<u2", 4: "<u4"}[stride]).tobytes()
        elements = meshopt.decode_vertex_buffer(count, stride, data, np.dtype((np.void, stride)))
    except (RuntimeError, ValueError) as error:
        raise RejectedAsset(f"holds meshopt data that is broken or cut off ({error})") from None
    if kind == "NONE":
        return elements.tobytes()
    function, strides = FILTERS.get(kind, ("", ()))
    if stride not in strides:
        raise RejectedAsset(f"holds meshopt vertices of {stride} bytes with the filter {kind!r:.40}: cannot be read")
    return getattr(meshopt, function)(elements, count, stride).tobytes()


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
