"""The textures of a glTF material, with the texture coordinates and the wrap mode that each of them wants.

The first texture that is read leads.  For references a material has one set of coordinates, and a second texture that
disagrees is replaced by its mean, and named; for pictures each has its own (KHR_texture_transform, texCoord, sampler).
KTX2 images (KHR_texture_basisu) and WebP images (EXT_texture_webp) are taken before the image that stands in for them.
"""

from typing import Any, NamedTuple

import numpy as np

from spnr_jax.formats.mesh import ktx2
from spnr_jax.formats.mesh.assets import MissingFile, RejectedAsset, Wrap
from spnr_jax.formats.mesh.gltf_container import GltfFile
from spnr_jax.formats.mesh.texels import read_image
from spnr_jax.formats.mesh.tolerance import Tolerance

WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
NEAREST = 9728
BASIS, WEBP = "KHR_texture_basisu", "EXT_texture_webp"
MOVED = "KHR_texture_transform"


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
        names = (BASIS, WEBP) if plain is None or ktx2.available() else (WEBP,)
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
