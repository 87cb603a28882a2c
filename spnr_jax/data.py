"""Training data from disk: objects as NumPy arrays, and batches that are a pure function of (seed, step).

A data set is the folder that `spnr-data generate` writes (its form: README, "Data on disk").  Because a batch depends
on nothing but the step, a resumed run needs no reader state to see the same data.
"""

import dataclasses
import json
import queue
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from spnr_jax import clouds
from spnr_jax.config import TrainConfig
from spnr_jax.types import Batch, Camera, PointCloud

CACHE_BYTES = 2**31  # decoded objects kept in memory
ORDER, POINTS_AND_VIEWS = 1, 2  # streams of random numbers under one seed: (0, 5) and (0, 5, 0) alone would be the same


@dataclass(frozen=True, kw_only=True)
class ObjectData:
    """One object: all its points, and every view as 8-bit RGBA (straight alpha) with its condition image."""

    name: str
    cloud: PointCloud
    camera: Camera
    images: np.ndarray  # (views, height, width, 4) uint8
    conditions: np.ndarray  # (views, height, width, 4) uint8, alpha 255 at visible points

    @property
    def num_bytes(self) -> int:
        """Memory that the images take."""
        return self.images.nbytes + self.conditions.nbytes


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """The folder, its settings and the object names of each split."""

    folder: Path
    settings: dict
    splits: dict[str, tuple[str, ...]]


def open_dataset(folder: Path | str) -> Dataset:
    """The data set in a folder; ValueError if it is none or unfinished."""
    folder = Path(folder)
    description = folder / "dataset.json"
    if not description.is_file():
        raise ValueError(f"{folder}: no finished data set (dataset.json is missing); run `spnr-data generate {folder}`")
    try:
        settings = json.loads(description.read_text())
    except ValueError as error:
        raise ValueError(f"{description}: not valid JSON ({error}); generate the data set again") from None
    splits = {}
    for split in ("train", "val", "test"):
        path = folder / "splits" / f"{split}.txt"
        if not path.is_file():
            raise ValueError(f"{path}: missing; run `spnr-data generate {folder}` again, it completes the data set")
        splits[split] = tuple(path.read_text().split())
    return Dataset(folder=folder, settings=settings, splits=splits)


def read_object(dataset: Dataset, name: str) -> ObjectData:
    """One object of the data set; ValueError names the file that is missing or broken."""
    folder = dataset.folder / "objects" / name
    path = folder / "transforms.json"
    try:
        meta = json.loads(path.read_text())
        poses = np.array([frame["transform_matrix"] for frame in meta["frames"]], np.float32)[:, :3]
        intrinsics = np.array([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]], np.float32)
        files = [Path(frame["file_path"]).name for frame in meta["frames"]]
        height, width = int(meta["h"]), int(meta["w"])
        if not np.isfinite(poses).all() or not np.isfinite(intrinsics).all():
            raise ValueError("a camera holds NaN or infinity")
        images = np.stack([_read_rgba(path := folder / "images" / f, height, width) for f in files])
        conditions = np.stack([_read_rgba(path := folder / "conditions" / f, height, width) for f in files])
        cloud = clouds.read_cloud(path := folder / "points.ply")
    except (OSError, ValueError, LookupError, TypeError, SyntaxError) as error:  # Pillow raises SyntaxError too
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error).replace(str(path), path.name)
        raise ValueError(f"{path}: cannot be read ({reason}); run `spnr-data check {dataset.folder}`") from None
    camera = Camera(
        cam_to_world=poses, intrinsics=np.broadcast_to(intrinsics, (len(files), 3, 3)), height=height, width=width
    )
    return ObjectData(name=name, cloud=cloud, camera=camera, images=images, conditions=conditions)


def _read_rgba(path: Path, height: int, width: int) -> np.ndarray:
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGBA"))
    if pixels.shape[:2] != (height, width):
        raise ValueError(f"{pixels.shape[1]} x {pixels.shape[0]} pixels, transforms.json says {width} x {height}")
    return pixels


def on_white(rgba: np.ndarray) -> np.ndarray:
    """Float RGB in [0, 1] of 8-bit straight-alpha pixels over white."""
    color, alpha = rgba[..., :3].astype(np.float32) / 255, rgba[..., 3:].astype(np.float32) / 255
    return color * alpha + (1 - alpha)


def choose_points(cloud: PointCloud, count: int, size: int, generator: np.random.Generator) -> PointCloud:
    """`count` of the points without repetition (or all, if there are fewer), padded to `size`."""
    total = len(cloud.positions)
    chosen = generator.permutation(total)[: min(count, total)]
    subset = PointCloud(**{f.name: getattr(cloud, f.name)[chosen] for f in dataclasses.fields(PointCloud)})
    return clouds.pad(subset, size)


def make_batch(objects: list[ObjectData], config: TrainConfig, step: int) -> Batch:
    """The training batch of these objects at this step: random points and random views of each."""
    clouds_of, views_of = [], []
    for i, data in enumerate(objects):
        generator = np.random.default_rng((config.seed, POINTS_AND_VIEWS, step, i))
        low, high = np.log2(config.min_points), np.log2(config.max_points)
        count = round(2 ** generator.uniform(low, high))
        clouds_of.append(choose_points(data.cloud, count, config.max_points, generator))
        views_of.append(generator.permutation(len(data.images))[: config.views_per_object])
    images = np.stack([on_white(data.images[v]) for data, v in zip(objects, views_of, strict=True)])
    conditions = np.stack([data.conditions[v] for data, v in zip(objects, views_of, strict=True)])
    mask = conditions[..., 3] > 0
    poses = np.stack([data.camera.cam_to_world[v] for data, v in zip(objects, views_of, strict=True)])
    intrinsics = np.stack([data.camera.intrinsics[v] for data, v in zip(objects, views_of, strict=True)])
    stacked = {
        f.name: np.stack([getattr(cloud, f.name) for cloud in clouds_of]) for f in dataclasses.fields(PointCloud)
    }
    first = objects[0].camera
    return Batch(
        cloud=PointCloud(**stacked),
        camera=Camera(cam_to_world=poses, intrinsics=intrinsics, height=first.height, width=first.width),
        image=images,
        condition=np.where(mask[..., None], conditions[..., :3].astype(np.float32) / 255, 0),
        condition_mask=mask,
    )


def object_names(names: tuple[str, ...], config: TrainConfig, step: int) -> list[str]:
    """The objects of a step: consecutive pieces of one new permutation of all objects per epoch."""
    chosen = []
    for position in range(step * config.batch_objects, (step + 1) * config.batch_objects):
        epoch, place = divmod(position, len(names))
        chosen.append(names[np.random.default_rng((config.seed, ORDER, epoch)).permutation(len(names))[place]])
    return chosen


def batches(dataset: Dataset, config: TrainConfig, first_step: int) -> Generator[Batch, None, None]:
    """Training batches from `first_step` on, read and assembled ahead in a thread."""
    names = dataset.splits["train"]
    if not names:
        raise ValueError(f"{dataset.folder}: the train split is empty; generate more objects")
    cache: dict[str, ObjectData] = {}

    def read(name: str) -> ObjectData:
        if name in cache:
            return cache[name]
        data = read_object(dataset, name)
        check_resolution(data, config)
        if len(data.images) < config.views_per_object:
            raise ValueError(
                f"object {name} has {len(data.images)} views, views_per_object is {config.views_per_object}; lower it "
                "or generate with more --views"
            )
        if sum(d.num_bytes for d in cache.values()) + data.num_bytes < CACHE_BYTES:
            cache[name] = data
        return data

    def assemble() -> Iterator[Batch]:
        for step in range(first_step, config.num_steps):
            yield make_batch([read(name) for name in object_names(names, config, step)], config, step)

    return prefetch(assemble())


def check_resolution(data: ObjectData, config: TrainConfig) -> None:
    """ValueError if an object's images do not have the size that the config's network renders."""
    size = config.model.image_resolution
    if (data.camera.height, data.camera.width) != (size, size):
        raise ValueError(
            f"object {data.name} has images of {data.camera.width} x {data.camera.height} pixels, preset "
            f"{config.preset} needs {size} x {size}; use another preset or generate with --resolution {size}"
        )


def prefetch(items: Iterator, depth: int = 4) -> Generator:
    """The same items, made ahead by a thread; its error is raised where the item would have come."""
    done = object()
    line: queue.Queue = queue.Queue(maxsize=depth)
    stopped = threading.Event()

    def put(item) -> bool:
        while not stopped.is_set():
            try:
                line.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def work() -> None:
        try:
            for item in items:
                if not put((item, None)):
                    return
            put((done, None))
        except Exception as error:  # noqa: BLE001 - handed to the consumer, which raises it
            put((done, error))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            item, error = line.get()
            if error is not None:
                raise error
            if item is done:
                return
            yield item
    finally:
        stopped.set()
        thread.join()
