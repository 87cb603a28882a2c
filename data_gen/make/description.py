"""dataset.json: what made a data set, and how another run's would differ."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict

from data_gen import procedural
from data_gen.plan.tasks import GenerateConfig, Plan, source_of
from data_gen.render import light
from data_gen.store import layout
from data_gen.store.check import checksum_of

# options that say where or how fast, or whose content is described instead
PLACES = ("out", "workers", "cluster", "root", "meshes", "objects", "envmap", "lights", "test_list", "split_file")


def describe(plan: Plan, variant: str) -> dict:
    """The content of dataset.json: all that decides the bytes, nothing of where or how fast."""
    config = plan.config
    settings = {name: value for name, value in asdict(config).items() if name not in PLACES}
    for name, first in (("reshape_variants", False), ("spread", "random")):
        if settings[name] == first:  # as data sets have it that were described before there was the choice
            del settings[name]
    mesh_ids = [task.object_id for task in plan.tasks if task.path]
    listed = {split: {"count": len(ids), "ids_sha256": text_checksum(ids)} for split, ids in plan.listed.items()}
    return {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": {
            **settings,
            "categories": sorted(set(config.categories or procedural.CATEGORIES)),
            "source": source_of(config),
            "objects": len(plan.tasks) - len(mesh_ids),
            "mesh_files": {"count": len(mesh_ids), "ids_sha256": text_checksum(mesh_ids)},
            "listed_splits": listed,
            "variant": variant,
        },
        "environment_map": describe_light(config),
        "colour_spaces": {"images": "sRGB, 8 bit, straight alpha", "points": "linear RGB", "background": "white"},
    }


def describe_light(config: GenerateConfig) -> dict:
    """What lights the pictures: names and checksums of maps, never where they lie."""
    white = {"white_sphere_radiance": light.WHITE_SPHERE_RADIANCE}
    if config.lights:
        return {"kinds": [describe_kind(name) for name in config.lights], **white}
    if config.envmap:
        return {"name": config.envmap.name, "sha256": checksum_of(config.envmap), **white}
    return {"name": "procedural room", "sha256": None, **white}


def describe_kind(name: str) -> dict:
    """One kind of `--lights`."""
    if name in ("room", "random"):
        return {"name": name}
    return {"name": "maps", "sha256": {file.name: checksum_of(file) for file in light.map_files(name)}}


def text_checksum(lines: Sequence[str]) -> str:
    """The SHA-256 of lines of text."""
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def differences(before: dict, after: dict) -> list[str]:
    """The names of the entries that differ, one level into nested settings, each with both values if short."""
    flat = [
        {**{k: v for k, v in side.items() if k != "settings"}, **side.get("settings", {})} for side in (before, after)
    ]
    names = sorted(name for name in flat[0].keys() | flat[1].keys() if flat[0].get(name) != flat[1].get(name))
    return [
        name if isinstance(flat[1].get(name), dict) else f"{name} {flat[0].get(name)}, now {flat[1].get(name)}"
        for name in names
    ]
