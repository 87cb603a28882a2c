"""What the documents show runs, and the signatures that they show are the code's; `make docs` checks the rest."""

import ast
import inspect
import pkgutil
import re
import shutil
import tomllib
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels, tiny_untrained

import spnr_jax
from spnr_jax import methods
from spnr_jax.formats import data_sets
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.tools import export
from spnr_jax.tools.commands import Export
from spnr_jax.training import trainer, weights

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SIGNATURE = re.compile(r"^(?:### |\| )`([\w.]+)\((.*)\)`", re.MULTILINE)  # of a heading, or of a table's first column
PARAMETER = re.compile(r"(\w+)(?:=([^,()]*(?:\(\))?))?")
PAGES = sorted(DOCS.rglob("*.md"))
ENCODE = jax.jit(spnr_jax.encode)  # one program for all pages; one by one its operations take long to compile


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder with what the examples use: what `make demo` leaves, a cloud, an exported network."""
    (tmp_path / "runs" / "demo").mkdir(parents=True)
    (tmp_path / "runs" / "demo" / "data").symlink_to(tiny_dataset.dataset().folder)
    (tmp_path / "runs" / "demo" / "paper").symlink_to(tiny_untrained.run())
    shutil.copy(tiny_dataset.dataset().folder / "objects" / "chair" / "points.ply", tmp_path / "chair.ply")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(weights, "packaged_file", tiny_surfels.shipped)
    monkeypatch.setattr(spnr_jax, "encode", ENCODE)
    monkeypatch.setattr(evaluation, "choose_radius", lambda *_: 1.5)
    return tmp_path


@pytest.fixture
def traced_gradients(monkeypatch):
    """Gradients are traced and not compiled: zeros of their shapes.  Those of one page are computed."""

    def traced(function):
        return lambda x: jnp.zeros_like(jax.eval_shape(gradient(function), x))

    gradient = jax.grad
    monkeypatch.setattr(jax, "grad", traced)


def execute(path):
    """The names that the python blocks of a page leave, run one after the other; errors name the page's lines."""
    text, names = path.read_text(), {"__name__": "__main__"}
    blocks = list(CODE.finditer(text))
    assert blocks, f"{path.name} has no example"
    for block in blocks:
        lines_before = text.count("\n", 0, block.start(1))
        exec(compile("\n" * lines_before + block.group(1), str(path), "exec"), names)
    return names


def check_gradient(tree, which=all):
    """Every leaf is finite, and the value depends on all of them, or on any."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert which(np.any(leaf) for leaf in leaves)


@pytest.mark.ci
def test_the_readmes_example_draws_pictures_and_has_a_gradient(workplace, traced_gradients):
    names = execute(ROOT / "README.md")
    pictures = np.asarray(names["images"])
    assert pictures.shape == (2, 128, 128, 3)
    assert np.abs(pictures[0] - pictures[1]).max() > 0.05, "two lights"
    assert names["by_color"].shape == names["cloud"].base_color.shape


@pytest.mark.ci
def test_the_examples_of_the_api_run_in_their_order(workplace, traced_gradients):
    names = execute(DOCS / "api.md")
    assert int(names["state"].step) == 1
    assert "paper" in names["outcome"].summary["methods"]
    assert names["volume_of_means"][2, 2, :, 0].tolist() == [2, 0, 0, 7], "as its comment says"
    assert names["seen"][1] == pytest.approx(0.63, abs=0.005), "as its comment says"


@pytest.mark.ci
def test_the_example_without_this_package_runs_on_what_the_command_writes(workplace):
    export.export_network(Export(run=tiny_surfels.untrained(), num_points=1024, resolution=128))
    names = execute(DOCS / "exporting.md")
    assert "spnr_jax" not in names
    assert names["picture"]["acc"].max() > 0.5


@pytest.mark.ci
def test_the_examples_of_differentiable_rendering_give_gradients_and_pictures_that_differ(workplace):
    names = execute(DOCS / "differentiable.md")
    pictures = np.asarray(names["pictures"])
    assert pictures.shape == (2, 3, 64, 64, 3)
    assert pictures.std(axis=(0, 1)).max() > 0.01
    params, plan = names["model"].params, names["plan"]
    scene = ENCODE(params, names["cloud"], names["neighbors"])
    assert names["draw"](params, scene, names["camera"], plan=plan).overflow == 0, "the loss's plan holds its picture"
    for name in ("by_color", "by_positions", "by_camera", "by_light"):
        check_gradient(names[name])


def test_the_lights_of_the_page_about_them_are_made_as_it_says():
    names = execute(DOCS / "light.md")
    assert names["light"].tables.shape == names["studio"].tables.shape
    assert float(names["light"].tables.min()) > 0.1, "the ambient light is everywhere"


@pytest.mark.ci
def test_a_method_and_losses_of_ones_own_work_as_their_page_shows_them(workplace, monkeypatch):
    monkeypatch.setattr(data_sets, "check_resolution", lambda *_: None)  # the demo's pictures are larger than these
    for registry in (methods.METHODS, PRESETS):
        monkeypatch.setitem(registry, "mean_color", None)  # is put back as it was: absent
        del registry["mean_color"]
    names = execute(DOCS / "own_network.md")
    loaded, again = names["mean"], spnr_jax.load(workplace / "runs" / "mean")
    assert (np.asarray(loaded.params["params"]["weight"]) != 0.5).all(), "the loss is the one that is trained"
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3), loaded.params["params"], again.params["params"])
    assert {"loss", "psnr"} <= trainer.read_rows(workplace / "runs" / "mean")[0].keys()
    check_gradient(names["by_weights"], any)


def test_the_signatures_that_the_api_shows_are_those_of_the_code():
    shown = SIGNATURE.findall((DOCS / "api.md").read_text())
    assert len(shown) > 30
    for name, arguments in shown:
        parameters = inspect.signature(pkgutil.resolve_name(f"spnr_jax.{name}")).parameters
        wanted = {n: p for n, p in parameters.items() if n != "self"}
        given = dict(PARAMETER.findall(arguments))
        assert list(given) == list(wanted), name
        for parameter, default in given.items():
            optional = wanted[parameter].default is not inspect.Parameter.empty
            assert optional == bool(default), f"{name}: {parameter}"
            if default not in ("", "...", "print", "Cut()"):
                assert wanted[parameter].default == ast.literal_eval(default), f"{name}: {parameter}"


def test_the_extras_that_the_documents_name_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"data", "viewer", "baselines", "bench", "cuda"} <= extras.keys()
    for page in (*PAGES, ROOT / "README.md", *(ROOT / "spnr_jax").rglob("*.py"), *(ROOT / "data_gen").rglob("*.py")):
        for names in re.findall(r"spnr-jax\[([\w,]+)\]", page.read_text()):
            assert set(names.split(",")) <= extras.keys(), page
