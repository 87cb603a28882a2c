"""Training batches that are a pure function of (seed, step), read ahead.

A batch depends only on the step, so the step number is the state of the reader: a resumed run gets the same data,
whatever was read ahead.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.devices.runtime import run_ahead
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.data_sets import Dataset, ObjectData, has_lights, on_white
from spnr_jax.kernels.cloud_arrays import pad
from spnr_jax.kernels.records import Batch, Camera, Light, PointCloud

CACHE_BYTES = 2**31  # decoded objects kept in memory
READERS, READ_AHEAD = 2, 4  # threads that assemble batches, and batches ready or in work
ORDER_STREAM, SAMPLE_STREAM = 1, 2  # streams under one seed: without them (0, 5) and (0, 5, 0) would be the same


def choose_points(
    cloud: PointCloud, count: int, size: int, generator: np.random.Generator, even_share: float = 0.0
) -> PointCloud:
    """`count` of the points without repetition (or all, if there are fewer), padded to `size`.

    They are random ones, or the first with the probability `even_share`.
    """
    total = len(cloud.positions)
    first = even_share > 0 and generator.random() < even_share
    chosen = (np.arange(total) if first else generator.permutation(total))[:count]
    return pad(jax.tree.map(lambda values: values[chosen], cloud), size)


def make_batch(objects: list[ObjectData], config: TrainConfig, step: int) -> Batch:
    """The training batch of these objects at this step: random points and random views of each."""
    clouds_of, views_of = [], []
    for i, item in enumerate(objects):
        generator = np.random.default_rng((config.seed, SAMPLE_STREAM, step, i))
        low, high = np.log2(config.min_points), np.log2(config.max_points)
        count = round(2 ** generator.uniform(low, high))
        cloud = dataclasses.replace(item.cloud, normals=None)  # networks of whole views estimate them if needed
        clouds_of.append(choose_points(cloud, count, config.max_points, generator, config.even_share))
        chosen = generator.permutation(len(item.images))[: config.views_per_object]
        camera = item.camera.cam_to_world, item.camera.intrinsics
        views_of.append([values[chosen] for values in (item.images, item.conditions, *camera)])
    images, conditions, poses, intrinsics = map(np.stack, zip(*views_of, strict=True))
    mask = conditions[..., 3] > 0
    first = objects[0].camera
    return Batch(
        cloud=jax.tree.map(lambda *columns: np.stack(columns), *clouds_of),
        camera=Camera(cam_to_world=poses, intrinsics=intrinsics, height=first.height, width=first.width),
        image=on_white(images),
        alpha=images[..., 3].astype(np.float32) / 255,
        condition=np.where(mask[..., None], conditions[..., :3].astype(np.float32) / 255, 0),
        condition_mask=mask,
    )


def object_names(names: tuple[str, ...], config: TrainConfig, step: int) -> list[str]:
    """The objects of a step: consecutive pieces of one new permutation of all objects per epoch."""
    positions = range(step * config.batch_objects, (step + 1) * config.batch_objects)
    slots = (divmod(position, len(names)) for position in positions)
    return [names[epoch_order(config.seed, epoch, len(names))[slot]] for epoch, slot in slots]


@functools.lru_cache(maxsize=4)  # one batch spans few epochs, and a million objects take 20 ms to permute
def epoch_order(seed: int, epoch: int, count: int) -> np.ndarray:
    """The permutation (count,) of all objects in an epoch."""
    return np.random.default_rng((seed, ORDER_STREAM, epoch)).permutation(count)


def prepare(
    config: TrainConfig, dataset: Dataset, run: Path, *, light: Light | None
) -> Callable[[int], Generator[Batch, None, None]]:
    """A function of a step: training batches of whole views from there on.

    ValueError for data that do not suit, also where the views have lights of their own: these networks cannot be told
    which.
    """
    del run, light
    if has_lights(dataset):
        raise UserError(
            f"{dataset.folder}: each view has a light of its own, and preset {config.preset} learns one light alone; "
            "train --preset surfels, or generate the data set without --lights"
        )
    if not (names := dataset.splits["train"]):
        raise UserError(f"{dataset.folder}: the train split is empty; generate more objects")
    if config.even_share and dataset.spread != "even":
        raise UserError(
            f"{dataset.folder}: its points are drawn at random, even_share is {config.even_share}; generate with "
            "--spread even, or use even_share 0"
        )
    cached_reader(dataset, config)(names[0])
    return lambda first_step: batches(dataset, config, first_step)


def batches(dataset: Dataset, config: TrainConfig, first_step: int) -> Generator[Batch, None, None]:
    """Training batches from `first_step` on, read and assembled ahead; an error is raised where its batch would be."""
    names = dataset.splits["train"]
    read = cached_reader(dataset, config)

    def assemble(step: int) -> Batch:
        return make_batch([read(name) for name in object_names(names, config, step)], config, step)

    yield from read_ahead(assemble, first_step, config)


def read_ahead(assemble: Callable[[int], Any], first_step: int, config: TrainConfig) -> Generator[Any, None, None]:
    """Results of `assemble` for each step, computed ahead in threads, which end with this generator."""
    steps = range(first_step, config.num_steps)
    yield from run_ahead((functools.partial(assemble, step) for step in steps), READERS, READ_AHEAD)


def cached_reader(dataset: Dataset, config: TrainConfig) -> Callable[[str], ObjectData]:
    """A function of an object's name that reads it, checked against the config; the first CACHE_BYTES stay in memory.

    Several threads may call it.  Which objects stay does not matter: an epoch needs each of them once.
    """
    cache: dict[str, ObjectData] = {}
    lock, free = threading.Lock(), CACHE_BYTES

    def read(name: str) -> ObjectData:
        nonlocal free
        if name in cache:
            return cache[name]
        item = data_sets.read_object(dataset, name)
        data_sets.check_resolution(item, config)
        if len(item.images) < config.views_per_object:
            raise UserError(
                f"object {name} has {len(item.images)} views, views_per_object is {config.views_per_object}; lower it "
                "or generate with more --views"
            )
        with lock:
            if name not in cache and item.num_bytes < free:
                cache[name] = item
                free -= item.num_bytes
        return item

    return read
