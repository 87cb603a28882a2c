"""The container of a glTF 2.0 file: its JSON document, buffers and accessors.

DracoPy (KHR_draco_mesh_compression) and meshoptimizer (EXT_, KHR_meshopt_compression) are extras.
"""

import json
import struct
from functools import cache
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats import assets
from spnr_jax.formats.assets import Loading
from spnr_jax.formats.columns import Columns

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
CHUNK_JSON = 0x4E4F534A  # of a .glb
DRACO, MESHOPT = "KHR_draco_mesh_compression", ("EXT_meshopt_compression", "KHR_meshopt_compression")
FILTERS = {  # of meshopt: the library's function, and the widths of a vertex
    "OCTAHEDRAL": ("decode_filter_oct", (4, 8)),
    "QUATERNION": ("decode_filter_quat", (8,)),
    "EXPONENTIAL": ("decode_filter_exp", range(4, 257, 4)),
}


class GltfFile:
    """The JSON document of a glTF file (`document`), with access to its buffers."""

    def __init__(self, path: Path, loading: Loading):
        self.loading, data = loading, path.read_bytes()
        text, self._binary = _split_glb(data) if data[:4] == b"glTF" else (data, None)
        try:
            self.document = json.loads(text.decode("utf-8-sig").rstrip("\0"))  # padding of old exporters
        except ValueError as error:
            raise UserError(f"its glTF header is not JSON, or truncated: {error}") from None
        version = str(self.document.get("asset", {}).get("version", "1.0"))
        if not version.startswith("2."):
            raise UserError(f"is glTF {version}; only glTF 2.0 can be read: convert it")
        self.view, self._buffer = cache(self._read_view), cache(self._read_buffer)
        self._unpacked: dict[int, np.ndarray] = {}  # accessors of Draco meshes

    def columns(self, attributes: dict[str, int], *names: str, rows: np.ndarray | None = None) -> Columns:
        """Columns (v, width) of the attributes with these names, all rows or some.

        float64 for floats and normalised integers, int64 for other integers.
        """
        found = {}
        for name, index in ((name, index) for name, index in attributes.items() if name in names):
            values, normalized = self.accessor(index), self.document["accessors"][index].get("normalized")
            values = values if rows is None else values[rows]
            if values.dtype.kind == "f":
                found[name] = values.astype(np.float64)
            elif normalized or name == "COLOR_0":  # always normalised; some writers forget the flag
                found[name] = np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1)
            else:
                found[name] = values.astype(np.int64)
        return found

    def accessor(self, index: int) -> np.ndarray:
        """Values (count, width) of an accessor in their stored type."""
        if index in self._unpacked:
            return self._unpacked[index]
        accessor = self.document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise UserError(f"accessor {index} is sparse or holds no data, which is not read: export it plain")
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        number, count, start = accessor["bufferView"], int(accessor["count"]), accessor.get("byteOffset", 0)
        size, view = dtype.itemsize * width, self.view(number)
        stride = self.document["bufferViews"][number].get("byteStride") or size
        if stride < size:
            raise UserError(f"buffer view {number} has elements that overlap: broken file")
        if count and start + (count - 1) * stride + size > len(view):
            raise UserError(f"buffer view {number} is shorter than its accessor says: truncated or broken file")
        return np.ndarray((count, width), dtype, buffer=view, offset=start, strides=(stride, dtype.itemsize))

    def _read_view(self, index: int) -> memoryview:
        view = self.document["bufferViews"][index]
        packed = next((packed for name, packed in view.get("extensions", {}).items() if name in MESHOPT), None)
        place = packed or view
        start, buffer = place.get("byteOffset", 0), self._buffer(place["buffer"])
        end = start + place["byteLength"]
        if not 0 <= start <= end <= len(buffer):
            number = place["buffer"]
            raise UserError(f"buffer {number} has {len(buffer)} bytes where {end} are needed: truncated file")
        data = memoryview(buffer)[start:end]
        return memoryview(unpack(data, packed)) if packed else data

    def _read_buffer(self, number: int) -> bytes:
        uri = self.document["buffers"][number].get("uri")
        data = self._binary if uri is None else self.loading.read(uri, needed=True)
        if data is None:
            raise UserError(f"buffer {number} has no data in the file")
        return data

    def unpack_mesh(self, primitive: dict) -> None:
        """Decodes a primitive's Draco mesh, so that `accessor` returns its values; integers are not normalised.

        The library checks the declared sizes against the data before it allocates.
        """
        draco, packed = assets.extra("DracoPy"), primitive["extensions"][DRACO]
        data = bytes(self.view(packed["bufferView"]))
        try:
            mesh = draco.decode(data)
        except (draco.FileTypeException, ValueError, RuntimeError, MemoryError) as error:
            raise UserError(f"holds a Draco mesh that is broken or cut off ({error})") from None
        if getattr(mesh, "faces", None) is None:
            raise UserError("holds Draco points where triangles are needed: broken file")
        columns = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
        for name, number in ({"POSITION": None} | packed["attributes"]).items():
            if number not in columns:
                raise UserError(f"has no {name:.40} in its Draco mesh: broken file")
            self._unpacked[primitive["attributes"][name]] = columns[number].reshape(len(columns[number]), -1)
        self._unpacked[primitive["indices"]] = np.asarray(mesh.faces).reshape(-1, 1)


def _split_glb(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON text and binary chunk of a .glb file."""
    version, length, size, kind = struct.unpack_from("<4I", data.ljust(20, b"\0"), 4)
    if version != 2:
        raise UserError(f"is a GLB container of version {version}; only version 2 (glTF 2.0) can be read: convert it")
    begin = 20 + size
    end = begin + 8 + int.from_bytes(data[begin : begin + 4], "little") if begin < length else begin
    if (needed := max(length, end)) > len(data):
        raise UserError(f"truncated file: it has {len(data)} bytes where {needed} are announced")
    if kind != CHUNK_JSON:
        raise UserError("is a GLB container without a JSON chunk")
    return data[20:begin], data[begin + 8 : end]


def unpack(data: memoryview, packed: dict) -> bytes:
    """The decoded bytes of a meshopt-compressed buffer view, described by its extension `packed`."""
    meshopt = assets.extra("meshoptimizer")
    mode, count, stride, kind = packed["mode"], packed["count"], packed["byteStride"], packed.get("filter", "NONE")
    with refusing("holds meshopt data that is broken or cut off"):
        if mode != "ATTRIBUTES":
            decode = {"TRIANGLES": meshopt.decode_index_buffer, "INDICES": meshopt.decode_index_sequence}[mode]
            return decode(count, 4, data).astype({2: "<u2", 4: "<u4"}[stride]).tobytes()
        elements = meshopt.decode_vertex_buffer(count, stride, data, np.dtype((np.void, stride)))
    if kind == "NONE":
        return elements.tobytes()
    function, strides = FILTERS.get(kind, ("", ()))
    if stride not in strides:
        raise UserError(f"holds meshopt vertices of {stride} bytes with the filter {kind!r:.40}: cannot be read")
    return getattr(meshopt, function)(elements, count, stride).tobytes()
