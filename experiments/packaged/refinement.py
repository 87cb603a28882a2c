"""Training of a refiner behind a network that stays as it is: on its pictures, which are rendered once and kept.

    FOLDER/OBJECT.npz   what the rays of an object's views gave, (views, height, width, features) as float16, and the
                        references (views, height, width, 4) in 8 bits; finished ones are only read
    FOLDER/asked.json   whose pictures they are: another network or data set is refused

Rendering would cost a step several times what the refiner's own work does, and would give the same again and again.
Steps see crops of the pictures, mirrored and upside down too.
"""

import dataclasses
import hashlib
import io
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import tqdm

from experiments.comparison import results_folder
from spnr_jax import presets
from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.npz import read_arrays
from spnr_jax.kernels import cameras, cloud_arrays, losses
from spnr_jax.kernels.colors import LEAST_OPACITY
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.method import inference
from spnr_jax.method.march import trace
from spnr_jax.model_config import AS_TRAINED, NearPointsConfig
from spnr_jax.nn.refiner import Refiner
from spnr_jax.training import batching, optimisation
from spnr_jax.training.weights import Trained

COUNTS = (512, 1024, 1024, 2048)  # points of an object, one of these by its name
BATCH = 8  # crops a step
LEARNING_RATE, WARMUP, LAST = 2e-3, 100, 0.02  # the peak, steps up to it, the last step's share of it
BETA2, CLIP, DECAY = 0.99, 1.0, 0.995  # of Adam, of the gradient's norm, of the averaged weights
CROSS_ENTROPY = 0.2  # weight of the opacity's, beside its squared error
EVERY = 7  # view, of which the features' mean and deviation are measured
LEAST_DEVIATION = 1e-3


def refined(trained: Trained, dataset: data_sets.Dataset, folder: Path, steps: int | None = None) -> Trained:
    """The network with a refiner, trained on pictures of the training objects, for the preset's steps by default."""
    config = with_refiner(trained.config)
    config = dataclasses.replace(config, num_steps=steps or config.num_steps)
    batching.check_spread(dataset, config)
    numbers = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(trained.variables))
    asked = {"network": hashlib.sha256(numbers).hexdigest(), "even_share": config.even_share}
    results_folder.claim(folder, "pictures", asked, dataset)
    places = [folder / f"{name}.npz" for name in dataset.splits["train"]]
    for place in tqdm(places, desc="rendering", unit="object"):
        if not place.exists():
            keep(place, trained.variables, config, data_sets.read_object(dataset, place.stem))
    pictures = [picture for place in tqdm(places, desc="reading", unit="object") for picture in read(place)]
    weights = train(config, pictures)
    params = trained.variables["params"] | {"refiner": jax.device_get(weights)}
    return Trained(config=config, variables=trained.variables | {"params": params}, steps=config.num_steps)


def with_refiner(config: TrainConfig) -> TrainConfig:
    """The config of a network near points with a refiner, trained as the preset of the package's network."""
    assert isinstance(config.model, NearPointsConfig)
    preset = presets.plus_refined()
    assert isinstance(preset.model, NearPointsConfig)
    loss = dataclasses.replace(
        config.loss, mse_weight=preset.loss.mse_weight, opacity_weight=preset.loss.opacity_weight
    )
    return dataclasses.replace(
        config,
        preset=preset.preset,
        model=dataclasses.replace(config.model, refiner_width=preset.model.refiner_width),
        loss=loss,
        num_steps=preset.num_steps,
        pixel_stride=1,
        crop=config.model.image_resolution // 2,
    )


def keep(place: Path, variables: dict, config: TrainConfig, item: data_sets.ObjectData) -> None:
    """Renders an object's views and writes the file of what the refiner will see."""
    number = zlib.crc32(item.name.encode())
    count = min(COUNTS[number % len(COUNTS)], len(item.cloud.mask))
    generator = np.random.default_rng(number)
    cloud = batching.choose_points(item.cloud, count, cloud_arrays.bucket(count), generator, config.even_share)
    seen = np.asarray(rendered(variables, cloud, item.camera, config=config.model), np.float16)
    stream = io.BytesIO()
    np.savez(stream, seen=seen, reference=item.images)
    write_whole(place, stream.getvalue())


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


def read(place: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What is seen, and the reference, of each view of a file; ValueError if it is damaged."""
    try:
        with place.open("rb") as file:
            arrays = read_arrays(file)
        return zip(arrays["seen"], arrays["reference"], strict=True)
    except (KeyError, ValueError) as error:
        raise UserError(f"{place}: not a file of kept pictures ({error}); delete it, and it is made again") from None


def train(config: TrainConfig, pictures: list[tuple[np.ndarray, np.ndarray]]) -> dict:
    """Averaged weights of a refiner after the config's steps on (seen, reference) of views."""
    assert isinstance(config.model, NearPointsConfig)
    refiner = Refiner(config.model.refiner_width)
    generator = np.random.default_rng(config.seed)
    weights = start(refiner, pictures)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, LEARNING_RATE, WARMUP, max(config.num_steps, WARMUP + 1), LAST * LEARNING_RATE
    )
    algorithm = optax.chain(optax.clip_by_global_norm(CLIP), optax.adam(schedule, b2=BETA2))

    @partial(jax.jit, donate_argnums=(0, 1, 2))
    def step(weights, optimizer, averaged, number, seen, reference):
        loss, gradient = jax.value_and_grad(partial(error, refiner, config))(weights, seen, reference)
        update, optimizer = algorithm.update(gradient, optimizer, weights)
        weights = optax.apply_updates(weights, update)
        return weights, optimizer, optimisation.moving_average(averaged, weights, number, DECAY), loss

    optimizer, averaged = algorithm.init(weights), jax.tree.map(jnp.copy, weights)
    shown: list[Array] = []
    progress = tqdm(range(config.num_steps), desc="refining", unit="step")
    for number in progress:
        crops = [crop(pictures, config.crop, generator) for _ in range(BATCH)]
        seen, reference = (np.stack(x) for x in zip(*crops, strict=True))
        weights, optimizer, averaged, loss = step(weights, optimizer, averaged, number, seen, reference)
        shown = [*shown[-99:], loss]
        if number % 100 == 99:
            progress.set_postfix(loss=f"{np.mean(shown):.4f}")
    return averaged


def start(refiner: Refiner, pictures: list[tuple[np.ndarray, np.ndarray]]) -> dict:
    """Fresh weights that know the mean and deviation of the features."""
    features = np.stack([seen.astype(np.float32) for seen, _ in pictures[::EVERY]])
    weights = refiner.init(jax.random.key(0), jnp.asarray(features[:1]))["params"]
    deviation = np.std(features, axis=(0, 1, 2)) + LEAST_DEVIATION
    return weights | {"mean": jnp.asarray(np.mean(features, axis=(0, 1, 2))), "deviation": jnp.asarray(deviation)}


def crop(
    pictures: list[tuple[np.ndarray, np.ndarray]], size: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A square of a random view, mirrored as often as not, upside down one time in four."""
    seen, reference = pictures[generator.integers(len(pictures))]
    row, column = (generator.integers(side - size + 1) for side in seen.shape[:2])
    turns = np.s_[:: -1 if generator.random() < 0.25 else 1, :: -1 if generator.random() < 0.5 else 1]
    inside = np.s_[row : row + size, column : column + size]
    return seen[inside][turns], reference[inside][turns]


def error(refiner: Refiner, config: TrainConfig, weights: dict, seen: Array, reference: Array) -> Float[Array, ""]:
    """What training minimises on crops: errors of the picture, and of the opacity at two scales."""
    image, opacity = refiner.bind({"params": weights})(seen.astype(jnp.float32))
    color, alpha = jnp.split(reference.astype(jnp.float32) / 255, [3], axis=-1)
    acc, true_image = opacity[..., None], color * alpha + (1 - alpha)
    squared = losses.mse(acc, alpha) + losses.mse(mean_of_squares(acc, 2), mean_of_squares(alpha, 2))
    entropy = -jnp.mean(alpha * jnp.log(acc + LEAST_OPACITY) + (1 - alpha) * jnp.log(1 - acc + LEAST_OPACITY))
    picture = losses.l1(image, true_image) + config.loss.mse_weight * losses.mse(image, true_image)
    return picture + config.loss.opacity_weight / 2 * squared + CROSS_ENTROPY * entropy
