"""How fast objects are made, where the time goes, how many samples a picture needs, and what the visibility rule does.

    python -m experiments.data_generation [--out runs/data_generation] [--meshes DIR] [--parts timing noise visibility]

timing      objects per hour on this machine's cores, and the share of each phase; only an idle machine measures it
noise       PSNR of pictures of few samples against one of 4096, both as they are written (8-bit sRGB on white)
visibility  condition pixels that the paper's rule (whole faces) has and the rule by point has not, and the reverse
Figures of parts that are not run again are kept.
Pictures of more than 256 samples are means of such pictures with different seeds: a compiled variant holds all samples
of a picture in memory. Mitsuba's own denoiser needs an NVIDIA GPU (OptiX), so none is measured here.
"""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

from data_gen.make.generate import make_light
from data_gen.make.objects import load_asset, object_seeds
from data_gen.plan.tasks import GenerateConfig, Task, plan_objects
from data_gen.render import views
from data_gen.render.variant import SCALAR, choose_variant, mitsuba_module, threads
from data_gen.store import layout
from experiments.data_timing import PHASES, time_objects, worker_pool
from spnr_jax import cli
from spnr_jax.formats.images import write_whole
from spnr_jax.formats.mesh import surface_points
from spnr_jax.formats.mesh.assets import Asset, RejectedAsset
from spnr_jax.scoring.report import psnr

SAMPLES = (16, 32, 64, 128, 256, 512, 1024)
REFERENCE_SAMPLES = 4096
AT_ONCE = 256  # samples of a pixel in one call of the renderer
TARGET = 38.0  # dB, median


@dataclass(frozen=True, kw_only=True)
class DataGeneration:
    """Measure the generation of data: time, noise, visibility."""

    out: Path = Path("runs/data_generation")
    """Folder of results.json, tables.md and noise.png."""
    meshes: Path | None = None
    """Folder of mesh files to measure beside the procedural objects."""
    parts: tuple[Literal["timing", "noise", "visibility"], ...] = ("timing", "noise", "visibility")
    """What to measure."""
    envmap: Path | None = None
    """Environment map (default: the procedural room)."""
    timed_objects: int = 8
    """Objects of each kind (procedural, meshes) whose making is timed."""
    noise_objects: int = 4
    """Objects of each kind whose noise is measured, in two views each."""
    visibility_objects: int = 50
    """Objects of each kind on which the visibility rules are compared."""
    views: int = 10
    """Views per object where time and visibility are measured."""
    resolutions: tuple[int, ...] = (128, 200)
    """Image sizes that are timed; the first one serves noise and visibility."""
    spp: int = 256
    """Samples per pixel that are timed."""
    seed: int = 0
    """Seed of objects, viewpoints and noise."""


def main(options: DataGeneration) -> None:
    """Measures the parts asked for and writes results.json, tables.md and noise.png."""
    place = options.out / "results.json"
    results = json.loads(place.read_text()) if place.is_file() else {}
    measure: dict[str, Callable] = {"timing": measure_timing, "noise": measure_noise, "visibility": measure_visibility}
    for part in options.parts:
        results[part] = measure[part](options)
        write_whole(place, layout.json_text(results).encode())
    if "noise" in results:
        plot_noise(options.out / "noise.png", results["noise"])
    tables = "\n".join(line for part in measure if part in results for line in TABLES[part](results[part]))
    write_whole(options.out / "tables.md", f"{tables}\n".encode())
    print(tables)


def tasks_of(options: DataGeneration, count: int) -> dict[str, list[Task]]:
    """Return `count` objects of each kind: procedural ones in turn, mesh files spread over the folder."""
    kinds = {"procedural": plan_objects(GenerateConfig(out=options.out, objects=count))}
    if options.meshes:
        found = plan_objects(GenerateConfig(out=options.out, meshes=options.meshes))
        kinds["meshes"] = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, count).round().astype(int))]
    return kinds


def light_for(options: DataGeneration, variant: str) -> np.ndarray:
    """Return the scaled environment map; the variant is set in this process."""
    return make_light(GenerateConfig(out=options.out, envmap=options.envmap), variant)


def load(task: Task, seed: int) -> Asset | None:
    """Return the normalised object of a task, or None if it cannot be used."""
    try:
        return surface_points.normalise(load_asset(task, seed))[0]
    except RejectedAsset as reason:
        tqdm.write(f"left out {task.object_id}: {reason}", file=sys.stderr)
        return None


def measure_timing(options: DataGeneration) -> list[dict]:
    """Return a row for each variant, kind and resolution: objects per hour, and mean seconds per object by phase."""
    workers = os.cpu_count() or 1
    fastest, _ = choose_variant()
    rows = []
    for variant in dict.fromkeys((SCALAR, fastest)):
        with worker_pool(1, variant) as pool:  # one process has one variant
            envmap = pool.submit(light_for, options, variant).result()
        for kind, tasks in tasks_of(options, options.timed_objects).items():
            for resolution in options.resolutions:
                view = views.ViewConfig(resolution=resolution, views=options.views, spp=options.spp)
                seconds, span = time_objects(tasks, envmap, view, variant, workers, options.seed)
                rows.append(
                    {
                        "variant": variant,
                        "kind": kind,
                        "resolution": resolution,
                        "spp": options.spp,
                        "views": options.views,
                        "workers": workers,
                        "objects": len(seconds),
                        "objects_per_hour": 3600 * len(seconds) / span,
                        "seconds": {phase: float(np.mean([row[phase] for row in seconds])) for phase in PHASES},
                    }
                )
    return rows


def measure_noise(options: DataGeneration) -> dict:
    """Return PSNR in dB by samples per pixel, over all pixels and over the object's: median and 10th percentile."""
    variant, _ = choose_variant()
    envmap = light_for(options, variant)
    config = views.ViewConfig(resolution=options.resolutions[0])
    tasks = [task for tasks in tasks_of(options, options.noise_objects).values() for task in tasks]
    whole: list[list[float]] = []
    covered: list[list[float]] = []
    with threads(os.cpu_count() or 1):
        for task in tqdm(tasks, desc="noise", file=sys.stderr):
            asset = load(task, options.seed)
            if asset is None:
                continue
            scene = views.build_scene(asset, envmap)
            rng = np.random.default_rng(object_seeds(options.seed, task.object_id)["viewpoints"])
            for pose in views.random_viewpoints(2, config.distance, rng):
                reference = rendered(scene, pose, config, REFERENCE_SAMPLES, first_seed=1000)
                tries = [rendered(scene, pose, config, samples, first_seed=samples) for samples in SAMPLES]
                there = reference[..., 3] > 0
                target = views.on_white(views.straight_srgb(reference))
                pictures = [views.on_white(views.straight_srgb(picture)) for picture in tries]
                whole.append([psnr(picture, target) for picture in pictures])
                covered.append([psnr(picture[there], target[there]) for picture in pictures])
    rows = [
        {
            "spp": samples,
            "median": float(np.median(np.array(whole)[:, i])),
            "percentile_10": float(np.percentile(np.array(whole)[:, i], 10)),
            "object_median": float(np.median(np.array(covered)[:, i])),
            "object_percentile_10": float(np.percentile(np.array(covered)[:, i], 10)),
        }
        for i, samples in enumerate(SAMPLES)
    ]
    enough = next((row["spp"] for row in rows if row["median"] >= TARGET), None)
    shared = {"variant": variant, "resolution": config.resolution, "pictures": len(whole), "target": TARGET}
    return {**shared, "smallest_spp": enough, "rows": rows}


def rendered(scene, pose: np.ndarray, config: views.ViewConfig, samples: int, first_seed: int) -> np.ndarray:
    """Return a picture (height, width, 4) of so many samples per pixel, as `views.render_view` makes it."""
    rounds = max(1, samples // AT_ONCE)
    config = replace(config, spp=samples // rounds)
    return np.mean([views.render_view(scene, pose, config, first_seed + number) for number in range(rounds)], axis=0)


def measure_visibility(options: DataGeneration) -> list[dict]:
    """Return a row for each kind: shares of the condition pixels by face that the rule by point drops, and adds."""
    variant, _ = choose_variant()
    mitsuba_module(variant)
    rows = []
    for kind, tasks in tasks_of(options, options.visibility_objects).items():
        shares = []
        for task in tqdm(tasks, desc=f"visibility, {kind}", file=sys.stderr):
            asset = load(task, options.seed)
            if asset is not None:
                shares.append(compare_rules(asset, task.object_id, options))
        dropped, added = np.array(shares).T
        rows.append(
            {
                "kind": kind,
                "objects": len(shares),
                "views": options.views,
                "resolution": options.resolutions[0],
                "dropped_mean": float(dropped.mean()),
                "dropped_median": float(np.median(dropped)),
                "dropped_percentile_90": float(np.percentile(dropped, 90)),
                "added_mean": float(added.mean()),
            }
        )
    return rows


def compare_rules(asset: Asset, object_id: str, options: DataGeneration) -> tuple[float, float]:
    """Return the shares of an object's condition pixels by face that the rule by point drops and adds, of all views."""
    seeds = object_seeds(options.seed, object_id)
    surface = surface_points.sample_surface(asset, 4096, seeds["points"])
    scene = views.build_scene(asset, np.ones((2, 4, 3), np.float32))
    rng = np.random.default_rng(seeds["viewpoints"])
    config = views.ViewConfig(resolution=options.resolutions[0])
    blank = np.zeros((config.resolution, config.resolution, 4), np.uint8)
    total = dropped = added = 0
    for number, pose in enumerate(views.random_viewpoints(options.views, config.distance, rng)):
        pixels = views.project(pose, surface.positions.astype(np.float64), config)
        by_face, by_point = (
            views.condition_image(blank, pixels[views.visible_points(scene, surface, pose, rule, number)])[..., 3] > 0
            for rule in (replace(config, visibility="face"), replace(config, visibility="point"))
        )
        total += by_face.sum()
        dropped += (by_face & ~by_point).sum()
        added += (by_point & ~by_face).sum()
    return dropped / total, added / total


def plot_noise(path: Path, noise: dict) -> None:
    """Write the curves of PSNR over samples per pixel."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    samples = [row["spp"] for row in noise["rows"]]
    curves = (("", "all pixels", "C0"), ("object_", "the object's pixels", "C1"))
    for prefix, label, color in curves:
        axes.plot(samples, [row[f"{prefix}median"] for row in noise["rows"]], "o-", color=color, label=label)
        low = [row[f"{prefix}percentile_10"] for row in noise["rows"]]
        axes.plot(samples, low, "o:", color=color, label=f"{label}, 10th percentile")
    axes.axhline(noise["target"], color="0.5", linewidth=1)
    axes.annotate("target", (samples[0], noise["target"]), xytext=(0, 3), textcoords="offset points", color="0.4")
    axes.set_xscale("log", base=2)
    axes.set_xticks(samples, [str(count) for count in samples])
    axes.set_xlabel("samples per pixel")
    axes.set_ylabel(f"PSNR against {REFERENCE_SAMPLES} samples (dB)")
    axes.set_title(f"{noise['pictures']} pictures of {noise['resolution']} px")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def timing_table(rows: list[dict]) -> list[str]:
    """Return Markdown lines: speed, and each phase's share of an object's time."""
    heads = ["variant", "kind", "px", "spp", "objects", "objects/hour", "s/object", *(f"{phase} %" for phase in PHASES)]
    body = []
    for row in rows:
        total = sum(row["seconds"].values())
        shares = [f"{100 * row['seconds'][phase] / total:.1f}" for phase in PHASES]
        facts = [row["variant"], row["kind"], row["resolution"], row["spp"], row["objects"]]
        body.append([*facts, f"{row['objects_per_hour']:.0f}", f"{total:.2f}", *shares])
    title = f"Speed: {rows[0]['views']} views per object, {rows[0]['workers']} workers"
    return markdown(title, heads, body)


def noise_table(noise: dict) -> list[str]:
    """Return Markdown lines: PSNR by samples per pixel."""
    heads = ["spp", "median dB", "10th percentile", "object's pixels: median dB", "10th percentile"]
    names = ("median", "percentile_10", "object_median", "object_percentile_10")
    body = [[row["spp"], *(f"{row[name]:.1f}" for name in names)] for row in noise["rows"]]
    enough = noise["smallest_spp"] or f"none up to {SAMPLES[-1]}"
    title = f"Noise: {noise['pictures']} pictures of {noise['resolution']} px; {noise['target']:g} dB median: {enough}"
    return markdown(title, heads, body)


def visibility_table(rows: list[dict]) -> list[str]:
    """Return Markdown lines: shares of condition pixels on which the two rules differ."""
    heads = ["kind", "objects", "views", "px", "dropped: mean %", "median %", "90th percentile %", "added: mean %"]
    names = ("dropped_mean", "dropped_median", "dropped_percentile_90", "added_mean")
    facts = ("kind", "objects", "views", "resolution")
    body = [[*(row[fact] for fact in facts), *(f"{100 * row[name]:.2f}" for name in names)] for row in rows]
    return markdown("Visibility: condition pixels by face that the rule by point drops or adds", heads, body)


def markdown(title: str, heads: list[str], body: list[list]) -> list[str]:
    """Return the lines of a titled Markdown table."""
    rows = [heads, ["---"] * len(heads), *body]
    return [title, "", *("| " + " | ".join(map(str, row)) + " |" for row in rows), ""]


TABLES: dict[str, Callable] = {"timing": timing_table, "noise": noise_table, "visibility": visibility_table}


if __name__ == "__main__":
    options = tyro.cli(DataGeneration, prog="python -m experiments.data_generation")
    sys.exit(cli.guarded(lambda: main(options), "data_generation"))
