"""The method that the documents show is trained, scored, written and loaded like ours; no file imports it by itself."""

import contextlib
import io
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import command_line, tiny_dataset

import spnr_jax
from spnr_jax import cli, methods
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.training import weights

PAGE = (Path(__file__).parents[1] / "docs" / "own_network.md").read_text()
SOURCE = re.search(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[1]


def forget(patch: pytest.MonkeyPatch) -> None:
    """What was registered before, and nothing of this file's."""
    patch.setattr(methods, "_included", set(methods._included))
    for registry in (methods.METHODS, PRESETS):
        patch.setitem(registry, "mean_color", None)  # is put back as it was: absent
        del registry["mean_color"]


@pytest.fixture
def fresh(monkeypatch):
    forget(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps by the command, which reads the file beside it."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_method.py").write_text(SOURCE)
    with pytest.MonkeyPatch.context() as patch:
        forget(patch)
        patch.chdir(folder)
        data = tiny_dataset.dataset().folder
        asked = ("train", data, "run", "--methods", "my_method.py", "--preset", "mean_color")
        with contextlib.redirect_stdout(io.StringIO()) as said:
            assert command_line.exit_code(cli, *asked, "--image-resolution", str(tiny_dataset.SIZE)) == 0
        assert said.getvalue().endswith(f"`spnr evaluate {shlex.quote(str(data))} run --methods my_method.py`)\n")
        described = json.loads((folder / "run" / "config.json").read_text())["model"]
        assert (described["method"], described["source"]) == ("mean_color", "my_method.py")
        trained = weights.read_trained("run")
        assert (np.asarray(trained.variables["params"]["weight"]) != 0.5).all(), "it has learnt"
        outcome = evaluation.evaluate(folder / "run", tiny_dataset.dataset(), say=lambda line: None)
        assert outcome.summary["methods"]["mean_color"]["psnr"] > 5
        shutil.copy(folder / "run" / "weights.npz", folder / "w.npz")
    return folder / "run"


@pytest.mark.parametrize("name", ["run", "w.npz"])
def test_it_is_loaded_with_its_file_and_refused_in_one_line_without(name, run, fresh, monkeypatch):
    source = run.parent / name
    with pytest.raises(ValueError, match=r"model\.method mean_color is not one of .*--methods my_method\.py") as error:
        spnr_jax.load(source)
    assert "\n" not in str(error.value)
    assert "mean_color" not in methods.METHODS, "nothing was imported"
    monkeypatch.chdir(run.parent)
    handle = spnr_jax.load(source, methods="my_method.py")
    cloud = spnr_jax.read_cloud(tiny_dataset.dataset().folder / "objects" / "chair" / "points.ply")
    volume = handle.encode(cloud)
    image = np.asarray(handle.render(volume, handle.camera(volume)).image)
    mean = np.asarray(cloud.base_color).mean(axis=0)
    np.testing.assert_allclose(image[5, 5], mean * np.asarray(handle.params["params"]["weight"]), rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("absent.py", None, r"it cannot be imported \("),
        ("no.such.module", None, "it cannot be imported .*No module named"),
        ("broken.py", "def", "it cannot be imported .*invalid syntax"),
        ("empty.py", "x = 1", "registers no method"),
    ],
)
def test_a_file_that_brings_no_method_is_refused_in_one_line(
    name, content, reason, fresh, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / name).write_text(content)
    assert command_line.exit_code(cli, "evaluate", "data", "run", "--methods", name) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"spnr: --methods {name}: ")
    with pytest.raises(ValueError, match=reason):
        methods.include(name)


def test_no_two_methods_have_one_name(fresh, run):
    methods.include(run.parent / "my_method.py")
    own = methods.METHODS["mean_color"]
    other = type("OtherConfig", (own.config,), {})
    with pytest.raises(ValueError, match="there is a method mean_color already"):
        methods.register(methods.Method(config=other, network=own.network))
    another = type("AnotherConfig", (own.config,), {"method": "another"})
    with pytest.raises(ValueError, match="there is a preset mean_color already"):
        methods.register(methods.Method(config=another, network=own.network, presets=own.presets))
    with pytest.raises(ValueError, match="method another is not registered"):
        methods.network(another())
