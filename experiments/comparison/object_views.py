"""An object of a data set as a study asks for it: so many points and views, at a resolution; what a network draws
of it, and how good that is."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.config import Quality
from spnr_jax.formats import data_sets
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Light, PointCloud, Volume
from spnr_jax.kernels.resizing import mean_of_squares
from spnr_jax.method.model import Model
from spnr_jax.scoring.picture_scores import flip, sharpness

Picture = tuple[np.ndarray, np.ndarray]  # image (height, width, 3) on white and opacity (height, width)


def cut(item: data_sets.ObjectData, count: int, views: int, normals: bool) -> data_sets.ObjectData:
    """An object with its first points and views alone, with its normals or without."""
    return dataclasses.replace(few(item, views), cloud=told(data_sets.first_points(item, count), normals))


def few(item: data_sets.ObjectData, views: int) -> data_sets.ObjectData:
    """An object with its first views alone."""
    camera = jax.tree.map(lambda x: x[:views], item.camera)
    return dataclasses.replace(item, camera=camera, images=item.images[:views])


def told(cloud: PointCloud, normals: bool) -> PointCloud:
    """The cloud with its normals or without."""
    return cloud if normals else dataclasses.replace(cloud, normals=None)


def view_of(item: data_sets.ObjectData, view: int, resolution: int | None) -> tuple[Camera, np.ndarray]:
    """Camera and reference (RGBA, straight alpha, float) of a view at a resolution, None for its own."""
    camera = jax.tree.map(lambda x: x[view], item.camera)
    if resolution and resolution != camera.height:
        camera = cameras.resize(camera, resolution, resolution)
    return camera, at(item.images[view], resolution)


def at(rgba: np.ndarray, resolution: int | None) -> np.ndarray:
    """Straight RGBA uint8 as float, averaged to a resolution that is a whole share of its own."""
    picture = rgba.astype(np.float32) / 255
    return smaller(picture, len(rgba) // resolution) if resolution and resolution != len(rgba) else picture


def smaller(reference: np.ndarray, side: int) -> np.ndarray:
    """The mean of squares of pixels, colours weighted by their opacity."""
    weighted = np.concatenate([reference[..., :3] * reference[..., 3:], reference[..., 3:]], axis=-1)
    weighted = np.asarray(mean_of_squares(jnp.asarray(weighted), side))
    return np.concatenate([weighted[..., :3] / np.maximum(weighted[..., 3:], 1e-4), weighted[..., 3:]], axis=-1)


def on_white(rgba: np.ndarray) -> Picture:
    """A straight RGBA picture on white, and its opacity."""
    return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], rgba[..., 3]


def drawn(
    model: Model,
    volume: Volume,
    views: Sequence[Camera],
    quality: Quality = "best",
    lights: Sequence[Light] | None = None,
) -> list[Picture]:
    """What a network shows of an encoded object, each camera in its light."""
    renderings = model.render_each(volume, views, quality, lights)
    return [(np.asarray(found.image), np.asarray(found.acc)) for found in renderings]


def view_scores(image: np.ndarray, opacity: np.ndarray, reference: np.ndarray) -> list[float]:
    """PSNR, PSNR inside and FLIP of a picture on white beside its reference (RGBA)."""
    found, white = sharpness(image, opacity, reference), on_white(reference)[0]
    return [found.psnr, found.psnr_inside, float(flip(image, white))]
