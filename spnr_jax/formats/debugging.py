"""Whether errors that are one line to a user show their call stack too: SPNR_DEBUG=1 or --debug."""

import os
import traceback

DEBUG = "SPNR_DEBUG"


def without_debug(arguments: list[str]) -> list[str]:
    """The arguments without --debug, which is remembered in the environment."""
    if "--debug" in arguments:
        os.environ[DEBUG] = "1"
    return [argument for argument in arguments if argument != "--debug"]


def show_stack() -> None:
    """Prints the call stack of the error being handled, if it is asked for."""
    if os.environ.get(DEBUG):
        traceback.print_exc()
