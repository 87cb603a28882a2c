"""The command `spnr`: train a network, evaluate one, render a cloud, export a network or splats, share a page.

Errors of the user and of the disk are one line on stderr and exit code 2; Ctrl-C keeps the state and exits with 130.
"""

import dataclasses
import importlib.util
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, get_args

import tyro

from spnr_jax import methods, presets
from spnr_jax.devices import runtime
from spnr_jax.devices.arguments import parse as parse_options, split_debug, take_option
from spnr_jax.errors import UserError, guard, leave, one_line, require, stop_at_once
from spnr_jax.tools.commands import Evaluate, Export, Render, Share, Train, View

DESCRIPTION = """Sparse-point neural rendering: train a network, evaluate one, render a cloud of points.
--debug, or SPNR_DEBUG=1, shows the call stack of an error.
--methods FILE, a .py file or a module, adds methods and presets of your own to every command (docs/own_network.md)."""


Command = Train | Evaluate | Render | View | Export | Share


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    whole = arguments is None  # process
    arguments, debug = split_debug(sys.argv[1:] if arguments is None else arguments)
    code = guard(lambda: run(parse(arguments)), "spnr", debug)
    if whole:
        leave(code)
    sys.exit(code)


def parse(arguments: list[str]) -> Command:
    """The command with all its options; --methods, which adds some, and --preset, their defaults, are read first."""
    source, arguments = take_option(arguments, "--methods")
    if source is not None:
        runtime.hide_false_alarms()  # it may import JAX
        methods.include(source)
    train = Annotated[Train, tyro.conf.subcommand("train", default=_train_defaults(arguments))]
    names = [record.__name__.lower() for record in get_args(Command)]
    return parse_options(train | Evaluate | Render | View | Export | Share, "spnr", arguments, DESCRIPTION, names)


def _train_defaults(arguments: list[str]) -> Train:
    """Defaults of the preset; its network determines the options."""
    preset = take_option(arguments, "--preset")[0] or "tiny"
    if preset not in presets.PRESETS:
        raise UserError(f"--preset {preset}: there are {', '.join(presets.PRESETS)}")
    return Train(data=tyro.MISSING, run=tyro.MISSING, config=presets.PRESETS[preset]())


def run(command: Command) -> None:
    """Carries a command out."""
    with stop_at_once("spnr"):
        set_up_jax(repeats=not isinstance(command, View))
    RUN[type(command)](command)


def set_up_jax(*, repeats: bool = True) -> None:
    """Enables the compilation cache and, for repeated work on a CPU, the reuse of memory."""
    runtime.cache_programs()  # before JAX is imported
    if repeats:
        runtime.reuse_memory()


def _make_note(cloud: Path) -> Callable[[str], None]:
    """A function that prints the assumptions about a cloud to stderr."""
    return lambda line: print(f"{cloud}: {line}", file=sys.stderr)


def check_installed(command: str, package: str, extra: str) -> None:
    """UserError if a package of the command's extra is missing."""
    if importlib.util.find_spec(package) is None:
        name = package.replace("_", "-")
        raise UserError(f"spnr {command} needs the package {name}; pip install 'spnr-jax[{extra}]'")


def run_train(command: Train) -> None:
    """`spnr train`."""
    check_installed("train", "tensorboardX", "train")
    from spnr_jax.devices import programs
    from spnr_jax.formats import data_sets
    from spnr_jax.training import trainer, weights

    dataset = data_sets.open_dataset(command.data)
    init = None if command.init is None else weights.read_trained(command.init)
    trainer.train(command.config, dataset, command.run, command.schedule, programs.device_mesh(), init)
    source = methods.method_of(command.config.model).source
    scoring = "spnr", "evaluate", str(command.data), str(command.run), *(("--methods", source) if source else ())
    print(f"trained: {command.run} (score it with `{shlex.join(scoring)}`)")


def run_evaluate(command: Evaluate) -> None:
    """`spnr evaluate`."""
    check_installed("evaluate", "flip_evaluator", "train")
    from spnr_jax.formats import data_sets
    from spnr_jax.formats.images import check_place
    from spnr_jax.scoring import evaluation
    from spnr_jax.scoring.report import describe_split, text_table, write_results

    start = time.monotonic()
    dataset = data_sets.open_dataset(command.data)
    out = command.out or (command.run.with_suffix("") if command.run.suffix == ".npz" else command.run)
    if out != command.run or out.is_dir():  # else it is no run
        check_place(out / "metrics.json")
    outcome = evaluation.evaluate(command.run, dataset, command.split, command.gallery)
    seconds = dict.fromkeys(("evaluate", "total"), round(time.monotonic() - start, 1))
    print(f"{len(dataset.splits[command.split])} {describe_split(outcome.summary)}")
    print("\n".join(text_table(outcome.summary["methods"])), flush=True)
    write_results(out, outcome, dataset.settings, seconds)
    print(f"wrote {out / 'metrics.json'} and {out / 'report.html'}")


def run_render(command: Render) -> None:
    """`spnr render`."""
    from spnr_jax.tools.pictures import render_file

    faults = 0
    for cloud in (command.cloud, *command.others):
        try:
            for line in render_file(dataclasses.replace(command, cloud=cloud, others=()), _make_note(cloud)):
                print(line, flush=True)
        except ValueError as error:
            if not command.others:
                raise
            print(f"left out {one_line(error)}", file=sys.stderr)
            faults += 1
    require(not faults, f"{faults} of {1 + len(command.others)} clouds cannot be drawn")


def run_view(command: View) -> None:
    """`spnr view`."""
    check_installed("view", "viser", "viewer")
    from spnr_jax.tools.server import open_viewer

    viewer, notes = open_viewer(command)
    for line in (*notes, *viewer.lines):
        print(line, flush=True)
    viewer.wait()


def run_export(command: Export) -> None:
    """`spnr export`."""
    from spnr_jax.tools.export import export_network, export_object

    whole = command.splats is None
    print(export_network(command) if whole else export_object(command, _make_note(command.run)))


def run_share(command: Share) -> None:
    """`spnr share`."""
    from spnr_jax.tools.export import share

    print(share(command, _make_note(command.cloud)))


RUN: dict[type, Callable] = {
    Train: run_train,
    Evaluate: run_evaluate,
    Render: run_render,
    View: run_view,
    Export: run_export,
    Share: run_share,
}


if __name__ == "__main__":
    main()
