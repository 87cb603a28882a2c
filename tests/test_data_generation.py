"""The measurement of data generation: its clocks miss nothing, and a shrunken run leaves the files it promises."""

import json

import numpy as np
import pytest

from data_gen import procedural
from data_gen.make.objects import Workbench
from data_gen.plan.tasks import Task
from data_gen.render import views
from data_gen.store import layout
from experiments import data_generation
from experiments.data_timing import PHASES, time_object

LIGHT = np.ones((4, 8, 3), np.float32)
VIEW = views.ViewConfig(resolution=8, spp=4, views=2)


def bench(folder):
    return Workbench(out=str(folder), envmap=LIGHT, view=VIEW, num_points=64, seed=0, variant="scalar_rgb")


def test_nearly_all_of_an_objects_time_has_a_phase_and_the_clocks_are_taken_off_again(tmp_path):
    before = procedural.make, views.render_view, layout.write_object
    seconds = time_object(bench(tmp_path), Task(object_id="chair_000000", category="chair"))
    assert (procedural.make, views.render_view, layout.write_object) == before
    assert tuple(seconds) == PHASES
    assert min(seconds.values()) > 0
    # the first picture sets Mitsuba up, outside of every phase
    again = time_object(bench(tmp_path), Task(object_id="table_000001", category="table"))
    assert again["other"] < 0.3 * sum(again.values())


def test_an_object_that_is_left_out_has_no_times(tmp_path):
    (tmp_path / "broken.obj").write_text("f 1 2 9\n")
    assert time_object(bench(tmp_path / "out"), Task(object_id="broken", path=tmp_path / "broken.obj")) is None


def test_the_table_of_noise_names_the_smallest_sufficient_count():
    rows = [
        {"spp": 16, "median": 37.0, "percentile_10": 30, "object_median": 30, "object_percentile_10": 29},
        {"spp": 32, "median": 39.0, "percentile_10": 31, "object_median": 33, "object_percentile_10": 30},
    ]
    noise = {"pictures": 2, "resolution": 8, "target": 38.0, "rows": rows, "smallest_spp": 32}
    lines = data_generation.noise_table(noise)
    assert lines[0].endswith("38 dB median: 32")
    assert lines[-2] == "| 32 | 39.0 | 31.0 | 33.0 | 30.0 |"


@pytest.mark.slow
def test_a_shrunken_run_measures_writes_and_keeps_what_is_not_run_again(tmp_path):
    shrunken = {"out": tmp_path, "timed_objects": 1, "noise_objects": 1, "visibility_objects": 2, "views": 1}
    options = data_generation.DataGeneration(**shrunken, resolutions=(8,), spp=4)
    data_generation.main(options)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["timing"][0]["objects_per_hour"] > 0
    assert [row["median"] for row in results["noise"]["rows"]] == sorted(
        row["median"] for row in results["noise"]["rows"]
    )
    assert results["visibility"][0]["objects"] == 2
    assert (tmp_path / "noise.png").stat().st_size > 1000
    data_generation.main(data_generation.DataGeneration(**shrunken, resolutions=(8,), parts=("visibility",)))
    assert json.loads((tmp_path / "results.json").read_text()) == results
    assert (tmp_path / "tables.md").read_text().count("\n| ---") == 3
