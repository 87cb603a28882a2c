"""How fast objects are made, where the time goes, and how many samples a picture needs.

    python -m experiments.speed.data_generation [--out runs/data_generation] [--meshes DIR]

Objects are made one after another here, as workers of `spnr-data generate` make them, under Python's profiler; N idle
cores make N times as many.  Noise: PSNR against 4096 samples a pixel (a mean of pictures of 256), 8-bit sRGB on white.
"""

import cProfile
import pstats
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_gen.make.generate import make_lights
from data_gen.make.objects import Workbench, load_asset, make_and_write, object_seeds
from data_gen.plan.tasks import GenerateConfig, Task, plan_objects
from data_gen.render import views
from data_gen.render.light import Lights
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments import entry_point
from experiments.comparison import results_folder
from spnr_jax.devices import machine
from spnr_jax.formats.mesh import surface_points
from spnr_jax.scoring.report import psnr
from spnr_jax.scoring.score_tables import Table, number

PHASES = {  # functions whose cumulative time is a phase; the rest is "other"
    "load": ("load_asset",),
    "points": ("normalise", "sample_surface"),
    "scene": ("mitsuba_shapes", "lit_scene"),
    "render": ("render_view",),
    "visibility": ("visible_points",),
    "encode and write": ("straight_srgb", "condition_image", "write_object"),
}
SAMPLES = (16, 32, 64, 128, 256, 512, 1024)
REFERENCE_SAMPLES, AT_ONCE = 4096, 256  # of a pixel, the second in one call of the renderer


@dataclass(frozen=True, kw_only=True)
class DataGeneration:
    """Measure the generation of data: time and noise."""

    out: Path = Path("runs/data_generation")
    """Folder of the results."""
    meshes: Path | None = None
    """Folder of mesh files to measure beside the procedural objects."""
    objects: int = 8
    """Objects of each kind (procedural, meshes); the noise is measured on half as many."""
    resolution: int = 128
    """Image size."""
    spp: int = 256
    """Samples per pixel that are timed."""


def main(options: DataGeneration) -> None:
    """Measures, and writes both tables."""
    kinds = {"procedural": plan_objects(GenerateConfig(out=options.out, objects=options.objects))}
    if options.meshes:
        found = plan_objects(GenerateConfig(out=options.out, meshes=options.meshes))
        kinds["meshes"] = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, options.objects).astype(int))]
    variant, _ = choose_variant()
    mitsuba_module(variant)
    light = make_lights(GenerateConfig(out=options.out), variant)
    seconds = {kind: timed(tasks, light, variant, options) for kind, tasks in kinds.items()}
    noise = measured_noise([t for tasks in kinds.values() for t in tasks[::2]], light, options.resolution)
    heads = ("objects an hour and core", *(f"{phase}, %" for phase in (*PHASES, "other")))
    rows = tuple((kind, speeds(row)) for kind, row in seconds.items())
    tables = [Table(title=f"Speed, 10 views of {options.resolution} px, {options.spp} samples", heads=heads, rows=rows)]
    rows = tuple((f"{samples} samples", (number(a, 1), number(b, 1))) for samples, (a, b) in noise.items())
    tables.append(Table(title="Noise", heads=("median, dB", "10th percentile, dB"), rows=rows))
    facts = {"hardware": machine.hardware(), "variant": variant, "seconds": seconds, "noise": noise}
    results_folder.write(options.out, facts, tables, [f"{variant}, {facts['hardware']}"])


def speeds(seconds: dict[str, float]) -> tuple:
    """Objects an hour, and the share of each phase."""
    whole = sum(seconds.values())
    return (number(3600 / whole, 0), *(number(s / whole, 1, factor=100) for s in seconds.values()))


def timed(tasks: list[Task], light: Lights, variant: str, options: DataGeneration) -> dict[str, float]:
    """Mean seconds of an object by phase."""
    view, profiler = views.ViewConfig(resolution=options.resolution, spp=options.spp), cProfile.Profile()
    with tempfile.TemporaryDirectory() as folder:
        bench = Workbench(out=folder, lights=light, view=view, num_points=4096, seed=0, variant=variant)
        start = time.perf_counter()
        made = sum(profiler.runcall(make_and_write, bench, task) is None for task in tasks)
        whole = time.perf_counter() - start
    calls: dict[str, float] = {}
    for (_, _, name), (*_, cumulative, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        calls[name] = calls.get(name, 0.0) + cumulative
    found = {phase: sum(calls.get(name, 0.0) for name in names) / max(made, 1) for phase, names in PHASES.items()}
    return found | {"other": max(whole / max(made, 1) - sum(found.values()), 0.0)}


def measured_noise(tasks: list[Task], light: Lights, resolution: int) -> dict[int, tuple[float, float]]:
    """Median and 10th percentile of the PSNR by samples per pixel, two views an object."""
    config, scores = views.ViewConfig(resolution=resolution), []
    for task in tasks:
        scene = views.build_scene(surface_points.normalise(load_asset(task, 0))[0], next(light.of_views(1, 0)))
        rng = np.random.default_rng(object_seeds(0, task.object_id)["viewpoints"])
        for pose in views.random_viewpoints(2, config.distance, rng):
            reference = picture(scene, pose, config, REFERENCE_SAMPLES, first_seed=1000)
            scores.append([psnr(picture(scene, pose, config, n, first_seed=n), reference) for n in SAMPLES])
    middle, low = np.percentile(scores, [50, 10], axis=0)
    return {n: (float(a), float(b)) for n, a, b in zip(SAMPLES, middle, low, strict=True)}


def picture(scene, pose: np.ndarray, config: views.ViewConfig, samples: int, first_seed: int) -> np.ndarray:
    """A picture (height, width, 3) of so many samples per pixel, as a data set would hold it."""
    rounds = max(1, samples // AT_ONCE)
    few = replace(config, spp=samples // rounds)
    found = [views.render_view(scene, pose, few, first_seed + i) for i in range(rounds)]
    return views.on_white(views.straight_srgb(np.mean(found, axis=0)))


if __name__ == "__main__":
    entry_point.run(main, DataGeneration, "speed.data_generation")
