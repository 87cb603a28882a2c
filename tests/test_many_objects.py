"""Many runs in one program are the single runs: states, losses, data; and the command goes on where it was stopped."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import same_bits
from support.tiny_baselines import SHRUNKEN

from experiments import many_objects, many_objects_report, many_runs
from experiments.many_objects import ManyObjects, main
from experiments.many_runs import AXES, FORMS, apart, create, entered_batch, entered_states, form_step, left
from spnr_jax import cli, presets
from spnr_jax.training import batching, optimisation, trainer

pytestmark = pytest.mark.ci  # it trains several networks
SEEDS = (3, 4, 5)
STEPS = 3
QUICK = dataclasses.replace(SHRUNKEN["points2nerf_tiny"], num_steps=STEPS)  # no convolutions: compiles in a second
OURS = dataclasses.replace(tiny_dataset.CONFIG, num_steps=STEPS)


def trained(form, of, adversarial=False):
    """Stacked states and losses after some steps of a form."""
    states, step, losses = entered_states(form, create(of, SEEDS)), form_step(form, of, adversarial), []
    for batch in many_runs.batches(tiny_dataset.dataset(), of, SEEDS, 0):
        states, metrics = step(states, entered_batch(form, batch))
        losses.append(np.asarray(metrics["loss"]))
    return left(form, states), np.array(losses)


def test_a_state_of_a_seed_is_that_of_the_config_with_this_seed():
    states = many_runs.unstack(create(QUICK, SEEDS))
    same_bits(states[1], optimisation.jitted_create_state(dataclasses.replace(QUICK, seed=SEEDS[1])))


@pytest.fixture(scope="module")
def loop():
    return trained("loop", QUICK)


@pytest.mark.parametrize("form", FORMS[1:])
def test_runs_in_one_program_are_the_single_runs(form, loop):
    states, losses = trained(form, QUICK)
    assert losses.shape == (STEPS, len(SEEDS))
    assert len(np.unique(losses[0])) == len(SEEDS)
    np.testing.assert_allclose(losses, loop[1], rtol=1e-4)
    assert apart(states, loop[0])["median"] < 1e-4
    assert int(states.step) == int(loop[0].step) == STEPS
    assert jax.tree.structure(states) == jax.tree.structure(loop[0])


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS[1:])
def test_runs_of_ours_with_its_discriminator_in_one_program_are_the_single_runs(form):
    (states, losses), (expected, curve) = trained(form, OURS, True), trained("loop", OURS, True)
    np.testing.assert_allclose(losses, curve, rtol=1e-3)
    assert apart(states, expected)["median"] < 1e-3


def test_the_step_is_shared_so_that_branches_on_it_stay_branches():
    states = create(QUICK, SEEDS)
    assert states.step.shape == ()

    def branches(axes):
        def every_other(state):
            return jax.lax.cond(state.step % 2 == 0, lambda: jnp.sum(state.key_data), lambda: jnp.uint32(0))

        plain = dataclasses.replace(states, key=jnp.zeros((len(SEEDS), 2), jnp.uint32))
        plain = plain if axes.step is None else dataclasses.replace(plain, step=jnp.zeros(len(SEEDS), jnp.int32))
        mapped = jax.vmap(lambda s: every_other(Keyed(s)), in_axes=(axes,))
        return str(jax.make_jaxpr(mapped)(plain)).count("cond[")

    class Keyed:
        def __init__(self, state):
            self.step, self.key_data = state.step, state.key

    assert branches(AXES) == 1
    assert branches(dataclasses.replace(AXES, step=0)) == 0


def test_apart_is_the_largest_relative_error_of_a_parameter_of_a_run():
    states = create(QUICK, SEEDS)
    ones = dataclasses.replace(states, generator={"a": jnp.ones((3, 4)), "b": jnp.zeros((3, 2))})
    moved = dataclasses.replace(ones, generator={"a": jnp.ones((3, 4)).at[1].mul(1.25), "b": jnp.zeros((3, 2))})
    assert apart(ones, ones) == {"largest": 0.0, "median": 0.0}
    assert apart(moved, ones) == {"largest": 0.25, "median": 0.0}


def test_the_batches_of_a_run_are_those_that_it_would_see_alone():
    dataset = tiny_dataset.dataset()
    together = next(many_runs.batches(dataset, QUICK, SEEDS, 2))
    for i, seed in enumerate(SEEDS):
        alone = next(batching.batches(dataset, dataclasses.replace(QUICK, seed=seed), 2))
        same_bits(jax.tree.map(lambda x, i=i: x[i], together), jax.tree.map(jnp.asarray, alone))


def test_a_saved_state_is_restored_bit_by_bit(tmp_path):
    states, losses = create(QUICK, SEEDS), np.arange(6.0).reshape(2, 3)
    many_runs.save(tmp_path / "a.npz", states, losses)
    found = many_runs.restore(tmp_path / "a.npz", create(QUICK, (0, 1, 2)))
    same_bits(found[0], states)
    np.testing.assert_array_equal(found[1], losses)
    assert many_runs.restore(tmp_path / "b.npz", states) is None


@pytest.fixture(scope="module", autouse=True)
def _shrunken():
    """The shrunken network under the name of the preset, and a state saved after every step."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "set_up_jax", lambda **_: None)
        patch.setitem(presets.PRESETS, "tiny", lambda: QUICK)
        patch.setattr(many_objects, "SAVE_EVERY", 1)
        yield


def asked(out, **options):
    return ManyObjects(data=tiny_dataset.dataset().folder, out=out, quick=True, **options)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many")
    main(asked(folder))
    return folder


def test_conditions_paces_and_differences_are_written(out):
    results = json.loads((out / "results.json").read_text())
    assert list(results["pace"]) == ["without discriminator"]
    assert set(results["render"]["seconds"]) == {"loop", "vmap", "map", "batch"}
    assert max(results["render"]["largest difference of a pixel"].values()) < 1e-4
    assert results["apart from the loop"]["vmap"]["losses"] < 1e-3
    text = (out / "table.md").read_text()
    assert results["hardware"] in text
    assert "seeds 0 to 1" in text
    assert (out / "many_objects.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_its_runs_are_those_of_the_trainer(out, tmp_path):
    of = dataclasses.replace(QUICK, num_steps=3, seed=1)
    schedule = trainer.Schedule(log_every=1, preview_every=9, checkpoint_every=9)
    state = trainer.train(of, tiny_dataset.dataset(), tmp_path / "run", schedule)
    states, losses = many_runs.restore(out / "train_loop.npz", create(of, (0, 1)))
    same_bits(many_runs.unstack(states)[1].generator, state.generator)
    rows = [row["loss"] for row in trainer.read_rows(tmp_path / "run") if "loss" in row]
    np.testing.assert_allclose(losses[:, 1], rows, rtol=1e-6)


def test_a_stopped_call_goes_on_to_the_same_states(out, tmp_path, monkeypatch):
    save, calls = many_runs.save, []

    def stopped(*arguments):
        save(*arguments)
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(many_runs, "save", stopped)
    with pytest.raises(KeyboardInterrupt):
        main(asked(tmp_path))
    main(asked(tmp_path))
    assert len(calls) == 3 * len(FORMS)
    like = create(QUICK, (0, 1))
    for form in FORMS:
        place = f"train_{form}.npz"
        same_bits(many_runs.restore(tmp_path / place, like), many_runs.restore(out / place, like))


def test_a_finished_call_does_nothing_again(out, monkeypatch):
    def forbidden(*_):
        raise AssertionError("something was done again")

    before = (out / "results.json").read_bytes()
    for name in ("measure_pace", "measure_rendering"):
        monkeypatch.setattr(many_objects, name, forbidden)
    monkeypatch.setattr(many_runs, "form_step", forbidden)
    main(asked(out))
    assert (out / "results.json").read_bytes() == before
    with pytest.raises(ValueError, match="holds many objects with another seed; choose another --out"):
        main(asked(out, seed=1))


@pytest.mark.parametrize("wrong", [{"preset": "huge"}, {"runs": 0}, {"steps": 0}, {"objects": 0}, {"rounds": 0}])
def test_wrong_options_are_refused_by_name(wrong, tmp_path):
    with pytest.raises(ValueError, match=f"--{next(iter(wrong))}[ :]"):
        asked(tmp_path, **wrong)


def test_the_slow_form_can_be_left_out(tmp_path):
    assert asked(tmp_path).forms == FORMS
    assert asked(tmp_path, map=False).forms == ("loop", "vmap")


def test_a_gain_is_how_many_times_as_fast_as_the_loop_round_by_round():
    seconds = {"loop": [2.0, 4.0, 6.0], "vmap": [1.0, 4.0, 1.5]}
    assert many_objects_report.gain(seconds, "vmap") == (2.0, 1.0, 4.0)
    assert many_objects_report.gain(seconds, "loop") == (1.0, 1.0, 1.0)
