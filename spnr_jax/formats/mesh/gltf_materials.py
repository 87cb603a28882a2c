"""glTF materials as principled ones, read from the raw JSON, and the texture coordinates that their textures want.

base colour = factor x texture (sRGB -> linear); roughness = factor x G, metallic = factor x B of the metallic-roughness
texture; defaults white, 1, 1. KHR_materials_pbrSpecularGlossiness is converted with the formulas of the extension's
reference converter. Where a picture is wanted and no reference (assets.py), alpha says where there is surface, and
the normal map is kept. Everything else that a material has is named as ignored.

The first texture that is read leads.  For references a material has one set of coordinates, and a second texture that
disagrees is replaced by its mean, and named; for pictures each has its own (KHR_texture_transform, texCoord, sampler).
KTX2 images (KHR_texture_basisu) and WebP images (EXT_texture_webp) are taken before the image that stands in for them.
"""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from spnr_jax.formats.mesh.assets import (
    Alpha,
    Material,
    MissingFile,
    Opacity,
    RejectedAsset,
    Tolerance,
    Wrap,
    make_material,
)
from spnr_jax.formats.mesh.gltf_container import GltfFile
from spnr_jax.formats.mesh.texels import KTX2_PACKAGE, color_texels, direction_texels, read_image, resize, value_texels

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


class Placement(NamedTuple):
    """Texture coordinates: a set of the file's, moved by uv @ rotate_scale.T + offset; plain numbers, comparable."""

    texcoord_set: int = 0
    rotate_scale: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    offset: tuple[float, float] = (0.0, 0.0)

    def transform(self, texcoords: np.ndarray) -> np.ndarray:
        """Texture coordinates (v, 2) after KHR_texture_transform."""
        return texcoords @ np.array(self.rotate_scale).T + np.array(self.offset)


class Textures:
    """Reads a material's textures; `placements` and `coordinates` say where they lie, `ignored` what was dropped."""

    def __init__(self, file: GltfFile, name: str, tolerance: Tolerance):
        self.file, self.name, self.tolerance = file, name, tolerance
        self.placements: list[Placement] = []
        self.coordinates: dict[str, tuple[int, Wrap]] = {}
        self.wrap: Wrap = "repeat"
        self.ignored: set[str] = set()

    def read(self, info: dict | None, stand_in: tuple[int, ...], channels: tuple[str, ...] = ()) -> np.ndarray | None:
        """Encoded texels (h, w, 4) of a textureInfo, or of the stand-in (4,) where its image may be missing.

        `channels` are those of a material that it alone fills, and which may lie by coordinates of their own; without
        any, or for references, the texels' mean (1, 1, 4) takes the place of a texture that disagrees with the first.
        """
        if info is None:
            return None
        texture = self.file.document["textures"][info["index"]]
        try:
            texels = self._image(texture)
        except MissingFile as missing:
            self.tolerance.goes_on_without(missing)
            texels = np.array(stand_in, np.uint8).reshape(1, 1, 4)
        wrap, place = self._wrap(texture), _placement(info)
        if not self.placements:
            self.placements, self.wrap = [place], wrap
        elif (place, wrap) != (self.placements[0], self.wrap):
            if self.tolerance.strict or not channels:
                self.ignored.add("second texture with its own coordinates (its mean is used)")
                return texels.mean(axis=(0, 1), keepdims=True).round().astype(np.uint8)
            if place not in self.placements:
                self.placements.append(place)
            self.coordinates |= dict.fromkeys(channels, (self.placements.index(place), wrap))
        return texels

    def _image(self, texture: dict) -> np.ndarray:
        extensions = texture.get("extensions", {})
        plain = texture.get("source")
        names = (BASIS, WEBP) if plain is None or find_spec(KTX2_PACKAGE) else (WEBP,)
        sources = [*(extensions.get(name, {}).get("source") for name in names), plain]
        source = next((number for number in sources if number is not None), None)
        if source is None:
            formats = ", ".join(extensions) or "no image"
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


def _placement(info: dict[str, Any]) -> Placement:
    """Where a texture lies.

    Rotations are counter-clockwise in a frame whose v runs down, as the extension's words and examples say (its GLSL
    snippet turns the other way).
    """
    moved = info.get("extensions", {}).get(MOVED, {})
    cos, sin = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
    scale = np.asarray(moved.get("scale", (1, 1)), np.float64)
    (a, b), (c, d) = np.array([[cos, sin], [-sin, cos]]) * scale
    x, y = np.asarray(moved.get("offset", (0, 0)), np.float64)
    matrix = (float(a), float(b)), (float(c), float(d))
    return Placement(moved.get("texCoord", info.get("texCoord", 0)), matrix, (float(x), float(y)))


@dataclass(frozen=True, kw_only=True)
class GltfMaterial:
    """A material, the texture coordinates it wants, whether its file asks for alpha, and whether it is nowhere seen."""

    material: Material
    placements: tuple[Placement, ...]
    has_alpha: bool
    nowhere: bool
    ignored: set[str]


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
    opacity = _opacity(spec, name, factor, color, tolerance)  # after the textures: a missing file is the plainer reason
    if "KHR_materials_unlit" in extensions:
        tolerance.holds_light(name)
    ignored = {key for key in extensions if key != SPECULAR_GLOSSINESS}
    ignored |= {key for key in ("normalTexture", "occlusionTexture") if key in spec}
    normal_map, bumps = None, None if tolerance.strict else spec.get("normalTexture")
    if bumps is not None and (encoded := textures.read(bumps, FLAT, ("normal_map",))) is not None:
        scale = float(bumps.get("scale", 1.0))
        normal_map = direction_texels(encoded) * np.array([scale, scale, 1], np.float32)
        ignored.discard("normalTexture")
    if any(spec.get("emissiveFactor", ())):
        ignored.add("emissive")
    material = replace(
        material,
        wrap=textures.wrap,
        opacity=opacity.texels,
        cutoff=opacity.cutoff,
        normal_map=normal_map,
        coordinates=textures.coordinates,
    )
    return GltfMaterial(
        material=material,
        placements=tuple(textures.placements) or (Placement(),),
        has_alpha=spec.get("alphaMode", "OPAQUE") != "OPAQUE",
        nowhere=opacity.nowhere,
        ignored=ignored | textures.ignored,
    )


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
    surface = textures.read(spec.get("metallicRoughnessTexture"), DULL, ("roughness", "metallic"))
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


def _opacity(spec: dict, name: str, factor: np.ndarray, color: np.ndarray | None, tolerance: Tolerance) -> Opacity:
    """Where a material with this factor (4,) and these texels (h, w, 4) has surface."""
    mode, extensions = spec.get("alphaMode", "OPAQUE"), spec.get("extensions", {})
    for extension, entry in TRANSPARENT.items():
        if extensions.get(extension, {}).get(entry, 0) > 0 and (not tolerance.strict or mode == "OPAQUE"):
            return tolerance.opacity(name, Alpha(extension, transmits=True))
    if mode == "OPAQUE":
        return Opacity()
    texels = None if color is None or tolerance.strict else value_texels(color[..., 3])
    cutoff = float(spec.get("alphaCutoff", 0.5)) if mode == "MASK" else None
    return tolerance.opacity(
        name, Alpha(f"alphaMode {mode}", float(factor[3]) if len(factor) > 3 else 1.0, texels, cutoff)
    )


def _perceive_brightness(color: np.ndarray) -> np.ndarray | np.floating:
    return np.sqrt((color * color) @ np.array([0.299, 0.587, 0.114]))
