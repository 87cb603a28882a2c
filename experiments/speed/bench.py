"""How fast the paper's network is beside a PyTorch twin of the same sizes, in one process.

    python -m experiments.speed.bench [--out runs/bench] [--presets ...] [--modes ...] [--rounds N] [--quick]

Both are called in turn on the same cores (ours, twin, ours, twin ...); the ratio is the median over the rounds of
ours / twin, each the median of its turn, so that a slow minute of the machine slows both.  That both are the same
network the tests say: with the same weights both give the outputs of one fixture (tests/support/twin_fixture.npz).

    OUT/rows/*.json  results.json  table.md   rows that are there are kept: take another OUT for other code
"""

import dataclasses
import importlib.util
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments import entry_point
from experiments.comparison import results_folder
from spnr_jax.config import EncoderConfig, LossConfig, OptimizerConfig, PaperConfig, SamplingConfig, TrainConfig
from spnr_jax.devices import runtime
from spnr_jax.errors import require_at_least
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Batch, Camera, PointCloud
from spnr_jax.method import inference
from spnr_jax.scoring.report import Table, number, text
from spnr_jax.training import optimisation

Mode = Literal["train", "train_l1", "encode", "render"]
Run = Callable[[], object]
Row = dict[str, Any]

BATCHES = {"tiny": 2, "small": 2, "abo": 1}  # objects of a batch, one view of each
FEWEST = 3  # timed runs of a turn
WARM_UP = 8  # torch.compile and oneDNN settle later


@dataclass(frozen=True, kw_only=True)
class Options:
    """Time the network beside its PyTorch twin; write a table."""

    out: Path = Path("runs/bench")
    """Folder of the results; the same command goes on there."""
    presets: tuple[Literal["tiny", "small", "abo"], ...] = ("tiny", "small", "abo")
    """Sizes."""
    modes: tuple[Mode, ...] = ("train", "train_l1", "encode", "render")
    """One step with and without the discriminator, points to volume, volume to image."""
    variants: tuple[Literal["plain", "compiled"], ...] = ("plain", "compiled")
    """Of the twin: as a user writes it, and that under torch.compile."""
    rounds: int = 12
    """Turns of each side in a row."""
    seconds: float = 0.5
    """Length of a turn; at least three runs."""
    threads: int = 2
    """Cores that both sides are held to."""
    quick: bool = False
    """A check that everything works: tiny, two rounds, short turns, into OUT-quick."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "rounds", "threads")


def main(options: Options) -> None:
    """Measures what is not yet measured, a line for each row."""
    if options.quick:
        out = options.out.with_name(f"{options.out.name}-quick")
        options = dataclasses.replace(options, out=out, presets=("tiny",), rounds=2, seconds=0.1)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    jax.config.update("jax_enable_compilation_cache", False)  # what compiling takes is measured
    load, rows = runtime.measure_load(), rows_of(options)
    note = f"{runtime.describe_hardware()}, load before {load}; {time.strftime('%Y-%m-%d')}"
    results_folder.write(options.out, {"rows": rows}, [table(rows)], [note])


def rows_of(options: Options) -> list[Row]:
    """All rows of these options; those that were missing are measured now."""
    asked = {name: getattr(options, name) for name in ("rounds", "seconds", "threads")}
    results_folder.claim(options.out, "times beside the twin", asked | {"hardware": runtime.describe_hardware()})
    variants: tuple[str | None, ...] = options.variants
    if importlib.util.find_spec("torch") is None:
        print("torch is not installed (pip install -c constraints.txt -e '.[bench]'): ours is timed alone")
        variants = (None,)
    rows = []
    for preset in options.presets:
        for mode in options.modes:
            ours = cache(partial(our_side, preset, mode))
            for variant in variants:
                place = options.out / "rows" / f"{preset}_{mode}_{variant}.json"
                rows.append(results_folder.load_or_make(place, partial(measure, preset, mode, variant, ours, options)))
                print({name: rows[-1][name] for name in ("preset", "mode", "twin_variant", "ours_ms", "twin_ms")})
            jax.clear_caches()
    return rows


def measure(preset: str, mode: Mode, variant: str | None, ours: Callable, options: Options) -> Row:
    """A row: both sides in turns, ours alone without a variant of the twin."""
    run, compile_s = ours()
    theirs = None if variant is None else twin_side(preset, mode, variant, options)
    turns = [
        (turn(run, options.seconds), turn(theirs, options.seconds) if theirs else []) for _ in range(options.rounds)
    ]
    row: Row = {"preset": preset, "batch": BATCHES[preset], "mode": mode, "twin_variant": variant}
    row |= {"ours_ms": statistics.median(ms for of, _ in turns for ms in of), "compile_s": compile_s}
    if theirs is None:
        return row | {"twin_ms": None, "ratio": None}
    return row | {"twin_ms": statistics.median(ms for _, of in turns for ms in of), "ratio": paired_ratio(turns)}


def paired_ratio(turns: Sequence[tuple[Sequence[float], Sequence[float]]]) -> list[float]:
    """Quartiles over the rounds of the ratio of the medians of a turn of each side."""
    ratios = [statistics.median(ours) / statistics.median(theirs) for ours, theirs in turns]
    return np.quantile(ratios, (0.25, 0.5, 0.75)).tolist()


def turn(run: Run, seconds: float) -> list[float]:
    """Milliseconds of each run until so many seconds are full; one run before them refills the caches."""
    run()
    taken: list[float] = []
    while len(taken) < FEWEST or sum(taken) < 1e3 * seconds:
        start = time.perf_counter()
        run()
        taken.append(1e3 * (time.perf_counter() - start))
    return taken


def our_config(preset: str, mode: Mode = "train", objects: int = 1) -> TrainConfig:
    """Our config of the twin's sizes, without R1; "train_l1" has no discriminator."""
    config = PAPER[preset]
    loss = dataclasses.replace(config.loss, adversarial_weight=float(mode != "train_l1"))
    return dataclasses.replace(config, loss=loss, batch_objects=objects)


jitted_encode = jax.jit(inference.encode, static_argnames="config")
jitted_render = jax.jit(inference.render, static_argnames="config")


def our_side(preset: str, mode: Mode) -> tuple[Run, float]:
    """What to time, and the seconds that its compilation took."""
    config = our_config(preset, mode, BATCHES[preset])
    arrays = make_arrays(config.batch_objects, config.model.image_resolution, config.max_points)
    run, start = function(config, jax.device_put(make_batch(arrays)), mode), time.perf_counter()
    run()
    first = time.perf_counter() - start
    return run, first - 1e-3 * min(turn(run, seconds=0))


def function(config: TrainConfig, batch: Batch, mode: Mode) -> Run:
    """One step, one encoding of the batch, or one view of each of its volumes; returns when it is done."""
    state = optimisation.jitted_create_state(config)
    if mode.startswith("train"):

        def step() -> None:
            nonlocal state
            state, metrics = optimisation.jitted_train_step(state, batch, config=config, adversarial=mode == "train")
            jax.block_until_ready((state, metrics))

        return step
    variables, cloud = optimisation.averaged_variables(state), batch.cloud
    encode = partial(jitted_encode, variables, cloud, config=config.model)
    if mode == "encode":
        return lambda: jax.block_until_ready(encode())
    draw = partial(jitted_render, variables, encode(), batch.camera, config=config.model)
    return lambda: jax.block_until_ready(draw())


def twin_side(preset: str, mode: Mode, variant: str, options: Options) -> Run:
    """The same of the twin, warm."""
    import torch

    from experiments.speed import twin

    device = "cpu" if jax.default_backend() == "cpu" else "cuda"  # where ours computes
    torch.set_num_threads(options.threads)
    torch.set_default_device(device)
    config = our_config(preset, mode)
    inputs = make_arrays(BATCHES[preset], config.model.image_resolution, config.max_points).items()
    batch = {name: torch.from_numpy(x).to(device) for name, x in inputs}
    work = twin.function(config, batch, mode, compile=variant == "compiled")

    def run() -> None:
        work()
        if device == "cuda":
            torch.cuda.synchronize()

    for _ in range(WARM_UP):
        run()
    return run


def table(rows: Sequence[Row]) -> Table:
    """Medians of milliseconds, the ratio with its quartiles over the rounds."""
    made = []
    for row in rows:
        low, middle, high = row["ratio"] or (0, None, 0)
        cells = (
            text(row["mode"]),
            text(row["twin_variant"] or "-"),
            *(number(row[name], 1, missing="-") for name in ("ours_ms", "twin_ms")),
            number(middle, 2, (low, high), missing="-"),
            number(row["compile_s"], 1),
        )
        made.append((f"{row['preset']}, batch {row['batch']}", cells))
    heads = ("mode", "twin", "ours, ms", "twin, ms", "ours / twin", "compile, s")
    return Table(title="One step, one encoding, one view", heads=heads, rows=tuple(made))


# --- what both sides draw ---------------------------------------------------------------------------------------------

SPHERE, BOX = 0.7, 0.55  # radius and half side, in the box [-1, 1]^3
DISTANCE, FOCAL = 3.2, 2.4  # of the cameras; 1 / tan of half the field of view


def paper_training(grid: int = 64, base: int = 16, stages: int = 5, samples: int = 64, render: int = 64) -> TrainConfig:
    """A training of the paper's network as the twin has it, without R1: the preset `abo` in group norms of 8."""
    encoder = EncoderConfig(point_features=32, volume_resolution=grid, base_width=base, num_stages=stages, num_groups=8)
    model = PaperConfig(
        encoder=encoder,
        field_width=64,
        num_features=32,
        direction_frequencies=4,
        sampling=SamplingConfig(num_coarse=samples, num_fine=samples, padding=1e-5),
        render_resolution=render,
        resize_resolution=render,
        image_resolution=2 * render,
        upsampler_width=64,
    )
    loss = LossConfig(l1_weight=100.0, low_resolution_weight=0.5, r1_gamma=0.0, r1_interval=1, discriminator_width=64)
    optimizer = OptimizerConfig(lr_generator=2e-4, lr_discriminator=2e-4)
    config = TrainConfig(model=model, loss=loss, optimizer=optimizer, batch_objects=1)
    return dataclasses.replace(config, min_points=1024, max_points=1024)


PAPER = {
    "abo": paper_training(),
    "small": paper_training(grid=32, stages=4, samples=32),
    "tiny": paper_training(grid=32, base=8, stages=3, samples=16, render=32),
}


def make_arrays(batch: int, size: int, num_points: int) -> dict[str, np.ndarray]:
    """A batch by the names of the PyTorch twin: spheres and boxes by turns, images (batch, channels, size, size)."""
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(batch, num_points, 3))
    sphere /= np.linalg.norm(sphere, axis=-1, keepdims=True)
    box = sphere / np.abs(sphere).max(axis=-1, keepdims=True)
    is_sphere = np.arange(batch)[:, None, None] % 2 == 0
    found = {
        "pos": np.where(is_sphere, SPHERE * sphere, BOX * box),
        "mat": rng.random((batch, num_points, 5)),
        "c2w": np.stack(
            [
                cameras.orbit(azimuth, elevation, DISTANCE, jnp.zeros(3))
                for azimuth, elevation in rng.uniform((0, -0.36), (2 * np.pi, 0.84), (batch, 2))
            ]
        ),
        "focal": np.full(batch, FOCAL),
        "target": rng.random((batch, 3, size, size)),
        "cond": rng.random((batch, 3, size, size)),
        "mask": rng.random((batch, 1, size, size)) < 0.5,
    }
    return {name: np.asarray(array, np.float32) for name, array in found.items()}


def make_batch(arrays: Mapping[str, np.ndarray]) -> Batch:
    """The batch of pos mat c2w focal target cond mask: one view of each object, every point real."""
    positions, materials = arrays["pos"], arrays["mat"]
    cloud = PointCloud(
        positions=positions,
        base_color=materials[..., :3],
        roughness=materials[..., 3],
        metallic=materials[..., 4],
        mask=np.ones(positions.shape[:2], bool),
    )
    images = {k: np.moveaxis(arrays[k], 1, -1)[:, None] for k in ("target", "cond", "mask")}
    size = images["target"].shape[-2]
    focal = arrays["focal"][:, None] * size / 2
    intrinsics = np.zeros((*focal.shape, 3, 3), np.float32)
    intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = focal
    intrinsics[..., 0, 2] = intrinsics[..., 1, 2] = size / 2
    intrinsics[..., 2, 2] = 1
    camera = Camera(cam_to_world=arrays["c2w"][:, None], intrinsics=intrinsics, height=size, width=size)
    return Batch(
        cloud=cloud,
        camera=camera,
        image=images["target"],
        alpha=np.ones_like(images["mask"][..., 0]),  # the twin has no loss of opacity
        condition=images["cond"],
        condition_mask=images["mask"][..., 0] > 0.5,
    )


if __name__ == "__main__":
    entry_point.run(main, Options, "speed.bench")
