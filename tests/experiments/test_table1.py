"""Table 1 is the same for a run that was stopped and for one that was not, and its numbers are those of the evaluation.

The networks are shrunken, the data set is painted: the way from an empty folder to the tables in seconds.
"""

import base64
import dataclasses
import importlib.util
import io
import json
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from support import tiny_dataset
from support.tiny_baselines import BASELINE, SHRUNKEN, SIZE
from support.tiny_runs import forbidden

from data_gen.render import poisson_surface as surfaces
from data_gen.render import views
from data_gen.store import layout
from experiments.comparison import budget, object_scores, poisson
from experiments.comparison.trained_networks import LABELS
from experiments.paper import table1
from spnr_jax import cli, presets
from spnr_jax.formats import data_sets
from spnr_jax.scoring import evaluation
from spnr_jax.training import optimisation, trainer

pytestmark = pytest.mark.ci  # it trains several networks
SOLVER = importlib.util.find_spec("pymeshlab") is not None
METHODS = tuple(name for name in table1.ROWS if SOLVER or not name.startswith("poisson"))


@pytest.fixture(scope="module", autouse=True)
def _shrunken_presets():
    """The shrunken networks under the names of the tiny presets, and no cache of compilations on disk."""
    with pytest.MonkeyPatch.context() as patch:
        for name, shrunken in SHRUNKEN.items():
            patch.setitem(presets.PRESETS, name, lambda shrunken=shrunken: shrunken)
        for name, surface in poisson.SURFACES.items():  # depth 12 takes seconds for a ball of few points
            patch.setitem(poisson.SURFACES, name, dataclasses.replace(surface, depth=5))
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """The painted data set, described as the generator describes its own: the Poisson surfaces need that."""
    folder = tmp_path_factory.mktemp("table1") / "data"
    shutil.copytree(tiny_dataset.dataset().folder, folder)
    described = {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": vars(views.ViewConfig(resolution=SIZE, spp=4, views=tiny_dataset.VIEWS, max_depth=2)),
        "environment_map": {"name": "procedural room", "sha256": None},
    }
    layout.write_text(folder / "dataset.json", layout.json_text(described))
    return folder


def asked(dataset, out, **options):
    options = {"budget": "quick", "methods": METHODS, "variant": "scalar_rgb"} | options
    return table1.Table1(data=dataset, out=out, **options)


def results_of(out):
    """results.json without the costs that a clock decides."""
    results = json.loads((out / "results.json").read_text())
    for cost in results["costs"].values():
        cost.pop("ms_per_view"), cost.pop("training_seconds", None)
    return results


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory):
    """A finished table."""
    folder = tmp_path_factory.mktemp("table1") / "out"
    table1.main(asked(dataset, folder))
    return folder


def test_scores_of_a_network_and_the_floors_are_those_of_the_evaluation_of_its_run(out, dataset):
    found = evaluation.evaluate(out / "runs" / "near_points", data_sets.open_dataset(dataset)).summary
    results = results_of(out)
    assert results["compared"] == "near_points"
    for method in ("near_points", *evaluation.FLOORS):
        assert results["methods"][method] == found["methods"][method]
        assert method == "near_points" or results["differences"][method] == found["near_points_minus"][method]


def test_a_finished_table_is_not_trained_again(out, dataset, monkeypatch):
    monkeypatch.setattr(optimisation, "jitted_train_step", forbidden)
    monkeypatch.setattr(poisson.Renderer, "pictures", forbidden)
    before, costs = results_of(out), json.loads((out / "results.json").read_text())["costs"]
    table1.main(asked(dataset, out))
    assert results_of(out) == before
    again = json.loads((out / "results.json").read_text())["costs"]
    for method, cost in costs.items():
        assert cost.get("training_seconds") == again[method].get("training_seconds")


def test_a_table_that_was_stopped_goes_on_to_the_same_numbers(out, dataset, tmp_path, monkeypatch, capsys):
    train, calls = trainer.train, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt("stopped at step 1 of 4; the same command goes on from there")
        return train(*arguments)

    monkeypatch.setattr(trainer, "train", stopped)
    options = asked(dataset, tmp_path, methods=budget.NETWORKS)
    assert cli.guarded(lambda: table1.main(options), "table1") == 130
    assert not (tmp_path / "results.json").exists()
    assert cli.guarded(lambda: table1.main(options), "table1") == 0
    results, uninterrupted = results_of(tmp_path), results_of(out)
    assert tuple(results["methods"]) == budget.NETWORKS
    for name, row in results["methods"].items():
        assert row == uninterrupted["methods"][name]
        assert results["costs"][name] == uninterrupted["costs"][name]
    said = capsys.readouterr().out
    assert "network 4 of 5, Point-NeRF: preset point_nerf_tiny, 4 steps" in said
    assert "scored 3 of 3 objects" in said


def test_without_the_solver_the_rows_say_what_to_install(dataset, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymeshlab", None)
    table1.main(asked(dataset, tmp_path, methods=("poisson", "poisson_trimmed", "white")))
    assert list(results_of(tmp_path)["methods"]) == ["white"]
    assert all("pip install" in reason for reason in results_of(tmp_path)["missing"].values())
    with pytest.raises(ValueError, match=r"^--methods poisson: none can be made here, not run: .*pip install"):
        table1.main(asked(dataset, tmp_path / "alone", methods=("poisson",)))


@pytest.mark.skipif(not SOLVER, reason="pymeshlab is not installed")
def test_a_poisson_row_shows_the_surface_of_the_points_that_the_networks_see(out, dataset):
    found, name = data_sets.open_dataset(dataset), tiny_dataset.SPLITS["test"][0]
    item, points = data_sets.read_object(found, name), tiny_dataset.CONFIG.test_points
    renderer = poisson.Renderer(found.settings, variant="scalar_rgb")
    expected, empty = renderer.pictures(item, points, surfaces.PoissonConfig(depth=5))
    folder = out / f"poisson_{points}" / name
    for view, picture in enumerate(expected):
        np.testing.assert_array_equal(layout.read_image(folder / f"{view:03d}.png"), picture)
    assert json.loads((folder / "made.json").read_text())["empty"] == empty


class Page(HTMLParser):
    """Every address of a page, and the content of its scripts."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.scripts, self._in_script = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        self._in_script = tag == "script"

    def handle_endtag(self, tag):
        self._in_script = False

    def handle_data(self, data):
        if self._in_script:
            self.scripts.append(data)


def decoded(address):
    head, _, content = address.partition(",")
    assert head == "data:image/png;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(content))))


def test_the_page_loads_nothing_and_holds_every_picture(out, dataset):
    text = (out / "table1.html").read_text()
    page = Page(text)
    assert page.addresses == []
    assert "http" not in text
    content = json.loads(page.scripts[0])
    assert tuple(content["methods"]) == tuple(LABELS[name] for name in METHODS)
    assert [shown["name"] for shown in content["objects"]] == list(tiny_dataset.SPLITS["test"])
    for shown in content["objects"]:
        item = data_sets.read_object(data_sets.open_dataset(dataset), shown["name"])
        reference = np.round(255 * data_sets.on_white(item.images[shown["view"]]))
        np.testing.assert_array_equal(decoded(shown["reference"]), reference)
        for method, address in shown["images"].items():
            error = np.mean((decoded(address) / 255 - reference / 255) ** 2)
            assert shown["psnr"][method] == pytest.approx(-10 * np.log10(error), abs=0.1)


def test_the_time_of_a_view_leaves_out_the_object_that_compiled(tmp_path):
    scored = object_scores.Scored(scores={}, shown=[], seconds={"white": [9.0, 0.001, 0.003], "splat": [9.0]})
    found = table1.costs(asked(tmp_path, tmp_path), {}, scored, BASELINE)
    assert found == {"white": {"ms_per_view": 2.0}, "splat": {"ms_per_view": None}}
