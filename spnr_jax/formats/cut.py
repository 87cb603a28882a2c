"""What is cut out of a scene before it is drawn, as options; nothing here takes time to import."""

import math
from dataclasses import dataclass

from spnr_jax.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Cut:
    """One object of a scene: inside a box, without the dominant plane, one cluster of points, in this order."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """Only what lies in this box: xmin ymin zmin xmax ymax zmax, in the file's own units and axes."""
    remove_plane: bool = False
    """Without the plane that holds most of the surface: floor, table or wall."""
    object: str | None = None
    """Only one cluster of points: `largest`, or 2 for the second largest, and so on, after the plane is removed."""

    keep_noise: bool = False
    """Also points that a scan's classification calls noise (7, 18), withheld ones, and those of next to no opacity."""

    @property
    def is_given(self) -> bool:
        """Whether anything is cut."""
        return bool(self.crop or self.remove_plane or self.object)

    @property
    def nth(self) -> int | None:
        """Which cluster, the largest is 1; None for all."""
        return None if self.object is None else 1 if self.object == "largest" else int(self.object)

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.object not in (None, "largest") and not (self.object.isdecimal() and int(self.object) > 0):
            raise UserError(f"--object must be largest or a number from 1, got {self.object!r}")
        if self.crop is None:
            return
        box = tuple(self.crop)
        if len(box) != 6 or not all(map(math.isfinite, box)) or any(a > b for a, b in zip(box, box[3:], strict=False)):
            raise UserError(f"--crop takes xmin ymin zmin xmax ymax zmax, each min up to its max, got {box}")
