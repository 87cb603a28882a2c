"""What light costs: every row is timed, on a few points."""

import json
from types import SimpleNamespace

import pytest
from support import tiny_surfels

from experiments.speed import light_times


@pytest.mark.ci
def test_pictures_changes_of_the_viewer_and_a_map_are_timed(tmp_path):
    cloud = tiny_surfels.dataset().folder / "objects" / tiny_surfels.NAME / "points.ply"
    options = {"run": str(tiny_surfels.run()), "points": 32, "size": 48, "rounds": 1}
    light_times.main(light_times.LightTimes(cloud=cloud, out=tmp_path, **options))
    seconds = json.loads((tmp_path / "results.json").read_text())["seconds"]
    assert len(seconds) == 2 + 4
    assert all(value > 0 for value in seconds.values())


def test_the_first_turn_does_not_count_and_each_work_is_told_its_turn(monkeypatch):
    seen, clock = [], [0.0]
    monkeypatch.setattr(light_times, "time", SimpleNamespace(perf_counter=lambda: clock[0]))

    def work(turn):
        clock[0] += 5 if turn == 0 else 1

    found = light_times.timed([seen.append, work], 3)
    assert seen == [0, 1, 2, 3]
    assert found == [0, 1]
