"""glTF materials as principled ones, read from the raw JSON.

base colour = factor x texture (sRGB -> linear); roughness = factor x G, metallic = factor x B of the metallic-roughness
texture; defaults white, 1, 1. KHR_materials_pbrSpecularGlossiness is converted with the formulas of the extension's
reference converter. Where a picture is wanted and no reference (tolerance.py), alpha says where there is surface, and
the normal map is kept. Everything else that a material has is named as ignored.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from spnr_jax.formats.mesh.assets import Material, Values
from spnr_jax.formats.mesh.gltf_container import GltfFile
from spnr_jax.formats.mesh.gltf_textures import Placement, Textures
from spnr_jax.formats.mesh.texels import color_texels, direction_texels, resize, value_texels
from spnr_jax.formats.mesh.tolerance import Alpha, Opacity, Tolerance

SPECULAR_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
DIELECTRIC = 0.04  # reflectance of a non-metal at normal incidence
TRANSPARENT = {
    "KHR_materials_transmission": "transmissionFactor",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
}
# texels in place of a missing image: grey 0.5, roughness 0.5 of a non-metal, a specular colour of 0.04, flat
GREY, DULL, GLOSS, FLAT = (188, 188, 188, 255), (255, 128, 0, 255), (56, 56, 56, 128), (128, 128, 255, 255)


class Look(NamedTuple):
    """The channels of a material, and the alpha of its colour: factor and texels (h, w), if it has any."""

    channels: dict[str, Any]
    alpha_factor: float | int
    alpha_texels: np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class GltfMaterial:
    """A material, the texture coordinates it wants, whether its file asks for alpha, and whether it is nowhere seen."""

    material: Material
    placements: tuple[Placement, ...] = (Placement(),)
    has_alpha: bool = False
    nowhere: bool = False
    ignored: frozenset[str] = frozenset()


def read_material(file: GltfFile, index: int | None, tolerance: Tolerance) -> GltfMaterial:
    """The material `index` of a file (None: glTF's default); RejectedAsset if nothing may shine through."""
    spec = {} if index is None else file.document["materials"][index]
    name = str(spec.get("name", f"number {index}"))
    extensions = spec.get("extensions", {})
    textures = Textures(file, name, tolerance)
    glossy = extensions.get(SPECULAR_GLOSSINESS)
    convert = _metallic_roughness if glossy is None else _specular_glossiness
    look = convert(textures, spec.get("pbrMetallicRoughness", {}) if glossy is None else glossy)
    opacity = _opacity(spec, name, look, tolerance)  # after the textures: a missing file is the plainer reason
    normal_map = None if tolerance.strict else _normal_map(textures, spec.get("normalTexture"))
    if "KHR_materials_unlit" in extensions:
        tolerance.holds_light(name)
    ignored = textures.ignored | {key for key in extensions if key != SPECULAR_GLOSSINESS}
    ignored |= {key for key in ("normalTexture", "occlusionTexture") if key in spec}
    if normal_map is not None:
        ignored.discard("normalTexture")
    if any(spec.get("emissiveFactor", ())):
        ignored.add("emissive")
    material = Material(
        **look.channels,
        wrap=textures.wrap,
        opacity=opacity.texels,
        cutoff=opacity.cutoff,
        normal_map=normal_map,
        coordinates=textures.coordinates,
    )
    return GltfMaterial(
        material=material,
        placements=tuple(textures.placements) or (Placement(),),
        has_alpha=not _opaque(spec),
        nowhere=opacity.nowhere,
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


def _metallic_roughness(textures: Textures, spec: dict) -> Look:
    color = textures.read(spec.get("baseColorTexture"), GREY)
    surface = textures.read(spec.get("metallicRoughnessTexture"), DULL, ("roughness", "metallic"))
    factor = np.asarray(spec.get("baseColorFactor", (1, 1, 1, 1)), np.float64)
    roughness, metallic = spec.get("roughnessFactor", 1.0), spec.get("metallicFactor", 1.0)
    channels = _channels(
        base_color=factor[:3] if color is None else color_texels(color) * factor[:3],
        roughness=roughness if surface is None else value_texels(surface[..., 1]) * roughness,
        metallic=metallic if surface is None or metallic == 0 else value_texels(surface[..., 2]) * metallic,
    )
    return Look(channels, *_alpha(factor, color, textures))


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
    channels = _channels(base_color=base_color, roughness=1 - glossiness, metallic=metallic)
    return Look(channels, *_alpha(factor, color, textures))


def _alpha(factor: np.ndarray, color: np.ndarray | None, textures: Textures) -> tuple[float, np.ndarray | None]:
    """Factor and texels (h, w) of the alpha of a colour; nobody asks for it where transparent parts are refused."""
    texels = None if color is None or textures.tolerance.strict else value_texels(color[..., 3])
    return float(factor[3]) if len(factor) > 3 else 1.0, texels


def _opacity(spec: dict, name: str, look: Look, tolerance: Tolerance) -> Opacity:
    """Where a material has surface."""
    extensions = spec.get("extensions", {})
    for extension, factor in TRANSPARENT.items():
        if extensions.get(extension, {}).get(factor, 0) > 0 and (not tolerance.strict or _opaque(spec)):
            return tolerance.opacity(name, Alpha(extension, transmits=True))
    if _opaque(spec):
        return Opacity()
    mode = spec["alphaMode"]
    cutoff = float(spec.get("alphaCutoff", 0.5)) if mode == "MASK" else None
    return tolerance.opacity(name, Alpha(f"alphaMode {mode}", look.alpha_factor, look.alpha_texels, cutoff))


def _opaque(spec: dict) -> bool:
    return spec.get("alphaMode", "OPAQUE") == "OPAQUE"


def _normal_map(textures: Textures, info: dict | None) -> np.ndarray | None:
    """Normals (h, w, 3) along u, against v, outwards; None where there are none."""
    encoded = textures.read(info, FLAT, ("normal_map",))
    if info is None or encoded is None:
        return None
    scale = float(info.get("scale", 1.0))
    return direction_texels(encoded) * np.array([scale, scale, 1], np.float32)


def _channels(**channels: Values | float | int) -> dict[str, Any]:
    """The channels as float32 in [0, 1]."""
    return {name: np.clip(np.asarray(values, np.float32), 0, 1) for name, values in channels.items()}


def _perceived_brightness(color: np.ndarray) -> Values:
    return np.sqrt((color * color) @ np.array([0.299, 0.587, 0.114]))
