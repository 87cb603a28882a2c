"""What every source of objects hands on: parts of triangles with principled materials.

Conventions, fixed here and nowhere else:
  axes        right-handed, y up (as in glTF), any unit; `normalise` brings an object into the unit sphere
  colours     linear RGB in [0, 1]
  textures    rows of texels; texture coordinate (u, v) = (0, 0) is the outer corner of texel [0, 0], v runs down the
              rows (as in glTF; mitsuba's `bitmap` reads the same way)
  faces       counted through all parts of an object in order: global face = faces of the parts before + local face
The renderer (what the network is shown) and the point sampler (what it is told) both read these records, so the two
cannot disagree about a material.  What only a picture of points needs (cut-outs, normal maps) is read where
transparent parts are allowed, and never reaches the renderer.

A file may leave open what is to be seen: parts that light passes through, and files that it names and that are missing.
Where references are made (`refuse`) both are reasons to reject an object.  For a picture:
  MASK            there is surface where alpha reaches the cut-off of the file, and none elsewhere
  BLEND and the like, transmission
      opaque      drawn in their colour; texels that are all but invisible beside the most visible one are no surface
      skip        there is surface where alpha is at least a half; a part that transmits light is left out
  missing images  plain values of a stand-in
A part whose alpha is 1 everywhere is opaque, whatever its file calls it.

Texel centres lie at half-integers / size.  The lookup is mitsuba's `bitmap` with `filter_type: bilinear` and the same
`wrap_mode`; a test compares the two.  Images of more than MAX_SIZE texels in width or height are box-filtered to that,
in linear values.
"""

import base64
import binascii
import importlib
import io
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from PIL import Image, UnidentifiedImageError
from scipy.ndimage import map_coordinates

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.columns import Columns, srgb_to_linear

Wrap = Literal["repeat", "mirror", "clamp"]
MODES = {"repeat": "grid-wrap", "mirror": "reflect", "clamp": "nearest"}  # as SciPy calls them
Values = np.ndarray | np.floating  # NumPy makes numbers of arrays without axes
ShownParts = Literal["opaque", "skip"]
# What becomes of parts that light passes through: refuse the object, as references need, draw them as if they were
# opaque, or leave them out; where they are not refused, a texture that is missing is no reason to refuse either.
TransparentParts = Literal["refuse", ShownParts]
CHANNELS = {"base_color": 1, "roughness": 0, "metallic": 0}  # of a material, and axes of one value
TEXTURES = {"opacity": 0, "normal_map": 1}  # of a material that may be absent, and axes of one texel
BARELY_VISIBLE = 0.1  # alpha below it, as a share of the texture's largest, is empty space around what is drawn
MOSTLY_OPAQUE = 0.5
MOST_NAMES, LONGEST_NAME = 3, 40  # in a sentence
MAX_SIZE = 1024
MOST_PIXELS = 2**26  # of an image file: 8192 x 8192
KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
LEVELS = np.arange(256) / 255  # of 8 bits
SRGB_TABLE, DIRECTION_TABLE = srgb_to_linear(LEVELS).astype(np.float32), (2 * LEVELS - 1).astype(np.float32)


class RejectedAsset(UserError):
    """An object that cannot be used; the message is the one-line reason that goes into rejected.jsonl."""


class MissingFile(RejectedAsset):
    """A file that a mesh file names is not there, or lies where it must not be looked for."""


def extra(package: str, name: str = "meshes") -> Any:
    """A package of an extra; RejectedAsset where it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise RejectedAsset(f"needs the package {package} to be read: pip install 'spnr-jax[{name}]'") from None


@dataclass(frozen=True, kw_only=True)
class Material:
    """A principled (metallic-roughness) material; each channel is one value or a texture of its own size.

    base_color: (3,) or (height, width, 3); roughness, metallic: () or (height, width). All float32 in [0, 1], linear.
    opacity (height, width) or None: there is surface where it is at least `cutoff`.
    normal_map (height, width, 3) or None: normals along the directions in which u grows, in which v falls, and
    outwards, of any length.
    """

    base_color: np.ndarray
    roughness: Values
    metallic: Values
    wrap: Wrap = "repeat"
    opacity: np.ndarray | None = None
    cutoff: float | int = 0.5
    normal_map: np.ndarray | None = None

    @property
    def textured(self) -> bool:
        """Whether anything of it needs texture coordinates."""
        channels = any(np.ndim(getattr(self, name)) > axes for name, axes in CHANNELS.items())
        return channels or self.opacity is not None or self.normal_map is not None


@dataclass(frozen=True, kw_only=True)
class Part:
    """Triangles that share one material.

    positions (v, 3) float64; faces (f, 3) int64, counter-clockwise seen from outside where the source knows;
    normals (v, 3) unit, or None for flat shading; texcoords (v, 2), needed only if the material has a texture;
    colors (v, 3) linear, multiplies the material's base colour, or None.
    """

    positions: np.ndarray
    faces: np.ndarray
    material: Material
    normals: np.ndarray | None = None
    texcoords: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Asset:
    """One object: its parts, what kind it is, and what its source holds that is not modelled (named, never silent).

    `notes` are sentences about what was made of transparent parts and of files that are missing; `points` the columns
    of the vertices of a file without faces.
    """

    parts: tuple[Part, ...]
    category: str = "object"
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    source: dict = field(default_factory=dict)
    points: Columns | None = None


def make_material(
    base_color: Values | float | int = 0.5,
    roughness: Values | float | int = 0.5,
    metallic: Values | float | int = 0.0,
    wrap: Wrap = "repeat",
) -> Material:
    """A material of float32 channels in [0, 1]; grey of roughness 0.5 where nothing is given."""
    color = np.asarray(base_color, np.float32)
    channels: dict[str, Any] = {"base_color": np.full(3, color) if color.ndim == 0 else color}
    channels |= {"roughness": np.asarray(roughness, np.float32), "metallic": np.asarray(metallic, np.float32)}
    for name, axes in CHANNELS.items():
        shape = channels[name].shape
        if shape[len(shape) - axes :] != (3,) * axes or len(shape) - axes not in (0, 2) or 0 in shape:
            raise RejectedAsset(f"has a material with {name} of shape {shape}: broken file")
        if not np.isfinite(channels[name]).all():
            raise RejectedAsset(f"has a material whose {name} is not finite (NaN or infinity)")
    return Material(**{name: np.clip(values, 0, 1) for name, values in channels.items()}, wrap=wrap)


def read_companion(folder: Path, uri: str, root: Path | None = None) -> bytes:
    """Bytes of the file that `uri` names, relative to `folder` (percent escapes as in glTF), or of a data URI.

    A name in a mesh file is somebody else's text: MissingFile for one that leads out of the object's folder, to the
    network or to nothing.  A path of another machine, or a name in other capitals, means the file of that name beside
    the mesh, if there is one.  `root` is the object's folder, `folder` or one above it: a ShapeNet object keeps its
    images beside the folder of its mesh (`../images`).
    """
    if uri.startswith("data:"):
        head, _, payload = uri.partition(",")
        try:
            return base64.b64decode(payload, validate=True) if head.endswith(";base64") else unquote_to_bytes(payload)
        except binascii.Error as error:
            raise RejectedAsset(f"holds a data URI that is not base64: {error}") from None
    plain, path = (_inside(root or folder, folder, name) for name in (uri, unquote(uri)))
    for place in (plain, path, _beside(folder, uri)):
        if place is not None and place.is_file():
            return place.read_bytes()
    if path is None:
        raise MissingFile(f"names a file outside its own folder: {uri!r}")
    raise MissingFile(f"names a file that is missing: {unquote(uri)!r}")


def _beside(folder: Path, uri: str) -> Path | None:
    """The file that a path of another machine means: its longest end that is in the folder, in any letter case."""
    names = unquote(uri).replace("\\", "/").casefold().split("/")
    for start in range(len(names)):
        place: Path | None = folder
        for name in names[start:]:
            inside = sorted(place.iterdir()) if place and place.is_dir() else []
            place = next((path for path in inside if path.name.casefold() == name), None)
        if place:
            return place
    return None


def _inside(root: Path, folder: Path, name: str) -> Path | None:
    """The file that a name, written with either kind of slash, means from `folder`; None where it leaves `root`.

    Parent steps are resolved in the text, so that a link among the folders cannot lead them elsewhere.
    """
    name = name.replace("\\", "/")
    first, *_ = place = os.path.normpath(os.path.join(*folder.relative_to(root).parts, name)).split("/")
    return None if first in ("", ".", "..") or ":" in name.partition("/")[0] else root.joinpath(*place)


class Alpha(NamedTuple):
    """The alpha of a material: why its file says that it is transparent, its factor and texels (h, w) in [0, 1]."""

    why: str
    factor: float | int = 1.0
    texels: np.ndarray | None = None
    cutoff: float | int | None = None  # of a mask
    transmits: bool = False


class Tolerance:
    """The policy of one reading, and what came of it; `ignored` names what a file holds that is not modelled."""

    def __init__(self, transparent_parts: TransparentParts):
        self.transparent_parts = transparent_parts
        self.ignored: set[str] = set()
        self.said: dict[str, dict[str, None]] = {}  # beginning of a sentence -> names, in their order

    @property
    def strict(self) -> bool:
        """Whether the object is wanted as it is, or not at all."""
        return self.transparent_parts == "refuse"

    def cut_out(self, name: str, material: Material, alpha: Alpha | None) -> Material | None:
        """The material with surface where its alpha says so, None if that is nowhere; RejectedAsset if it may not."""
        if alpha is None:
            return material
        if self.strict:
            raise RejectedAsset(f"is transparent: material {name!r} has {alpha.why}")
        values, cutoff = np.asarray(alpha.factor if alpha.texels is None else alpha.texels * alpha.factor), alpha.cutoff
        if cutoff is None:
            if not alpha.transmits and values.min() >= 1:
                return material
            cutoff = np.inf if alpha.transmits else MOSTLY_OPAQUE
            if self.transparent_parts == "skip":
                self._say("transparent parts left out (--transparent-parts opaque draws them)", name)
            else:
                self._say("transparent parts drawn as opaque (--transparent-parts skip leaves them out)", name)
                values = np.ones(()) if alpha.texels is None else alpha.texels
                cutoff = BARELY_VISIBLE * float(values.max())
        surface = values >= cutoff
        if surface.all():
            return material
        if alpha.cutoff is not None and surface.any():
            self._say("surface only where the alpha of the texture reaches its cut-off", name)
        elif alpha.cutoff is not None:
            self._say("left out, wholly below the alpha cut-off", name)
        return replace(material, opacity=values.astype(np.float32), cutoff=cutoff) if surface.any() else None

    def goes_on_without(self, error: MissingFile) -> None:
        """Keeps the reason for the notes; raises it again where everything has to be there."""
        if self.strict:
            raise error
        reason, _, name = str(error).partition(": ")
        self._say(f"plain values taken where it {reason}", name, quoted=False)

    def holds_light(self, name: str) -> None:
        """Keeps for the notes that a material's colours are what is to be seen, light and all."""
        self._say("colours that hold light already (KHR_materials_unlit) taken as base colours", name)

    def asset(self, parts: Sequence[Part], *more_notes: str) -> Asset:
        """The asset of the parts, with a sentence for each thing that was decided; RejectedAsset if there are none."""
        notes = []
        for beginning, names in self.said.items():
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            notes.append(f"{beginning}: {', '.join(list(names)[:MOST_NAMES])}{more}")
        if not parts:
            raise RejectedAsset(f"has nothing to draw: {'; '.join(notes)}" if notes else "has no faces")
        return Asset(parts=tuple(parts), ignored=tuple(sorted(self.ignored)), notes=(*notes, *more_notes))

    def _say(self, beginning: str, name: str, quoted: bool = True) -> None:
        self.said.setdefault(beginning, {})[repr(name[:LONGEST_NAME]) if quoted else name[:200]] = None


def read_image(data: bytes, name: str) -> np.ndarray:
    """The texels of `decode_image`; ValueError, which names it, for an image that cannot be read."""
    with refusing(f"names an image that cannot be read: {name}"):
        return decode_image(data)


def decode_image(data: bytes) -> np.ndarray:
    """Texels (height, width, 4) uint8 of an image file as they are encoded; alpha is 255 where it has none.

    ValueError for none, and for too large a one; what is damaged raises whatever Pillow raises.
    """
    if data.startswith(KTX2):
        raise ValueError("KTX2, which is not read: convert it to PNG, e.g. with `ktx extract`")
    try:
        with warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning):
            image: Image.Image = Image.open(io.BytesIO(data))
    except UnidentifiedImageError:
        raise ValueError("is not an image") from None
    if image.width * image.height > MOST_PIXELS:  # before memory is taken for them
        raise ValueError(f"{image.width} x {image.height} pixels, more than {MOST_PIXELS}")
    if image.mode.startswith("I"):  # PIL would clip 16-bit grey to 255 instead of scaling it
        image = Image.fromarray((np.asarray(image) // 257).astype(np.uint8))
    return np.asarray(image.convert("RGBA"))


def color_texels(encoded: np.ndarray, table: np.ndarray = SRGB_TABLE) -> np.ndarray:
    """Linear colours (h, w, 3) float32 of texels (h, w, 4) uint8 that are sRGB, or what a table (256,) says."""
    return np.stack([shrink(table[encoded[..., channel]]) for channel in range(3)], axis=-1)  # one by one: memory


def value_texels(encoded: np.ndarray) -> np.ndarray:
    """Values (h, w) float32 in [0, 1] of linearly encoded texels (h, w) uint8, at most MAX_SIZE a side."""
    return shrink(encoded.astype(np.float32) / 255)


def shrink(texels: np.ndarray) -> np.ndarray:
    """The texture (height, width) or (height, width, c), float32, box-filtered to at most MAX_SIZE texels a side."""
    height, width = texels.shape[:2]
    ratio = MAX_SIZE / max(height, width)
    if ratio >= 1:
        return texels.astype(np.float32)
    return resize(texels, max(1, round(height * ratio)), max(1, round(width * ratio)))


def resize(texels: np.ndarray, height: int | np.integer, width: int | np.integer) -> np.ndarray:
    """The texture resampled with a box filter, float32."""
    channels, size = texels.reshape(*texels.shape[:2], -1), (int(width), int(height))
    resized = [
        np.asarray(Image.fromarray(np.ascontiguousarray(channel)).resize(size, Image.Resampling.BOX))
        for channel in np.moveaxis(channels.astype(np.float32), -1, 0)
    ]
    return np.stack(resized, axis=-1).reshape(height, width, *texels.shape[2:])


def lookup(texels: np.ndarray, texcoords: np.ndarray, wrap: Wrap) -> np.ndarray:
    """Bilinear values (n,) or (n, c) of a texture (height, width) or (height, width, c) at texcoords (n, 2)."""
    height, width, *channels = texels.shape
    places = (np.asarray(texcoords, np.float64) * [width, height] - 0.5)[:, ::-1].T
    flat = np.moveaxis(texels.reshape(height, width, -1), -1, 0)
    values = [map_coordinates(channel, places, np.float64, order=1, mode=MODES[wrap]) for channel in flat]
    return np.stack(values, axis=-1).reshape(-1, *channels)
