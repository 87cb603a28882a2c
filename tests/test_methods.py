"""A method of one's own is trained, scored, written and loaded like the package's, and no file imports it by itself."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support import command_line, tiny_dataset

import spnr_jax
from spnr_jax import methods
from spnr_jax.presets import PRESETS
from spnr_jax.scoring import evaluation
from spnr_jax.training import weights

cli = command_line.unchecked_cli()
SOURCE = Path(__file__).parent / "support" / "grey_method.py"


def forget(patch: pytest.MonkeyPatch) -> None:
    """What was registered before, and nothing of this file's."""
    patch.setattr(methods, "_included", dict(methods._included))
    for registry in (methods.METHODS, PRESETS):
        for name in ("grey",):
            patch.setitem(registry, name, None)  # is put back as it was: absent
            del registry[name]


@pytest.fixture
def fresh(monkeypatch):
    monkeypatch.setattr(cli, "set_up_jax", lambda **_: None)
    forget(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps by the command, which reads the file beside it."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copy(SOURCE, folder / "my_method.py")
    with pytest.MonkeyPatch.context() as patch:
        forget(patch)
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        patch.chdir(folder)
        data = tiny_dataset.dataset().folder
        asked = ("train", data, "run", "--methods", "my_method.py", "--preset", "grey", "--lr-generator", "0.05")
        assert command_line.exit_code(cli, *asked, "--warmup-steps", "0") == 0
        described = json.loads((folder / "run" / "config.json").read_text())["model"]
        assert (described["method"], described["source"]) == ("grey", "my_method.py")
        trained = weights.read_trained("run")
        assert (np.asarray(trained.variables["params"]["weight"]) != 0.5).all(), "it has learnt"
        outcome = evaluation.evaluate(folder / "run", tiny_dataset.dataset(), say=lambda line: None)
        assert outcome.summary["methods"]["grey"]["psnr"] > 5
        weights.write_weights(folder / "w.npz", trained)
    return folder / "run"


@pytest.mark.parametrize("name", ["run", "w.npz"])
def test_it_is_loaded_with_its_file_and_refused_in_one_line_without(name, run, fresh, monkeypatch):
    source = run.parent / name
    with pytest.raises(ValueError, match=r"model\.method grey is not one of .*--methods my_method\.py") as error:
        spnr_jax.load(source)
    assert "\n" not in str(error.value)
    assert "grey" not in methods.METHODS, "nothing was imported"
    monkeypatch.chdir(run.parent)
    handle = spnr_jax.load(source, methods="my_method.py")
    cloud = spnr_jax.read_cloud(tiny_dataset.dataset().folder / "objects" / "chair" / "points.ply")
    volume = handle.encode(cloud)
    image = np.asarray(handle.render(volume, handle.camera(volume)).image)
    mean = np.asarray(cloud.base_color).mean(axis=0)
    np.testing.assert_allclose(image[5, 5], mean * np.asarray(handle.variables["params"]["weight"]), rtol=1e-4)


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


def test_no_two_methods_have_one_name(fresh):
    methods.include(SOURCE)
    own = methods.METHODS["grey"]
    other = type("OtherConfig", (own.config,), {})
    with pytest.raises(ValueError, match="there is a method grey already"):
        methods.register(methods.Method(config=other, network=own.network))
    another = type("AnotherConfig", (own.config,), {"method": "another"})
    with pytest.raises(ValueError, match="there is a preset grey already"):
        methods.register(methods.Method(config=another, network=own.network, presets=own.presets))
    with pytest.raises(ValueError, match="method another is not registered"):
        methods.network(another())
