"""Pictures by Mitsuba beside the references of lit data sets: each view under the very map that lit it.

Maps are drawn again from a data set's record (which map, how far turned) and compared with the small ones it keeps.
Meshes are made again from object.json (`data_gen/make/originals.py`); surfaces are made of an object's first points.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from data_gen.render import light, poisson_surface, unshadowed, views
from data_gen.render.variant import LLVM, choose_variant, mitsuba_module
from experiments.comparison import poisson, source_meshes
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.light_files import read_envmap
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.surfels import envmaps

How = Literal["path", "unshadowed", "occlusion"]
DIFFERENT = 0.02  # of a stored map's mean: it is kept in halves
KEPT = 4  # assets that are kept in memory: an object's mesh and surfaces of two numbers of points
NOTHING = Asset(parts=())  # what points make that span no surface


class Mitsuba:
    """The references' film and materials, on the meshes that they were made of or on surfaces made of points."""

    def __init__(self, meshes: Path | None, maps: Path, spp: int) -> None:
        """Takes the folder of mesh files, that of the maps, and samples a pixel of large pictures."""
        poisson.check_packages()
        if choose_variant("auto")[0] != LLVM:
            raise UserError("pictures without shadows need Mitsuba's llvm_ad_rgb: install LLVM 17 or newer (libllvm19)")
        mitsuba_module(LLVM)
        self._meshes, self._folder, self._spp = meshes, maps, spp
        self._assets: dict[tuple, Asset] = {}

    def maps(self, dataset: data_sets.Dataset, item: data_sets.ObjectData) -> list[np.ndarray]:
        """The map of each view of an object; ValueError if they are not those that lit it."""
        if item.lights is None:
            room = light.scaled_to_white(poisson.unscaled_light(dataset.settings["environment_map"], None))
            return [room] * len(item.images)
        seed = source_meshes.details(dataset, item.name)["seeds"]["noise"]
        drawn = list(light.Lights(kinds=kinds_of(dataset, self._folder)).of_views(len(item.images), seed))
        for found, stored in zip(drawn, item.lights, strict=True):
            off = np.abs(envmaps.resampled(found, len(stored)) - stored).mean() / stored.mean()
            if not off < DIFFERENT:
                raise UserError(f"--maps {self._folder}: does not give the light of {item.name} again ({off:.0%} off)")
        return drawn

    def mesh(self, dataset: data_sets.Dataset, item: data_sets.ObjectData) -> Asset:
        """The mesh that an object was made from."""
        seed = dataset.settings.get("settings", {}).get("seed")
        key = (item.name, seed, _digest(item, None))
        return self._asset(key, lambda: source_meshes.mesh_of(dataset, item, self._meshes))

    def surface(self, item: data_sets.ObjectData, count: int) -> Asset:
        """The trimmed Poisson surface of an object's first points; without parts where they span none."""

        def make() -> Asset:
            first = jax.tree.map(lambda x: np.asarray(x)[:count], item.cloud)
            try:
                return poisson_surface.reconstruct(first, poisson.SURFACES["poisson_trimmed"])
            except poisson_surface.NoSurface:
                return NOTHING

        return self._asset((item.name, count, _digest(item, count)), make)

    def _asset(self, key: tuple, make: Callable[[], Asset]) -> Asset:
        """An asset out of the few that are kept: data sets of the same objects share them."""
        if key not in self._assets:
            made = make()
            while len(self._assets) >= KEPT:
                self._assets.pop(next(iter(self._assets)))
            self._assets[key] = made
        return self._assets[key]

    def draw(
        self,
        asset: Asset,
        poses: Sequence[np.ndarray],
        maps: Sequence[np.ndarray],
        settings: dict,
        size: int,
        how: How = "path",
    ) -> Iterator[np.ndarray]:
        """Straight-alpha sRGB (size, size, 4) uint8 from each pose (3, 4) in its map, as a data set's settings say.

        Pictures smaller than the data set's have as many samples a pixel as it has; they are cheap.
        """
        view = poisson.view_config(settings)
        spp = self._spp if size >= view.resolution else view.spp
        view = dataclasses.replace(view, resolution=size, spp=spp)
        shapes = views.mitsuba_shapes(asset)
        for number, (pose, envmap) in enumerate(zip(poses, maps, strict=True)):
            if not shapes:
                yield np.zeros((size, size, 4), np.uint8)
                continue
            scene, whole = views.lit_scene(shapes, envmap), np.concatenate([pose, [[0, 0, 0, 1]]])
            if how == "path":
                yield views.straight_srgb(views.render_view(scene, whole, view, number))
            else:
                radiance = unshadowed.render_unshadowed(scene, whole, view, number, how == "occlusion")
                yield views.straight_srgb(radiance)


def turned(envmap: np.ndarray, degrees: float | int) -> np.ndarray:
    """The map turned about the up axis as `Light.turned` turns a light, to the nearest texel."""
    return np.roll(envmap, -round(degrees / 360 * envmap.shape[1]), axis=1)


def kinds_of(dataset: data_sets.Dataset, maps: Path) -> tuple[tuple[np.ndarray, ...], ...]:
    """The kinds of light of a data set, its map files found again in a folder; ValueError if one is not there."""
    kinds: list[tuple[np.ndarray, ...]] = []
    for kind in dataset.settings["environment_map"]["kinds"]:
        if "sha256" not in kind:
            kinds += light.read_kinds((kind["name"],))
            continue
        for name, checksum in kind["sha256"].items():
            path = maps / name
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != checksum:
                raise UserError(f"--maps {maps}: holds no {name} as it lit {dataset.folder}; give the folder that does")
        kinds.append(tuple(envmaps.resampled(read_envmap(maps / name), light.DRAWN_HEIGHT) for name in kind["sha256"]))
    return tuple(kinds)


def _digest(item: data_sets.ObjectData, count: int | None) -> str:
    return hashlib.sha256(np.ascontiguousarray(np.asarray(item.cloud.positions)[:count]).tobytes()).hexdigest()
