"""The refiner's training: what is kept, what a step sees, what it learns, and that nothing before it moves."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import close, same_bits
from support.stopped_runs import interrupted
from support.tiny_model import PLUS

from spnr_jax import presets
from spnr_jax.config import LossConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.npz import packed
from spnr_jax.kernels import cloud_arrays
from spnr_jax.method import inference
from spnr_jax.training import checkpoint, metrics_log, optimisation, refiner_training, trainer
from spnr_jax.training.weights import Trained

pytestmark = pytest.mark.ci  # it trains several networks

SIZE = tiny_dataset.CONFIG.model.image_resolution
PLAIN = dataclasses.replace(
    tiny_dataset.CONFIG,
    model=dataclasses.replace(PLUS, image_resolution=SIZE),
    loss=LossConfig(l1_weight=1.0, mse_weight=1.0, adversarial_weight=0.0),
)
CONFIG = dataclasses.replace(
    presets.near_points(),
    preset="refiner",
    trains="refiner",
    optimizer=dataclasses.replace(presets.QUICK, beta2=0.99, clip_norm=1.0),
    model=dataclasses.replace(PLAIN.model, refiner_width=4),
    crop=SIZE // 2,
    num_steps=4,
    batch_objects=2,
    min_points=8,
    max_points=32,
    test_points=24,
)
NETWORK = np.zeros(32, np.uint8)


@pytest.fixture(scope="module")
def trained():
    variables = optimisation.averaged_variables(optimisation.jitted_create_state(PLAIN))
    return Trained(config=PLAIN, variables=variables, steps=0)


@pytest.fixture(scope="module")
def finished(trained, tmp_path_factory):
    """A run of four steps and its last state."""
    run = tmp_path_factory.mktemp("refiner")
    return run, trainer.train(CONFIG, tiny_dataset.dataset(), run, tiny_dataset.SCHEDULE, init=trained)


def majorities(count=6, size=24):
    """Pictures whose references show what most of left neighbour, pixel and right one do: none can know it alone."""
    generator, pictures = np.random.default_rng(0), []
    for _ in range(count):
        blocks = np.kron(generator.random((size // 4, size // 4 + 2)) > 0.5, np.ones((4, 4)))
        there, most = blocks[:, 4:-4], blocks[:, :-8] + blocks[:, 4:-4] + blocks[:, 8:] > 1.5
        seen = np.stack([1 - 0.9 * there] * 3 + [there, 1 - there, 0 * there, 0.9 * there], axis=-1)
        reference = np.stack([0 * most] * 3 + [255 * most], axis=-1)
        pictures.append((seen.astype(np.float16), reference.astype(np.uint8)))
    return pictures


def state_for(config, pictures):
    """A state of a refiner alone, for pictures of other features than a network's."""
    module = refiner_training.Refiner(config.model.refiner_width)
    refiner = jax.jit(module.init)(jax.random.key(0), jnp.asarray(pictures[0][0], jnp.float32)[None])["params"]
    state = optimisation.jitted_create_state(CONFIG)
    algorithm, _ = optimisation.optimizers(config)
    state = dataclasses.replace(
        state,
        generator={"refiner": refiner},
        averaged={"refiner": jax.tree.map(jnp.copy, refiner)},
        generator_optimizer=algorithm.init(refiner),
    )
    return refiner_training.begun(state, pictures)


def test_the_network_before_the_refiner_stays_bit_for_bit_and_the_refiner_moves(trained, finished):
    _, state = finished
    before = trained.variables["params"]
    for weights in (state.generator, state.averaged):
        same_bits({name: weights[name] for name in before}, before)
        assert set(weights) == {*before, "refiner"}
    moved = np.abs(state.generator["refiner"]["down_0_kernel"] - state.averaged["refiner"]["down_0_kernel"])
    assert moved.max() > 0
    assert np.abs(state.generator["refiner"]["out"]["kernel"]).max() > 0, "it began with zeros"
    assert jax.tree.map(np.shape, state.generator) == jax.tree.map(
        np.shape, optimisation.jitted_create_state(CONFIG).generator
    )


def test_a_stopped_run_goes_on_to_the_same_bits(trained, finished, tmp_path, monkeypatch):
    arguments = CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE
    with monkeypatch.context() as patch:
        interrupted(patch, refiner_training, 2)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 2 of 4"):
            trainer.train(*arguments, init=trained)
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "pictures").iterdir()}
    assert {path.stem for path in times} == set(tiny_dataset.dataset().splits["train"])
    trainer.train(*arguments)
    same_bits(checkpoint.restore(tmp_path, CONFIG), checkpoint.restore(finished[0], CONFIG))
    assert {path: path.stat().st_mtime_ns for path in times} == times, "pictures that are there are only read"
    assert "val_psnr" in metrics_log.read_rows(tmp_path)[-1]


def test_a_refiner_without_the_network_before_it_is_refused(tmp_path):
    with pytest.raises(ValueError, match="preset refiner trains a refiner behind a network .* --init"):
        trainer.train(CONFIG, tiny_dataset.dataset(), tmp_path, tiny_dataset.SCHEDULE)


@pytest.mark.parametrize("wrong", [{"crop": 0}, {"model": PLAIN.model}])
def test_only_a_network_with_a_refiner_has_its_refiner_trained(wrong):
    with pytest.raises(ValueError, match="trains refiner needs a network near points with a refiner_width, a crop"):
        dataclasses.replace(CONFIG, **wrong)


def test_a_network_that_saw_even_clouds_is_not_refined_on_random_ones(trained, tmp_path):
    even = dataclasses.replace(CONFIG, even_share=0.5)
    with pytest.raises(ValueError, match="points are drawn at random.*--spread even"):
        refiner_training.complete(tiny_dataset.dataset(), trained.variables, even, tmp_path)
    assert not list(tmp_path.iterdir())


def test_kept_is_what_the_network_shows_and_its_references(trained):
    item = data_sets.read_object(tiny_dataset.dataset(), tiny_dataset.dataset().splits["train"][0])
    kept = refiner_training.drawn(trained.variables, CONFIG, item)
    assert len(kept["seen"]) == len(item.images)
    assert len(item.cloud.mask) < min(refiner_training.COUNTS), "all points of this object are kept"
    cloud = cloud_arrays.pad(item.cloud, cloud_arrays.bucket(len(item.cloud.mask)))
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, item.camera))
    shown = jax.jit(inference.network(PLAIN.model).apply)(trained.variables, cloud, camera)
    same_bits(kept["reference"], item.images)
    assert kept["seen"].dtype == np.float16
    for seen, image, acc in zip(kept["seen"], shown.image[0], shown.acc[0], strict=True):
        different = np.abs(seen[..., [0, 1, 2, -1]] - np.concatenate([image, acc[..., None]], axis=-1))
        assert np.quantile(different, 0.99) < 2e-3, "points in another order may share a cell otherwise"


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"x" * 400])
def test_a_damaged_file_is_made_again(tmp_path, content):
    place = tmp_path / "chair.npz"
    place.write_bytes(content)
    assert refiner_training.read(place, NETWORK) is None


@pytest.mark.parametrize("left_out", ["network", "seen", "reference"])
def test_a_file_of_another_network_and_one_that_lacks_an_array_are_made_again(tmp_path, left_out):
    arrays = {"network": NETWORK, "seen": np.zeros(1), "reference": np.zeros(1)}
    place = tmp_path / "chair.npz"
    place.write_bytes(packed(arrays))
    assert refiner_training.read(place, NETWORK).keys() == arrays.keys()
    assert refiner_training.read(place, NETWORK + 1) is None
    del arrays[left_out]
    place.write_bytes(packed(arrays))
    assert refiner_training.read(place, NETWORK) is None


def test_learns_what_no_pixel_knows_alone():
    config = dataclasses.replace(
        CONFIG, model=dataclasses.replace(CONFIG.model, refiner_width=8, image_resolution=24), crop=24, num_steps=300
    )
    pictures = majorities()
    state = state_for(config, pictures)
    seen, reference = (jnp.stack([jnp.asarray(x) for x in of]) for of in zip(*pictures, strict=True))
    error = jax.jit(lambda refiner: refiner_training.loss(refiner, seen, reference, config=config)[0])
    before = error(state.averaged["refiner"])
    for step in range(config.num_steps):
        batch = refiner_training.make_batch(pictures, config, step)
        state, _ = refiner_training.jitted_train_step(state, batch, config=config)
    assert error(state.averaged["refiner"]) < 0.6 * before


def test_a_start_knows_the_features():
    pictures = majorities(refiner_training.EVERY + 1)
    state = state_for(CONFIG, pictures)
    seen = np.stack([pictures[0][0], pictures[refiner_training.EVERY][0]]).astype(np.float32)
    for weights in (state.generator, state.averaged):
        close(weights["refiner"]["mean"], seen.mean((0, 1, 2)), atol=1e-5)
        deviation = seen.std((0, 1, 2)) + refiner_training.LEAST_DEVIATION
        close(weights["refiner"]["deviation"], deviation, atol=1e-5)


def test_a_crop_is_the_same_square_of_both_turned_alike():
    rows, columns = np.mgrid[:24, :24]
    place = np.stack([rows, columns], axis=-1)
    generator, firsts, turns = np.random.default_rng(0), set(), set()
    for _ in range(40):
        seen, reference = refiner_training.cropped((place, place + 100), 10, generator)
        same_bits(seen + 100, reference)
        down, right = seen[1, 0, 0] - seen[0, 0, 0], seen[0, 1, 1] - seen[0, 0, 1]
        assert sorted(seen[:, 0, 0])[-1] - sorted(seen[:, 0, 0])[0] == 9
        turns.add((int(down), int(right)))
        firsts.add((int(seen[..., 0].min()), int(seen[..., 1].min())))
    assert turns == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert len(firsts) > 20
