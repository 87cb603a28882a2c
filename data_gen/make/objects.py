"""One object from its source to its folder, as a worker process makes it.

Everything random about an object follows from (seed, object id) alone, so neither the order, nor the number of workers,
nor an interruption changes a byte.
"""

import hashlib
from dataclasses import dataclass, fields, replace

import numpy as np

from data_gen import procedural
from data_gen.make import augmentation
from data_gen.plan.tasks import GenerateConfig, Task
from data_gen.render import views
from data_gen.render.light import Lights
from data_gen.render.variant import mitsuba_module
from data_gen.store import layout
from spnr_jax.errors import UserError
from spnr_jax.formats import meshes, surface_points
from spnr_jax.formats.assets import Asset, Material
from spnr_jax.surfels.lighting import HEIGHT, resample


@dataclass(frozen=True, kw_only=True)
class Workbench:
    """What a worker needs for any object of the data set."""

    config: GenerateConfig
    lights: Lights
    variant: str


def make_and_write(bench: Workbench, task: Task) -> str | None:
    """Make one object's folder; return None, or the reason why it is left out.

    What is wrong with the disk and not with the object is raised.
    """
    if layout.has_object(bench.config.out, task.object_id):  # another run on the same data set was faster
        return None
    mitsuba_module(bench.variant)
    try:
        record = make_record(bench, task)
    except UserError as error:
        return str(error)
    except Exception as error:  # whatever is wrong with one object must not stop the others; its row says what it was
        return f"unexpected {type(error).__name__}: {error}".splitlines()[0]
    layout.write_object(bench.config.out, task.object_id, record)
    return None


def make_record(bench: Workbench, task: Task) -> layout.ObjectRecord:
    """One object, rendered: asset, points, views, condition images."""
    config, seeds = bench.config, object_seeds(bench.config.seed, task.object_id)
    view = views.ViewConfig(**{field.name: getattr(config, field.name) for field in fields(views.ViewConfig)})
    asset, details = make_asset(task, config.seed)
    surface = surface_points.sample_surface(asset, config.points, seeds["points"], config.spread)
    surface = surface._replace(positions=surface.positions.astype(np.float32))  # as the file holds them
    cam_to_world = views.random_viewpoints(view.views, view.distance, np.random.default_rng(seeds["viewpoints"]))
    maps = list(bench.lights.of_views(view.views, seeds["noise"]))
    images, conditions = views.render_views(asset, surface, cam_to_world, maps, view, seeds["noise"])
    return layout.ObjectRecord(
        points=layout.pack_points(surface),
        transforms=layout.nerf_transforms(cam_to_world, view.resolution, view.fov, view.focal_length),
        images=images,
        conditions=conditions,
        lights=None if bench.lights.shared is not None else np.stack([resample(x, HEIGHT) for x in maps]),
        details=object_details(task, asset, seeds) | details,
    )


def make_asset(task: Task, seed: int) -> tuple[Asset, dict]:
    """The object as it is rendered and sampled, and what was done to it as it stands in object.json."""
    asset, seeds = load_asset(task, seed), object_seeds(seed, task.object_id)
    details: dict = {"colour_rotation": None}
    if task.colour_variant:
        asset, rotation = augmentation.rotate_colors(asset, seeds["colours"])
        details["colour_rotation"] = rotation.describe()
    if task.reshaped:
        shape = augmentation.draw_reshaping(seeds["pose"])
        asset = augmentation.reshape(asset, shape)
        details["reshaping"] = shape.describe()
    asset, details["normalisation"] = surface_points.normalise(asset)
    return asset, details


def load_asset(task: Task, seed: int) -> Asset:
    """The object as its source has it; a colour variant has the shape of its product."""
    if task.path is None:
        return procedural.make(task.category, object_seeds(seed, task.product)["shape"])
    asset = meshes.load_mesh(task.path, task.folder)
    return replace(asset, category=task.category) if task.category else asset


def object_seeds(seed: int, object_id: str) -> dict[str, int]:
    """An independent 32-bit seed for each purpose, a function of (seed, object id) alone."""
    digest = hashlib.sha256(f"{seed}/{object_id}".encode()).digest()
    purposes = ("shape", "points", "viewpoints", "noise", "colours", "pose")
    return {name: int.from_bytes(digest[4 * i : 4 * i + 4], "little") for i, name in enumerate(purposes)}


def object_details(task: Task, asset: Asset, seeds: dict[str, int]) -> dict:
    """The content of object.json (the checksums of the files are added when they are written)."""
    return {
        "id": task.object_id,
        "product": task.product,
        "variant": task.colour_variant,
        "category": asset.category,
        "source": {**asset.source, "file": task.shown_path} if task.path else asset.source,
        "materials": [describe_material(part.material) | {"faces": len(part.faces)} for part in asset.parts],
        "ignored": list(asset.ignored),
        "seeds": seeds,
    }


def describe_material(material: Material) -> dict:
    """A material's channels as numbers, or as the size of their texture."""
    described: dict = {"wrap": material.wrap}
    for name, value_rank in (("base_color", 1), ("roughness", 0), ("metallic", 0)):
        channel = np.asarray(getattr(material, name))
        size = {"texture": list(channel.shape[:2])}
        described[name] = channel.astype(float).tolist() if channel.ndim == value_rank else size
    return described
