"""Pictures by Mitsuba beside the references of lit data sets: each view under the very map that lit it.

Maps are drawn again from a data set's record (which map, how far turned) and compared with the small ones it keeps.
Meshes are made again from object.json (`source_meshes.py`); surfaces are made of an object's first points.
"""

import dataclasses
import hashlib
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from data_gen.render import light, unshadowed, views
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments.comparison import poisson, source_meshes
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.light_files import read_envmap
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.surfels import envmaps

How = Literal["path", "unshadowed", "occlusion"]
DIFFERENT = 0.02  # of a stored map's mean: it is kept in halves


def prepare() -> None:
    """Chooses Mitsuba's variant; ValueError, with what to install, where a package is absent."""
    poisson.check_packages()
    chosen, notice = choose_variant("auto")
    if notice:
        print(notice, file=sys.stderr)
    mitsuba_module(chosen)


def maps_of(dataset: data_sets.Dataset, item: data_sets.ObjectData, folder: Path) -> list[np.ndarray]:
    """The map of each view of a lit object, its file in a folder; ValueError if they are not those that lit it."""
    seed = source_meshes.details(dataset, item.name)["seeds"]["noise"]
    found = list(light.Lights(kinds=_kinds(dataset, folder)).of_views(len(item.images), seed))
    for drawn, stored in zip(found, np.asarray(item.lights), strict=True):
        off = np.abs(envmaps.resampled(drawn, len(stored)) - stored).mean() / stored.mean()
        if not off < DIFFERENT:
            raise UserError(f"--maps {folder}: does not give the light of {item.name} again ({off:.0%} off)")
    return found


def _kinds(dataset: data_sets.Dataset, folder: Path) -> tuple[tuple[np.ndarray, ...], ...]:
    """The kinds of light of a data set, its map files found again; ValueError if one is not there."""
    kinds: list[tuple[np.ndarray, ...]] = []
    for kind in dataset.settings["environment_map"]["kinds"]:
        for name, checksum in kind.get("sha256", {}).items():
            path = folder / name
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != checksum:
                raise UserError(
                    f"--maps {folder}: holds no {name} as it lit {dataset.folder}; give the folder that does"
                )
        files = [folder / name for name in kind.get("sha256", {})]
        kinds += [tuple(_map(file) for file in files)] if files else light.read_kinds((kind["name"],))
    return tuple(kinds)


@lru_cache(maxsize=8)
def _map(path: Path) -> np.ndarray:
    return envmaps.resampled(read_envmap(path), light.DRAWN_HEIGHT)


def turned(envmap: np.ndarray, degrees: float | int) -> np.ndarray:
    """The map turned about the up axis as `Light.turned` turns a light, to the nearest texel."""
    return np.roll(envmap, -round(degrees / 360 * envmap.shape[1]), axis=1)


def pictures(
    asset: Asset,
    poses: Sequence[np.ndarray],
    maps: Sequence[np.ndarray],
    view: views.ViewConfig,
    how: How = "path",
) -> list[np.ndarray]:
    """Straight-alpha sRGB (height, width, 4) in [0, 1], float32, from each pose (3, 4) in its map."""
    shapes = views.mitsuba_shapes(asset)
    if not shapes:
        return [np.zeros((view.resolution, view.resolution, 4), np.float32)] * len(poses)
    found = []
    for number, (pose, envmap) in enumerate(zip(poses, maps, strict=True)):
        scene, whole = views.lit_scene(shapes, envmap), np.concatenate([pose, [[0, 0, 0, 1]]])
        if how == "path":
            radiance = views.render_view(scene, whole, view, number)
        else:
            radiance = unshadowed.render_unshadowed(scene, whole, view, number, how == "occlusion")
        found.append(views.straight_srgb(radiance).astype(np.float32) / 255)
    return found


def view_config(dataset: data_sets.Dataset, spp: int, resolution: int | None = None) -> views.ViewConfig:
    """How a data set's references are drawn, with other samples a pixel and pixels along each side."""
    view = poisson.view_config(dataset.settings)
    return dataclasses.replace(view, spp=spp, resolution=resolution or view.resolution)
