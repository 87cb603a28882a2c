"""Data sets that are made in the process of the tests: worker processes take seconds to start (test_same_bytes.py)."""

import pytest
from support.command_line import spnr_data

from data_gen.make import generate


@pytest.fixture(scope="session")
def generate_here():
    """A function: the exit code of `spnr-data generate` by scalar code, without worker processes."""

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(generate, "run_tasks", lambda make, bench, tasks, _: ((t, make(bench, t)) for t in tasks))
            return spnr_data("generate", *arguments, "--variant", "scalar_rgb")

    return run
