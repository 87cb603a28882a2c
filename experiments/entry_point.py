"""How an experiment becomes a command: options of a dataclass, errors as one line, the exit codes of `spnr`."""

import sys
from collections.abc import Callable
from typing import Any, NoReturn

import experiments.baselines  # noqa: F401 - registers them: runs of theirs are loaded by every command
from spnr_jax import cli, errors
from spnr_jax.devices import arguments


def run(main: Callable[[Any], object], options: type, name: str) -> NoReturn:
    """Calls `main` with the options of the command line `python -m experiments.NAME`, and ends the process."""
    given, debug = arguments.split_debug(sys.argv[1:])

    def work() -> None:
        parsed = arguments.parse(options, f"python -m experiments.{name}", given)
        cli.set_up_jax()
        main(parsed)

    errors.leave(errors.guard(work, name.rpartition(".")[2], debug))
