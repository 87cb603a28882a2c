"""The options of `spnr render` and `spnr view` that say in what light pictures are drawn; nothing slow to import."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from spnr_jax.errors import UserError

MOST_STOPS = 20


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """The light of pictures by a network over surfels; others know that of their training alone."""

    light: str | None = None
    """Light: an environment map (.hdr .exr), or room, studio, sunset, overcast, night of the package (default: room, or
    none where there is a sun)."""
    light_yaw: float = 0.0
    """Degrees that the map is turned about the up axis."""
    sun: tuple[float, float] | None = None
    """Azimuth and elevation, in degrees, of a sun: added to the light."""
    exposure: float = 0.0
    """Stops by which the light is brighter (negative: darker)."""
    background: Literal["white", "light"] = "white"
    """Background: white, or the environment map, blurred."""

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the options that are not as they are where nothing is asked of the light."""
        given = (field.name for field in dataclasses.fields(self) if getattr(self, field.name) != field.default)
        return tuple(f"--{name.replace('_', '-')}" for name in given)

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if not math.isfinite(self.light_yaw):
            raise UserError(f"--light-yaw must be a number of degrees, got {self.light_yaw}")
        if self.sun and not (math.isfinite(self.sun[0]) and -90 <= self.sun[1] <= 90):
            raise UserError(f"--sun: expected an azimuth and an elevation of -90 to 90 degrees, got {self.sun}")
        if not abs(self.exposure) <= MOST_STOPS:
            raise UserError(f"--exposure must be -{MOST_STOPS} to {MOST_STOPS} stops, got {self.exposure:g}")
