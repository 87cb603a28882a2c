"""The options of the commands of `spnr`, as records; of `spnr render` and `spnr share`, in files of their own."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.formats.cut import Cut
from spnr_jax.tools.light_options import Lighting
from spnr_jax.tools.splat_options import SplatMaking


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a network on a data set.  A run folder that holds an unfinished run of the same config is continued."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    run: tyro.conf.Positional[Path]
    """Folder of the run: config, checkpoints, metrics, previews."""
    config: tyro.conf.AvoidSubcommands[tyro.conf.OmitArgPrefixes[TrainConfig]] = field(default_factory=presets.tiny)
    """Every number of the run; --preset chooses the defaults."""
    init: str | None = None
    """Weights that a new run begins with: a run folder, a file of weights, or `surfels`, the network of the package
    (default: random)."""
    log_every: int = 20
    """Steps between rows of metrics.jsonl and TensorBoard."""
    preview_every: int = 500
    """Steps between preview images with validation scores."""
    checkpoint_every: int = 500
    """Steps between checkpoints."""
    distributed: bool = False
    """One of several processes that a launcher started (SLURM, Open MPI, Kubernetes) and that train together."""
    coordinator: str | None = None
    """Without a launcher: HOST:PORT at which process 0 is found by all; with --num-processes and --process-id."""
    num_processes: int | None = None
    """Processes that train together."""
    process_id: int | None = None
    """Rank of this process, from 0."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a run's newest checkpoint beside trivial baselines; write metrics.json and report.html."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    run: tyro.conf.Positional[Path]
    """Folder of the run, a file of weights, or `surfels`, the network of the package."""
    out: Path | None = None
    """Folder for metrics.json and report.html (default: the run, or the name of the file without its suffix)."""
    split: Literal["train", "val", "test"] = "test"
    """Objects to score."""
    gallery: int = 16
    """Objects shown in the report."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a network as a file of weights, as functions for JAX without this package, and as StableHLO; or a cloud's
    object, with --splats as Gaussian splats, with --mesh as its surface."""

    run: tyro.conf.Positional[Path]
    """Run folder whose network is exported; with --splats or --mesh a cloud, what `spnr render` reads."""
    splats: Path | None = None
    """Write Gaussian splats: .ply or .spz."""
    mesh: Path | None = None
    """Write the surface with its materials: .glb, in the frame and units of the cloud's file."""
    network: Path | None = None
    """Network that draws the cloud for --splats and --mesh, as `spnr render --run` (default: surfels)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = field(default_factory=Lighting)
    """Light baked into --splats."""
    making: tyro.conf.OmitArgPrefixes[SplatMaking] = field(default_factory=SplatMaking)
    """Options of --splats."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The upward axis of the file for --splats and --mesh; splats are written with y up."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """As for `spnr render`, for --splats and --mesh."""
    out: Path = Path("exported")
    """Folder for weights.npz, encode.jax, render.jax, both as .stablehlo, and export.json: what they take and give;
    of a network over surfels also light.npz, the room."""
    num_points: int | None = None
    """Points of a cloud, padding included; exactly so many (default: 1,024).  With --splats and --mesh, points used
    of a bigger cloud (default: 16,384)."""
    resolution: int | None = None
    """Pixels along each side (default: what the network was trained for)."""
    quality: Literal["draft", "balanced", "best", "trained"] = "best"
    """As for `spnr render`."""
    reach: int = 4
    """Sampling radius around the points in voxels, 1 to 4: 1.6 times their median spacing, rounded up, is lossless."""
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu",)
    """Target platforms."""

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.num_points is not None and self.num_points < 1:
            raise ValueError(f"--num-points must be at least 1, got {self.num_points}")
        if self.splats is not None and self.mesh is not None:
            raise ValueError("--splats and --mesh are written one at a time")
        given = ["light"] if self.lighting.asked else []
        given += ["most-splats"] if self.making != SplatMaking() else []
        if self.splats is None and given:
            raise ValueError(f"--{given[0]} is for --splats FILE, which is not given")
        given = [name for name in ("network", "up", "clean") if getattr(self, name) != getattr(type(self), name)]
        if self.splats is None and self.mesh is None and given:
            raise ValueError(f"--{given[0]} is for --splats FILE or --mesh FILE, which is not given")
        if self.lighting.background != "white":
            raise ValueError("--background light: splats have no background; leave it out")


@dataclass(frozen=True, kw_only=True)
class View:
    """Look at the network's picture of a point cloud or mesh file in the browser: turn it, light it, save it."""

    cloud: tyro.conf.Positional[Path]
    """What `spnr render` reads."""
    run: Path | None = None
    """As for `spnr render`."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = Lighting()
    """The light at first; the network of the package takes any, other networks that of their training alone."""
    host: str = "127.0.0.1"
    """Address to listen on; another than this machine's own opens the viewer to a network."""
    port: int = 8080
    """Port to listen on; 0 takes any free one."""
    reached_at: str | None = None
    """HOST or HOST:PORT by which browsers reach the viewer, where a proxy before it asks under another name."""
    num_points: int = 16384
    """Points used of a bigger cloud or sampled from a mesh; fewer work too."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """Outliers of points are removed, and noisy ones averaged, before they are thinned; a clean cloud, and a mesh, stay
    as they are.  strong: at smaller deviations."""
    cut: tyro.conf.OmitArgPrefixes[Cut] = Cut()
    """Object of a scene to show first; files dropped on the page are shown whole."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The file's upward axis; auto looks for it, and says what it found."""

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.reached_at is not None and not re.fullmatch(r"([\w.-]+|\[[\da-fA-F:.]+\])(:\d+)?", self.reached_at):
            raise ValueError(f"--reached-at {self.reached_at}: expected HOST or HOST:PORT, without http:// and path")
