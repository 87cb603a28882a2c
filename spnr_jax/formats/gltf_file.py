"""A glTF 2.0 file, .gltf or .glb: its JSON document, its accessors decoded, its materials as principled ones.

Read here and not through trimesh 5.2, whose reader leaves normalised integers unscaled, drops triangle fans, and shows
a compressed file as vertices at the origin; tests compare the rest with trimesh.  DracoPy (KHR_draco_mesh_compression)
and meshoptimizer (EXT_, KHR_meshopt_compression) are extras.

base colour = factor x texture (sRGB -> linear); roughness = factor x G, metallic = factor x B of the metallic-roughness
texture; defaults white, 1, 1. KHR_materials_pbrSpecularGlossiness is converted with the formulas of the extension's
reference converter. Where a picture is wanted and no reference (assets.py), alpha says where there is surface, and
the normal map is kept. Everything else that a material has is named as ignored.

A material has one set of coordinates, that of the first texture that is read (KHR_texture_transform, texCoord,
sampler); another texture that lies differently is replaced by its mean, and named.
"""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spnr_jax.errors import refusing
from spnr_jax.formats.assets import (
    DIRECTION_TABLE,
    Alpha,
    Material,
    MissingFile,
    RejectedAsset,
    Tolerance,
    Wrap,
    color_texels,
    extra,
    make_material,
    read_companion,
    read_image,
    resize,
    value_texels,
)

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
DRACO, MESHOPT = "KHR_draco_mesh_compression", ("EXT_meshopt_compression", "KHR_meshopt_compression")
FILTERS = {  # of meshopt: the library's function, and the widths of a vertex
    "OCTAHEDRAL": ("decode_filter_oct", (4, 8)),
    "QUATERNION": ("decode_filter_quat", (8,)),
    "EXPONENTIAL": ("decode_filter_exp", range(4, 257, 4)),
}
GLB_MAGIC, CHUNK_JSON, CHUNK_BIN = b"glTF", 0x4E4F534A, 0x004E4942
WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728
BASIS, WEBP = "KHR_texture_basisu", "EXT_texture_webp"
MOVED = "KHR_texture_transform"
SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
DIELECTRIC = 0.04  # reflectance of a non-metal at normal incidence
TRANSPARENT = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}
# texels in place of a missing image: grey 0.5, roughness 0.5 of a non-metal, a specular colour of 0.04, flat
GREY, DULL, GLOSS, FLAT = (188, 188, 188, 255), (255, 128, 0, 255), (56, 56, 56, 128), (128, 128, 255, 255)
Look = tuple[Material, np.ndarray, np.ndarray | None]  # and factor (4,) and texels (h, w, 4) of the colour and alpha


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
        if "sparse" in accessor or "bufferView" not in accessor:
            raise RejectedAsset(f"accessor {index} is sparse or holds no data, which is not read: export it plain")
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        number, count, start = accessor["bufferView"], accessor["count"], accessor.get("byteOffset", 0)
        stride, view = self.document["bufferViews"][number].get("byteStride", dtype.itemsize * width), self.view(number)
        if count and start + (count - 1) * stride + width * dtype.itemsize > len(view):
            raise RejectedAsset(f"buffer view {number} is shorter than its accessor says: truncated or broken file")
        rows = np.ndarray((count, width), dtype, buffer=view, offset=start, strides=(stride, dtype.itemsize))
        return decode_accessor(rows, accessor)

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
    with refusing("holds meshopt data that is broken or cut off"):
        if mode != "ATTRIBUTES":
            decode = {"TRIANGLES": meshopt.decode_index_buffer, "INDICES": meshopt.decode_index_sequence}[mode]
            return decode(count, 4, data).astype({2: "<u2", 4: "<u4"}[stride]).tobytes()
        elements = meshopt.decode_vertex_buffer(count, stride, data, np.dtype((np.void, stride)))
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


# --- materials --------------------------------------------------------------------------------------------------------


class Placement(NamedTuple):
    """Texture coordinates: a set of the file's, moved by uv @ rotate_scale.T + offset; plain numbers, comparable."""

    wrap: Wrap = "repeat"
    texcoord_set: int = 0
    rotate_scale: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    offset: tuple[float, float] = (0.0, 0.0)

    def transform(self, texcoords: np.ndarray) -> np.ndarray:
        """Texture coordinates (v, 2) after KHR_texture_transform."""
        return texcoords @ np.array(self.rotate_scale).T + np.array(self.offset)


class Textures:
    """Reads a material's textures; `place` says where the first lies."""

    def __init__(self, file: GltfFile, name: str, tolerance: Tolerance):
        self.file, self.name, self.tolerance = file, name, tolerance
        self.place: Placement | None = None

    def read(self, info: dict | None, stand_in: tuple[int, ...]) -> np.ndarray | None:
        """Encoded texels (h, w, 4) of a textureInfo, or of the stand-in (4,) where its image may be missing.

        The texels' mean (1, 1, 4) takes the place of a texture that lies differently from the first.
        """
        if info is None:
            return None
        texture = self.file.document["textures"][info["index"]]
        try:
            texels = self._image(texture)
        except MissingFile as missing:
            self.tolerance.goes_on_without(missing)
            texels = np.array(stand_in, np.uint8).reshape(1, 1, 4)
        place = self._placement(info, texture)
        self.place = self.place or place
        if place == self.place:
            return texels
        self.tolerance.ignored.add("second texture with its own coordinates (its mean is used)")
        return texels.mean(axis=(0, 1), keepdims=True).round().astype(np.uint8)

    def _image(self, texture: dict) -> np.ndarray:
        extensions = texture.get("extensions", {})
        webp, basis = (extensions.get(name, {}).get("source") for name in (WEBP, BASIS))
        source = next((number for number in (webp, texture.get("source"), basis) if number is not None), None)
        if source is None:
            formats = ", ".join(extensions) or "no image"
            raise RejectedAsset(f"material {self.name!r} has a texture that cannot be read: {formats}")
        image = self.file.document["images"][source]
        if "uri" in image:
            return read_image(read_companion(self.file.folder, image["uri"]), image["uri"][:80])
        return read_image(bytes(self.file.view(image["bufferView"])), f"image {source}")

    def _placement(self, info: dict[str, Any], texture: dict) -> Placement:
        """Where a texture lies.

        Rotations are counter-clockwise in a frame whose v runs down, as the extension's words and examples say (its
        GLSL snippet turns the other way).
        """
        sampler = self.file.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wrap, wrap_t = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
        if wrap != wrap_t:
            self.tolerance.ignored.add(f"wrapT {wrap_t} (wrapS {wrap} is used for both)")
        if sampler.get("magFilter") == NEAREST:
            self.tolerance.ignored.add("nearest-texel filter (bilinear is used)")
        moved = info.get("extensions", {}).get(MOVED, {})
        cos, sin = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
        matrix = np.array([[cos, sin], [-sin, cos]]) * np.asarray(moved.get("scale", (1, 1)), np.float64)
        (a, b), (c, d) = matrix.tolist()
        x, y = moved.get("offset", (0, 0))
        return Placement(wrap, moved.get("texCoord", info.get("texCoord", 0)), ((a, b), (c, d)), (float(x), float(y)))


class GltfMaterial(NamedTuple):
    """A material, None if it is nowhere seen, the texture coordinates it wants, and whether its file asks for alpha."""

    material: Material | None
    placement: Placement
    has_alpha: bool


def read_material(file: GltfFile, index: int | None, tolerance: Tolerance) -> GltfMaterial:
    """The material `index` of a file (None: glTF's default); RejectedAsset if nothing may shine through."""
    spec = {} if index is None else file.document["materials"][index]
    name = str(spec.get("name", f"number {index}"))
    extensions = spec.get("extensions", {})
    textures = Textures(file, name, tolerance)
    glossy = extensions.get(SPECULAR_GLOSSINESS)
    if glossy is None:
        material, factor, color = _metallic_roughness(textures, spec.get("pbrMetallicRoughness", {}))
    else:
        material, factor, color = _specular_glossiness(textures, glossy)
    # after the textures: a missing file is the plainer reason
    shown = tolerance.cut_out(name, material, _alpha(spec, factor, color, tolerance.strict))
    if "KHR_materials_unlit" in extensions:
        tolerance.holds_light(name)
    dropped = {"occlusionTexture", "normalTexture"} if tolerance.strict else {"occlusionTexture"}
    tolerance.ignored |= (extensions.keys() - {SPECULAR_GLOSSINESS}) | (spec.keys() & dropped)
    if any(spec.get("emissiveFactor", ())):
        tolerance.ignored.add("emissive")
    bumps = None if tolerance.strict else textures.read(spec.get("normalTexture"), FLAT)
    if shown is not None and bumps is not None:
        scale = float(spec["normalTexture"].get("scale", 1.0))
        normal_map = color_texels(bumps, DIRECTION_TABLE) * np.array([scale, scale, 1], np.float32)
        shown = replace(shown, normal_map=normal_map)
    placement = textures.place or Placement()
    shown = shown and replace(shown, wrap=placement.wrap)
    return GltfMaterial(shown, placement, spec.get("alphaMode", "OPAQUE") != "OPAQUE")


def metallic_roughness(diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """base_color (*n, 3) and metallic (*n,) of linear diffuse and specular colours (*n, 3)."""
    strength = 1 - specular.max(axis=-1)
    bright_diffuse, bright_specular = _perceive_brightness(diffuse), _perceive_brightness(specular)
    b = bright_diffuse * strength / (1 - DIELECTRIC) + bright_specular - 2 * DIELECTRIC
    discriminant = np.maximum(b * b - 4 * DIELECTRIC * (DIELECTRIC - bright_specular), 0)
    metallic = np.clip((-b + np.sqrt(discriminant)) / (2 * DIELECTRIC), 0, 1)
    metallic = np.where(bright_specular < DIELECTRIC, 0, metallic)[..., None]
    from_diffuse = diffuse * strength[..., None] / (1 - DIELECTRIC) / np.maximum(1 - metallic, 1e-6)
    from_specular = (specular - DIELECTRIC * (1 - metallic)) / np.maximum(metallic, 1e-6)
    base_color = from_diffuse + (from_specular - from_diffuse) * metallic**2
    return np.clip(base_color, 0, 1), metallic[..., 0]


def _metallic_roughness(textures: Textures, spec: dict) -> Look:
    color = textures.read(spec.get("baseColorTexture"), GREY)
    surface = textures.read(spec.get("metallicRoughnessTexture"), DULL)
    factor = np.asarray(spec.get("baseColorFactor", (1, 1, 1, 1)), np.float64)
    roughness, metallic = spec.get("roughnessFactor", 1.0), spec.get("metallicFactor", 1.0)
    if surface is not None:
        roughness = value_texels(surface[..., 1]) * roughness
        metallic = metallic if metallic == 0 else value_texels(surface[..., 2]) * metallic
    base_color = factor[:3] if color is None else color_texels(color) * factor[:3]
    return make_material(base_color, roughness, metallic), factor, color


def _specular_glossiness(textures: Textures, spec: dict) -> Look:
    color = textures.read(spec.get("diffuseTexture"), GREY)
    surface = textures.read(spec.get("specularGlossinessTexture"), GLOSS)
    factor = np.asarray(spec.get("diffuseFactor", (1, 1, 1, 1)), np.float64)
    diffuse = factor[:3]
    specular = np.asarray(spec.get("specularFactor", (1, 1, 1)), np.float64)
    glossiness = np.asarray(spec.get("glossinessFactor", 1.0), np.float64)
    if color is not None:
        diffuse = color_texels(color) * diffuse
    if surface is not None:
        specular = color_texels(surface) * specular
        glossiness = value_texels(surface[..., 3]) * glossiness
    if diffuse.ndim == specular.ndim == 3:
        height, width = np.maximum(diffuse.shape[:2], specular.shape[:2])
        diffuse, specular = resize(diffuse, height, width), resize(specular, height, width)
    base_color, metallic = metallic_roughness(diffuse, np.broadcast_to(specular, np.broadcast(diffuse, specular).shape))
    return make_material(base_color, 1 - glossiness, metallic), factor, color


def _alpha(spec: dict, factor: np.ndarray, color: np.ndarray | None, strict: bool) -> Alpha | None:
    """The alpha of a material with this factor (4,) and these texels (h, w, 4) of its colour."""
    mode, extensions = spec.get("alphaMode", "OPAQUE"), spec.get("extensions", {})
    for extension, entry in TRANSPARENT.items():
        if extensions.get(extension, {}).get(entry, 0) > 0 and (not strict or mode == "OPAQUE"):
            return Alpha(extension, transmits=True)
    if mode == "OPAQUE":
        return None
    texels = None if color is None or strict else value_texels(color[..., 3])
    cutoff = float(spec.get("alphaCutoff", 0.5)) if mode == "MASK" else None
    return Alpha(f"alphaMode {mode}", float(factor[3]) if len(factor) > 3 else 1.0, texels, cutoff)


def _perceive_brightness(color: np.ndarray) -> np.ndarray | np.floating:
    return np.sqrt((color * color) @ np.array([0.299, 0.587, 0.114]))
