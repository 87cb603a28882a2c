"""Run folders: a config guards its run, and a broken checkpoint costs the steps since the one before, not the run."""

import dataclasses
import json
import shutil

import jax
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_baselines import SHRUNKEN
from support.tiny_dataset import CONFIG

from spnr_jax.methods import to_dict
from spnr_jax.training import checkpoint, optimisation

# Orbax's reader drops a coroutine of its Zarr store when a file is not what it expects
pytestmark = pytest.mark.filterwarnings(
    "ignore:coroutine 'Store:RuntimeWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


DAMAGES = {
    "emptied": lambda content: b"",
    "overwritten": lambda content: b"\xff" * len(content),
    "halved": lambda content: content[: len(content) // 2],
    "deleted": None,
}


def hurt(run, step, damage):
    """Every file of a checkpoint is damaged."""
    for path in [path for path in (run / "checkpoints" / str(step)).rglob("*") if path.is_file()]:
        if damage is None:
            path.unlink()
        else:
            path.write_bytes(damage(path.read_bytes()))


def saved(folder, *steps):
    """A run folder with checkpoints of untrained weights at these steps."""
    state = optimisation.jitted_create_state(CONFIG)
    checkpoint.write_config(folder, CONFIG)
    for step in steps:
        checkpoint.save(folder, dataclasses.replace(state, step=jax.numpy.full_like(state.step, step)))
    return folder


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("run"), 2, 4, 6)


@pytest.fixture
def run(whole_run, tmp_path):
    return shutil.copytree(whole_run, tmp_path / "run")


@pytest.mark.parametrize("config", [CONFIG, SHRUNKEN["npbg_tiny"]], ids=["paper", "without statistics"])
def test_a_state_comes_back_bit_by_bit(config, tmp_path):
    state = optimisation.jitted_create_state(config)
    assert (state.batch_stats == {}) == (config is not CONFIG)
    checkpoint.write_config(tmp_path, config)
    assert checkpoint.restore(tmp_path, config) is None
    checkpoint.save(tmp_path, state)
    same_bits(checkpoint.load_run(tmp_path)[1], state)


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_taken(damage, run):
    hurt(run, 6, damage)
    said = []
    state = checkpoint.restore(run, CONFIG, said.append)
    assert int(state.step) == 4
    assert len(said) == 1
    assert str(run / "checkpoints" / "6") in said[0]
    assert "\n" not in said[0]


def test_a_run_whose_checkpoints_are_all_damaged_is_one_clear_error(run):
    for step in (2, 4, 6):
        hurt(run, step, DAMAGES["emptied"])
    with pytest.raises(
        ValueError, match="no checkpoint of this run can be read; remove the folder to start again"
    ) as error:
        checkpoint.restore(run, CONFIG, lambda line: None)
    assert "\n" not in str(error.value)


def test_the_newest_three_checkpoints_stay_and_a_reader_removes_nothing_that_is_being_written(tmp_path):
    saved(tmp_path, *range(1, 6))
    writing = tmp_path / "checkpoints" / "8.orbax-checkpoint-tmp"
    writing.mkdir()
    checkpoint.restore(tmp_path, CONFIG)
    writing.rmdir()
    assert {path.name for path in (tmp_path / "checkpoints").iterdir() if path.is_dir()} == {"3", "4", "5"}


def test_a_run_of_another_preset_is_refused_with_the_fields_that_differ(run):
    other = dataclasses.replace(CONFIG, preset="small", model=dataclasses.replace(CONFIG.model, field_width=16))
    with pytest.raises(ValueError, match="with another config") as error:
        checkpoint.write_config(run, other)
    assert "preset tiny there, small asked" in str(error.value)
    assert "model.field_width 8 there, 16 asked" in str(error.value)
    assert checkpoint.read_config(run) == CONFIG
    checkpoint.write_config(run, CONFIG)
    with pytest.raises(ValueError, match=r"model\.method paper there, npbg asked"):
        checkpoint.write_config(run, SHRUNKEN["npbg_tiny"])


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", '{"preset": "tiny"}', json.dumps(to_dict(CONFIG) | {"num_steps": "many"})]
)
def test_a_config_that_is_none_is_an_error_with_its_path(text, tmp_path):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match="config.json: not a config of this version"):
        checkpoint.read_config(tmp_path)


@pytest.mark.parametrize("changed", ["list", "files"])
def test_a_run_with_a_checkpoint_tells_another_data_set_once(changed, run, tmp_path):
    one = tiny_dataset.dataset()
    other = dataclasses.replace(one, splits=one.splits | {"train": one.splits["train"][1:]})
    if changed == "files":  # of one object
        shutil.copytree(one.folder, tmp_path / "other")
        other = dataclasses.replace(one, folder=tmp_path / "other")
        (tmp_path / "other" / "objects" / one.splits["train"][0] / "object.json").write_text("{}")
    assert [checkpoint.record_data(run, dataset) for dataset in (one, one, other, other)] == [True, True, False, True]
    shutil.rmtree(run / "checkpoints")
    assert checkpoint.record_data(run, one)
