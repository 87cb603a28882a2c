"""Training of the shader network: a step learns, a stopped run goes on to the same bits, its file is a network."""

import dataclasses

import jax
import numpy as np
import pytest
from support import tiny_dataset, tiny_surfels
from support.laws import close, same_bits
from support.stopped_runs import interrupted, rows_without_time
from support.tiny_surfels import CONFIG, LIGHT, SCHEDULE

import spnr_jax
from spnr_jax.config import SurfelConfig
from spnr_jax.surfels import lighting
from spnr_jax.training import checkpoint, gbuffers, metrics_log, optimisation, shading, trainer, work

loss = jax.jit(shading.loss, static_argnames="config")


@pytest.fixture(scope="module")
def crops():
    return next(iter(gbuffers.batches(tiny_surfels.views(), CONFIG, 0)))


@pytest.fixture(scope="module")
def params():
    return optimisation.jitted_create_state(CONFIG).generator


def test_a_clear_pixel_costs_nothing_whatever_colour_lies_under_it(crops, params):
    maps = np.array(crops.maps)
    maps[..., 4] = 0  # opacity
    clear = dataclasses.replace(crops, maps=maps, target=np.zeros_like(crops.target))
    assert float(loss(params, clear, config=CONFIG)[0]) < 1e-6


def test_steps_lower_the_loss_on_one_object(crops):
    config = dataclasses.replace(CONFIG, num_steps=100)
    state, losses = optimisation.jitted_create_state(config), []
    for _ in range(90):
        state, metrics = shading.jitted_train_step(state, crops, config=config)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.6 * losses[0]
    assert float(loss(state.averaged, crops, config=config)[0]) < losses[0]


def test_the_loss_is_the_sum_of_its_weighted_errors(crops, params):
    value, metrics = loss(params, crops, config=CONFIG)
    terms = {}
    names = "l1_weight", "mse_weight", "opacity_weight", "opacity_l1_weight"
    for name in names:
        weights = dataclasses.replace(CONFIG.loss, **(dict.fromkeys(names, 0.0) | {name: 1.0}))
        terms[name] = float(loss(params, crops, config=dataclasses.replace(CONFIG, loss=weights))[0])
    assert min(terms.values()) > 0
    assert float(value) == pytest.approx(sum(getattr(CONFIG.loss, name) * terms[name] for name in names), rel=1e-5)
    assert terms["l1_weight"] == pytest.approx(float(metrics["l1"]))
    assert terms["opacity_weight"] == pytest.approx(float(metrics["mse_opacity"]))


def test_a_stopped_run_goes_on_to_the_same_bits_and_rows(monkeypatch, tmp_path):
    with monkeypatch.context() as patch:
        interrupted(patch, gbuffers, 3)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 3 of 4"):
            trainer.train(CONFIG, tiny_surfels.dataset(), tmp_path, SCHEDULE, light=LIGHT)
    assert not (tmp_path / "weights.npz").exists()
    trainer.train(CONFIG, tiny_surfels.dataset(), tmp_path, SCHEDULE, light=LIGHT)
    same_bits(checkpoint.restore(tmp_path, CONFIG), checkpoint.restore(tiny_surfels.run(), CONFIG))
    assert rows_without_time(tmp_path) == rows_without_time(tiny_surfels.run())
    assert (tmp_path / "weights.npz").read_bytes() == (tiny_surfels.run() / "weights.npz").read_bytes()


def test_the_run_and_the_file_that_it_ends_with_are_one_network():
    of_run, of_file = spnr_jax.load(tiny_surfels.run()), spnr_jax.load(tiny_surfels.run() / "weights.npz")
    assert isinstance(of_file.config, SurfelConfig)
    assert of_run.config == of_file.config == CONFIG.model
    close(of_file.variables, jax.tree.map(np.asarray, of_run.variables), rtol=1e-3, atol=1e-4)
    assert "val_psnr" in metrics_log.read_rows(tiny_surfels.run())[-1]


def test_a_gradient_longer_than_the_configs_norm_counts_as_one_of_that_norm():
    optimizer = dataclasses.replace(CONFIG.optimizer, clip_norm=0.0)
    clipping, _ = optimisation.optimizers(CONFIG)
    plain, _ = optimisation.optimizers(dataclasses.replace(CONFIG, optimizer=optimizer))
    for length, counted in ((40.0, 1.0), (0.5, 0.5)):
        (_, moments), (_, expected) = (
            adam.update({"a": np.float32([0, size])}, adam.init({"a": np.zeros(2, np.float32)}))
            for adam, size in ((clipping, length), (plain, counted))
        )
        close(moments, jax.tree.map(np.asarray, expected))


def test_the_room_is_the_light_where_a_data_set_names_no_other_one():
    dataset = tiny_surfels.dataset()
    assert work.light_of(dataset) is lighting.room_light()
    other = dataclasses.replace(dataset, settings={"environment_map": {"name": "forest.hdr"}})
    with pytest.raises(ValueError, match=r"lit by forest\.hdr"):
        work.light_of(other)


def test_networks_of_rays_refuse_views_with_lights_of_their_own_in_one_line():
    dataset = dataclasses.replace(tiny_dataset.dataset(), settings={"environment_map": {"kinds": [{"name": "random"}]}})
    with pytest.raises(ValueError, match="preset tiny learns one light alone; train --preset surfels") as refused:
        work.of_views(tiny_dataset.CONFIG, dataset, None, None)
    assert "\n" not in str(refused.value)
