"""The options of `spnr export --splats` and `spnr share` that say how splats are made; nothing slow to import."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from spnr_jax.errors import UserError

MOST_SPLATS = 200_000  # that a file or page is asked for: more than viewers on telephones draw


@dataclass(frozen=True, kw_only=True)
class SplatMaking:
    """How Gaussian splats are made of a cloud."""

    seconds: float = 20.0
    """Seconds that splats are refined against the network's pictures, compilation apart; 0 leaves them as they are
    first made."""
    most_splats: int = 80_000
    """Splats at most."""
    harmonics: Literal[0, 1, 2, 3] = 1
    """Degree of the spherical harmonics by which a splat's colour follows the view; 0: it does not."""
    fitting_views: int = 32
    """Pictures of the network that splats are made from."""

    @property
    def asked(self) -> dict[str, Any]:
        """What `splat_making.splats_of` is asked for."""
        sizes = {"degree": self.harmonics, "most": self.most_splats, "views": self.fitting_views}
        return {**sizes, "seconds": self.seconds}

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if not (math.isfinite(self.seconds) and self.seconds >= 0):
            raise UserError(f"--seconds must be 0 or more, got {self.seconds:g}")
        if not 1 <= self.most_splats <= MOST_SPLATS:
            raise UserError(f"--most-splats must be 1 to {MOST_SPLATS:,}, got {self.most_splats:,}")
        if self.fitting_views < 4:
            raise UserError(f"--fitting-views must be at least 4, got {self.fitting_views}")
