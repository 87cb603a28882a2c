"""Nearly all of an object's time has a phase, and more samples are nearer to the reference."""

import json

import numpy as np
import pytest

from data_gen.render.light import Lights
from experiments.speed import data_generation
from experiments.speed.data_generation import DataGeneration


@pytest.mark.ci
def test_phases_add_up_and_noise_falls(tmp_path, monkeypatch):
    monkeypatch.setattr(data_generation, "choose_variant", lambda: ("scalar_rgb", ""))
    monkeypatch.setattr(data_generation, "make_lights", lambda *_: Lights(np.ones((4, 8, 3), np.float32)))
    monkeypatch.setattr(data_generation, "SAMPLES", (1, 16))
    monkeypatch.setattr(data_generation, "REFERENCE_SAMPLES", 256)
    data_generation.main(DataGeneration(out=tmp_path, objects=2, resolution=8, spp=4))
    found = json.loads((tmp_path / "results.json").read_text())
    seconds = found["seconds"]["procedural"]
    assert set(seconds) == {*data_generation.PHASES, "other"}
    assert all(seconds[phase] > 0 for phase in data_generation.PHASES)
    assert found["noise"]["1"][0] < found["noise"]["16"][0]
