"""Poisson reconstruction beside the references: a surface from each object's points, rendered as they were.

Light, cameras, samples per pixel and integrator are those that dataset.json names.  An object whose points span no
surface is an empty picture.  `keep_pictures` keeps them by object, as FOLDER/NAME.npz.
"""

import dataclasses
import hashlib
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import jax
import numpy as np

from data_gen.render import light, poisson_surface, views
from data_gen.render.poisson_surface import PoissonConfig
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments.comparison.contenders import Method, of_rgba
from experiments.comparison.results_folder import load_or_make
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets
from spnr_jax.formats.assets import Asset
from spnr_jax.formats.images import read_envmap
from spnr_jax.kernels.records import PointCloud
from spnr_jax.scoring.evaluation import Pictures
from spnr_jax.surfels.skies import indoor_envmap

RENDERING = ("resolution", "fov", "spp", "max_depth")  # settings that decide a picture, given the pose of its camera
SURFACES = {"poisson": PoissonConfig(), "poisson_trimmed": PoissonConfig(trim=0.3)}


class Renderer:
    """The references' light, cameras and integrator, on surfaces that are made of points."""

    def __init__(self, settings: dict, envmap: Path | None = None, variant: str = "auto", seed: int = 0) -> None:
        """Takes the settings of a data set (`Dataset.settings`); the envmap where that is a file."""
        chosen, notice = choose_variant(variant)
        if notice:
            print(notice, file=sys.stderr)
        mitsuba_module(chosen)
        self._seed, self._view = seed, view_config(settings)
        self._light = light.scale_to_white(unscaled_light(settings["environment_map"], envmap))

    def draw(self, asset: Asset | str, item: data_sets.ObjectData) -> np.ndarray:
        """Straight-alpha sRGB (views, height, width, 4) uint8 from the object's cameras; empty without a surface."""
        if isinstance(asset, str):
            return np.zeros(item.images.shape, np.uint8)
        scene = views.build_scene(asset, self._light)
        config = dataclasses.replace(self._view, resolution=item.camera.height)
        poses = np.tile(np.eye(4), (len(item.images), 1, 1))
        poses[:, :3] = item.camera.cam_to_world
        radiance = [views.render_view(scene, p, config, self._seed + view) for view, p in enumerate(poses)]
        return np.stack([views.straight_srgb(r) for r in radiance])

    def method(self, surface: str) -> Method:
        """The surface of SURFACES as a method, through all points of an object."""
        return Method(
            encode=lambda item: reconstruct(item.cloud, SURFACES[surface]),
            draw=lambda asset, item: of_rgba(self.draw(asset, item)),
            identity=dataclasses.asdict(SURFACES[surface]),
        )


def reconstruct(cloud: PointCloud, surface: PoissonConfig) -> Asset | str:
    """The surface of a cloud, or the reason why its points span none."""
    try:
        return poisson_surface.reconstruct(jax.tree.map(np.asarray, cloud), surface)
    except poisson_surface.NoSurface as error:
        return str(error)


def view_config(settings: dict) -> views.ViewConfig:
    """What decides a data set's pictures, given the poses of their cameras."""
    if missing := [name for name in RENDERING if name not in settings["settings"]]:
        raise UserError(f"dataset.json: the setting {missing[0]} is missing; generate the data set again")
    return views.ViewConfig(**{name: settings["settings"][name] for name in RENDERING})


def unscaled_light(described: dict, envmap: Path | None) -> np.ndarray:
    """The environment map that a data set describes; ValueError if the file given is not it."""
    if described["sha256"] is None:
        if envmap:
            raise UserError(f"--envmap {envmap}: the {described['name']} lit the data set; leave the option out")
        return indoor_envmap()
    if envmap is None:
        raise UserError(f"--envmap: give {described['name']}, which lit the data set")
    radiance = read_envmap(envmap)
    if hashlib.sha256(envmap.read_bytes()).hexdigest() != described["sha256"]:
        raise UserError(f"--envmap {envmap}: not the {described['name']} that lit the data set (another checksum)")
    return radiance


def keep_pictures(renderer: Renderer, surface: PoissonConfig, folder: Path) -> Method:
    """The surface as a method whose pictures and seconds a view are kept by object: made once, then read."""

    def make(item: data_sets.ObjectData) -> tuple[np.ndarray, np.ndarray]:
        start = time.monotonic()
        pictures = renderer.draw(reconstruct(item.cloud, surface), item)
        return pictures, np.array((time.monotonic() - start) / len(pictures))

    def draw(_: None, item: data_sets.ObjectData) -> Pictures:
        return of_rgba(load_or_make(folder / f"{item.name}.npz", lambda: make(item))[0])

    return Method(draw=draw)


def seconds_per_view(folder: Path, names: Iterable[str]) -> list[float]:
    """Seconds of solver and renderer by object, shared by its views."""
    return [float(np.load(folder / f"{name}.npz")["1"]) for name in names]
