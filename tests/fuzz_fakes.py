"""Readers that misbehave at their third input, as tests/test_fuzz.py wants the fuzzer to see."""

import os
import pickle
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.fuzz_readers import Reader

COUNT = {"inputs": -1}  # the seed itself is read first


def third(misbehave: Callable[[Path], object]) -> Reader:
    """A reader of four inputs: read, refused, misbehaved, read."""

    def read(folder: Path, main: str) -> None:
        number = COUNT["inputs"]
        COUNT["inputs"] += 1
        if number == 1:
            raise ValueError("a.txt: holds nothing")
        if number == 2:
            misbehave(folder)

    return Reader(seeds=lambda: [{"a.txt": b"1 2 3"}], read=read)


READERS = {
    "crash": third(lambda folder: os.abort()),
    "hang": third(lambda folder: time.sleep(60)),
    "memory": third(lambda folder: np.empty(2**32)),
    "traceback": third(lambda folder: {}["a"]),
    "write": third(lambda folder: (folder.parent / "outside").write_text("a")),
    "peek": third(lambda folder: (folder.parent / "secret.bin").read_bytes()),
    "program": third(lambda folder: subprocess.run([sys.executable, "-c", ""], check=True)),
    "pickle": third(lambda folder: pickle.loads(pickle.dumps(Path))),
    "warn": third(lambda folder: warnings.warn("a", stacklevel=1)),
}
