"""The options of `spnr render`, and nothing that takes time to import: `--help` reads this file alone."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from spnr_jax.errors import UserError
from spnr_jax.formats.cut import Cut
from spnr_jax.tools.light_options import Lighting
from spnr_jax.tools.splat_options import SplatMaking

Output = Literal["image", "depth", "opacity"]
WILDCARDS = "*?["  # of a pattern of files


def is_catalogue(cloud: Path) -> bool:
    """Whether a folder or a pattern is meant, and not a file, whatever its name."""
    return cloud.is_dir() or (not cloud.exists() and any(mark in str(cloud) for mark in WILDCARDS))


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a point cloud or mesh file: views as .png, a turntable, depth, opacity, a mesh, splats.
    Of a folder, or a pattern in quotation marks, every file is drawn, and a page shows them all."""

    cloud: tyro.conf.Positional[Path]
    """.ply .spz (also 3D Gaussian splats) .pcd .xyz .txt .csv .asc .pts .las .laz .npz .npy, or a mesh: .glb .gltf .obj
    .stl .off (its surface is sampled).  Or a folder, with all folders in it, or a pattern such as 'scans/**/*.ply'."""
    run: Path | None = None
    """Network that renders: a run folder or a file of weights (default: that of the package, `surfels`)."""
    out: Path = Path("renders")
    """Output folder. Of a folder or pattern, files whose results are there are skipped."""
    workers: int | None = None
    """Processes that draw the files of a folder or pattern (default: this one; extra `cluster`)."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers draw instead.  They see the files and OUT under the same names."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The file's upward axis; auto: by the format, else y or z, as the object would stand."""
    num_points: int = 16384
    """Points used of a bigger cloud, evenly spread, or sampled from a mesh; fewer work too."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """Outliers of points are removed, and noisy ones averaged, before they are thinned; a clean cloud, and a mesh, stay
    as they are.  strong: at smaller deviations."""
    cut: tyro.conf.OmitArgPrefixes[Cut] = Cut()
    """Select one object of a scene, before it is cleaned."""
    transparent_parts: Literal["opaque", "skip"] = "opaque"
    """Glass and other parts of a mesh that light passes through: drawn in their colour, or left out.  What the alpha of
    a texture cuts out is left out either way."""
    seed: int = 0
    """Seed of the points that are chosen, and of the planes that --remove-plane tries."""
    views: int = 4
    """Still pictures, evenly around the object."""
    elevation: float = 20.0
    """Degrees above the horizon."""
    resolution: int | None = None
    """Pixels along each side (default: 512 of surfels, else what the network was trained for)."""
    quality: Literal["draft", "balanced", "best", "trained"] = "best"
    """balanced: three quarters of the size, enlarged; draft: discs and light alone, without the CNN.  Of the paper's
    network: a quarter, half or all of the samples that a ray was trained with, near the points; or just as trained."""
    outputs: tuple[Output, ...] = ("image", "depth", "opacity")
    """What is written of each view; depth comes coloured, as .npy and as 16-bit .png."""
    transparent: bool = False
    """Stills on a transparent background instead of white (straight alpha)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = Lighting()
    """Light; only `surfels` takes another than that of its training."""
    turntable: Literal["gif", "mp4", "none"] = "gif"
    """Format of the turntable."""
    turn: Literal["object", "light"] = "object"
    """What turns in it."""
    frames: int = 48
    """Frames of the turntable."""
    fps: int = 16
    """Frames a second of the turntable."""
    mesh: bool = False
    """Also write the surface as .glb, with the materials of the nearest points."""
    grid_resolution: int | None = None
    """Places along each side of the grid of --mesh (default: 192)."""
    splats: Literal["none", "ply", "spz"] = "none"
    """Also write Gaussian splats."""
    making: SplatMaking = field(default_factory=SplatMaking)
    """Options of the Gaussian splats."""

    @property
    def asked_of_light(self) -> tuple[str, ...]:
        """Names of the options that need a network that takes a light."""
        return (*self.lighting.asked, *(("--turn light",) if self.turn == "light" else ()))

    @property
    def few(self) -> bool:
        """Whether so few pictures are drawn that the first one counts most."""
        return self.turntable == "none" and self.splats == "none" and not is_catalogue(self.cloud)

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.views < 0:
            raise UserError(f"--views must not be negative, got {self.views}")
        for name in ("frames", "num_points", "fps"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(self, name)}")
        if self.workers is not None and (self.workers < 1 or self.cluster is not None):
            raise UserError(f"--workers must be at least 1, and without --cluster, got {self.workers}")
        if self.resolution is not None and (self.resolution < 16 or self.resolution % 4):
            raise UserError(f"--resolution must be a multiple of 4 of at least 16, got {self.resolution}")
        if not -90 <= self.elevation <= 90:
            raise UserError(f"--elevation must be -90 to 90 degrees, got {self.elevation:g}")
        if self.transparent and self.lighting.background != "white":
            raise UserError("--background light: not together with --transparent; give one of them")
        if self.grid_resolution is not None and not 8 <= self.grid_resolution <= 512:
            raise UserError(f"--grid-resolution must be 8 to 512, got {self.grid_resolution}")
