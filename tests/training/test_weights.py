"""A network in one file: the same pictures as from its run, and one line for whatever is wrong with the file."""

import dataclasses
import io
import shutil
import zipfile

import jax
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from support import tiny_surfels, tiny_untrained
from support.laws import close

from spnr_jax.formats.array_files import pack_arrays
from spnr_jax.presets import PRESETS
from spnr_jax.training import checkpoint, optimisation, trainer, weights


@pytest.fixture(scope="module")
def trained() -> weights.Trained:
    return weights.read_trained(tiny_untrained.run())


@pytest.fixture
def file(trained, tmp_path):
    weights.write_weights(tmp_path / "w.npz", trained)
    return tmp_path / "w.npz"


def test_what_is_read_is_the_run_rounded_to_half_precision(trained, file):
    config, state = checkpoint.load_run(tiny_untrained.run())
    read = weights.read_trained(file)
    assert (read.config, read.steps) == (config, int(state.step))
    close(read.variables, jax.tree.map(np.asarray, optimisation.averaged_variables(state)), rtol=1e-3, atol=1e-4)
    halved = jax.tree.map(lambda x: np.asarray(x, np.float16).astype(np.float32), trained.variables)
    jax.tree.map(np.testing.assert_array_equal, read.variables, halved)


def test_the_network_in_the_package_has_the_weights_and_the_name_of_its_preset(tmp_path):
    copy = tmp_path / "copy.npz"  # the package's own file is not checked when it is read
    copy.write_bytes(weights.packaged_file().read_bytes())
    checked, trusted = weights.read_weights(copy), weights.read_trained(None)
    assert checked.config == trusted.config
    assert checked.config.preset == "surfels"
    assert checked.config.model == PRESETS["surfels"]().model
    jax.tree.map(np.testing.assert_array_equal, checked.variables["params"], trusted.variables["params"])


@pytest.mark.ci
def test_the_densifier_stands_beside_every_network_over_surfels_and_in_no_file_of_weights(tmp_path):
    trained = weights.read_trained(None)
    weights.write_weights(tmp_path / "w.npz", trained)
    assert "densifier" not in weights.read_weights(tmp_path / "w.npz").variables
    for again in (weights.read_trained(tmp_path / "w.npz"), weights.read_trained(tiny_surfels.untrained())):
        jax.tree.map(
            np.testing.assert_array_equal,
            again.variables["densifier"],
            weights.read_variables(weights.packaged_file("densifier")),
        )
    assert "densifier" not in weights.read_trained(tiny_untrained.run()).variables


def test_a_densifier_beside_the_weights_or_in_the_run_comes_before_that_of_the_package(tmp_path):
    own = jax.tree.map(lambda x: x + 1, weights.read_variables(weights.packaged_file("densifier")))
    flat = {name: np.asarray(x, np.float16) for name, x in flatten_dict(own, sep="/").items()}
    shutil.copytree(tiny_surfels.untrained(), tmp_path / "run")
    for folder in (tmp_path, tmp_path / "run"):
        (folder / "densifier.npz").write_bytes(pack_arrays(flat))
    weights.write_weights(tmp_path / "w.npz", weights.read_trained(None))
    for source in (tmp_path / "w.npz", tmp_path / "run"):
        jax.tree.map(lambda x, y: close(x, y, rtol=1e-3), weights.read_trained(source).variables["densifier"], own)


def test_a_run_trains_with_the_densifier_of_its_first_weights_or_with_one_that_is_there_and_says_so(tmp_path, capsys):
    run, trained = tmp_path / "run", weights.read_trained(tiny_surfels.untrained())
    run.mkdir()
    for factor in (2, 2, 3):
        assert not capsys.readouterr().out
        own = jax.tree.map(lambda x, f=factor: f * x, trained.variables["densifier"])
        init = dataclasses.replace(trained, variables=trained.variables | {"densifier": own})
        trainer.restore_or_init(trained.config, run, None, init)
        found = weights.add_companions(trained.config.model, {}, run)["densifier"]
        jax.tree.map(lambda x, y: close(x, 2 * y, rtol=1e-3), found, trained.variables["densifier"])
    assert "densifier.npz is used, not the densifier of the initial weights" in capsys.readouterr().out


def test_a_name_is_the_packages_network_and_a_path_is_not(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert weights.read_trained(None).config.preset == weights.read_trained("surfels").config.preset == "surfels"
    with pytest.raises(ValueError, match="none.npz: no such file"):
        weights.read_trained("none.npz")


def test_weights_that_half_precision_does_not_hold_are_refused_and_nothing_is_written(trained, tmp_path):
    large = dataclasses.replace(trained, variables=jax.tree.map(lambda x: x * 0 + 7e4, trained.variables))
    with pytest.raises(ValueError, match=r"reaches 7e\+04, which float16 does not hold"):
        weights.write_weights(tmp_path / "w.npz", large)
    assert not list(tmp_path.iterdir())


WEIGHT = "params/encoder/unet/stem/kernel"
BROKEN = {  # what is done to the file, and a part of what is said
    "absent": (lambda file: file.unlink(), "no such file"),
    "empty": (lambda file: file.write_bytes(b""), ""),
    "no archive": (lambda file: file.write_bytes(b"PK\x03\x04 and no more"), ""),
    "half": (lambda file: file.write_bytes(file.read_bytes()[:-200]), ""),
    **{
        f"config {content!r:.12}": (lambda file, content=content: rewrite(file, config=content), "")
        for content in (None, b"", b"{", b"[1]", b"{}", b'{"preset": 3}', b"[" * 10000)
    },
    "a weight is missing": (lambda file: rewrite(file, **{WEIGHT: None}), WEIGHT),
    "of another shape": (lambda file: change(file, lambda x: x[..., :1]), WEIGHT),
    "of another type": (lambda file: change(file, lambda x: x.astype(np.float32)), WEIGHT),
    "not finite": (lambda file: change(file, lambda x: np.full_like(x, np.nan)), WEIGHT),
    "one more": (lambda file: rewrite(file, **{"params/more": np.zeros(3, np.float16)}), "no params/more"),
    "a pickle": (lambda file: pickle(file), "Object arrays"),
}


def rewrite(file, **changes):
    """The file with other arrays; bytes are an array of them, None leaves one out."""
    arrays = dict(np.load(file, allow_pickle=False)) | changes
    arrays = {name: np.frombuffer(x, np.uint8) if isinstance(x, bytes) else x for name, x in arrays.items()}
    np.savez(file, allow_pickle=False, **{name: values for name, values in arrays.items() if values is not None})


def change(file, how):
    rewrite(file, **{WEIGHT: how(np.load(file)[WEIGHT])})


def pickle(file):
    stream = io.BytesIO()
    np.save(stream, np.array([print], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("config.npy", stream.getvalue())


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_line_that_says_what_to_do(case, file):
    damage, words = BROKEN[case]
    damage(file)
    with pytest.raises(ValueError, match=rf"^{file}: ") as error:
        weights.read_trained(file)
    assert "\n" not in str(error.value)
    assert "spnr export RUN" in str(error.value)
    assert words in str(error.value)
