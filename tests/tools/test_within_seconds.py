"""`--seconds` takes the best level that keeps to the time, and measures each level once."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image
from support import tiny_model, tiny_surfels

from spnr_jax.config import SurfelConfig
from spnr_jax.method import inference
from spnr_jax.method.model import Model
from spnr_jax.tools import catalogue, pictures, within_seconds
from spnr_jax.tools.render_command import Render
from spnr_jax.tools.within_seconds import Level, Timing, choose, levels
from spnr_jax.training import weights
from spnr_jax.training.weights import Trained

CONFIG = SurfelConfig(image_resolution=512)
PICTURES = 10  # 4 stills, 6 frames
MICROSECOND = 1e-6


class Slow(Model):
    """A model whose pictures take a microsecond a pixel, less at the other levels, and its first one a minute."""

    def start(self):
        object.__setattr__(self, "now", 0.0)
        object.__setattr__(self, "drawn", [])
        return self

    def encode(self, cloud):  # the volume is its number of points
        return len(cloud.positions)

    def camera(self, volume, resolution):
        return resolution

    def render(self, volume, camera, quality):
        if (camera, quality) not in self.drawn:
            object.__setattr__(self, "now", self.now + 60)
        self.drawn.append((camera, quality))
        spent = camera**2 * MICROSECOND * {"best": 1, "balanced": 0.6, "draft": 0.1}[quality]
        object.__setattr__(self, "now", self.now + spent)
        return SimpleNamespace(image=np.zeros(1))


def slow(weights=0.0):
    return Slow(config=CONFIG, variables={"w": np.full(2, weights)}).start()


def asked(seconds, **options):
    return Render(cloud=Path("chair.ply"), seconds=seconds, views=4, frames=6, **options)


def chosen(model, folder, seconds, points=1000, **options):
    found, line = choose(asked(seconds, **options), model, points, Timing(clock=lambda: model.now, folder=folder))
    return Level(found.quality, found.resolution), line


def test_the_best_level_that_keeps_to_the_time_is_taken(tmp_path):
    full = PICTURES * 512**2 * MICROSECOND
    model = slow()
    assert chosen(model, tmp_path, 1.01 * full)[0] == Level("best", 512)
    level, line = chosen(model, tmp_path, 0.99 * full)
    assert level == levels(CONFIG, None)[1]
    assert line.startswith(f"--seconds {0.99 * full:g}: {level.quality} at {level.pixels} px, about ")
    assert line.endswith(f" for {PICTURES} pictures")
    order = [levels(CONFIG, None).index(chosen(model, tmp_path, s)[0]) for s in np.geomspace(full, 1e-3 * full, 12)]
    assert order == sorted(order)


def test_the_cheapest_is_taken_where_none_keeps_to_the_time_and_the_line_says_so(tmp_path):
    level, line = chosen(slow(), tmp_path, 1e-9)
    assert level == levels(CONFIG, None)[-1]
    assert "nothing that is known here keeps to it" in line


def test_a_level_is_measured_once_for_each_network_and_number_of_points(tmp_path):
    chosen(slow(), tmp_path, 1e9)
    again = slow()
    assert chosen(again, tmp_path, 1e9, points=1024)[0] == Level("best", 512)  # 1,000 points are drawn as 1,024
    assert not again.drawn
    for other, points in ((slow(1.0), 1000), (again, 1025)):
        chosen(other, tmp_path, 1e9, points=points)
        assert {drawn[0] for drawn in other.drawn} == {512}
    assert len(json.loads((tmp_path / within_seconds.FILE).read_text())) == 3


@pytest.mark.parametrize("content", ["{", "[]", '{"a": 1}'])
def test_a_damaged_file_of_measurements_is_made_anew(tmp_path, content):
    (tmp_path / within_seconds.FILE).write_text(content)
    assert chosen(slow(), tmp_path, 1e9)[0] == Level("best", 512)
    again = slow()
    chosen(again, tmp_path, 1e9)
    assert not again.drawn


def test_a_folder_that_cannot_be_written_costs_a_measurement_alone(tmp_path):
    (tmp_path / "file").write_text("")
    assert chosen(slow(), tmp_path / "file" / "folder", 1e9)[0] == Level("best", 512)


def test_a_size_that_is_asked_for_or_learnt_is_kept():
    assert {level.pixels for level in levels(CONFIG, 200)} == {200}
    assert {level.quality for level in levels(CONFIG, 200)} == {"best", "balanced", "draft"}
    assert {level.pixels for level in levels(tiny_model.MODEL, None)} == {tiny_model.SIZE}
    assert [level.quality for level in levels(tiny_model.PLUS, 64)] == ["best", "balanced", "draft"]
    assert min(level.pixels for level in levels(dataclasses.replace(CONFIG, image_resolution=20), None)) == 16


@pytest.mark.ci
def test_the_command_draws_as_was_chosen_and_says_it(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    cloud = tmp_path / "chair.xyz"
    np.savetxt(cloud, np.random.default_rng(0).uniform(-1, 1, (40, 3)))
    one = {"turntable": "none", "outputs": ("image",), "views": 1, "up": "y"}
    untrained = inference.init(jax.random.key(0), tiny_surfels.CONFIG.model)
    weights.write_weights(tmp_path / "w.npz", Trained(config=tiny_surfels.CONFIG, variables=untrained, steps=0))
    command = Render(cloud=cloud, out=tmp_path / "out", run=tmp_path / "w.npz", seconds=1e-9, **one)
    lines = list(pictures.render_file(command, lambda line: None))
    level = levels(tiny_surfels.CONFIG.model, None)[-1]
    assert sum(line.startswith(f"--seconds 1e-09: {level.quality} at {level.pixels} px") for line in lines) == 1
    with Image.open(tmp_path / "out" / "chair_000.png") as picture:
        assert picture.size == (level.pixels,) * 2
    assert (tmp_path / "home" / ".cache" / "spnr_jax" / within_seconds.FILE).is_file()


def test_what_makes_no_sense_is_one_line():
    for seconds, options in ((0, {}), (-1, {}), (float("nan"), {}), (1, {"quality": "draft"})):
        with pytest.raises(ValueError, match="--seconds must be positive, and without --quality"):
            asked(seconds, **options)


def test_a_catalogue_is_told_to_name_its_level(tmp_path):
    with pytest.raises(ValueError, match="--seconds: of a single file; give --quality"):
        list(catalogue.render_catalogue(Render(cloud=tmp_path, out=tmp_path / "out", seconds=5.0)))
