"""The command line for tests that run it whole."""

import importlib.util
import sys
from types import ModuleType


def unchecked_cli() -> ModuleType:
    """The module without executed annotations: tyro's mark of a missing value stands where a Path will be."""
    spec = importlib.util.spec_from_file_location("unchecked_cli", importlib.util.find_spec("spnr_jax.cli").origin)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
