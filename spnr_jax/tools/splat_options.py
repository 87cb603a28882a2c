"""The options of `spnr share`, and those of `spnr export --splats` that it has, too; nothing slow to import."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from spnr_jax.errors import UserError
from spnr_jax.tools.light_options import Lighting

MOST_SPLATS = 300_000  # that a file or page is asked for: more than viewers on telephones draw


@dataclass(frozen=True, kw_only=True)
class SplatMaking:
    """How Gaussian splats are made of a cloud."""

    most_splats: int = 150_000
    """Splats at most."""
    harmonics: Literal[0, 1, 2, 3] = 1
    """Degree of the spherical harmonics by which a splat's colour follows the view; 0: it does not."""
    fitting_views: int = 32
    """Pictures of the network that splats are made from."""

    @property
    def asked(self) -> dict[str, Any]:
        """What `splat_making.splats_of` is asked for."""
        return {"degree": self.harmonics, "most": self.most_splats, "views": self.fitting_views}

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if not 1 <= self.most_splats <= MOST_SPLATS:
            raise UserError(f"--most-splats must be 1 to {MOST_SPLATS:,}, got {self.most_splats:,}")
        if self.fitting_views < 4:
            raise UserError(f"--fitting-views must be at least 4, got {self.fitting_views}")


@dataclass(frozen=True, kw_only=True)
class Share:
    """Write one .html file that shows a cloud's object in any browser: Gaussian splats to turn, a poster, a title."""

    cloud: tyro.conf.Positional[Path]
    """What `spnr render` reads."""
    out: Path = Path("page.html")
    """The .html to write."""
    title: str | None = None
    """Title (default: the file's name)."""
    credit: str = ""
    """Credit and licence line."""
    run: Path | None = None
    """Network that draws it, as for `spnr render` (default: surfels)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = field(default_factory=Lighting)
    """The light, which is part of the splats."""
    making: tyro.conf.OmitArgPrefixes[SplatMaking] = field(default_factory=SplatMaking)
    """How the splats are made."""
    num_points: int = 16384
    """Points used of a bigger cloud, evenly spread, or sampled from a mesh."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The file's upward axis; auto looks for it, and says what it found."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """As for `spnr render`."""
    azimuth: float = 30.0
    """Degrees around the object from which the page first shows it."""
    elevation: float = 20.0
    """Degrees above the horizon."""

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.out.suffix.lower() not in (".html", ".htm") or self.out.is_dir():
            raise UserError(f"--out {self.out}: expected the name of an .html file")
        if self.num_points < 1:
            raise UserError(f"--num-points must be at least 1, got {self.num_points}")
        if not -89 <= self.elevation <= 89:
            raise UserError(f"--elevation must be -89 to 89 degrees, got {self.elevation:g}")
        if self.lighting.background != "white":
            raise UserError("--background light: a page shows its object on white; leave it out")
