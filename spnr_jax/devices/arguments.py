"""Command lines: options that are read before the others, and options as records, an error in one line."""

import contextlib
import io
import os
import re
from collections.abc import Collection
from importlib import metadata
from typing import Any

import tyro

from spnr_jax.errors import UserError

# Parts of tyro's error box, which becomes one line: "╭─ Parsing error ─╮ │ ... invalid literal for int() with base 10:
# 'x' ... │ Argument helptext: ... │" -> "... expected INT, got 'x'."  BOX: frame, marks of bold, and tyro's name
# for the whole command
BOX = r"[╭╮╰╯│─•]+|-{4,}|\[/?bold\]|__tyro-dummy-inner__\."
UNION = r"no type matching (?:\{None\}\|)?(.+?) could be instantiated from \[(.+?)\]\..*?(?= Argument helptext)"
NUMBER = r"(?:invalid literal for (int)\(\) with base 10|could not convert string to (float)): ('.*?')"
HELP = r" Argument helptext:.*?(?= For full helptext)"


def split_debug(arguments: list[str]) -> tuple[list[str], bool]:
    """The arguments without `--debug`, and whether call stacks are shown: for it, or for SPNR_DEBUG=1."""
    others = [argument for argument in arguments if argument != "--debug"]
    return others, len(others) < len(arguments) or os.environ.get("SPNR_DEBUG", "0") not in ("", "0")


def take_option(arguments: list[str], name: str) -> tuple[str | None, list[str]]:
    """The value of an option (None if not given), and the other arguments; ValueError for an option without one."""
    for i, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if option == name:
            value, used = (value, 1) if equals else ("".join(arguments[i + 1 : i + 2]), 2)
            if not value:
                raise UserError(f"{name} needs a value")
            return value, arguments[:i] + arguments[i + used :]
    return None, arguments


def parse(
    options: Any, prog: str, arguments: list[str], description: str | None = None, commands: Collection[str] = ()
) -> Any:
    """The options of a record, or of one of several commands of these names; UserError for what they do not allow."""
    if arguments == ["--version"]:
        print(f"spnr_jax {metadata.version('spnr-jax')}, jax {metadata.version('jax')}")
        raise SystemExit(0)
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            return tyro.cli(options, prog=prog, description=description, args=arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
        said = " ".join(re.sub(BOX, " ", stderr.getvalue().partition("\n")[2]).split())  # without the title
        said = re.sub(HELP, ".", re.sub(UNION, r"expected \1, got \2", said))
        said = re.sub(NUMBER, lambda found: f"expected {(found[1] or found[2]).upper()}, got {found[3]}", said)
        command = next((f" {name}" for name in arguments[:1] if name in commands), "")
        raise UserError(said.replace(f"{prog} --help", f"{prog}{command} --help")) from None
