"""Where the time of an object goes: the functions that generation calls, each with a clock around it.

Objects are made by worker processes, one per core, as in generation, into a folder that is thrown away.
"""

import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from unittest import mock

import numpy as np
from tqdm import tqdm

from data_gen import procedural
from data_gen.make.objects import Workbench, make_and_write
from data_gen.plan.tasks import Task
from data_gen.render import views
from data_gen.render.variant import mitsuba_module
from data_gen.store import layout
from spnr_jax.formats.mesh import meshes, surface_points

# the functions of each phase; the rest of an object's time is "other"
CALLS = (
    ("load", meshes, "load_mesh"),
    ("load", procedural, "make"),
    ("points", surface_points, "normalise"),
    ("points", surface_points, "sample_surface"),
    ("scene", views, "build_scene"),
    ("render", views, "render_view"),
    ("visibility", views, "visible_points"),
    ("encode", views, "straight_srgb"),
    ("encode", views, "condition_image"),
    ("write", layout, "write_object"),
)
PHASES = (*dict.fromkeys(phase for phase, _, _ in CALLS), "other")


def worker_pool(workers: int, variant: str) -> ProcessPoolExecutor:
    """Return processes that are ready to render with the variant."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=spawn, initializer=mitsuba_module, initargs=(variant,))


def time_objects(
    tasks: list[Task], envmap: np.ndarray, view: views.ViewConfig, variant: str, workers: int, seed: int
) -> tuple[list[dict[str, float]], float]:
    """Return the seconds of each object by phase, and those of all together, with every worker busy to the end."""
    with tempfile.TemporaryDirectory() as folder, worker_pool(workers, variant) as pool:
        bench = Workbench(out=folder, envmap=envmap, view=view, num_points=4096, seed=seed, variant=variant)
        label = f"{variant} {view.resolution} px"
        timed = list(tqdm(pool.map(partial(time_object, bench), tasks), total=len(tasks), desc=label, file=sys.stderr))
    made = [seconds for seconds in timed if seconds is not None]
    if not made:
        raise ValueError("timing: every object was left out; give other --meshes")
    # the sum and not the clock: with few objects the last one keeps one worker busy while the others wait
    return made, sum(sum(seconds.values()) for seconds in made) / workers


def time_object(bench: Workbench, task: Task) -> dict[str, float] | None:
    """Make an object as a worker does; return its seconds by phase, or None if it was left out."""
    start = time.perf_counter()
    with timed_calls() as seconds:
        left_out = make_and_write(bench, task)
    seconds["other"] = time.perf_counter() - start - sum(seconds.values())
    return None if left_out else seconds


@contextmanager
def timed_calls() -> Iterator[dict[str, float]]:
    """Yield the seconds of each phase, which grow as the functions of CALLS are called."""
    seconds = dict.fromkeys(PHASES, 0.0)

    def timed(phase: str, function: Callable) -> Callable:
        def call(*arguments, **options):
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                seconds[phase] += time.perf_counter() - start

        return call

    with ExitStack() as stack:
        for phase, module, name in CALLS:
            stack.enter_context(mock.patch.object(module, name, timed(phase, getattr(module, name))))
        yield seconds
