"""The command line for tests that run it whole."""

import importlib
import importlib.util
import sys
from types import ModuleType

import pytest

import data_gen.__main__


def unchecked_cli() -> ModuleType:
    """The module; of `spnr train` annotations are not executed: tyro's mark of a missing value stands for a Path."""
    name = "spnr_jax.tools.commands"
    commands, own = importlib.import_module(name), _unchecked(name, "unchecked_commands")
    train, commands.Train = commands.Train, own.Train
    try:
        return _unchecked("spnr_jax.cli", "unchecked_cli")
    finally:
        commands.Train = train


def spnr_data(*arguments: object) -> int:
    """The exit code of `spnr-data` in this process."""
    return exit_code(data_gen.__main__, *arguments)


def exit_code(program: ModuleType, *arguments: object) -> int:
    """The exit code of a program's main in this process."""
    with pytest.raises(SystemExit) as stopped:
        program.main([str(argument) for argument in arguments])
    return stopped.value.code


def _unchecked(name: str, own: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(own, importlib.util.find_spec(name).origin)
    module = sys.modules[own] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
