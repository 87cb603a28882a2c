"""How fast the network is beside a PyTorch twin of the same sizes, in one run.

    python -m experiments.speed.bench [--out runs/bench] [--presets ...] [--modes ...] [--rounds N] [--quick]

Before a preset is timed, both sides render the same scene with the same weights and must agree.  Then each side lives
in its own process on the same cores, and the two are asked in turn (ours, twin, ours, twin ...) for some runs; the
ratio is the median over the rounds of ours / theirs, each the median of its turn, so that a slow minute of the machine
slows both.  "near points" is a function of ours that evaluates less (see `bench_ours`).

    OUT/rows.json  results.json  table.md  bench.png   rows.json is written after every row
"""

import dataclasses
import hashlib
import importlib.util
import json
import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments import entry_point
from experiments.comparison import results_folder
from experiments.speed import bench_report as report
from experiments.speed.bench_scene import BATCHES
from experiments.speed.worker import Worker, worker
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats.images import write_whole

Preset = Literal["tiny", "small", "abo"]
Mode = Literal["train", "train_l1", "encode", "render"]
Variant = Literal["plain", "fast", "compiled"]
Row = dict[str, Any]

VARIANTS: tuple[Variant, ...] = ("plain", "fast", "compiled")
AGREEMENT = 1e-4  # of the norm of each output, between the sides
ALONE = "none"  # the variant of a row without the twin
OURS, TWIN = "experiments.speed.ours", "experiments.speed.theirs"
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Time the network beside its PyTorch twin; write the rows, a table and a plot."""

    out: Path = Path("runs/bench")
    """Folder of the results; a rerun keeps the rows whose code and options are the same."""
    presets: tuple[Preset, ...] = ("tiny", "small", "abo")
    """Sizes."""
    modes: tuple[Mode, ...] = ("train", "train_l1", "encode", "render")
    """One step with and without the discriminator, points to volume, volume to image."""
    variants: tuple[Variant, ...] = VARIANTS
    """Of the twin: as a user writes it, tuned, tuned and compiled."""
    rounds: int = 12
    """Turns of each side in a row."""
    seconds: float = 0.5
    """Length of a turn; at least three runs."""
    threads: int = 2
    """Cores that both sides are held to."""
    platform: Literal["cpu", "cuda"] = "cpu"
    """Where both sides compute; what peak memory says is the host's."""
    bf16: bool = False
    """Convolutions of ours, and the twin under torch.autocast, in bfloat16; both are compared in float32 on the CPU."""
    quick: bool = False
    """A check that everything works: tiny, two rounds, short turns, into OUT-quick."""

    def __post_init__(self) -> None:
        at_least(self, 1, "rounds", "threads")


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One row of the table."""

    preset: str
    mode: str
    function: str
    variant: str


def main(options: Options) -> None:
    """Measures what is not yet measured, a line for each row."""
    if options.quick:
        out = options.out.with_name(f"{options.out.name}-quick")
        options = dataclasses.replace(options, out=out, presets=("tiny",), rounds=2, seconds=0.1)
    rows = rows_of(options)
    files = {"bench.png": report.plot(rows)}
    results_folder.write(options.out, {"rows": rows}, [report.table(rows)], report.settings(rows), files)


def rows_of(options: Options) -> list[Row]:
    """All rows that the folder holds of these options, those that were missing measured now."""
    start, variants = time.monotonic(), twin_variants(options)
    cores = min(options.threads, len(os.sched_getaffinity(0)))  # that the sides can be held to
    setting = {
        "hardware": f"{cores} of {os.cpu_count()} cores, {machine.processor()}",
        "rounds": options.rounds,
        "turn_s": options.seconds,
        "platform": options.platform,
        "bf16": options.bf16,
        "code": fingerprint(),
    }
    path, cells = options.out / "rows.json", cells_of(options, variants)
    kept = {cell_of(row): row for row in read_rows(path) if setting.items() <= row.items()}
    todo = [cell for cell in cells if cell not in kept]
    if kept:
        print(f"{len(kept)} rows of the same code and options are kept; remove {path} to measure them again")
    for done, row in enumerate(measured(options, todo, bool(variants)), start=1):
        row = setting | row | {"date": time.strftime("%Y-%m-%d")}
        kept[cell_of(row)] = row
        write_whole(path, results_folder.as_json(list(kept.values())))
        left = (time.monotonic() - start) / done * (len(todo) - done)
        print(f"[{done}/{len(todo)}, about {left / 60:.0f} min left] {report.line(row)}", flush=True)
    return [kept[cell] for cell in cells_of(Options(), (*VARIANTS, ALONE)) if cell in kept]


def twin_variants(options: Options) -> tuple[str, ...]:
    """The variants to time; none, and a line that says why, where the twin cannot run."""
    if importlib.util.find_spec("torch") is None:
        print("torch is not installed (pip install -c constraints.txt -e '.[bench]'): ours is timed alone")
        return ()
    return options.variants


def cells_of(options: Options, variants: Sequence[str]) -> list[Cell]:
    """All rows of the table, those of one preset and mode together.

    Encoding is the same for both functions; "near points" has nothing to learn from the twin that is not tuned.
    """
    return [
        Cell(preset=preset, mode=mode, function=function, variant=variant)
        for preset in options.presets
        for mode in options.modes
        for variant in variants or (ALONE,)
        for function in ("network", "near points")
        if function == "network" or (mode != "encode" and variant != "plain")
    ]


def cell_of(row: Row) -> Cell:
    """Which row of the table this is."""
    return Cell(preset=row["preset"], mode=row["mode"], function=row["function"], variant=row["twin_variant"] or ALONE)


def fingerprint() -> str:
    """Hash of all code that is timed: a row of other code is measured again."""
    files = sorted([*ROOT.glob("spnr_jax/**/*.py"), *ROOT.glob("experiments/speed/[!b]*.py")])
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in files)).hexdigest()[:12]


def measured(options: Options, cells: Sequence[Cell], with_twin: bool) -> Iterator[Row]:
    """A row for each cell; the processes of a preset and mode are shared by its rows."""
    for preset in dict.fromkeys(cell.preset for cell in cells):
        if with_twin:
            check_parity(options, preset)
        for mode in dict.fromkeys(cell.mode for cell in cells if cell.preset == preset):
            here = [cell for cell in cells if (cell.preset, cell.mode) == (preset, mode)]
            spec = {"preset": preset, "mode": mode, "batch": BATCHES[preset], "threads": options.threads}
            spec |= {"platform": options.platform, "bf16": options.bf16}
            with ExitStack() as stack:
                ours = {
                    function: stack.enter_context(worker(OURS, spec | {"function": function}))
                    for function in dict.fromkeys(cell.function for cell in here)
                }
                for variant in dict.fromkeys(cell.variant for cell in here):
                    with twin_worker(spec, variant) as twin:
                        for cell in here:
                            if cell.variant == variant:
                                yield dataclasses.asdict(cell) | compare(ours[cell.function], twin, cell, options)


def twin_worker(spec: dict, variant: str) -> AbstractContextManager[Worker | None]:
    """The twin's process; None for a row without the twin."""
    if variant == ALONE:
        return nullcontext()
    return worker(TWIN, spec | {"variant": variant})


def check_parity(options: Options, preset: str) -> None:
    """ValueError unless both sides make the same of the same scene with the same weights."""
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "twin.npz")
        spec = {"preset": preset, "mode": "parity", "batch": BATCHES[preset], "threads": options.threads}
        spec |= {"parity": file}
        with worker(TWIN, spec):  # writes the file
            pass
        with worker(OURS, spec) as ours:
            found = ours.facts["differences"]
    for name, difference in found.items():
        if not difference <= AGREEMENT:
            raise UserError(
                f"{preset}: {name} differs from the twin's by {difference:.1e} of its norm, more than {AGREEMENT:g}; "
                "nothing is timed, because the two are not the same network"
            )
    print(f"{preset}: the same network as the twin, within {max(found.values()):.1e} of the norm of every output")


def compare(ours: Worker, twin: Worker | None, cell: Cell, options: Options) -> Row:
    """The rest of a row, from the turns of both."""
    rounds, load = [], machine.load()
    for _ in range(options.rounds):
        rounds.append((ours.turn(options.seconds), twin.turn(options.seconds) if twin else None))
    row: Row = {"batch": BATCHES[cell.preset], "load": load, **side("ours", [a for a, _ in rounds])}
    row |= {"compile_s": ours.facts["compile_s"], "ours_software": ours.facts["software"]}
    names = ("twin_ms", "twin_min_ms", "twin_peak_mb", "twin_idle_cpu_s", "ratio", "ratio_low", "ratio_high")
    row |= dict.fromkeys(names) | {"twin_variant": None, "twin_software": None}
    if twin is None:
        return row
    theirs = [b for _, b in rounds if b is not None]
    ratios = [statistics.median(a["ms"]) / statistics.median(b["ms"]) for (a, _), b in zip(rounds, theirs, strict=True)]
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75)).tolist()
    row |= side("twin", theirs) | {"ratio": round(middle, 4), "ratio_low": round(low, 4), "ratio_high": round(high, 4)}
    return row | {"twin_variant": cell.variant, "twin_software": twin.facts["software"]}


def side(name: str, turns: Sequence[dict]) -> Row:
    """Median and least milliseconds of all runs of one side, its peak memory and what it used while it waited."""
    runs = [ms for turn in turns for ms in turn["ms"]]
    return {
        f"{name}_ms": round(statistics.median(runs), 2),
        f"{name}_min_ms": round(min(runs), 2),
        f"{name}_peak_mb": max(turn["peak_mb"] for turn in turns),
        f"{name}_idle_cpu_s": round(max(turn["idle_cpu_s"] for turn in turns), 4),
    }


def read_rows(path: Path) -> list[Row]:
    """The rows of an earlier run."""
    if not path.exists():
        return []
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise UserError(f"{path} is no JSON ({error}); remove it or choose another --out") from None


if __name__ == "__main__":
    entry_point.run(main, Options, "speed.bench")
