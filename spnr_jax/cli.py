"""The command `spnr`: train a network, evaluate one, render a cloud, export a network or splats, share a page.

Errors of the user and of the disk are one line on stderr and exit code 2; Ctrl-C keeps the state and exits with 130.
"""

import contextlib
import dataclasses
import importlib.util
import io
import json
import os
import re
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.devices import allocator, compilation
from spnr_jax.errors import UserError, one_line, split_debug
from spnr_jax.formats.cut import Cut
from spnr_jax.model_config import SurfelConfig
from spnr_jax.tools.light_options import Lighting
from spnr_jax.tools.render_command import Render, is_catalogue
from spnr_jax.tools.share_command import Share
from spnr_jax.tools.splat_options import SplatMaking

BOX = r"[╭╮╰╯│─•]+|__tyro-dummy-inner__\."  # what tyro draws around an error, and its name for the whole command
MANY_POINTS = 16384  # of a cloud that splats are made of
DESCRIPTION = """Sparse-point neural rendering: train a network, evaluate one, render a cloud of points.
--debug, or SPNR_DEBUG=1, shows the call stack of an error."""


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
    """Weights that a new run begins with: a run folder, a file of weights, or `small` or `tiny`, the networks in the
    package, which are of the presets plus_refined and plus_lite (default: random)."""
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
    """Which of them this is, from 0."""
    depth_devices: int = 1
    """Devices that share each volume, cut along one axis, if it is too big for one."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a run's newest checkpoint beside the trivial renderers; write metrics.json and report.html."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    run: tyro.conf.Positional[Path]
    """Folder of the run, a file of weights, or `small` or `tiny`, the networks in the package."""
    out: Path | None = None
    """Folder for metrics.json and report.html (default: the run, or the name of the file without its suffix)."""
    split: Literal["train", "val", "test"] = "test"
    """Objects to score."""
    gallery: int = 16
    """Objects shown in the report."""
    lpips: Path | None = None
    """LPIPS weights, an .npz that `spnr convert-lpips` wrote; without them LPIPS is n/a."""


@dataclass(frozen=True, kw_only=True)
class ConvertLpips:
    """Convert LPIPS weights for `spnr evaluate --lpips`; needs PyTorch to read the two files."""

    alexnet: tyro.conf.Positional[Path]
    """AlexNet weights of torchvision: alexnet-owt-....pth."""
    heads: tyro.conf.Positional[Path]
    """Linear heads of LPIPS, version 0.1: alex.pth, in weights/v0.1 of the package `lpips`."""
    out: tyro.conf.Positional[Path]
    """The .npz to write."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a network as a file of weights, as functions for JAX without this package, and as StableHLO; or, with
    --splats, a cloud's object as Gaussian splats."""

    run: tyro.conf.Positional[Path]
    """Run folder whose network is exported; with --splats a cloud, what `spnr render` reads."""
    splats: Path | None = None
    """Write Gaussian splats: .ply, .spz, or .glb (KHR_gaussian_splatting)."""
    network: Path | None = None
    """Network that draws the cloud for --splats, as `spnr render --run` (default: surfels)."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = field(default_factory=Lighting)
    """The light of --splats, which is part of them."""
    making: tyro.conf.OmitArgPrefixes[SplatMaking] = field(default_factory=SplatMaking)
    """How --splats are made."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The upward axis of the file for --splats; what is written has y up."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """As for `spnr render`, for --splats."""
    out: Path = Path("exported")
    """Folder for weights.npz, encode.jax, render.jax, both as .stablehlo, and export.json: what they take and give."""
    num_points: int | None = None
    """Points of a cloud, padding included; exactly so many (default: 1,024).  With --splats, points used of a bigger
    cloud (default: 16,384)."""
    resolution: int | None = None
    """Pixels along each side (default: what the network was trained for)."""
    quality: Literal["draft", "balanced", "best", "trained"] = "best"
    """As for `spnr render`."""
    reach: int = 4
    """Voxels around points that are looked at, 1 to 4: 1.6 times their median distance, rounded up, loses nothing."""
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu",)
    """Where the functions are to run."""

    def __post_init__(self) -> None:
        """ValueError names the option that makes no sense."""
        if self.num_points is not None and self.num_points < 1:
            raise ValueError(f"--num-points must be at least 1, got {self.num_points}")
        given = [f.name for f in dataclasses.fields(self) if f.name in ("network", "up", "clean")]
        given = [name for name in given if getattr(self, name) != getattr(type(self), name)]
        given += ["light"] if self.lighting.asked else []
        given += ["seconds"] if self.making != SplatMaking() else []
        if self.splats is None and given:
            raise ValueError(f"--{given[0]} is for --splats FILE, which is not given")
        if self.lighting.background != "white":
            raise ValueError("--background light: splats have no background; leave it out")


@dataclass(frozen=True, kw_only=True)
class View:
    """Look at a point cloud or mesh file in the browser: its points and what a network makes of them, edited live."""

    cloud: tyro.conf.Positional[Path]
    """What `spnr render` reads."""
    run: Path | None = None
    """As for `spnr render`."""
    lighting: tyro.conf.OmitArgPrefixes[Lighting] = Lighting()
    """The light at first; of the networks of the package `surfels` alone takes another than that of its training."""
    host: str = "127.0.0.1"
    """Address to listen on; another than this machine's own opens the viewer to a network."""
    port: int = 8080
    """Port to listen on; 0 takes any free one."""
    num_points: int = 16384
    """Points used of a bigger cloud or sampled from a mesh; fewer work too."""
    clean: Literal["auto", "off", "strong"] = "auto"
    """Outliers of points are removed, and noisy ones averaged, before they are thinned; a clean cloud, and a mesh, stay
    as they are.  strong: at smaller deviations."""
    cut: tyro.conf.OmitArgPrefixes[Cut] = Cut()
    """Which part of a scene is shown first; files that are dropped on the page are shown whole."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """The file's upward axis; auto looks for it, and says what it found."""


@dataclass(frozen=True, kw_only=True)
class Runs:
    """List the runs below a folder: best validation PSNR, time, learning curve."""

    folder: tyro.conf.Positional[Path] = Path()
    """Folder that holds run folders, at any depth."""


Command = Train | Evaluate | Render | View | Export | Share | Runs | ConvertLpips


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    arguments, debug = split_debug(sys.argv[1:] if arguments is None else arguments)
    code = guarded(lambda: run(parse(arguments)), "spnr", debug)
    if code == 2 and _one_of_several():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # JAX would wait for the other processes, which wait for this one
    sys.exit(code)


def _one_of_several() -> bool:
    jax = sys.modules.get("jax")  # a mistyped option need not wait until it is imported
    return jax is not None and jax.distributed.is_initialized() and jax.process_count() > 1


def guarded(work: Callable[[], None], name: str, debug: bool = False) -> int:
    """Exit code of the work; an error that a person can mend is one line on stderr and code 2, a stop is code 130.

    For `debug` the line stands behind the call stack.
    """
    try:
        work()
    except KeyboardInterrupt as stop:
        print(f"{name}: {str(stop) or 'stopped'}", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        if debug:
            traceback.print_exc()
        print(f"{name}: {one_line(error)}", file=sys.stderr)
        return 2
    return 0


def parse(arguments: list[str]) -> Command:
    """The command with all its options; the preset named by --preset gives the defaults of the others."""
    train = Annotated[Train, tyro.conf.subcommand("train", default=_train_defaults(arguments))]
    evaluate = Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    render = Annotated[Render, tyro.conf.subcommand("render")]
    view = Annotated[View, tyro.conf.subcommand("view")]
    export = Annotated[Export, tyro.conf.subcommand("export")]
    share = Annotated[Share, tyro.conf.subcommand("share")]
    runs = Annotated[Runs, tyro.conf.subcommand("runs")]
    convert = Annotated[ConvertLpips, tyro.conf.subcommand("convert-lpips")]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                train | evaluate | render | view | export | share | runs | convert,
                prog="spnr",
                description=DESCRIPTION,
                args=arguments,
            )
    except SystemExit as stop:
        if stop.code:
            raise UserError(re.sub(BOX, " ", said.getvalue().partition("\n")[2])) from None  # without the title
        raise


def _train_defaults(arguments: list[str]) -> Train:
    preset = "tiny"
    for i, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name == "--preset":
            preset = value or (arguments[i + 1] if i + 1 < len(arguments) else "")
    if preset not in presets.PRESETS:
        raise UserError(f"--preset {preset}: there are {', '.join(presets.PRESETS)}")
    return Train(data=tyro.MISSING, run=tyro.MISSING, config=presets.PRESETS[preset]())


def run(command: Command) -> None:
    """Carries a command out."""
    set_up_jax(repeats=not isinstance(command, View) and not (isinstance(command, Render) and command.few))
    match command:
        case Train():
            run_train(command)
        case Evaluate():
            run_evaluate(command)
        case Render():
            run_render(command)
        case View():
            run_view(command)
        case Export():
            run_export(command)
        case Share():
            run_share(command)
        case Runs():
            run_runs(command)
        case ConvertLpips():
            run_convert_lpips(command)


def set_up_jax(*, repeats: bool = True) -> None:
    """Lets a second run skip XLA's compilation, and arrays lie where others lay.

    Work that repeats itself on a CPU uses the memory of the time before; a first picture comes 0.1 s sooner without.
    """
    if repeats:
        allocator.keep_arrays()
    compilation.keep_programs()


def run_train(command: Train) -> None:
    """`spnr train`."""
    import jax

    from spnr_jax.devices import launch, placement
    from spnr_jax.formats import data_sets
    from spnr_jax.training import trainer, weights

    address = command.coordinator, command.num_processes, command.process_id
    if command.distributed or address != (None, None, None):
        launch.join(*address)
    mesh = placement.device_mesh(command.depth_devices) if jax.device_count() > 1 else None
    dataset = data_sets.open_dataset(command.data)
    schedule = trainer.Schedule(
        log_every=command.log_every, preview_every=command.preview_every, checkpoint_every=command.checkpoint_every
    )
    init = None if command.init is None else weights.read_trained(command.init)
    trainer.train(command.config, dataset, command.run, schedule, mesh, init)
    if placement.leads():
        print(f"trained: {command.run} (score it with `spnr evaluate {command.data} {command.run}`)")


def run_evaluate(command: Evaluate) -> None:
    """`spnr evaluate`."""
    from spnr_jax.formats import data_sets
    from spnr_jax.scoring import evaluation, lpips_weights
    from spnr_jax.scoring.results import text_table, write_results
    from spnr_jax.training import trainer

    start = time.monotonic()
    dataset = data_sets.open_dataset(command.data)
    weights = None if command.lpips is None else lpips_weights.read_weights(command.lpips)
    outcome = evaluation.evaluate(command.run, dataset, command.split, command.gallery, weights=weights)
    out = command.out or (command.run.with_suffix("") if command.run.suffix == ".npz" else command.run)
    seconds = dict.fromkeys(("evaluate", "total"), round(time.monotonic() - start, 1))
    write_results(out, outcome, dataset.settings, trainer.read_rows(command.run), seconds)
    print("\n".join(text_table(outcome.summary["methods"])))
    print(f"wrote {out / 'metrics.json'} and {out / 'report.html'}")


def run_render(command: Render) -> None:
    """`spnr render`."""
    if is_catalogue(command.cloud):
        from spnr_jax.tools.catalogue import render_catalogue

        lines = render_catalogue(command)
    else:
        from spnr_jax.tools.pictures import render_file

        lines = render_file(command, note=lambda line: print(f"{command.cloud}: {line}", file=sys.stderr))
    for line in lines:
        print(line, flush=True)


def run_view(command: View) -> None:
    """`spnr view`."""
    if importlib.util.find_spec("viser") is None:
        raise UserError("spnr view needs the package viser; pip install 'spnr-jax[viewer]'")
    from spnr_jax.viewer.server import open_viewer

    viewer, notes = open_viewer(**{f.name: getattr(command, f.name) for f in dataclasses.fields(command)})
    for line in (*notes, *viewer.lines):
        print(line, flush=True)
    viewer.wait()


def run_export(command: Export) -> None:
    """`spnr export`."""
    if command.splats is not None:
        run_export_splats(command, command.splats)
        return
    from spnr_jax.formats.images import write_whole
    from spnr_jax.method import model
    from spnr_jax.tools import export
    from spnr_jax.training import weights

    trained, where = weights.read_trained(command.run), command.platforms
    if isinstance(trained.config.model, SurfelConfig):
        raise UserError(
            f"{command.run}: sizes of a picture of surfels are counted first, so it is no single function "
            "to export; use a network of rays, such as small"
        )
    handle = model.Model(config=trained.config.model, variables=trained.variables)
    weights.write_weights(command.out / "weights.npz", trained)
    functions = {
        "encode": export.export_encode(handle, num_points=command.num_points or 1024, platforms=where),
        "render": export.export_render(
            handle, resolution=command.resolution, quality=command.quality, reach=command.reach, platforms=where
        ),
    }
    for name, content in functions.items():
        write_whole(command.out / f"{name}.jax", content)
        write_whole(command.out / f"{name}.stablehlo", export.stablehlo(content))
    signatures = {name: export.signature(content) for name, content in functions.items()}
    write_whole(command.out / "export.json", (json.dumps(signatures, indent=1) + "\n").encode())
    print(f"wrote weights.npz, encode and render to {command.out} (export.json says what they take and give)")


def run_export_splats(command: Export, out: Path) -> None:
    """`spnr export --splats`."""
    from spnr_jax.tools.splat_export import export_splats

    for line in export_splats(
        command.run,
        out,
        run=command.network,
        lighting=command.lighting,
        making=command.making,
        num_points=command.num_points or MANY_POINTS,
        up=command.up,
        clean=command.clean,
        note=lambda line: print(f"{command.run}: {line}", file=sys.stderr),
    ):
        print(line, flush=True)


def run_share(command: Share) -> None:
    """`spnr share`."""
    from spnr_jax.tools.splat_export import share

    for line in share(command, note=lambda line: print(f"{command.cloud}: {line}", file=sys.stderr)):
        print(line, flush=True)


def run_runs(command: Runs) -> None:
    """`spnr runs`."""
    from spnr_jax.tools import runs_command

    print("\n".join(runs_command.table(runs_command.read_runs(command.folder))))


def run_convert_lpips(command: ConvertLpips) -> None:
    """`spnr convert-lpips`."""
    from spnr_jax.scoring import lpips_weights

    lpips_weights.convert(command.alexnet, command.heads, command.out)
    print(f"wrote {command.out} (score with `spnr evaluate DATA RUN --lpips {command.out}`)")


if __name__ == "__main__":
    main()
