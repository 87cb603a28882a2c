"""The command `spnr-data`: generate a data set, check one, show one.

Errors of the user and of the disk are one line on stderr and exit code 2; Ctrl-C is one line and exit code 130.
`--debug` or SPNR_DEBUG=1 shows the call stack before the line.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from data_gen.make.generate import generate
from data_gen.plan.tasks import PRESETS, GenerateConfig
from data_gen.store.check import check
from data_gen.store.show import ShowConfig, show
from spnr_jax.devices.arguments import parse as parse_options, split_debug, take_option
from spnr_jax.errors import UserError, guard

DESCRIPTION = """Data sets of rendered objects and their surface points.
With --debug or SPNR_DEBUG=1 an error shows its call stack."""


@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """Check every file of a data set: print a table, exit with 1 if something is wrong."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the data set."""


Command = GenerateConfig | CheckConfig | ShowConfig


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    arguments, debug = split_debug(sys.argv[1:] if arguments is None else arguments)
    codes: list[int] = []
    code = guard(lambda: codes.append(run(parse(arguments))), "spnr-data", debug)
    sys.exit(code or codes[0])


def parse(arguments: list[str]) -> Command:
    """The command with all its options; the preset named by --preset gives the defaults of the others."""
    preset = PRESETS.get(take_option(arguments, "--preset")[0] or "")  # another name is refused with the other options
    defaults = preset(tyro.MISSING) if preset else GenerateConfig(out=tyro.MISSING)
    generate_options = Annotated[GenerateConfig, tyro.conf.subcommand("generate", default=defaults)]
    check_options = Annotated[CheckConfig, tyro.conf.subcommand("check")]
    show_options = Annotated[ShowConfig, tyro.conf.subcommand("show")]
    commands = generate_options | check_options | show_options
    return parse_options(commands, "spnr-data", arguments, DESCRIPTION, ("generate", "check", "show"))


def run(config: Command) -> int:
    """The exit code of one command; errors of the disk and stops say what is kept."""
    kept = "; finished objects are kept, the same command goes on from there"
    try:
        if isinstance(config, CheckConfig):
            return 0 if check(config.dataset) else 1
        if isinstance(config, GenerateConfig):
            generate(config)
        else:
            show(config)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"stopped{kept}") from None
    except OSError as error:
        if not error.strerror:
            raise
        place, kept = (config.out, kept) if isinstance(config, GenerateConfig) else (config.dataset, "")
        raise UserError(f"{error.filename or place}: {error.strerror}{kept}") from error
    return 0


if __name__ == "__main__":
    main()
