"""One object from its source to its folder, as a worker process makes it.

Everything random about an object follows from (seed, object id) alone, so neither the order, nor the number of workers,
nor an interruption changes a byte.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_gen import meshes, points, procedural, records, views
from data_gen.assets import Asset, Material, RejectedAsset
from data_gen.plan import Task
from data_gen.variant import mitsuba_module


@dataclass(frozen=True, kw_only=True)
class Workbench:
    """What a worker needs for any object of the data set."""

    out: Path
    envmap: np.ndarray
    view: views.ViewConfig
    num_points: int
    seed: int


def set_up(bench: Workbench, variant: str) -> Workbench:
    """Return the workbench in a worker process that is ready to render."""
    mitsuba_module(variant)
    return bench


def make_and_write(bench: Workbench, task: Task) -> str | None:
    """Make one object's folder; return None, or the reason why it is left out. Errors of the disk are raised."""
    try:
        record = make_record(bench, task)
    except RejectedAsset as error:
        return str(error)
    except Exception as error:  # whatever is wrong with one object must not stop the others; its row says what it was
        return f"unexpected {type(error).__name__}: {error}".splitlines()[0]
    records.write_object(bench.out, task.object_id, record)
    return None


def make_record(bench: Workbench, task: Task) -> records.ObjectRecord:
    """Return one object, rendered: asset, points, views, condition images."""
    seeds = object_seeds(bench.seed, task.object_id)
    asset = meshes.load_mesh(task.path) if task.path else procedural.make(task.category, seeds["shape"])
    asset, transform = points.normalise(asset)
    surface = points.sample_surface(asset, bench.num_points, seeds["points"])
    cam_to_world = views.random_viewpoints(
        bench.view.views, bench.view.distance, np.random.default_rng(seeds["viewpoints"])
    )
    images, conditions = views.render_views(asset, surface, cam_to_world, bench.envmap, bench.view, seeds["noise"])
    return records.ObjectRecord(
        points=records.pack_points(surface),
        transforms=records.nerf_transforms(
            cam_to_world, bench.view.resolution, bench.view.fov, bench.view.focal_length
        ),
        images=images,
        conditions=conditions,
        details=object_details(task, asset, transform, seeds),
    )


def object_seeds(seed: int, object_id: str) -> dict[str, int]:
    """Return an independent 32-bit seed for each purpose, a function of (seed, object id) alone."""
    digest = hashlib.sha256(f"{seed}/{object_id}".encode()).digest()
    purposes = ("shape", "points", "viewpoints", "noise")
    return {name: int.from_bytes(digest[4 * i : 4 * i + 4], "little") for i, name in enumerate(purposes)}


def object_details(task: Task, asset: Asset, transform: dict, seeds: dict[str, int]) -> dict:
    """Return the content of object.json (the checksums of the files are added when they are written)."""
    return {
        "id": task.object_id,
        "category": asset.category,
        "source": {**asset.source, "file": task.shown_path} if task.path else asset.source,
        "normalisation": transform,
        "materials": [describe_material(part.material) | {"faces": len(part.faces)} for part in asset.parts],
        "ignored": list(asset.ignored),
        "seeds": seeds,
        "colour_rotation": None,
    }


def describe_material(material: Material) -> dict:
    """Return a material's channels as numbers, or as the size of their texture."""
    described: dict = {"wrap": material.wrap}
    for name, value_rank in (("base_color", 1), ("roughness", 0), ("metallic", 0)):
        channel = np.asarray(getattr(material, name))
        size = {"texture": list(channel.shape[:2])}
        described[name] = channel.astype(float).tolist() if channel.ndim == value_rank else size
    return described
