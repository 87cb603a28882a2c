"""A data set from its plan: what is missing is made by worker processes, then the lists are written.

A run may stop anywhere: finished objects stay, and the same command makes the others, to the same bytes. dataset.json
comes first and holds the folder for these settings; rejected.jsonl and the splits come last.
"""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import numpy as np
from tqdm import tqdm

from data_gen import light, records, views
from data_gen.objects import Workbench, make_and_write, set_up
from data_gen.plan import (
    GenerateConfig,
    Task,
    check_options,
    describe,
    differences,
    plan_objects,
    read_test_list,
    split_objects,
)
from data_gen.variant import choose_variant, mitsuba_module
from data_gen.workers import Died, run_tasks


def generate(config: GenerateConfig) -> None:
    """Write the data set that the config describes, or what is missing of it; ValueError or OSError if it cannot be."""
    check_options(config)
    tasks = plan_objects(config)
    test_ids = read_test_list(config.test_list, {task.object_id for task in tasks})
    variant, notice = choose_variant(config.variant)
    settings = describe(config, tasks, test_ids, variant)
    refuse_other_content(config.out, settings)
    done = records.completed_objects(config.out)
    missing = [task for task in tasks if task.object_id not in done]
    rejected = {}
    if missing:
        envmap = make_light(config, variant)
        records.write_text(config.out / "dataset.json", records.json_text(settings))
        records.remove_unfinished(config.out)
        if notice:
            print(notice, file=sys.stderr)
        rejected = make_objects(config, missing, envmap, variant)
    finish(config, tasks, test_ids, rejected)


def make_light(config: GenerateConfig, variant: str) -> np.ndarray:
    """Return the scaled environment map (height, width, 3) of the data set."""
    mitsuba_module(variant)
    return light.scaled_to_white(light.load_envmap(config.envmap) if config.envmap else light.indoor_envmap())


def refuse_other_content(out: Path, settings: dict) -> None:
    """Raise ValueError if the folder holds another data set, or anything else."""
    described = out / "dataset.json"
    if described.exists():
        try:
            before = json.loads(described.read_text())
        except ValueError:
            raise ValueError(f"{described} is damaged: remove {out}, or choose another folder") from None
        if before != settings:
            changed = ", ".join(differences(before, settings))
            raise ValueError(f"{out} holds a data set with other settings ({changed}): choose another folder")
    elif out.exists() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty and holds no data set: choose another folder")


def make_objects(config: GenerateConfig, tasks: Sequence[Task], envmap: np.ndarray, variant: str) -> dict[str, str]:
    """Make the objects in worker processes; return the reason for each that was left out, by id."""
    view = views.ViewConfig(**{field.name: getattr(config, field.name) for field in fields(views.ViewConfig)})
    bench = Workbench(out=config.out, envmap=envmap, view=view, num_points=config.points, seed=config.seed)
    rejected = {}
    results = run_tasks(make_and_write, tasks, config.workers or os.cpu_count() or 1, set_up, (bench, variant))
    bar = tqdm(total=len(tasks), unit="object", disable=not tasks, dynamic_ncols=True)
    try:
        with closing(results), bar:
            for task, reason in results:
                if isinstance(reason, Died):
                    reason = f"the process that made it died twice (exit code {reason.exitcode}); out of memory?"
                if reason is not None:
                    rejected[task.object_id] = reason
                    tqdm.write(f"left out {task.shown_path or task.object_id}: {reason}", file=sys.stderr)
                bar.update()
    finally:
        records.remove_unfinished(config.out)
    return rejected


def finish(config: GenerateConfig, tasks: Sequence[Task], test_ids, rejected: dict[str, str]) -> None:
    """Write rejected.jsonl and the splits, and say what became of the objects."""
    done = [task.object_id for task in tasks if task.object_id not in rejected]
    rows = [
        json.dumps({"id": task.object_id, "path": task.shown_path or None, "reason": rejected[task.object_id]})
        for task in tasks
        if task.object_id in rejected
    ]
    records.write_text(config.out / "rejected.jsonl", "".join(row + "\n" for row in rows))
    split_ids = split_objects(done, test_ids, config)
    for split in records.SPLITS:
        records.write_text(
            config.out / "splits" / f"{split}.txt", "".join(f"{object_id}\n" for object_id in split_ids[split])
        )
    counts = ", ".join(f"{len(split_ids[split])} {split}" for split in records.SPLITS)
    print(f"{config.out}: {len(done)} objects ({counts}), {len(rows)} left out", file=sys.stderr)
    if not done:
        raise ValueError(f"{config.out}: every object was left out; {config.out / 'rejected.jsonl'} says why")
