"""What every source of objects hands on: parts of triangles with principled materials.

Conventions, fixed here and nowhere else:
  axes        right-handed, y up (as in glTF), any unit; `normalise` brings an object into the unit sphere
  colours     linear RGB in [0, 1]
  textures    rows of texels; texture coordinate (u, v) = (0, 0) is the outer corner of texel [0, 0], v runs down the
              rows (as in glTF; mitsuba's `bitmap` reads the same way)
  faces       counted through all parts of an object in order: global face = faces of the parts before + local face
The renderer (what the network is shown) and the point sampler (what it is told) both read these records, so the two
cannot disagree about a material.  What only a picture of points needs (cut-outs, normal maps, textures with
coordinates of their own) is read where transparent parts are allowed, and never reaches the renderer.

A file may leave open what is to be seen: parts that light passes through, and files that it names and that are missing.
Where references are made (`refuse`) both are reasons to reject an object.  For a picture:
  MASK            there is surface where alpha reaches the cut-off of the file, and none elsewhere
  BLEND and the like, transmission
      opaque      drawn in their colour; texels that are all but invisible beside the most visible one are no surface
      skip        there is surface where alpha is at least a half; a part that transmits light is left out
  missing images  plain values of a stand-in
A part whose alpha is 1 everywhere is opaque, whatever its file calls it.
"""

import base64
import binascii
import importlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from spnr_jax.errors import UserError

Wrap = Literal["repeat", "mirror", "clamp"]
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


class RejectedAsset(UserError):
    """An object that cannot be used; the message is the one-line reason that goes into rejected.jsonl."""


class MissingFile(RejectedAsset):
    """A file that a mesh file names is not there, or lies where it must not be looked for."""


def extra(package: str) -> Any:
    """A package of the extra `meshes`; RejectedAsset where it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise RejectedAsset(f"needs the package {package} to be read: pip install 'spnr-jax[meshes]'") from None


@dataclass(frozen=True, kw_only=True)
class Material:
    """A principled (metallic-roughness) material; each channel is one value or a texture of its own size.

    base_color: (3,) or (height, width, 3); roughness, metallic: () or (height, width). All float32 in [0, 1], linear.
    opacity (height, width) or None: there is surface where it is at least `cutoff`.
    normal_map (height, width, 3) or None: normals along the directions in which u grows, in which v falls, and
    outwards, of any length.
    `coordinates` names the channels that lie by other texture coordinates than the first: their number, their wrap.
    """

    base_color: np.ndarray
    roughness: Values
    metallic: Values
    wrap: Wrap = "repeat"
    opacity: np.ndarray | None = None
    cutoff: float | int = 0.5
    normal_map: np.ndarray | None = None
    coordinates: Mapping[str, tuple[int, Wrap]] = field(default_factory=dict)

    @property
    def textured(self) -> bool:
        """Whether anything of it needs texture coordinates."""
        channels = any(np.ndim(getattr(self, name)) > axes for name, axes in CHANNELS.items())
        return channels or self.opacity is not None or self.normal_map is not None


@dataclass(frozen=True, kw_only=True)
class Part:
    """Triangles that share one material.

    positions (v, 3) float64; faces (f, 3) int64, counter-clockwise seen from outside where the source knows;
    normals (v, 3) unit, or None for flat shading; texcoords (v, 2), needed only if the material has a texture, or
    (v, 2 n) for n pairs of coordinates, of which `Material.coordinates` counts from 0;
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

    `notes` are sentences about what was made of transparent parts and of files that are missing.
    """

    parts: tuple[Part, ...]
    category: str = "object"
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    source: dict = field(default_factory=dict)


def make_material(
    base_color: Values | float | int = 0.5,
    roughness: Values | float | int = 0.5,
    metallic: Values | float | int = 0.0,
    wrap: Wrap = "repeat",
) -> Material:
    """A material of float32 channels in [0, 1]; grey of roughness 0.5 where nothing is given."""
    color, *values = (np.clip(np.asarray(x, np.float32), 0, 1) for x in (base_color, roughness, metallic))
    color = np.full(3, color) if color.ndim == 0 else color
    return Material(base_color=color, roughness=values[0], metallic=values[1], wrap=wrap)


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
    """The file in the folder that a path of another machine means: its last name, in any letter case."""
    name = unquote(uri).replace("\\", "/").rpartition("/")[2].casefold()
    if not name or not folder.is_dir():
        return None
    return next((path for path in sorted(folder.iterdir()) if path.name.casefold() == name), None)


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


class Opacity(NamedTuple):
    """Where a material has surface: everywhere without `texels`, else where they reach the cut-off; or `nowhere`."""

    texels: np.ndarray | None = None
    cutoff: float | int = MOSTLY_OPAQUE
    nowhere: bool = False


class Tolerance:
    """The policy of one reading, and what came of it."""

    def __init__(self, transparent_parts: TransparentParts):
        self.transparent_parts = transparent_parts
        self.said: dict[str, dict[str, None]] = {}  # beginning of a sentence -> names, in their order

    @property
    def strict(self) -> bool:
        """Whether the object is wanted as it is, or not at all."""
        return self.transparent_parts == "refuse"

    def opacity(self, name: str, alpha: Alpha) -> Opacity:
        """Where a material that may be transparent has surface; RejectedAsset where that is not to be decided."""
        if self.strict:
            raise RejectedAsset(f"is transparent: material {name!r} has {alpha.why}")
        if alpha.cutoff is not None:
            found = _cut(alpha.texels, alpha.factor, alpha.cutoff)
            self._say("surface only where the alpha of the texture reaches its cut-off", name, found.texels is not None)
            self._say("left out, wholly below the alpha cut-off", name, found.nowhere)
            return found
        if not (alpha.transmits or alpha.factor < 1 or (alpha.texels is not None and alpha.texels.min() < 1)):
            return Opacity()
        if self.transparent_parts == "skip":
            found = Opacity(nowhere=True) if alpha.transmits else _cut(alpha.texels, alpha.factor, MOSTLY_OPAQUE)
            self._say("transparent parts left out (--transparent-parts opaque draws them)", name)
            return found
        self._say("transparent parts drawn as opaque (--transparent-parts skip leaves them out)", name)
        if alpha.texels is None or not alpha.texels.max() > 0:
            return Opacity()
        return _cut(alpha.texels, 1.0, BARELY_VISIBLE * float(alpha.texels.max()))

    def goes_on_without(self, error: MissingFile) -> None:
        """Keeps the reason for the notes; raises it again where everything has to be there."""
        if self.strict:
            raise error
        reason, _, name = str(error).partition(": ")
        self._say(f"plain values taken where it {reason}", name, quoted=False)

    def holds_light(self, name: str) -> None:
        """Keeps for the notes that a material's colours are what is to be seen, light and all."""
        self._say("colours that hold light already (KHR_materials_unlit) taken as base colours", name)

    def notes(self) -> Iterable[str]:
        """One sentence for each thing that was decided."""
        for beginning, names in self.said.items():
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            yield f"{beginning}: {', '.join(list(names)[:MOST_NAMES])}{more}"

    def _say(self, beginning: str, name: str, happened: bool | np.bool_ = True, quoted: bool = True) -> None:
        if happened:
            self.said.setdefault(beginning, {})[repr(name[:LONGEST_NAME]) if quoted else name[:200]] = None


def _cut(texels: np.ndarray | None, factor: float | int, cutoff: float | int) -> Opacity:
    """Surface where texels * factor reach the cut-off; without texels everywhere or nowhere."""
    values = np.asarray(factor if texels is None else texels * factor)
    if values.min() >= cutoff:
        return Opacity()
    if not values.max() >= cutoff:
        return Opacity(nowhere=True)
    return Opacity(values.astype(np.float32), cutoff)
