"""What a reader makes of transparent parts and of images that are missing, and the sentences about it.

Where references are made (`refuse`) both are reasons to reject an object.  Where a picture is wanted:
  MASK            there is surface where alpha reaches the cut-off of the file, and none elsewhere
  BLEND and the like, transmission
      opaque      drawn in their colour; texels that are all but invisible beside the most visible one are no surface
      skip        there is surface where alpha is at least a half; a part that transmits light is left out
  missing images  plain values of a stand-in
A part whose alpha is 1 everywhere is opaque, whatever its file calls it.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from spnr_jax.formats.mesh.assets import MissingFile, RejectedAsset, TransparentParts

BARELY_VISIBLE = 0.1  # alpha below it, as a share of the texture's largest, is empty space around what is drawn
MOSTLY_OPAQUE = 0.5
MOST_NAMES, LONGEST_NAME = 3, 40  # in a sentence


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
        if not _sees_through(alpha):
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


def _sees_through(alpha: Alpha) -> bool:
    return alpha.transmits or alpha.factor < 1 or (alpha.texels is not None and bool(alpha.texels.min() < 1))


def _cut(texels: np.ndarray | None, factor: float | int, cutoff: float | int) -> Opacity:
    """Surface where texels * factor reach the cut-off; without texels everywhere or nowhere."""
    values = np.asarray(factor if texels is None else texels * factor)
    if values.min() >= cutoff:
        return Opacity()
    if not values.max() >= cutoff:
        return Opacity(nowhere=True)
    return Opacity(values.astype(np.float32), cutoff)
