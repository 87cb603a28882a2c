"""glTF materials as principled ones, read from the raw JSON.

base colour = factor x texture (sRGB -> linear); roughness = factor x G, metallic = factor x B of the metallic-roughness
texture; defaults white, 1, 1. KHR_materials_pbrSpecularGlossiness is converted with the formulas of the extension's
reference converter. One set of texture coordinates serves a material: the base-colour texture's (its texCoord,
KHR_texture_transform and wrap mode); a second texture that disagrees is replaced by its mean, and named.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spnr_jax.formats.mesh.assets import Material, RejectedAsset, Values, Wrap
from spnr_jax.formats.mesh.gltf_container import GltfFile
from spnr_jax.formats.mesh.texels import color_texels, read_image, resize, value_texels

WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728
SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
DIELECTRIC = 0.04  # reflectance of a non-metal at normal incidence
TRANSPARENT = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}


@dataclass(frozen=True, kw_only=True)
class GltfMaterial:
    """A material with the texture coordinates it wants: `texcoord_set`, moved by uv @ rotate_scale.T + offset."""

    material: Material
    texcoord_set: int = 0
    rotate_scale: np.ndarray = field(default_factory=lambda: np.eye(2))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(2))
    ignored: frozenset[str] = frozenset()

    def transform(self, texcoords: np.ndarray) -> np.ndarray:
        """Texture coordinates (v, 2) after KHR_texture_transform."""
        return texcoords @ self.rotate_scale.T + self.offset


def read_material(file: GltfFile, index: int | None) -> GltfMaterial:
    """The material `index` of a file (None: glTF's default); RejectedAsset if light passes through it."""
    spec = {} if index is None else file.document["materials"][index]
    name = spec.get("name", f"number {index}")
    extensions = spec.get("extensions", {})
    textures = _Textures(file, name)
    glossy = extensions.get(SPECULAR_GLOSSINESS)
    convert = _metallic_roughness if glossy is None else _specular_glossiness
    channels = convert(textures, spec.get("pbrMetallicRoughness", {}) if glossy is None else glossy)
    _reject_transparent(spec, name)  # after the textures: a missing file is the plainer reason
    ignored = textures.ignored | {key for key in extensions if key != SPECULAR_GLOSSINESS}
    ignored |= {key for key in ("normalTexture", "occlusionTexture") if key in spec}
    if any(spec.get("emissiveFactor", ())):
        ignored.add("emissive")
    info = textures.leading or {}
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    rotate_scale, offset = _texture_transform(moved)
    return GltfMaterial(
        material=Material(**channels, wrap=textures.wrap),
        texcoord_set=moved.get("texCoord", info.get("texCoord", 0)),
        rotate_scale=rotate_scale,
        offset=offset,
        ignored=frozenset(ignored),
    )


def metallic_roughness(diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """base_color (*n, 3) and metallic (*n,) of linear diffuse and specular colours (*n, 3)."""
    strength = 1 - specular.max(axis=-1)
    bright_diffuse, bright_specular = _perceived_brightness(diffuse), _perceived_brightness(specular)
    b = bright_diffuse * strength / (1 - DIELECTRIC) + bright_specular - 2 * DIELECTRIC
    discriminant = np.maximum(b * b - 4 * DIELECTRIC * (DIELECTRIC - bright_specular), 0)
    metallic = np.clip((-b + np.sqrt(discriminant)) / (2 * DIELECTRIC), 0, 1)
    metallic = np.where(bright_specular < DIELECTRIC, 0, metallic)[..., None]
    from_diffuse = diffuse * strength[..., None] / (1 - DIELECTRIC) / np.maximum(1 - metallic, 1e-6)
    from_specular = (specular - DIELECTRIC * (1 - metallic)) / np.maximum(metallic, 1e-6)
    base_color = from_diffuse + (from_specular - from_diffuse) * metallic**2
    return np.clip(base_color, 0, 1), metallic[..., 0]


def _metallic_roughness(textures: "_Textures", spec: dict) -> dict[str, Any]:
    color = textures.read(spec.get("baseColorTexture"))
    surface = textures.read(spec.get("metallicRoughnessTexture"))
    base_color = np.asarray(spec.get("baseColorFactor", (1, 1, 1, 1)), np.float64)[:3]
    roughness, metallic = spec.get("roughnessFactor", 1.0), spec.get("metallicFactor", 1.0)
    return _channels(
        base_color=base_color if color is None else color_texels(color) * base_color,
        roughness=roughness if surface is None else value_texels(surface[..., 1]) * roughness,
        metallic=metallic if surface is None or metallic == 0 else value_texels(surface[..., 2]) * metallic,
    )


def _specular_glossiness(textures: "_Textures", spec: dict) -> dict[str, Any]:
    color = textures.read(spec.get("diffuseTexture"))
    surface = textures.read(spec.get("specularGlossinessTexture"))
    diffuse = np.asarray(spec.get("diffuseFactor", (1, 1, 1, 1)), np.float64)[:3]
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
    return _channels(base_color=base_color, roughness=1 - glossiness, metallic=metallic)


class _Textures:
    """Reads a material's textures; the first one read decides the texture coordinates and the wrap mode."""

    def __init__(self, file: GltfFile, name: str):
        self.file, self.name = file, name
        self.leading: dict | None = None
        self.wrap: Wrap = "repeat"
        self.ignored: set[str] = set()

    def read(self, info: dict | None) -> np.ndarray | None:
        """Encoded texels (h, w, 4) of a textureInfo; their mean (1, 1, 4) where its coordinates are its own."""
        if info is None:
            return None
        texture = self.file.document["textures"][info["index"]]
        texels = self._image(texture)
        wrap = self._wrap(texture)
        if self.leading is None:
            self.leading, self.wrap = info, wrap
        elif (_placement(info), wrap) != (_placement(self.leading), self.wrap):
            self.ignored.add("second texture with its own coordinates (its mean is used)")
            return texels.mean(axis=(0, 1), keepdims=True).round().astype(np.uint8)
        return texels

    def _image(self, texture: dict) -> np.ndarray:
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.get("source"))
        if source is None:
            formats = ", ".join(texture.get("extensions", {})) or "no image"
            raise RejectedAsset(f"material {self.name!r} has a texture that cannot be read: {formats}")
        label = self.file.document["images"][source].get("uri", f"image {source}")
        return read_image(self.file.image_bytes(source), label[:80])

    def _wrap(self, texture: dict) -> Wrap:
        sampler = self.file.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        wrap_s, wrap_t = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
        if wrap_s != wrap_t:
            self.ignored.add(f"wrapT {wrap_t} (wrapS {wrap_s} is used for both)")
        if sampler.get("magFilter") == NEAREST:
            self.ignored.add("nearest-texel filter (bilinear is used)")
        return wrap_s


def _placement(info: dict) -> tuple:
    """What decides the coordinates of a texture: its set and its transform, comparable."""
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    rotate_scale, offset = _texture_transform(moved)
    return moved.get("texCoord", info.get("texCoord", 0)), rotate_scale.tolist(), offset.tolist()


def _texture_transform(moved: dict) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (2, 2) and offset (2,) of KHR_texture_transform.

    Counter-clockwise in a frame whose v runs down, as the extension's words and examples say (its GLSL snippet turns
    the other way).
    """
    cos, sin = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
    scale = np.asarray(moved.get("scale", (1, 1)), np.float64)
    return np.array([[cos, sin], [-sin, cos]]) * scale, np.asarray(moved.get("offset", (0, 0)), np.float64)


def _channels(**channels: Values | float | int) -> dict[str, Any]:
    """The channels as float32 in [0, 1]."""
    return {name: np.clip(np.asarray(values, np.float32), 0, 1) for name, values in channels.items()}


def _perceived_brightness(color: np.ndarray) -> Values:
    return np.sqrt((color * color) @ np.array([0.299, 0.587, 0.114]))


def _reject_transparent(spec: dict, name: str) -> None:
    if (mode := spec.get("alphaMode", "OPAQUE")) != "OPAQUE":
        raise RejectedAsset(f"is transparent: material {name!r} has alphaMode {mode}")
    for extension, factor in TRANSPARENT.items():
        if spec.get("extensions", {}).get(extension, {}).get(factor, 0) > 0:
            raise RejectedAsset(f"is transparent: material {name!r} has {extension}")
