"""Where the time of a training step and of a film frame goes, the machine's limit, and how cost grows with the work.

    python -m experiments.speed.where_time_goes [--out runs/where_time_goes] [--points 4096] [--size 512] [--quick]

The programs that a step of the surfel network and a frame of it are made of are timed alone, in turns; beside each
stand the operations that the compiler counts in it (`cost_analysis`) and how long they would take at the pace of a
product of matrices, which is measured in the same turns.  On a CPU time is that of the processor, all threads added up,
so that other work on the machine changes little.  Weights are fresh: no time depends on them.

The paper's network (`tiny`, one object, one view, 1,024 points) is given more and more work along one axis at a time.
Cost that is linear in the work has slope 1 on a log-log plot, less where something that does not grow takes a part; the
table has the slope of a line through all values, and that of the last step, where the rest weighs least.

    OUT/results.json  table.md
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import clock, results_folder
from experiments.speed import bench
from experiments.speed.speed_scenes import orbiting, random_crops, surfel_training, surfel_volume
from spnr_jax import cli
from spnr_jax.config import PaperConfig, SurfelConfig, TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import at_least
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Batch, Camera, Light
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.nn.shader import Shader
from spnr_jax.scoring.report import Table, number, text
from spnr_jax.surfels import splatting
from spnr_jax.surfels.lighting import room_light
from spnr_jax.training import gbuffers, optimisation

SIDE = 1024  # of the matrices whose product is the machine's pace


@dataclass(frozen=True, kw_only=True)
class WhereTimeGoes:
    """Time the programs of a training step and of a film frame, beside the machine's limit."""

    out: Path = Path("runs/where_time_goes")
    """Folder of the results."""
    points: int = 4096
    """Points of the object that is drawn."""
    size: int = 512
    """Pixels along each side of a frame."""
    doublings: int = 1
    """Of the crops of the training step: 0 to 4, most steps have 0 to 2."""
    rounds: int = 9
    """Turns of each program."""
    only: tuple[Literal["points", "volume", "image", "samples", "views", "objects"], ...] = ()
    """Axes along which work grows (default: all)."""
    quick: bool = False
    """A check that everything works: a few points and pixels, two turns."""

    def __post_init__(self) -> None:
        at_least(self, 1, "points", "size", "rounds")


class Program(NamedTuple):
    """What to run, and the operations that are counted in it (None where it is not one program)."""

    run: Callable[[], object]
    operations: float | None


def main(options: WhereTimeGoes) -> None:
    """Times both and the growth of cost, and writes a table of each."""
    cli.set_up_jax()
    if options.quick:
        options = dataclasses.replace(options, points=256, size=64, rounds=2)
    parts = {"a training step": step_programs(options), f"a frame of {options.size} px": frame_programs(options)}
    found: dict[str, Any] = {"hardware": runtime.hardware(), "processor": runtime.processor(), "load": runtime.load()}
    tables = []
    for name, programs in parts.items():
        found[name], shown = time_views(programs, options.rounds), name[0].upper() + name[1:]
        tables.append(table(shown, programs, found[name]))
    found["growth"] = {name: measure_growth(name, options) for name in options.only or AXES}
    tables.append(growth_table(found["growth"]))
    sizes = f"{options.points} points, {options.size} px, crops of {options.doublings} doublings"
    results_folder.write(options.out, found, tables, [f"{sizes}; {found['processor']}, load {found['load']}."])


def program(function: Callable, *arguments: Any, **static: Any) -> Program:
    """The function compiled for these arguments; one that is jitted keeps its compiler's options."""
    jitted: Any = function if hasattr(function, "lower") else jax.jit(function)
    compiled = jitted.lower(*arguments, **static).compile()
    cost: Any = compiled.cost_analysis() or {}
    return Program(lambda: compiled(*arguments), cost.get("flops"))


def peak() -> Program:
    """The product of two matrices."""
    ones = jnp.ones((SIDE, SIDE))
    return Program(program(jnp.matmul, ones, ones).run, 2.0 * SIDE**3)


def step_programs(options: WhereTimeGoes) -> dict[str, Program]:
    """The training step of the preset `surfels` and what it is made of."""
    config = surfel_training(options.quick)
    state = optimisation.jitted_create_state(config)
    crops = random_crops(config, options.doublings)
    assert isinstance(config.model, SurfelConfig)
    shader = Shader(config.model.widths, config.model.top)

    def loss(params: dict, crops: Any) -> Any:
        return gbuffers.loss({"params": params}, crops, config=config)

    def network(params: dict, seen: jax.Array) -> Any:
        return shader.apply({"params": params}, seen, options.doublings)

    def network_gradient(params: dict, seen: jax.Array) -> Any:
        return jax.grad(lambda params: jnp.sum(network(params, seen)))(params)

    return {
        "whole step": program(partial(optimisation.train_step, config=config), state, crops),
        "loss and its gradient": program(lambda p, c: jax.grad(loss, has_aux=True)(p, c)[0], state.generator, crops),
        "loss alone": program(lambda p, c: loss(p, c)[0], state.generator, crops),
        "network and its gradient": program(network_gradient, state.generator, crops.seen),
        "network alone": program(network, state.generator, crops.seen),
        "product of matrices": peak(),
    }


def frame_programs(options: WhereTimeGoes) -> dict[str, Program]:
    """A frame as the handle draws it, and its programs alone."""
    config = SurfelConfig(image_resolution=options.size)
    variables, light = surfel_method.init(jax.random.key(0), config), room_light()
    volume, camera = surfel_volume(options.points), orbiting(options.size)
    scene, draw = volume.scene, partial(surfel_method.render, config=config, quality="best")
    doublings, side = surfel_renderer.resolution(scene, camera)
    plan = surfel_renderer.plan(scene, camera)
    count = partial(surfel_renderer.count_sizes, doublings=doublings, side=side)
    window = surfel_renderer.scale_camera(camera, doublings, side)
    found = jax.jit(splatting.entries, static_argnames="room")(scene.surfels, window, room=plan.entries)[0]
    blended = jax.jit(surfel_renderer.blend_window, static_argnames="plan")(scene, camera, light, plan=plan)

    def blend(found: splatting.Entries, light: Light) -> object:
        return surfel_renderer.blend_entries(found, scene.surfels, light, window, slots=plan.slots)

    return {
        "whole frame": Program(lambda: next(draw(variables, volume, [camera], [light])).image, None),
        "sizes counted": program(count, scene, camera),
        "entries made and sorted": program(partial(splatting.entries, room=plan.entries), scene.surfels, window),
        "blended, lit": program(blend, found, light),
        "network, light on materials": program(
            partial(surfel_renderer.shade_window, plan=plan), variables, scene, camera, light, blended
        ),
        "product of matrices": peak(),
    }


def time_views(programs: Mapping[str, Program], rounds: int) -> dict[str, float]:
    """Milliseconds of each, the median of turns; those of the processor on a CPU."""
    taken = clock.in_turns({name: one.run for name, one in programs.items()}, rounds)
    return {name: 1e3 * float(np.median(seconds)) for name, seconds in taken.items()}


def table(title: str, programs: Mapping[str, Program], taken: Mapping[str, float]) -> Table:
    """A row for each program: its time, its share of the whole, its operations, and the machine's limit for them."""
    whole, *_, last = taken
    pace = 2.0 * SIDE**3 / taken[last]  # operations a millisecond
    rows = []
    for name, one in programs.items():
        count, ms = one.operations, taken[name]
        limit = None if count is None else count / pace
        cells = (number(ms, 1), number(ms / taken[whole], 2))
        counted = (number(None if count is None else 1e-9 * count, 3, missing="-"), number(limit, 1, missing="-"))
        rows.append((name, (*cells, *counted, number(None if limit is None else limit / ms, 2, missing="-"))))
    heads = ("ms", "of the whole", "10^9 operations", "ms at the pace of a product", "of that pace")
    return Table(title=title, heads=heads, rows=tuple(rows))


class Axis(NamedTuple):
    """`change` makes network and inputs of a value; the work grows with the value to this power."""

    mode: bench.Mode
    values: tuple[int, ...]
    power: int
    change: Callable[[TrainConfig, int], TrainConfig]
    """The training with so much more of it."""
    widen: Callable[[Camera, int], Camera] = lambda camera, _: camera
    """The cameras with so many more views or pixels, by the same network."""

    def case(self, config: TrainConfig, value: int) -> tuple[TrainConfig, Batch]:
        """Network and inputs."""
        config = self.change(config, value)
        batch = bench.our_batch(config)
        return config, dataclasses.replace(batch, camera=self.widen(batch.camera, value))


def with_model(config: TrainConfig, **changes: Any) -> TrainConfig:
    """A training of another network."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **changes))


def with_volume(config: TrainConfig, resolution: int) -> TrainConfig:
    """Volumes of so many voxels along each side."""
    assert isinstance(config.model, PaperConfig)
    return with_model(config, encoder=dataclasses.replace(config.model.encoder, volume_resolution=resolution))


def with_samples(config: TrainConfig, count: int) -> TrainConfig:
    """So many samples on each ray, half of them coarse."""
    assert isinstance(config.model, PaperConfig)
    half = {"num_coarse": count // 2, "num_fine": count // 2}
    return with_model(config, sampling=dataclasses.replace(config.model.sampling, **half))


def same(config: TrainConfig, _: int) -> TrainConfig:
    """The training as it is."""
    return config


def repeat(camera: Camera, count: int) -> Camera:
    """So many cameras for each object."""
    return jax.tree.map(lambda x: jnp.repeat(x, count, 1), camera)


POWERS = tuple(2**i for i in range(21))
AXES = {
    "points": Axis("encode", POWERS[9::3], 1, lambda c, n: dataclasses.replace(c, min_points=n, max_points=n)),
    "volume": Axis("encode", POWERS[5:8], 3, with_volume),
    "image": Axis("render", POWERS[6:11], 2, same, lambda camera, size: cameras.resize(camera, size, size)),
    "samples": Axis("render", POWERS[4:8], 1, with_samples),
    "views": Axis("render", POWERS[:5], 1, same, repeat),
    "objects": Axis("train_l1", POWERS[:5], 1, lambda c, n: dataclasses.replace(c, batch_objects=n)),
}


def measure_growth(name: str, options: WhereTimeGoes) -> dict[str, Any]:
    """Least milliseconds at each value of an axis, and the slopes that follow."""
    axis = AXES[name]
    values = axis.values[:2] if options.quick else axis.values
    cases = [axis.case(bench.our_config("tiny", "train_l1"), value) for value in values]
    runs = [bench.function(config, batch, axis.mode) for config, batch in cases]
    ms = [1e3 * min(clock.in_turns({name: run}, options.rounds)[name]) for run in runs]
    slope, last = slopes([value**axis.power for value in values], ms)
    return {"mode": axis.mode, "ms": dict(zip(map(str, values), ms, strict=True)), "slope": slope, "last_slope": last}


def slopes(work: Sequence[float], ms: Sequence[float]) -> tuple[float, float]:
    """Slope of the log-log line through all points, and between the last two."""
    x, y = np.log(work), np.log(ms)
    return float(np.polyfit(x, y, 1)[0]), float((y[-1] - y[-2]) / (x[-1] - x[-2]))


def growth_table(found: Mapping[str, Mapping]) -> Table:
    """The milliseconds of each axis and its slopes."""
    rows = []
    for name, row in found.items():
        label = f"{name}, to the power of {AXES[name].power}" if AXES[name].power > 1 else name
        times = ", ".join(f"{value}: {ms:.1f}" for value, ms in row["ms"].items())
        rows.append((label, (text(row["mode"]), text(times), number(row["slope"], 2), number(row["last_slope"], 2))))
    heads = ("mode", "value: ms", "slope", "of the last step")
    return Table(title="Milliseconds along each axis", heads=heads, rows=tuple(rows))


if __name__ == "__main__":
    entry_point.run(main, WhereTimeGoes, "speed.where_time_goes")
