"""Time to quality: as many steps as fit into the seconds, times on a curve, and a stopped study that goes on."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from support import tiny_dataset
from support.tiny_runs import forbidden, shrunken

from experiments.comparison.object_scores import color_scores
from experiments.studies import time_to_quality
from experiments.studies.time_to_quality import Pace, TimeToQuality
from experiments.studies.time_to_quality_report import reached
from spnr_jax import presets
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.training import run_record

PACE = Pace(alone=0.1, adversarial=0.2, hardware="a machine", load=0.0)


def asked(out, **changes):
    return TimeToQuality(**{"data": tiny_dataset.dataset().folder, "out": out, "presets": ("tiny",)} | changes)


def test_a_curve_reaches_a_target_between_its_rows_or_never():
    rows = [(10.0, 20.0), (20.0, 22.0), (30.0, 26.0)]
    assert reached(rows, 24.0) == pytest.approx(25.0)
    assert reached(rows, 22.0) == pytest.approx(20.0)
    assert reached(rows, 5.0) == 10.0
    assert reached(rows, 26.5) is None


@pytest.mark.parametrize("seconds", [3.0, 10.0, 77.7])
def test_a_training_takes_the_most_steps_that_fit(tmp_path, seconds):
    options = asked(tmp_path, seconds=seconds, marks=1)
    steps = time_to_quality.steps_of("tiny", options, PACE)
    config = time_to_quality.config_of("tiny", options, steps)
    assert PACE.seconds(config, steps) <= seconds
    config = time_to_quality.config_of("tiny", options, steps + 1)
    assert PACE.seconds(config, steps + 1) > seconds


def test_steps_with_the_discriminator_have_their_own_pace():
    config = dataclasses.replace(presets.tiny(), num_steps=100)  # the discriminator begins at 85
    assert PACE.seconds(config, 85) == pytest.approx(8.5)
    assert PACE.seconds(config, 100) == pytest.approx(11.5)


def test_bad_options_are_refused(tmp_path):
    for change in ({"seeds": (1, 1)}, {"seconds": 0.0}, {"marks": 0}, {"presets": ("tinny",)}):
        with pytest.raises(UserError):
            asked(tmp_path, **change)


def test_the_colour_error_is_of_the_mean_inside_the_silhouette_alone():
    item = data_sets.read_object(tiny_dataset.dataset(), tiny_dataset.dataset().splits["train"][0])
    reference = data_sets.on_white(item.images)
    inside = item.images[..., 3:] > 127.5
    assert inside.any(axis=(1, 2)).all()
    found = color_scores(item, reference, reference + np.where(inside, 0.1, 0.5))
    np.testing.assert_allclose(found["color"], 20.0, atol=1e-4)
    assert (found["hue"] > 99).all()
    checks = np.indices(inside.shape[1:3]).sum(axis=0)[..., None] % 2 - 0.5
    balance = (checks * inside).sum(axis=(1, 2), keepdims=True) / inside.sum(axis=(1, 2), keepdims=True)
    assert (color_scores(item, reference, reference + np.where(inside, checks - balance, 0.5))["color"] > 60).all()


@pytest.mark.ci  # it trains a network
def test_a_stopped_run_goes_on_and_a_finished_one_is_only_read(tmp_path, monkeypatch):
    with shrunken():
        options = asked(tmp_path, seconds=1.0, marks=2, seeds=(0,), even_share=0.0, shown=1)
        place = tmp_path / "paces" / "tiny.json"
        place.parent.mkdir()
        place.write_text(json.dumps(dataclasses.asdict(dataclasses.replace(PACE, alone=0.2))))

        def stopped(state, *rest):
            if int(state.step) == 5:
                raise KeyboardInterrupt
            return scored(state, *rest)

        scored = time_to_quality.mark
        with monkeypatch.context() as patch:  # between the checkpoint after the last step and its scores
            patch.setattr(time_to_quality, "mark", stopped)
            with pytest.raises(KeyboardInterrupt):
                time_to_quality.main(options)
        time_to_quality.main(options)
        first = (tmp_path / "results.json").read_bytes()
        rows = json.loads(first)["curves"]["tiny"]["0"]
        assert [row["step"] for row in rows] == [3, 5]
        assert 0 < rows[0]["seconds"] < rows[1]["seconds"]
        assert set(rows[1]["scores"]) == set(tiny_dataset.dataset().splits["test"])
        for picture in [*tmp_path.glob("curves_*.png"), tmp_path / "sheet.png"]:
            assert picture.read_bytes().startswith(b"\x89PNG")
        further = dataclasses.replace(options, out=tmp_path / "further", init=tmp_path / "runs" / "tiny_0", marks=1)
        shutil.copytree(place.parent, further.out / "paces")
        time_to_quality.main(further)
        assert run_record.read_starts(further.out / "runs" / "tiny_0")[0]["init"] == "tiny, 5 steps"
        monkeypatch.setattr(time_to_quality, "score_objects", forbidden)
        time_to_quality.main(options)
        assert (tmp_path / "results.json").read_bytes() == first
    with pytest.raises(UserError, match="seconds"):
        time_to_quality.main(dataclasses.replace(options, seconds=2.0))
