"""The command `spnr-data`: generate a data set, check one, show one.

Errors of the user and of the disk are one line on stderr and exit code 2; Ctrl-C is one line and exit code 130.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from data_gen.check import check
from data_gen.generate import generate
from data_gen.plan import GenerateConfig
from data_gen.show import ShowConfig, show


@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """Check every file of a data set: print a table, exit with 1 if something is wrong."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the data set."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    config = tyro.extras.subcommand_cli_from_dict(
        {"generate": GenerateConfig, "check": CheckConfig, "show": ShowConfig},
        prog="spnr-data",
        description="Data sets of rendered objects and their surface points.",
        args=arguments,
    )
    try:
        sys.exit(run(config))
    except KeyboardInterrupt:
        sys.exit(interrupted())
    except (ValueError, OSError) as error:
        print(f"spnr-data: {one_line(error, config)}", file=sys.stderr)
        sys.exit(2)


def run(config: GenerateConfig | CheckConfig | ShowConfig) -> int:
    """Return the exit code of one command."""
    if isinstance(config, GenerateConfig):
        generate(config)
        return 0
    if isinstance(config, CheckConfig):
        return 0 if check(config.dataset) else 1
    show(config)
    return 0


def interrupted() -> int:
    """Say that the run was stopped; return the exit code."""
    print("spnr-data: stopped; finished objects are kept, the same command goes on from there", file=sys.stderr)
    return 130


def one_line(error: Exception, config: GenerateConfig | CheckConfig | ShowConfig) -> str:
    """Return what an error says, on one line; an error of the disk with its place and what to do."""
    if isinstance(error, OSError) and error.strerror:
        place = error.filename or (config.out if isinstance(config, GenerateConfig) else config.dataset)
        kept = "; finished objects are kept, the same command goes on from there"
        return f"{place}: {error.strerror}{kept if isinstance(config, GenerateConfig) else ''}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    main()
