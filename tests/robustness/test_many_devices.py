"""Devices divide the work and change nothing: what one device computes is what all of them compute."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from spnr_jax.devices import programs


@pytest.mark.ci
def test_eight_devices_train_as_one_in_float64_and_go_on_from_its_checkpoint(tmp_path):
    here = Path(__file__).parent
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=8",
        "PYTHONPATH": str(here.parents[1]),
    }
    command = [sys.executable, here / "many_devices.py", tmp_path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["gradients"] < 1e-9, found
    assert found["trained"] < 1e-5, found


def test_a_batch_that_the_devices_do_not_divide_is_refused_in_one_line():
    assert programs.device_mesh() is None, "of one device"
    mesh = jax.sharding.Mesh(np.full(4, jax.devices()[0]), (programs.OBJECTS,))
    with pytest.raises(ValueError, match="batch_objects 6 cannot be divided among 4 devices; use a multiple"):
        programs.check_divides(mesh, 6)
