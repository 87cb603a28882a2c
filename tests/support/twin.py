"""The parity fixture: weights, inputs and every stage's output of a PyTorch twin in float64, under the twin's names."""

from pathlib import Path

import numpy as np

FIXTURE = Path(__file__).with_name("twin_fixture.npz")


def load():
    """All arrays of the fixture by name, the JSON string under "meta"."""
    with np.load(FIXTURE, allow_pickle=False) as data:
        return dict(data.items())
