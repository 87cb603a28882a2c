"""The options of the commands of `spnr`, as records; nothing that takes time to import, for `--help` reads them.

An option that makes no sense raises ValueError, which names it.
"""

import dataclasses
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from spnr_jax import presets
from spnr_jax.config import MOST_PIXELS, Cut, Quality, Schedule, TrainConfig
from spnr_jax.errors import UserError, require, require_at_least, require_within

MOST_STOPS = 20


def changed_options(options: Any) -> tuple[str, ...]:
    """Names of the options that differ from their defaults."""
    changed = (field.name for field in dataclasses.fields(options) if getattr(options, field.name) != field.default)
    return tuple(f"--{name.replace('_', '-')}" for name in changed)


def require_drawable(pixels: int | None, name: str = "--resolution") -> None:
    """UserError for a number of pixels along a side that is not drawn."""
    if pixels is not None and not (16 <= pixels <= MOST_PIXELS and pixels % 4 == 0):
        raise UserError(f"{name} must be a multiple of 4 from 16 to {MOST_PIXELS}, got {pixels}")


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """The light of pictures.  `surfels` takes any; other networks only that of their training."""

    light: str | None = None
    """Environment map (.hdr .exr), or room, studio, sunset, overcast, night (default: room, or none if there is a
    sun)."""
    light_yaw: float = 0.0
    """Degrees by which the map is rotated about the up axis."""
    sun: tuple[float, float] | None = None
    """Azimuth and elevation, in degrees, of a sun that is added to the light."""
    exposure: float = 0.0
    """Stops by which the light is brighter (negative: darker)."""

    def __post_init__(self) -> None:
        require(self.light != "", "--light: empty; expected a file or a name")
        require(math.isfinite(self.light_yaw), f"--light-yaw must be a number of degrees, got {self.light_yaw}")
        turned = self.light_yaw and self.sun and not self.light
        require(not turned, "--light-yaw turns the map of --light, which is not given; --sun has an azimuth of its own")
        if self.sun and not (math.isfinite(self.sun[0]) and -90 <= self.sun[1] <= 90):
            raise UserError(f"--sun: expected an azimuth and an elevation of -90 to 90 degrees, got {self.sun}")
        require_within(self, -MOST_STOPS, MOST_STOPS, "exposure")


FASTEST_GIF = 50  # frames a second that browsers show
MOST_VIEWS = 1000  # of a fit
MOST_PORT = 65535
FEWEST_SPLATS, MOST_SPLATS = 6, 300_000  # that are asked for: one for each side; more than viewers on telephones draw


@dataclass(frozen=True, kw_only=True)
class SplatOptions:
    """How Gaussian splats are made from a cloud."""

    most_splats: int = 150_000
    """Maximum number of splats."""
    harmonics: Literal[0, 1, 2, 3] = 1
    """Degree of the spherical harmonics of a splat's colour; 0: it does not depend on the view."""
    fitting_views: int = 32
    """Pictures of the network that the splats are made from."""

    def __post_init__(self) -> None:
        require_within(self, FEWEST_SPLATS, MOST_SPLATS, "most_splats")
        require_within(self, 4, MOST_VIEWS, "fitting_views")


@dataclass(frozen=True, kw_only=True)
class CloudOptions:
    """A file of points or a mesh, how it is read, and the network and light that draw it."""

    cloud: tyro.conf.Positional[Path]
    """.ply .spz (also 3D Gaussian splats) .pcd .xyz .txt .csv .tsv .asc .pts .las .laz .npz .npy, or a mesh: .glb .gltf
    .obj .stl .off (its surface is sampled)."""
    num_points: int = 16384
    """Points kept of a larger cloud, evenly spread, or sampled from a mesh; fewer work too."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The file's upward axis; auto: by the format, else y or z, whichever lets the object stand."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """Remove outliers and average noisy points before thinning; clean clouds and meshes are unchanged.  strong: at
    smaller deviations."""
    run: Path | None = None
    """Network that renders: a run folder or a weights file (default: `surfels`, which the package includes)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = Lighting()
    """Light; only `surfels` takes one other than its training light."""

    @property
    def light_options_given(self) -> tuple[str, ...]:
        """Names of the options that need a network that takes a light."""
        own = (name for name in changed_options(self) if name in ("--background", "--turn"))
        return (*changed_options(self.lighting), *own)

    def __post_init__(self) -> None:
        require_at_least(self, 1, "num_points")


@dataclass(frozen=True, kw_only=True)
class Share(CloudOptions):
    """Write one .html file that shows a cloud's object in any browser: Gaussian splats to turn, a poster, a title."""

    out: Path = Path("page.html")
    """The .html to write."""
    title: str | None = None
    """Title (default: the file's name)."""
    credit: str = ""
    """Credit and licence line."""
    making: tyro.conf.OmitArgPrefixes[SplatOptions] = SplatOptions()
    """How the splats are made."""
    azimuth: float = 30.0
    """Azimuth, in degrees, of the page's first view."""
    elevation: float = 20.0
    """Degrees above the horizon."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.out.suffix.lower() not in (".html", ".htm") or self.out.is_dir():
            raise UserError(f"--out {self.out}: expected the name of an .html file")
        require_within(self, -89, 89, "elevation")
        require(math.isfinite(self.azimuth), f"--azimuth must be a number of degrees, got {self.azimuth}")


Output = Literal["image", "depth", "opacity"]
Background = Literal["white", "light"]


@dataclass(frozen=True, kw_only=True)
class Render(CloudOptions):
    """Render a point cloud or mesh file: views as .png, a turntable, depth, opacity."""

    others: tyro.conf.Positional[tuple[Path, ...]] = ()
    """More clouds, rendered one after the other; those that cannot be are named and left out."""
    out: Path = Path("renders")
    """Output folder."""
    cut: tyro.conf.OmitArgPrefixes[Cut] = Cut()
    """Select one object of a scene before cleaning."""
    transparent_parts: Literal["opaque", "skip"] = "opaque"
    """Glass and other transparent parts of a mesh: drawn in their colour, or left out.  Parts that a texture's alpha
    cuts out are always left out."""
    seed: int = 0
    """Seed of the chosen points, and of the planes that --remove-plane tries."""
    views: int = 4
    """Stills, at even angles around the object."""
    cameras: Path | None = None
    """Cameras of the stills instead of those around the object: a transforms.json of NeRF or nerfstudio, in the frame
    of the cloud's file, or a NAME_cameras.json that this command wrote."""
    elevation: float = 20.0
    """Degrees above the horizon."""
    resolution: int | None = None
    """Pixels along each side (default: 512 for surfels, else the size of the training).  Cameras of a file may have
    their own size."""
    quality: Quality = "best"
    """balanced: three quarters of the size, enlarged; draft: discs and light without the CNN.  The paper's network
    takes a quarter, half or all of its training samples per ray, near the points; trained: exactly as in training."""
    densify: bool = True
    """Add learned points to clouds of at most 32,768 points, and reflected ones to small symmetric clouds: sharper;
    films take up to three times as long."""
    outputs: tuple[Output, ...] = ("image", "depth", "opacity")
    """Files to write for each view; depth comes coloured and as .npy."""
    background: Background = "white"
    """White, or the environment map, blurred."""
    transparent: bool = False
    """Stills on a transparent background instead of white (straight alpha)."""
    turntable: Literal["gif", "mp4", "none"] = "gif"
    """Format of the turntable."""
    turn: Literal["object", "light"] = "object"
    """What rotates in the turntable."""
    frames: int = 48
    """Frames of the turntable."""
    fps: int = 16
    """Frames per second of the turntable."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [cloud.stem for cloud in (self.cloud, *self.others)]
        require(len(set(names)) == len(names), "two clouds have one name; give them an --out each")
        require_at_least(self, 0, "views")
        own = "--views" in changed_options(self)
        require(self.cameras is None or not own, "--views: not together with --cameras FILE; give one of them")
        require(len(self.outputs) > 0, "--outputs: expected one or more of image, depth, opacity")
        require(self.views > 0 or self.turntable != "none", "--views 0 --turntable none: nothing is left to draw")
        require_at_least(self, 1, "frames", "fps")
        require_within(self, -90, 90, "elevation")
        require_drawable(self.resolution)
        if self.turntable == "gif" and self.fps > FASTEST_GIF:
            raise UserError(f"--fps: a .gif shows at most {FASTEST_GIF} frames a second; take --turntable mp4")
        if self.transparent and self.background != "white":
            raise UserError("--background light: not together with --transparent; give one of them")


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a network on a data set.  If the run folder holds an unfinished run of the same config, it is continued."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    run: tyro.conf.Positional[Path]
    """Folder of the run: config, checkpoints, metrics, previews."""
    config: tyro.conf.AvoidSubcommands[tyro.conf.OmitArgPrefixes[TrainConfig]] = field(default_factory=presets.tiny)
    """Every number of the run; --preset chooses the defaults."""
    init: str | None = None
    """Initial weights of a new run: a run folder, a weights file, or `surfels`, the package's network (default:
    random)."""
    schedule: tyro.conf.OmitArgPrefixes[Schedule] = Schedule()
    """What the run writes beside its weights."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a run's newest checkpoint beside trivial baselines; write metrics.json and report.html."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    run: tyro.conf.Positional[Path]
    """Folder of the run, a weights file, or `surfels`, the package's network."""
    out: Path | None = None
    """Folder for metrics.json and report.html (default: the run, or the weights file's name without its suffix)."""
    split: Literal["train", "val", "test"] = "test"
    """Objects to score."""
    gallery: int = 16
    """Objects shown in the report."""

    def __post_init__(self) -> None:
        require_at_least(self, 0, "gallery")


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a surfel network as a weights file, as functions for JAX without this package, and as StableHLO.  Or, with
    --splats, write a cloud's object as Gaussian splats."""

    run: tyro.conf.Positional[Path]
    """Run folder of the network to export; with --splats, a cloud that `spnr render` reads."""
    splats: Path | None = None
    """Write Gaussian splats: .ply or .spz."""
    network: Path | None = None
    """Network that renders the cloud for --splats, as `spnr render --run` (default: surfels)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = Lighting()
    """Light baked into --splats."""
    making: tyro.conf.OmitArgPrefixes[SplatOptions] = SplatOptions()
    """Options of --splats."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The upward axis of the file, for --splats; these are written with y up (.spz) or y down (.ply), as is usual."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """As for `spnr render`, for --splats."""
    out: Path = Path("exported")
    """Folder for weights.npz, densifier.npz, encode.jax, render.jax, both as .stablehlo, export.json with their inputs
    and outputs, and light.npz, the room."""
    num_points: int | None = None
    """Exact number of points of a cloud, padding included (default: 1,024).  With --splats, points kept of a larger
    cloud (default: 16,384)."""
    resolution: int | None = None
    """Pixels along each side (default: the size of the training)."""
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu",)
    """Target platforms."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "num_points")
        require_drawable(self.resolution)
        changed = changed_options(self)
        of_cloud = [name for name in changed if name in ("--network", "--up", "--clean")]
        of_cloud += [*changed_options(self.lighting), *changed_options(self.making)]
        of_network = [name for name in changed if name in ("--out", "--resolution", "--platforms")]
        if wrong := of_cloud[:1] if self.splats is None else of_network[:1]:
            what = "is for --splats FILE, which is not given" if self.splats is None else "is not for --splats"
            raise UserError(f"{wrong[0]} {what}; leave it out")


@dataclass(frozen=True, kw_only=True)
class View(CloudOptions):
    """View the network's picture of a point cloud or mesh file in the browser: turn it, light it, save it."""

    host: str = "127.0.0.1"
    """Address to listen on; one other than this machine's own opens the viewer to a network."""
    port: int = 8080
    """Port to listen on; 0 takes any free one."""
    background: Background = "white"
    """White, or the environment map, blurred."""
    reached_at: str | None = None
    """HOST or HOST:PORT by which browsers reach the viewer, if a proxy before it uses another name."""
    cut: tyro.conf.OmitArgPrefixes[Cut] = Cut()
    """Object of a scene to show first; files that are dropped on the page are shown whole."""

    def __post_init__(self) -> None:
        super().__post_init__()
        place = re.fullmatch(r"(?:[\w.-]+|\[[\da-fA-F:.]+\])(?::(\d{1,5}))?", self.reached_at or "")
        if self.reached_at is not None and (place is None or int(place[1] or 0) > MOST_PORT):
            form = f"expected HOST or HOST:PORT, at most {MOST_PORT}, without http:// and path"
            raise UserError(f"--reached-at {self.reached_at}: {form}")
