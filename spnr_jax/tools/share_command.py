"""The options of `spnr share`, and nothing that takes time to import: `--help` reads this file alone."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from spnr_jax.errors import UserError
from spnr_jax.tools.light_options import Lighting
from spnr_jax.tools.splat_options import SplatMaking


@dataclass(frozen=True, kw_only=True)
class Share:
    """Write one .html file that shows a cloud's object in any browser: Gaussian splats to turn, a poster, a title."""

    cloud: tyro.conf.Positional[Path]
    """What `spnr render` reads."""
    out: Path = Path("page.html")
    """The .html to write."""
    title: str | None = None
    """What stands above the object (default: the name of the file)."""
    credit: str = ""
    """Whose object it is, and its licence: stands below it."""
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
