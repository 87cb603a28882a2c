"""A data set from its plan: what is missing is made by workers (workers.py), then the lists are written.

Products are made first, split, and then the colour variants of those that train (plan/tasks.py). A run may stop
anywhere: finished objects stay, and the same command makes the others, to the same bytes. dataset.json
comes first and holds the folder for these settings; rejected.jsonl and the splits come last. Runs on several machines
may share a data set: each skips what another has finished meanwhile, and equal settings write equal bytes.
"""

import hashlib
import json
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from data_gen import procedural
from data_gen.make.objects import Workbench, make_and_write
from data_gen.make.workers import run_tasks
from data_gen.plan.tasks import PAPER_COUNTS, GenerateConfig, Plan, Task, check_options, plan_data_set, source_of
from data_gen.render import light
from data_gen.render.variant import choose_variant
from data_gen.store import layout
from data_gen.store.check import checksum_of, read_details
from spnr_jax.errors import UserError
from spnr_jax.formats.columns import list_names
from spnr_jax.formats.images import check_place, read_envmap, write_whole
from spnr_jax.surfels.skies import indoor_envmap

# options that say where or how fast, or whose content is described instead
PLACES = ("out", "workers", "root", "meshes", "objects", "envmap", "lights", "test_list")


def describe(plan: Plan, variant: str) -> dict:
    """The content of dataset.json: options and names that decide the bytes, nothing of where or how fast."""
    config, (source, category) = plan.config, source_of(plan.config)
    settings = {name: value for name, value in asdict(config).items() if name not in PLACES}
    for name, first in (("reshape_variants", False), ("spread", "random")):
        if settings[name] == first:  # as data sets have it that were described before there was the choice
            del settings[name]
    mesh_ids = [task.object_id for task in plan.tasks if task.path]
    return {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": {
            **settings,
            "categories": sorted(set(config.categories or procedural.CATEGORIES)),
            "source": source,
            "category": category,
            "visibility": "face",
            "objects": len(plan.tasks) - len(mesh_ids),
            "mesh_files": describe_ids(mesh_ids),
            "listed_splits": {} if plan.listed is None else {"test": describe_ids(plan.listed)},
            "variant": variant,
        },
        "environment_map": describe_light(config),
        "colour_spaces": {"images": "sRGB, 8 bit, straight alpha", "points": "linear RGB", "background": "white"},
    }


def describe_light(config: GenerateConfig) -> dict:
    """What lights the pictures: names and checksums of maps, never where they lie."""
    white = {"white_sphere_radiance": light.WHITE_SPHERE_RADIANCE}
    if config.lights:
        kinds = [
            {"name": name}
            if name in ("room", "random")
            else {"name": "maps", "sha256": {file.name: checksum_of(file) for file in light.map_files(name)}}
            for name in config.lights
        ]
        return {"kinds": kinds, **white}
    if config.envmap:
        return {"name": config.envmap.name, "sha256": checksum_of(config.envmap), **white}
    return {"name": "procedural room", "sha256": None, **white}


def describe_ids(ids: Sequence[str]) -> dict:
    """A list of objects: how many, and the SHA-256 of its lines."""
    return {"count": len(ids), "ids_sha256": hashlib.sha256("\n".join(ids).encode()).hexdigest()}


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


def generate(config: GenerateConfig) -> None:
    """Write the data set that the config describes, or what is missing of it; ValueError or OSError if it cannot be."""
    check_options(config)
    plan = plan_data_set(config)
    variant, notice = choose_variant(config.variant)
    settings = describe(plan, variant)
    refuse_other_content(config.out, settings)
    if notice:
        print(notice, file=sys.stderr)
    rejected = {task.object_id: task.fault for task in plan.tasks if task.fault}
    rejected |= make_missing(config, [task for task in plan.tasks if not task.fault], settings)
    split_ids = plan.split([task.object_id for task in plan.tasks if task.object_id not in rejected])
    variants = plan.variants(split_ids["train"])
    rejected |= make_missing(config, variants, settings)
    split_ids["train"] = sorted(split_ids["train"] + [v.object_id for v in variants if v.object_id not in rejected])
    finish(config, [*plan.tasks, *variants], split_ids, rejected)


def make_missing(config: GenerateConfig, tasks: Sequence[Task], settings: dict) -> dict[str, str]:
    """Make the objects that are not there yet; return the reason for each that was left out, by id."""
    done = layout.list_completed(config.out)
    if changed := [task.object_id for task in tasks if task.object_id in done and has_changed(config.out, task)]:
        said = f"{len(changed)} objects are kept whose mesh files changed since: {list_names(changed)}"
        print(f"{config.out}: {said}; remove their folders in objects/ to make them anew", file=sys.stderr)
    missing = [task for task in tasks if task.object_id not in done]
    if not missing:
        return {}
    variant = settings["settings"]["variant"]
    lights = make_lights(config)
    refuse_other_content(config.out, settings)  # another run may have begun there meanwhile
    write_whole(config.out / "dataset.json", layout.json_text(settings).encode())
    layout.remove_unfinished(config.out)
    rejected = make_objects(config, missing, lights, variant)
    # the process of one that is there died here, but another run has made it
    return {name: reason for name, reason in rejected.items() if not layout.has_object(config.out, name)}


def has_changed(dataset: Path, task: Task) -> bool:
    """Whether the mesh file of a complete object is newer than the object, and another one than it was made of."""
    record = dataset / "objects" / task.object_id / layout.LAST_FILE
    if task.path is None or task.path.stat().st_mtime <= record.stat().st_mtime:
        return False
    return read_details(dataset, task.object_id).get("source", {}).get("sha256") != checksum_of(task.path)


def make_lights(config: GenerateConfig) -> light.Lights:
    """The light of the data set: one scaled map for all views, or kinds that each view draws from."""
    if config.lights:
        return light.Lights(kinds=light.read_kinds(config.lights))
    return light.Lights(light.scale_to_white(read_envmap(config.envmap) if config.envmap else indoor_envmap()))


def refuse_other_content(out: Path, settings: dict) -> None:
    """ValueError if the place holds another data set, or anything else, or can hold nothing."""
    check_place(out / "dataset.json")
    if (out / "dataset.json").is_file():
        try:
            before = json.loads((out / "dataset.json").read_bytes())
        except ValueError:
            raise UserError(f"{out}/dataset.json is damaged: remove {out}, or choose another folder") from None
        if before != settings:
            changed = ", ".join(differences(before, settings))
            raise UserError(f"{out} holds a data set with other settings ({changed}): choose another folder")
    elif out.is_dir() and not all(path.name.startswith(layout.UNFINISHED) for path in out.iterdir()):
        raise UserError(f"{out} is not empty and holds no data set: choose another folder")


def make_objects(config: GenerateConfig, tasks: Sequence[Task], lights: light.Lights, variant: str) -> dict[str, str]:
    """Make the objects on the workers; return the reason for each that was left out, by id."""
    bench = Workbench(config=config, lights=lights, variant=variant)
    rejected, workers = {}, config.workers or os.cpu_count() or 1
    try:
        with (
            closing(run_tasks(make_and_write, bench, tasks, workers)) as results,
            tqdm(total=len(tasks), unit="object", dynamic_ncols=True) as bar,
        ):
            for task, reason in results:
                if reason is not None:
                    rejected[task.object_id] = reason
                    tqdm.write(f"left out {task.shown_path or task.object_id}: {reason}", file=sys.stderr)
                bar.update()
    finally:
        layout.remove_unfinished(config.out)
    return rejected


def finish(
    config: GenerateConfig, tasks: Sequence[Task], split_ids: dict[str, list[str]], rejected: dict[str, str]
) -> None:
    """Write rejected.jsonl and the splits, and say what became of the objects."""
    rows = [
        json.dumps({"id": task.object_id, "path": task.shown_path or None, "reason": rejected[task.object_id]})
        for task in tasks
        if task.object_id in rejected
    ]
    write_whole(config.out / "rejected.jsonl", "".join(row + "\n" for row in rows).encode())
    for split in layout.SPLITS:
        lines = "".join(f"{object_id}\n" for object_id in split_ids[split])
        write_whole(config.out / "splits" / f"{split}.txt", lines.encode())
    counts = ", ".join(f"{len(split_ids[split])} {split}" for split in layout.SPLITS)
    made = len(tasks) - len(rows)
    paper = "; the paper has {} train, {} test".format(*PAPER_COUNTS[config.preset]) if config.preset else ""
    print(f"{config.out}: {made} objects ({counts}), {len(rows)} left out{paper}", file=sys.stderr)
    if not made:
        raise UserError(f"{config.out}: every object was left out; {config.out}/rejected.jsonl says why")
    if not split_ids["test"]:
        print(
            f"{config.out}: the test split is empty, so `spnr evaluate` needs --split; "
            "for one, generate into another folder with --test-objects N",
            file=sys.stderr,
        )
