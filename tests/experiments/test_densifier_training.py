"""The training of the densifier: which meshes it sees, what it prints, how it goes on."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.packaged import densifier_training
from spnr_jax.errors import UserError
from spnr_jax.training import weights


def test_the_densifier_trains_on_no_mesh_of_the_test_list(tmp_path, monkeypatch):
    names = ("my table.glb", "lamp.glb", "lamp.obj", "sub/vase.glb", "sub/chair.glb")
    for name in names:
        (tmp_path / "meshes" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "meshes" / name).touch()
    loaded = set()

    def load(source, variant, seed):
        loaded.add(source.name)
        raise UserError("is empty")

    monkeypatch.setattr(densifier_training, "load", load)
    left_out = frozenset({"my_table", "lamp.glb", "chair"})
    densifier_training.make_records(
        densifier_training.Options(meshes=tmp_path / "meshes", left_out=left_out, out=tmp_path, objects=0, steps=1)
    )
    assert loaded == {"lamp.obj", "vase.glb"}


@pytest.fixture
def small(monkeypatch):
    """A training of three numbers; returns what makes its options from a folder."""
    metrics = {"kept": jnp.zeros(()), **dict.fromkeys(densifier_training.OF_KEPT, jnp.zeros(()))}
    batch = densifier_training.Batch(*np.ones((4, 1), np.float32))
    monkeypatch.setattr(densifier_training, "init", lambda *_: {"w": jnp.ones(3)})
    monkeypatch.setattr(densifier_training, "make_batch", lambda *_: batch)
    monkeypatch.setattr(
        densifier_training,
        "measure_losses",
        lambda params, batch: (jnp.sum(params["w"] ** 2), metrics | {"loss": jnp.sum(params["w"] * batch.nodes[0])}),
    )
    return lambda out: densifier_training.Options(meshes=None, left_out=frozenset(), out=out, objects=1, steps=3)


@pytest.mark.parametrize("written", [0, 1])
def test_a_training_that_is_killed_between_its_files_goes_on_to_the_same(small, tmp_path, monkeypatch, written):
    whole, killed = small(tmp_path / "whole"), small(tmp_path / "killed")
    densifier_training.train(whole)
    write, left = densifier_training.write_whole, [written]

    def stop(path, content):
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        write(path, content)

    with monkeypatch.context() as patch:
        for module in (densifier_training, weights):  # the checkpoint, the densifier
            patch.setattr(module, "write_whole", stop)
        with pytest.raises(KeyboardInterrupt):
            densifier_training.train(killed)
    densifier_training.train(killed)
    for name in ("densifier.npz", "checkpoint.npz"):
        assert (killed.out / name).read_bytes() == (whole.out / name).read_bytes(), name


def test_a_loss_that_is_not_finite_stops_the_training_and_names_the_step(small, tmp_path, monkeypatch):
    monkeypatch.setattr(densifier_training, "init", lambda *_: {"w": jnp.full(3, jnp.nan)})
    with pytest.raises(UserError, match="loss is nan at step 1"):
        densifier_training.train(small(tmp_path))
    assert not (tmp_path / "densifier.npz").exists()


def test_metrics_of_learned_points_are_means_over_those_that_are_kept():
    steps = [{"kept": 0.0, "off": 0.0, "cosine": 0.0, "good": 0.0}, {"kept": 0.5, "off": 0.1, "cosine": 0.4, "good": 0}]
    assert densifier_training.describe(steps[:1]) == "kept 0.0000 off nan cosine nan good nan"
    assert densifier_training.describe(steps) == "kept 0.2500 off 0.2000 cosine 0.8000 good 0.0000"
