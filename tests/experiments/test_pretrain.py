"""The package's network is made again from two data sets joined into one, and what is there is reused."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from support import tiny_dataset, tiny_model

from experiments.packaged import pretrain
from spnr_jax import cli, presets
from spnr_jax.formats import data_sets
from spnr_jax.training import run_record, weights

pytestmark = pytest.mark.ci  # it trains several networks

SIZE = tiny_dataset.CONFIG.model.image_resolution
CONFIG = dataclasses.replace(
    tiny_dataset.CONFIG,
    model=dataclasses.replace(tiny_model.PLUS, image_resolution=SIZE, surface_cells=45),
    loss=dataclasses.replace(tiny_dataset.CONFIG.loss, adversarial_weight=0.0),
)


@pytest.fixture
def asked(monkeypatch):
    """Instead of Mitsuba, the tests' data set, its objects under other names for the meshes; what was to be made."""
    configs = []

    def generate(generation):
        configs.append(generation)
        if generation.out.exists():
            return
        shutil.copytree(tiny_dataset.dataset().folder, generation.out)
        described = {"settings": {"spread": generation.spread}}
        (generation.out / "dataset.json").write_text(json.dumps(described))
        if generation.meshes:
            for path in sorted((generation.out / "objects").iterdir()):
                path.rename(path.with_name(f"mesh-{path.name}"))
            for path in (generation.out / "splits").iterdir():
                path.write_text("".join(f"mesh-{name}\n" for name in path.read_text().split()))

    monkeypatch.setattr(pretrain, "generate", generate)
    monkeypatch.setattr(pretrain, "first_run", lambda: CONFIG)
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    return configs


def test_both_data_sets_train_one_network_and_its_file_is_what_was_scored(asked, tmp_path, capsys):
    options = pretrain.Pretrain(out=tmp_path / "out", meshes=tmp_path, test_list=tmp_path / "test.txt", steps=2)
    pretrain.main(options)
    procedural, meshes = asked
    assert (procedural.objects, procedural.meshes, procedural.colour_variants) == (2400, None, 0)
    assert (meshes.meshes, meshes.colour_variants, meshes.reshape_variants) == (tmp_path, 24, True)
    assert meshes.test_list == tmp_path / "test.txt"
    assert {procedural.spread, meshes.spread} == {"even"}
    joined, single = data_sets.open_dataset(options.out / "data"), tiny_dataset.dataset()
    for split, names in single.splits.items():
        assert set(joined.splits[split]) == {*names, *(f"mesh-{name}" for name in names)}
    assert data_sets.read_object(joined, f"mesh-{single.splits['test'][0]}").images.size
    trained, out = weights.read_trained(options.out / "near_points.npz"), options.out / "near_points"
    assert (trained.config, trained.steps) == (pretrain.recipe(options)[-1], 2)
    before = weights.read_trained(out / "run4").variables["params"]
    for part, kept in before.items():
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-3), trained.variables["params"][part], kept)
    starts = [run_record.read_starts(out / f"run{number}") for number in range(1, 6)]
    assert [start.get("init") for (start,) in starts] == [None, *[f"{CONFIG.preset}, 2 steps"] * 4]
    scored = json.loads((out / "metrics.json").read_text())
    assert scored["methods"]["near_points"]["objects"] == len(joined.splits["test"])
    assert "report.html" in capsys.readouterr().out

    pretrain.main(options)
    again = json.loads((out / "metrics.json").read_text())
    assert again["methods"] == scored["methods"]
    assert again["seconds"].get("train") == scored["seconds"].get("train")


def test_without_meshes_the_procedural_objects_train_alone(asked, tmp_path):
    parts = pretrain.data_sets(pretrain.Pretrain(out=tmp_path, objects=5), 128)
    assert [(part.objects, part.resolution, part.meshes) for part in parts] == [(5, 128, None)]


def test_the_lite_network_has_one_run_and_each_run_of_the_other_begins_where_the_one_before_ended():
    assert pretrain.recipe(pretrain.Pretrain(network="near_points_lite")) == [presets.near_points_lite()]
    first, *later, refiner = pretrain.recipe(pretrain.Pretrain())
    assert (first.model.refiner_width, first.crop, first.pixel_stride, first.num_steps) == (0, 0, 4, 11_000)
    assert [run.num_steps for run in later] == [9000, 6000, 4000]
    assert [run.even_share for run in (first, *later)] == [0, 0, 0, 0.5]
    assert len({run.seed for run in (first, *later)}) == 4
    assert all(run.model.surface_cells == presets.near_points_lite().model.surface_cells for run in later)
    assert (refiner.trains, refiner.num_steps, refiner.even_share, refiner.crop) == ("refiner", 20_000, 0.5, 64)
    assert refiner.model == presets.near_points().model, "what the package holds"
