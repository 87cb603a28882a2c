"""The same seed gives the same bits on a CPU: of batches, training and pictures, in every process.

What repeats itself within a process, and what a resumed run repeats, is tested where it is computed: test_training,
test_trainer, test_renderer (chunks of rays), test_data (order of reading) and test_generate (data sets).
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import tiny_dataset

SCRIPT = Path(__file__).parents[1] / "support" / "run_bits.py"


def checksums(folder: Path, hash_seed: str) -> dict[str, str]:
    """What run_bits.py prints in a process of its own, without the flags of this suite."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment |= {"PYTHONHASHSEED": hash_seed, "PYTHONPATH": os.pathsep.join(map(str, SCRIPT.parents[1:3]))}
    command = [sys.executable, SCRIPT, folder]
    out = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return dict(line.split() for line in out.splitlines())


@pytest.fixture(scope="module")
def twice():
    return [checksums(tiny_dataset.dataset().folder, seed) for seed in ("1", "2")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["batch", "state", "picture"])
def test_two_processes_make_the_same(name, twice):
    """Their sets and hashes are in another order; nothing else can tell them apart."""
    first, second = twice
    assert first[name] == second[name]
