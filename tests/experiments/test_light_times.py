"""What light costs: every row is timed, on a few points."""

import json
import time

import pytest
from support import tiny_surfels

from experiments.speed import lights


@pytest.mark.ci
def test_pictures_changes_of_the_viewer_and_a_map_are_timed(tmp_path):
    cloud = tiny_surfels.dataset().folder / "objects" / tiny_surfels.NAME / "points.ply"
    options = {"run": str(tiny_surfels.run()), "points": 32, "size": 48, "rounds": 1}
    lights.main(lights.LightTimes(cloud=cloud, out=tmp_path, **options))
    seconds = json.loads((tmp_path / "results.json").read_text())["seconds"]
    assert len(seconds) == 2 + 4
    assert all(value > 0 for value in seconds.values())


def test_the_first_turn_does_not_count_and_each_work_is_told_its_turn():
    seen = []
    found = lights.timed([seen.append, lambda turn: time.sleep(0.05 if turn == 0 else 0.01)], 3)
    assert seen == [0, 1, 2, 3]
    assert 0.01 <= found[1] < 0.04
