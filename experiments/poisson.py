"""Poisson reconstruction beside the references: a surface from each object's points, rendered as they were.

    python -m experiments.poisson DATA OUT [--split test] [--points 1024] [--depth 12] [--trim 0]

Light, cameras, samples per pixel and integrator are those that dataset.json names.  An object whose points span no
surface is an empty picture, and a line says so.

    OUT/images/ID/000.png   RGBA, sRGB, straight alpha, as a data set has them
    OUT/poisson.json        options, PSNR of every object on white, and why a picture is empty

Pictures that are there already are kept; other options need another folder.
"""

import hashlib
import importlib.util
import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from data_gen.render import light, poisson_surface, views
from data_gen.render.poisson_surface import PoissonConfig
from data_gen.render.variant import choose_variant, mitsuba_module
from data_gen.store import layout
from spnr_jax import cli
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels import metrics
from spnr_jax.surfels.room import indoor_envmap

RENDERING = ("resolution", "fov", "spp", "max_depth")  # settings that decide a picture, given the pose of its camera


@dataclass(frozen=True, kw_only=True)
class Options:
    """Reconstruct and render the objects of one split of a data set."""

    data: tyro.conf.Positional[Path]
    """Folder of the data set."""
    out: tyro.conf.Positional[Path]
    """Folder of the pictures."""
    split: str = "test"
    """train, val or test."""
    points: int = 1024
    """Points per object: its first ones, as the networks are given."""
    surface: tyro.conf.OmitArgPrefixes[PoissonConfig] = field(default_factory=PoissonConfig)
    """How the surface is made."""
    envmap: Path | None = None
    """The environment map of the data set, where that is a file."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    seed: int = 0
    """Seed of the renderer's noise."""


def main(options: Options) -> None:
    """Writes pictures and scores of every object of the split."""
    check_packages()
    dataset = data_sets.open_dataset(options.data)
    if not dataset.splits.get(options.split):
        raise ValueError(f"--split {options.split}: {options.data} has no objects there; try train, val or test")
    if options.points < 1:
        raise ValueError(f"--points: expected 1 or more, got {options.points}")
    outcome = Outcome(options)
    renderer = Renderer(dataset.settings, options.envmap, options.variant, options.seed)
    for name in tqdm(dataset.splits[options.split], unit="object", file=sys.stderr):
        item = data_sets.read_object(dataset, name)
        paths = [options.out / "images" / name / f"{view:03d}.png" for view in range(len(item.images))]
        if outcome.has(name) and all(path.is_file() for path in paths):
            continue
        pictures, empty = renderer.pictures(item, options.points, options.surface)
        if empty:
            tqdm.write(f"{name}: {empty}; its pictures are empty", file=sys.stderr)
        for path, picture in zip(paths, pictures, strict=True):
            write_whole(path, layout.encode_image(picture))
        scores = metrics.psnr(*(jnp.asarray(data_sets.on_white(x)) for x in (pictures, item.images)))
        outcome.add(name, float(np.mean(scores)), empty)
    mean = np.mean([row["psnr"] for row in outcome.objects.values()])
    print(f"{options.out}: {len(outcome.objects)} objects, PSNR {mean:.2f} dB on white")


class Renderer:
    """The references' light, cameras and integrator, on surfaces that are made of points."""

    def __init__(self, settings: dict, envmap: Path | None = None, variant: str = "auto", seed: int = 0) -> None:
        """Takes the settings of a data set (`Dataset.settings`); the envmap where that is a file."""
        chosen, notice = choose_variant(variant)
        if notice:
            print(notice, file=sys.stderr)
        mitsuba_module(chosen)
        self._seed, self._view = seed, view_config(settings)
        self._light = light.scaled_to_white(unscaled_light(settings["environment_map"], envmap))

    def pictures(self, item: data_sets.ObjectData, num_points: int, surface: PoissonConfig) -> tuple[np.ndarray, str]:
        """Straight-alpha sRGB (views, height, width, 4) uint8 from the object's first points, and "".

        Where they span no surface: empty pictures, and the reason.
        """
        try:
            asset = poisson_surface.reconstruct(jax.tree.map(lambda x: np.asarray(x)[:num_points], item.cloud), surface)
        except poisson_surface.NoSurface as error:
            return np.zeros(item.images.shape, np.uint8), str(error)
        scene = views.build_scene(asset, self._light)
        poses = np.tile(np.eye(4), (len(item.images), 1, 1))
        poses[:, :3] = item.camera.cam_to_world
        radiance = [views.render_view(scene, p, self._view, self._seed + view) for view, p in enumerate(poses)]
        return np.stack([views.straight_srgb(r) for r in radiance]), ""


def view_config(settings: dict) -> views.ViewConfig:
    """What decides a data set's pictures, given the poses of their cameras."""
    if missing := [name for name in RENDERING if name not in settings["settings"]]:
        raise ValueError(f"dataset.json: the setting {missing[0]} is missing; generate the data set again")
    return views.ViewConfig(**{name: settings["settings"][name] for name in RENDERING})


def unscaled_light(described: dict, envmap: Path | None) -> np.ndarray:
    """The environment map that a data set describes; ValueError if the file given is not it."""
    if described["sha256"] is None:
        if envmap:
            raise ValueError(f"--envmap {envmap}: the {described['name']} lit the data set; leave the option out")
        return indoor_envmap()
    if envmap is None:
        raise ValueError(f"--envmap: give {described['name']}, which lit the data set")
    radiance = light.load_envmap(envmap)
    if hashlib.sha256(envmap.read_bytes()).hexdigest() != described["sha256"]:
        raise ValueError(f"--envmap {envmap}: not the {described['name']} that lit the data set (another checksum)")
    return radiance


class Outcome:
    """poisson.json: written after every object, so that a stopped run goes on."""

    def __init__(self, options: Options) -> None:
        """Reads what an earlier run wrote; ValueError if that had other options."""
        self._path = options.out / "poisson.json"
        self._options = {
            "split": options.split,
            "points": options.points,
            "seed": options.seed,
            **asdict(options.surface),
        }
        self.objects: dict[str, dict] = {}
        if self._path.is_file():
            before = json.loads(self._path.read_text())
            if before["options"] != self._options:
                raise ValueError(f"{options.out} holds pictures made with other options: choose another folder")
            self.objects = before["objects"]

    def has(self, name: str) -> bool:
        """Whether the object has been scored."""
        return name in self.objects

    def add(self, name: str, psnr: float, empty: str) -> None:
        """Notes an object's score."""
        self.objects[name] = {"psnr": round(psnr, 3), "empty": empty}
        write_whole(self._path, layout.json_text({"options": self._options, "objects": self.objects}).encode())


def check_packages() -> None:
    """Raise ValueError, with what to install, where one of the two optional packages is absent."""
    for package in ("pymeshlab", "mitsuba"):
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"this needs {package}: pip install 'spnr-jax[data,baselines]'")


if __name__ == "__main__":
    sys.exit(cli.guarded(lambda: main(tyro.cli(Options, prog="python -m experiments.poisson")), "poisson"))
