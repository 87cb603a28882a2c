"""What a data set is to hold, decided before anything is rendered: the options, the objects, the splits.

A procedural object is `category_000012`, its number counted through all categories; a mesh's id comes from its file.
Splits: objects are ranked by a hash of (seed, id); the first `test_fraction` of them are the test split, the next
`val_fraction` the validation split. With a test list, its ids are the test split and `val_fraction` of the others
validate. Objects that were left out are in no split.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import count, islice
from pathlib import Path

import tyro

from data_gen import light, meshes, procedural, records

DEFAULT_OBJECTS = 200


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """Generate a data set of rendered objects: procedural ones, mesh files, or both."""

    out: tyro.conf.Positional[Path]
    """Folder of the data set. One that holds an unfinished run with the same settings is completed."""
    objects: int | None = None
    """Number of procedural objects (default: 200, or 0 if mesh files are given)."""
    categories: tuple[str, ...] = ()
    """Categories of procedural objects (default: all)."""
    meshes: Path | None = None
    """Folder of .glb, .gltf, .obj and .ply files to render, too."""
    test_list: Path | None = None
    """Text file with the ids, one per line, of the objects that go to the test split."""
    resolution: int = 64
    """Width and height of the images in pixels."""
    views: int = 10
    """Views per object, from random directions."""
    points: int = 4096
    """Surface points per object."""
    spp: int = 64
    """Samples per pixel; Mitsuba rounds it up to a product of two near-equal numbers."""
    max_depth: int = 6
    """Longest light path in segments; 2 is direct light only."""
    fov: float = 40.0
    """Field of view in degrees."""
    distance: float = 3.0
    """Distance of the cameras from the object's centre; the object fits into the unit sphere."""
    visibility_grid: int = 4
    """Rays per pixel side that look for visible faces."""
    envmap: Path | None = None
    """Environment map, .hdr or .exr (default: a procedural room). Scaled: a white sphere averages 0.6."""
    seed: int = 0
    """Seed of shapes, points, viewpoints, noise and splits."""
    workers: int | None = None
    """Processes that render (default: one per CPU core)."""
    val_fraction: float = 0.05
    """Share of the objects that goes to the validation split."""
    test_fraction: float = 0.1
    """Share of the objects that goes to the test split; not used with a test list."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One object to make: a mesh file (with its path as it is reported), or a procedural category."""

    object_id: str
    category: str = ""
    path: Path | None = None
    shown_path: str = ""


def check_options(config: GenerateConfig) -> None:
    """Raise ValueError, naming the option, for a value that no data set can be made with."""
    for name in ("resolution", "views", "points", "spp", "visibility_grid", "max_depth"):
        least = 2 if name == "max_depth" else 1
        if getattr(config, name) < least:
            raise ValueError(f"--{name.replace('_', '-')}: expected {least} or more, got {getattr(config, name)}")
    for name in ("objects", "workers"):
        least = 1 if name == "workers" else 0
        if getattr(config, name) is not None and getattr(config, name) < least:
            raise ValueError(f"--{name}: expected {least} or more, got {getattr(config, name)}")
    if config.seed < 0:
        raise ValueError(f"--seed: expected 0 or more, got {config.seed}")
    if not 0 < config.fov < 180:
        raise ValueError(f"--fov: expected degrees between 0 and 180, got {config.fov:g}")
    if not config.distance > 1:
        raise ValueError(f"--distance: expected more than 1, outside the object's unit sphere, got {config.distance:g}")
    if min(config.val_fraction, config.test_fraction) < 0 or config.val_fraction + config.test_fraction >= 1:
        raise ValueError("--val-fraction, --test-fraction: expected shares that leave some objects to train on")
    if config.envmap and not config.envmap.is_file():
        raise ValueError(f"--envmap {config.envmap}: no such file; give a latitude-longitude .hdr or .exr")
    if unknown := set(config.categories) - set(procedural.CATEGORIES):
        known = ", ".join(procedural.CATEGORIES)
        raise ValueError(f"--categories: no category {', '.join(sorted(unknown))}; there are {known}")


def plan_objects(config: GenerateConfig) -> list[Task]:
    """Return every object of the data set, sorted by id. A procedural object's id does not depend on --categories."""
    num_objects = config.objects if config.objects is not None else 0 if config.meshes else DEFAULT_OBJECTS
    wanted = set(config.categories or procedural.CATEGORIES)
    numbered = ((index, procedural.category_of(index)) for index in count())
    chosen = islice(((index, category) for index, category in numbered if category in wanted), num_objects)
    tasks = [Task(object_id=f"{category}_{index:06d}", category=category) for index, category in chosen]
    if config.meshes:
        for object_id, path in meshes.find_meshes(config.meshes):
            shown = path.relative_to(config.meshes).as_posix()
            tasks.append(Task(object_id=object_id, path=path, shown_path=shown))
    if not tasks:
        raise ValueError("nothing to do: give --objects above 0, or --meshes with mesh files")
    ids = [task.object_id for task in tasks]
    if repeated := sorted({object_id for object_id in ids if ids.count(object_id) > 1}):
        raise ValueError(f"{repeated[0]} is the id of two objects; rename the mesh file")
    return sorted(tasks, key=lambda task: task.object_id)


def read_test_list(path: Path | None, known: set[str]) -> tuple[str, ...] | None:
    """Return the ids of a test list, sorted; ValueError if it is unreadable or names an object that is not planned."""
    if path is None:
        return None
    try:
        ids = sorted(set(path.read_text().split()))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"--test-list {path}: not a readable text file ({error})") from None
    if unknown := [object_id for object_id in ids if object_id not in known]:
        raise ValueError(f"--test-list {path}: no object {unknown[0]} ({len(unknown)} of {len(ids)} ids unknown)")
    return tuple(ids)


def split_objects(ids: Sequence[str], test_ids: Sequence[str] | None, config: GenerateConfig) -> dict[str, list[str]]:
    """Return the sorted ids of each split, as the header of this file says."""
    ranked = sorted(ids, key=lambda object_id: hashlib.sha256(f"split/{config.seed}/{object_id}".encode()).digest())
    test = set(ranked[: round(config.test_fraction * len(ids))] if test_ids is None else test_ids) & set(ids)
    rest = [object_id for object_id in ranked if object_id not in test]
    num_val = min(round(config.val_fraction * len(ids if test_ids is None else rest)), len(rest))
    val = set(rest[:num_val])
    return {"train": sorted(set(rest) - val), "val": sorted(val), "test": sorted(test)}


def describe(config: GenerateConfig, tasks: Sequence[Task], test_ids: Sequence[str] | None, variant: str) -> dict:
    """Return the content of dataset.json: all that decides the bytes, nothing of where or how fast."""
    settings = {
        name: value
        for name, value in asdict(config).items()
        if name not in ("out", "workers", "meshes", "envmap", "test_list", "objects")
    }
    mesh_ids = [task.object_id for task in tasks if task.path]
    envmap_sum = hashlib.sha256(config.envmap.read_bytes()).hexdigest() if config.envmap else None
    return {
        "schema_version": records.SCHEMA_VERSION,
        "settings": {
            **settings,
            "categories": sorted(set(config.categories or procedural.CATEGORIES)),
            "objects": len(tasks) - len(mesh_ids),
            "mesh_files": {"count": len(mesh_ids), "ids_sha256": text_checksum(mesh_ids)},
            "test_list": None if test_ids is None else {"count": len(test_ids), "ids_sha256": text_checksum(test_ids)},
            "variant": variant,
        },
        "environment_map": {
            "name": config.envmap.name if config.envmap else "procedural room",
            "sha256": envmap_sum,
            "white_sphere_radiance": light.WHITE_SPHERE_RADIANCE,
        },
        "colour_spaces": {"images": "sRGB, 8 bit, straight alpha", "points": "linear RGB", "background": "white"},
    }


def text_checksum(lines: Sequence[str]) -> str:
    """Return the SHA-256 of lines of text."""
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def differences(before: dict, after: dict) -> list[str]:
    """Return the names of the entries that differ, one level into nested settings, each with both values if short."""
    flat = [
        {**{k: v for k, v in side.items() if k != "settings"}, **side.get("settings", {})} for side in (before, after)
    ]
    names = sorted(name for name in flat[0].keys() | flat[1].keys() if flat[0].get(name) != flat[1].get(name))
    return [
        name if isinstance(flat[1].get(name), dict) else f"{name} {flat[0].get(name)}, now {flat[1].get(name)}"
        for name in names
    ]
