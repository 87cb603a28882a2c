"""Training of a refiner alone, behind a network that stays as it is: on its pictures, rendered once and kept.

    FOLDER/OBJECT.npz   network    checksum of the weights that drew the pictures
                        seen       what the rays of an object's views gave, (views, height, width, features), float16
                        reference  (views, height, width, 4) in 8 bits

Rendering would cost a step several times what the refiner's own work does, and would give the same again and again.
A file appears whole or not at all; one of another network, or one that cannot be read, is made again.  Steps see crops
of the pictures, mirrored and upside down too; a batch is a pure function of (seed, step) and the pictures.
"""

import dataclasses
import hashlib
import zlib
from collections.abc import Generator
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import tqdm

from spnr_jax.config import AS_TRAINED, NearPointsConfig, TrainConfig
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.npz import packed, read_arrays
from spnr_jax.kernels import cameras, cloud_arrays, losses
from spnr_jax.kernels.colors import LEAST_OPACITY
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.method import inference
from spnr_jax.method.march import trace
from spnr_jax.nn.refiner import Refiner
from spnr_jax.training import batching, optimisation
from spnr_jax.training.optimisation import TrainState

COUNTS = (512, 1024, 1024, 2048)  # points of an object, one of these by its name
CROSS_ENTROPY = 0.2  # weight of the opacity's, beside its squared error
EVERY = 7  # view, of which the features' mean and deviation are measured
LEAST_DEVIATION = 1e-3
CROP = 5  # stream of random numbers under one seed, beside those of `batching` and `gbuffers`

View = tuple[np.ndarray, np.ndarray]  # what is seen of it, and its reference


def complete(dataset: data_sets.Dataset, variables: dict, config: TrainConfig, folder: Path) -> list[View]:
    """The pictures of all training objects; those that are missing, broken or of another network are made."""
    batching.check_spread(dataset, config)
    digest = hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(variables)))
    network, views = np.frombuffer(digest.digest(), np.uint8), list[View]()
    for name in tqdm(dataset.splits["train"], "pictures", unit="object"):
        place = folder / f"{name}.npz"
        kept = read(place, network)
        if kept is None:
            arrays = drawn(variables, config, data_sets.read_object(dataset, name))
            write_whole(place, packed({"network": network} | arrays))
            kept = arrays
        views += zip(kept["seen"], kept["reference"], strict=True)
    return views


def read(place: Path, network: np.ndarray) -> dict[str, np.ndarray] | None:
    """The arrays of a file; None if there is none of this network that can be read and is whole."""
    names = {"network", "seen", "reference"}
    try:
        with place.open("rb") as file:
            arrays = read_arrays(file, names)
    except (OSError, ValueError):
        return None
    return arrays if arrays.keys() == names and np.array_equal(arrays["network"], network) else None


def drawn(variables: dict, config: TrainConfig, item: data_sets.ObjectData) -> dict[str, np.ndarray]:
    """What the refiner will see of an object's views, and their references."""
    number = zlib.crc32(item.name.encode())
    count = min(COUNTS[number % len(COUNTS)], len(item.cloud.mask))
    generator = np.random.default_rng(number)
    cloud = batching.choose_points(item.cloud, count, cloud_arrays.bucket(count), generator, config.even_share)
    seen = np.asarray(rendered(variables, cloud, item.camera, config=config.model), np.float16)
    return {"seen": seen, "reference": np.asarray(item.images)}


@partial(jax.jit, static_argnames="config")
def rendered(
    variables: dict, cloud: PointCloud, camera: Camera, *, config: NearPointsConfig
) -> Float[Array, "views height width features"]:
    """What the refiner sees of the views of one object at the size of its training."""
    cloud, camera = jax.tree.map(lambda x: jnp.asarray(x)[None], (cloud, camera))
    size = config.image_resolution
    camera = cameras.resize(camera, size, size)
    module = inference.network(config).bind(variables)
    traced = trace(module, module.encode(cloud), module.rays(camera), config.sampling, AS_TRAINED, None)
    pictures = jax.tree.map(lambda x: x.reshape(-1, size, size, *x.shape[2:]), traced)
    return module.looked_over(camera, pictures)


def begun(state: TrainState, views: list[View]) -> TrainState:
    """A fresh state whose refiner knows the mean and deviation of the features."""
    features = np.stack([seen.astype(np.float32) for seen, _ in views[::EVERY]])
    mean, deviation = features.mean(axis=(0, 1, 2)), features.std(axis=(0, 1, 2)) + LEAST_DEVIATION

    def told(generator: dict) -> dict:
        measured = {"mean": jnp.array(mean), "deviation": jnp.array(deviation)}  # a donated buffer is held once
        return generator | {"refiner": generator["refiner"] | measured}

    return dataclasses.replace(state, generator=told(state.generator), averaged=told(state.averaged))


def batches(views: list[View], config: TrainConfig, first_step: int) -> Generator[View, None, None]:
    """Training batches from `first_step` on, assembled ahead."""
    yield from batching.read_ahead(partial(make_batch, views, config), first_step, config.num_steps)


def make_batch(views: list[View], config: TrainConfig, step: int) -> View:
    """The batch of a step: crops of random views."""
    generator = np.random.default_rng((config.seed, CROP, step))
    crops = [
        cropped(views[generator.integers(len(views))], config.crop, generator) for _ in range(config.batch_objects)
    ]
    return np.stack([seen for seen, _ in crops]), np.stack([reference for _, reference in crops])


def cropped(view: View, size: int, generator: np.random.Generator) -> View:
    """A square of a view, mirrored as often as not, upside down one time in four."""
    seen, reference = view
    row, column = (int(generator.integers(side - size + 1)) for side in seen.shape[:2])
    turns = np.s_[:: -1 if generator.random() < 0.25 else 1, :: -1 if generator.random() < 0.5 else 1]
    inside = np.s_[row : row + size, column : column + size]
    return seen[inside][turns], reference[inside][turns]


def loss(
    refiner: dict, seen: Array, reference: Array, *, config: TrainConfig
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """(loss, metrics) on crops: errors of the picture, and of the opacity at two scales."""
    module = Refiner(cast(NearPointsConfig, config.model).refiner_width)
    image, opacity = cast(Any, module.apply({"params": refiner}, seen.astype(jnp.float32)))
    color, alpha = jnp.split(reference.astype(jnp.float32) / 255, [3], axis=-1)
    acc, true_image = opacity[..., None], color * alpha + (1 - alpha)
    squared = losses.mse(acc, alpha) + losses.mse(mean_of_squares(acc, 2), mean_of_squares(alpha, 2))
    entropy = -jnp.mean(alpha * jnp.log(acc + LEAST_OPACITY) + (1 - alpha) * jnp.log(1 - acc + LEAST_OPACITY))
    value = optimisation.reconstruction_loss(config, image, image, true_image)
    value += config.loss.opacity_weight / 2 * squared + CROSS_ENTROPY * entropy
    metrics = {"psnr": jnp.mean(psnr(image, true_image)), "l1": losses.l1(image, true_image), "mse_opacity": squared}
    return value, metrics


def train_step(state: TrainState, view: Any, *, config: TrainConfig) -> tuple[TrainState, dict[str, Array]]:
    """State after one step of the refiner, and scalar metrics."""
    of_crops = jax.value_and_grad(partial(loss, config=config), has_aux=True)
    (value, metrics), gradient = of_crops(state.generator["refiner"], *view)
    state = optimisation.stepped(config, state, gradient, "refiner")
    return state, metrics | {"loss": value, "gradient_norm": optax.tree.norm(gradient)}


jitted_train_step = jax.jit(train_step, static_argnames="config", donate_argnames="state")
