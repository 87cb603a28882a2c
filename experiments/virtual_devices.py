"""A module run on so many virtual devices, in a process of its own: JAX counts devices when it starts."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any


def in_child(
    module: str, devices: int, arguments: Sequence[str], flags: str = "", environment: Mapping[str, str] | None = None
) -> Any:
    """The JSON in the last line of `python -m MODULE ARGUMENTS`; `flags` are more of XLA's.  ValueError if it fails."""
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={
            **os.environ,
            **(environment or {}),
            "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices} {flags}",
        },
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise ValueError(f"{module} {' '.join(arguments)} on {devices} devices: {done.stderr.strip()[-300:]}")
    return json.loads(done.stdout.splitlines()[-1])
