"""Time to quality: as many steps as fit into the seconds, times on a curve, and a stopped study that goes on."""

import dataclasses
import json

import pytest
from support import tiny_dataset
from support.tiny_runs import shrunken

from experiments.studies import time_to_quality
from experiments.studies.time_to_quality import Pace, TimeToQuality, reached
from spnr_jax import presets
from spnr_jax.errors import UserError

PACE = Pace(alone=0.1, adversarial=0.2, hardware="a machine", load=0.0)


def asked(out, **changes):
    return TimeToQuality(data=tiny_dataset.dataset().folder, out=out, presets=("tiny",), **changes)


def test_a_curve_reaches_a_target_between_its_rows_or_never():
    rows = [{"seconds": 10.0, "psnr": 20.0}, {"seconds": 20.0, "psnr": 22.0}, {"seconds": 30.0, "psnr": 26.0}]
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
    for change in ({"seeds": (1, 1)}, {"seconds": 0.0}, {"marks": 0}):
        with pytest.raises(UserError):
            asked(tmp_path, **change)


@pytest.mark.ci  # it trains a network
def test_a_finished_run_is_only_read_and_a_plot_is_drawn(tmp_path):
    with shrunken():
        options = asked(tmp_path, seconds=1.0, marks=2, seeds=(0,), even_share=0.0)
        place = tmp_path / "paces" / "tiny.json"
        place.parent.mkdir()
        place.write_text(json.dumps(dataclasses.asdict(dataclasses.replace(PACE, alone=0.2))))
        time_to_quality.main(options)
        first = (tmp_path / "results.json").read_bytes()
        rows = json.loads(first)["curves"]["tiny"]["0"]
        assert [row["step"] for row in rows] == [2, 5]
        assert [row["seconds"] for row in rows] == [0.4, 1.0]
        assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
        time_to_quality.main(options)
        assert (tmp_path / "results.json").read_bytes() == first
    with pytest.raises(UserError, match="seconds"):
        time_to_quality.main(dataclasses.replace(options, seconds=2.0))
