"""Reads the data sets that `spnr-data generate` writes, as NumPy arrays; docs/data.md describes their files."""

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from spnr_jax.config import TrainConfig
from spnr_jax.errors import UserError, is_bug
from spnr_jax.formats import clouds
from spnr_jax.formats.array_files import read_arrays
from spnr_jax.formats.assets import decode_image
from spnr_jax.formats.camera_files import cameras_of
from spnr_jax.kernels.records import Camera, Light, PointCloud
from spnr_jax.surfels.lighting import HEIGHT, WIDTH, light_of

ROOM = "procedural room"  # name of the package's room light in a data set
LONGEST_NAME = 200  # of an object, in bytes: file systems allow 255


@dataclass(frozen=True, kw_only=True)
class ObjectData:
    """One object: its points, and all views as 8-bit RGBA (straight alpha) with their condition images."""

    name: str
    cloud: PointCloud
    camera: Camera
    images: np.ndarray  # (views, height, width, 4) uint8
    conditions: np.ndarray  # (views, height, width, 4) uint8, alpha 255 at visible points
    lights: np.ndarray | None = None  # (views, 32, 64, 3): environment maps, where each view has its own

    @property
    def own_lights(self) -> list[Light] | None:
        """The light of each view, if each has its own."""
        return None if self.lights is None else [light_of(envmap) for envmap in self.lights]

    @property
    def num_bytes(self) -> int:
        """Bytes of the images and points in memory."""
        return self.images.nbytes + self.conditions.nbytes + sum(x.nbytes for x in jax.tree.leaves(self.cloud))


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A data set: its folder, settings and the object names of each split."""

    folder: Path
    settings: dict
    splits: dict[str, tuple[str, ...]]

    @property
    def spread(self) -> Literal["random", "even"]:
        """Sampling of the objects' points; every prefix of an even cloud is evenly spread, too."""
        return "even" if self.settings.get("settings", {}).get("spread") == "even" else "random"

    @property
    def light(self) -> str:
        """Name of the light of all views; that of the room if none is named."""
        described = self.settings.get("environment_map")
        return described.get("name", ROOM) if isinstance(described, dict) else ROOM

    def check_lit_by_room(self) -> None:
        """ValueError if one light other than the room lights all views: the data set does not store it."""
        if self.light != ROOM:
            lit = f"{self.folder}: lit by {self.light}, which it does not hold"
            advice = "generate it with --lights FOLDER, a light for each view"
            raise UserError(f"{lit}; {advice}, or in Python give spnr_jax.training.trainer.train its light")


def open_dataset(folder: Path | str) -> Dataset:
    """The data set in a folder; ValueError if there is none or it is unfinished."""
    folder = Path(folder)
    description = folder / "dataset.json"
    if not description.is_file():
        raise UserError(f"{folder}: no finished data set (dataset.json is missing); run `spnr-data generate {folder}`")
    try:
        settings = json.loads(description.read_text())
    except (ValueError, RecursionError) as error:
        raise UserError(f"{description}: not valid JSON ({error}); generate the data set again") from None
    if not isinstance(settings, dict):
        raise UserError(f"{description}: holds no settings; generate the data set again")
    splits = {}
    for split in ("train", "val", "test"):
        path = folder / "splits" / f"{split}.txt"
        if not path.is_file():
            raise UserError(f"{path}: missing; repeat the `spnr-data generate` command that began it")
        splits[split] = tuple(path.read_text(errors="replace").split())
        if strange := [name for name in splits[split] if not is_plain_name(name)]:
            raise UserError(f"{path}: {strange[0]!r} is no name of an object; generate the data set again")
    return Dataset(folder=folder, settings=settings, splits=splits)


def checksum(dataset: Dataset, *splits: str) -> str:
    """SHA-256 of the settings and of splits: the names of their objects, and the checksums of these objects' files."""
    found = hashlib.sha256(json.dumps(dataset.settings, sort_keys=True).encode())
    for split in splits:
        found.update(split.encode() + b"\n")
        for name in dataset.splits[split]:
            found.update(name.encode() + b"\n" + read_record(dataset, name))
    return found.hexdigest()


def read_record(dataset: Dataset, name: str) -> bytes:
    """The content of an object's object.json, with the checksums of its files; the files' own if it is missing."""
    folder = dataset.folder / "objects" / name
    files = [folder / "object.json"] if (folder / "object.json").is_file() else sorted(folder.rglob("*"))
    return b"".join(file.read_bytes() for file in files if file.is_file())


def is_plain_name(name: str) -> bool:
    """Whether a name in a data set's lists is a plain folder name: no path, not hidden."""
    plain = name.isprintable() and not (name.startswith(".") or set(name) & set("/\\:"))
    return plain and 0 < len(name) <= LONGEST_NAME


def read_object(dataset: Dataset, name: str) -> ObjectData:
    """One object of the data set; ValueError names a missing or broken file."""
    folder = dataset.folder / "objects" / name
    file = "transforms.json"

    def read(file: str) -> bytes:
        return (folder / file).read_bytes()

    try:
        meta = json.loads(read(file))
        cameras = cameras_of(meta)
        camera = jax.tree.map(lambda *views: np.stack(views), *cameras)  # ValueError if their sizes differ
        names = [Path(frame["file_path"]).name for frame in meta["frames"]]
        images = np.stack([_rgba(read(file := f"images/{name}"), camera) for name in names])
        conditions = np.stack([_rgba(read(file := f"conditions/{name}"), camera) for name in names])
        cloud = clouds.cloud_of_ply(read(file := "points.ply"))
        lights = _lights(read(file := "lights.npz"), len(names)) if has_lights(dataset) else None
    except Exception as error:
        if isinstance(error, MemoryError) or is_bug(error):
            raise
        path = folder / file
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error).replace(str(path), path.name)
        advice = f"remove {folder} and run the same `spnr-data generate` again"
        raise UserError(f"{path}: cannot be read ({reason}); {advice}") from None
    return ObjectData(name=name, cloud=cloud, camera=camera, images=images, conditions=conditions, lights=lights)


def has_lights(dataset: Dataset) -> bool:
    """Whether each view of the data set has its own light."""
    described = dataset.settings.get("environment_map")
    return isinstance(described, dict) and "kinds" in described


def _lights(content: bytes, views: int) -> np.ndarray:
    lights = read_arrays(io.BytesIO(content), ("lights",))["lights"].astype(np.float32)
    if lights.shape != (views, HEIGHT, WIDTH, 3) or not np.isfinite(lights).all() or lights.min() < 0:
        raise UserError(f"expected {views} maps of {HEIGHT} x {WIDTH} texels of radiance, got {lights.shape}")
    return lights


def _rgba(content: bytes, camera: Camera) -> np.ndarray:
    image, sides = decode_image(content), (camera.width, camera.height)
    if image.shape[1::-1] != sides:
        found, said = (f"{width} x {height}" for width, height in (image.shape[1::-1], sides))
        raise UserError(f"{found} pixels, transforms.json says {said}")
    return image


def on_white(rgba: np.ndarray) -> np.ndarray:
    """Float RGB in [0, 1] of 8-bit straight-alpha pixels over white."""
    color, alpha = rgba[..., :3].astype(np.float32) / 255, rgba[..., 3:].astype(np.float32) / 255
    return color * alpha + (1 - alpha)


def first_points(item: ObjectData, count: int) -> PointCloud:
    """The first `count` points of an object, or all if it has fewer."""
    return jax.tree.map(lambda values: values[:count], item.cloud)


def check_resolution(data: ObjectData, config: TrainConfig) -> None:
    """ValueError if an object's images do not have the size on which the config's network is trained."""
    size = config.model.image_resolution
    if (data.camera.height, data.camera.width) != (size, size):
        raise UserError(
            f"object {data.name} has images of {data.camera.width} x {data.camera.height} pixels, preset "
            f"{config.preset} needs {size} x {size}; generate with --resolution {size}"
        )
