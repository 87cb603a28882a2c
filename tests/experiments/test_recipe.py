"""The recipe of the package's weights, all parts of it, shrunken: what it writes, and that it goes on."""

import dataclasses
import json
import re

import numpy as np
import pytest
from support import tiny_surfels

from experiments.packaged import recipe
from spnr_jax import presets
from spnr_jax.training.weights import load, packaged_file, read_trained, read_variables

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setattr(presets, "surfels", lambda: tiny_surfels.CONFIG)
    monkeypatch.setattr(recipe, "STEPS", 2)
    monkeypatch.setattr(recipe, "DENSIFIER_STEPS", 2)
    monkeypatch.setattr(recipe, "COUNTS", (256,))
    large = recipe.generation_of
    monkeypatch.setattr(
        recipe,
        "generation_of",
        lambda options: dataclasses.replace(
            large(options), resolution=48, views=2, points=1024, spp=1, objects=3, test_objects=1, variant="scalar_rgb"
        ),
    )


def test_one_command_makes_data_both_networks_and_scores_and_then_has_nothing_left_to_do(tmp_path, capsys):
    options = recipe.Recipe(out=tmp_path / "w", share=0.01, workers=1)
    recipe.main(options)
    run = options.out / "run"
    own, packaged = read_trained(run).variables["densifier"], read_variables(packaged_file("densifier"))
    assert not np.array_equal(own["point"]["kernel"], packaged["point"]["kernel"])
    rows = json.loads((options.out / "scores.json").read_text())
    assert len(rows) == len(recipe.PARTS)
    assert all(np.isfinite(row["psnr"]) and row["psnr"] > 3 for row in rows.values())
    assert load(run).config == tiny_surfels.CONFIG.model
    made = {path: path.stat().st_mtime_ns for path in (options.out / "densifier" / "records").iterdir()}
    assert re.search(r"densifier\.npz; data \d+ s, densifier \d+ s, shader \d+ s$", capsys.readouterr().out.rstrip())
    recipe.main(options)
    assert made == {path: path.stat().st_mtime_ns for path in made}
    assert "is finished: 1 steps" in capsys.readouterr().out
