"""The entry of `spnr-data` where its packages may be missing: one line then, the command otherwise."""

import importlib.util
import sys

from spnr_jax.errors import start_command

PACKAGES = ("mitsuba",)  # the extra `data`, as pyproject.toml names it


def main() -> None:
    """Run the command line, or say what it needs."""
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        print(f"spnr-data: needs {', '.join(missing)}; pip install 'spnr-jax[data]'", file=sys.stderr)
        sys.exit(2)
    start_command("data_gen.__main__", "spnr-data")
