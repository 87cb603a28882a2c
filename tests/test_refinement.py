"""The refiner's training on kept pictures: what is kept, what a step sees, what it learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_dataset
from support.laws import close, same_bits
from support.tiny_model import PLUS

from experiments.packaged import refinement
from spnr_jax.config import LossConfig
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cloud_arrays
from spnr_jax.method import inference
from spnr_jax.nn.refiner import Refiner
from spnr_jax.training import optimisation
from spnr_jax.training.weights import Trained

SIZE = tiny_dataset.CONFIG.model.image_resolution
PLAIN = dataclasses.replace(
    tiny_dataset.CONFIG,
    model=dataclasses.replace(PLUS, image_resolution=SIZE),
    loss=LossConfig(l1_weight=1.0, mse_weight=1.0, adversarial_weight=0.0),
)
CONFIG = dataclasses.replace(refinement.with_refiner(PLAIN), num_steps=40)


@pytest.fixture(scope="module")
def trained():
    return Trained(config=PLAIN, variables=optimisation.averaged_variables(optimisation.create_state(PLAIN)), steps=0)


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


def test_a_refined_network_is_the_one_before_with_a_refiner(trained, tmp_path):
    dataset = tiny_dataset.dataset()
    refined = refinement.refined(trained, dataset, tmp_path, steps=2)
    assert refined.config == dataclasses.replace(CONFIG, num_steps=2)
    assert refined.steps == 2
    before = trained.variables["params"]
    same_bits({name: refined.variables["params"][name] for name in before}, before)
    assert {path.stem for path in tmp_path.glob("*.npz")} == set(dataset.splits["train"])
    shapes = jax.tree.map(np.shape, optimisation.create_state(refined.config).generator)
    assert jax.tree.map(np.shape, refined.variables["params"]) == shapes


def test_a_network_that_saw_even_clouds_is_not_refined_on_random_ones(trained, tmp_path):
    even = dataclasses.replace(trained, config=dataclasses.replace(PLAIN, even_share=0.5))
    with pytest.raises(ValueError, match="points are drawn at random.*--spread even"):
        refinement.refined(even, tiny_dataset.dataset(), tmp_path, steps=2)
    assert not list(tmp_path.iterdir())


def test_pictures_that_are_there_are_only_read_and_steps_repeat(trained, tmp_path):
    dataset = tiny_dataset.dataset()
    first = refinement.refined(trained, dataset, tmp_path, steps=2)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    again = refinement.refined(trained, dataset, tmp_path, steps=2)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")} == times
    same_bits(again.variables, first.variables)


def test_pictures_of_another_network_are_refused(trained, tmp_path):
    refinement.refined(trained, tiny_dataset.dataset(), tmp_path, steps=1)
    other = dataclasses.replace(trained, variables=jax.tree.map(lambda x: 2 * x, trained.variables))
    with pytest.raises(ValueError, match=r"holds pictures with another network; choose another --out"):
        refinement.refined(other, tiny_dataset.dataset(), tmp_path, steps=1)


def test_kept_is_what_the_network_shows_and_its_references(trained, tmp_path):
    item = data_sets.read_object(tiny_dataset.dataset(), tiny_dataset.dataset().splits["train"][0])
    place = tmp_path / "kept.npz"
    refinement.keep(place, trained.variables, CONFIG, item)
    views = list(refinement.read(place))
    assert len(views) == len(item.images)
    plain = inference.network(PLAIN.model)
    assert len(item.cloud.mask) < min(refinement.COUNTS), "all points of this object are kept"
    cloud = cloud_arrays.pad(item.cloud, cloud_arrays.bucket(len(item.cloud.mask)))
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, item.camera))
    shown = plain.bind(trained.variables)(cloud, camera)
    for (seen, reference), image, acc, truth in zip(views, shown.image[0], shown.acc[0], item.images, strict=True):
        same_bits(reference, truth)
        assert seen.dtype == np.float16
        different = np.abs(seen[..., [0, 1, 2, -1]] - np.concatenate([image, acc[..., None]], axis=-1))
        assert np.quantile(different, 0.99) < 2e-3, "points in another order may share a cell otherwise"


def test_learns_what_no_pixel_knows_alone():
    config = dataclasses.replace(
        CONFIG, model=dataclasses.replace(CONFIG.model, refiner_width=8), num_steps=400, crop=24
    )
    pictures = majorities()
    weights = refinement.train(config, pictures)
    seen, reference = (jnp.stack(x) for x in zip(*pictures, strict=True))
    refiner = Refiner(8)
    before = refinement.error(refiner, config, refinement.start(refiner, pictures), seen, reference)
    assert refinement.error(refiner, config, weights, seen, reference) < 0.6 * before


def test_a_start_knows_the_features():
    pictures = majorities(refinement.EVERY + 1)
    weights = refinement.start(Refiner(4), pictures)
    seen = np.stack([pictures[0][0], pictures[refinement.EVERY][0]]).astype(np.float32)
    close(weights["mean"], seen.mean((0, 1, 2)), atol=1e-5)
    close(weights["deviation"], seen.std((0, 1, 2)) + refinement.LEAST_DEVIATION, atol=1e-5)


def test_a_crop_is_the_same_square_of_both_turned_alike():
    rows, columns = np.mgrid[:24, :24]
    place = np.stack([rows, columns], axis=-1)
    generator, firsts, turns = np.random.default_rng(0), set(), set()
    for _ in range(40):
        seen, reference = refinement.crop([(place, place + 100)], 10, generator)
        same_bits(seen + 100, reference)
        down, right = seen[1, 0, 0] - seen[0, 0, 0], seen[0, 1, 1] - seen[0, 0, 1]
        assert sorted(seen[:, 0, 0])[-1] - sorted(seen[:, 0, 0])[0] == 9
        turns.add((int(down), int(right)))
        firsts.add((int(seen[..., 0].min()), int(seen[..., 1].min())))
    assert turns == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert len(firsts) > 20


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"x" * 400])
def test_a_damaged_file_is_named_with_what_to_do(tmp_path, content):
    place = tmp_path / "chair.npz"
    place.write_bytes(content)
    with pytest.raises(ValueError, match="chair.npz: not a file of kept pictures .* delete it, and it is made again"):
        refinement.read(place)
