"""The command line for tests that run it whole."""

from types import ModuleType

import pytest

import data_gen.__main__


def spnr_data(*arguments: object) -> int:
    """The exit code of `spnr-data` in this process."""
    return exit_code(data_gen.__main__, *arguments)


def exit_code(program: ModuleType, *arguments: object) -> int:
    """The exit code of a program's main in this process, which writes nothing to the home folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(program, "set_up_jax", lambda **_: None, raising=False)
        with pytest.raises(SystemExit) as stopped:
            program.main([str(argument) for argument in arguments])
    return stopped.value.code
