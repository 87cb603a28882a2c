"""What a mesh file may leave open: parts that light passes through, and files that it names and that are missing.

Where references are made (`refuse`) transparency and a missing file are reasons to reject an object.  For a picture:
  MASK            there is surface where alpha reaches the cut-off of the file, and none elsewhere
  BLEND and the like, transmission
      opaque      drawn in their colour; texels that are all but invisible beside the most visible one are no surface
      skip        there is surface where alpha is at least a half; a part that transmits light is left out
  missing images  plain values of a stand-in
A part whose alpha is 1 everywhere is opaque, whatever its file calls it.

A name in a mesh file is somebody else's text: data URIs are decoded, and a name that leaves the object's folder or
points to the network is refused.  A path of another machine, or a name in other capitals, means the file of that name
beside the mesh, if there is one.  The object's folder is the mesh's, unless its source says otherwise: a ShapeNet
object keeps its images beside the folder of its mesh (`../images`).
"""

import base64
import binascii
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from spnr_jax.formats.mesh.assets import MissingFile, RejectedAsset, TransparentParts

BARELY_VISIBLE = 0.1  # alpha below it, as a share of the texture's largest, is empty space around what is drawn
MOSTLY_OPAQUE = 0.5
MOST_NAMES, LONGEST_NAME = 3, 40  # in a sentence


def read_companion(folder: Path, uri: str, root: Path | None = None) -> bytes:
    """Bytes of the file that `uri` names, relative to `folder` (percent escapes as in glTF), or of a data URI.

    `root` is the object's folder, `folder` or one above it; MissingFile for a name that leads out of it or to nothing.
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
