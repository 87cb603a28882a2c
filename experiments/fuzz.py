"""Bad input at volume: every reader is given thousands of damaged files, and may only read or refuse them.

    python -m experiments.fuzz --out OUT [--inputs 10000] [--seed 0] [--reader NAME ...]

The law, for each input: it is read (finite values of the right shapes and types), or refused with one line, as the
commands print with exit code 2.  No other exception, no warning, no crash, no more than 10 seconds, no more than a GiB
beyond what the process has with valid files, no file read or changed outside the input's folder, no program, network
or pickle.  Each reader works in a child process (experiments/fuzz_worker.py), which is started again behind an input
that ended or silenced it.  The same seed gives the same inputs; a stopped run goes on.

    OUT/results/READER.json     counts so far
    OUT/failures/READER-N/      every failing input as files, and reason.txt
    OUT/fuzz.md .json .png      the table and a picture
"""

import io
import json
import os
import select
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from experiments.fuzz_worker import SECONDS, make_input
from spnr_jax import cli
from spnr_jax.formats.images import write_whole

GRACE = 5.0  # seconds that a child may need beyond those of an input
START = 120.0  # seconds that a child may need to begin
REPORT = 2.0  # seconds between lines of progress
KEPT_FAILURES = 100  # of a reader, saved as files; the others are counted
CHILD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg"}


@dataclass(frozen=True, kw_only=True)
class Fuzz:
    """Give every reader damaged files, and count what it reads, refuses, and fails on."""

    out: Path
    """Folder of the results; a run that stopped there goes on."""
    inputs: int = 10_000
    """Inputs of each reader."""
    seed: int = 0
    """Seed of all damage."""
    reader: tuple[str, ...] = ()
    """Readers to be tried (default: all)."""
    module: str = "experiments.fuzz_readers"
    """Module with the READERS."""


@dataclass(kw_only=True)
class Result:
    """What came of a reader's inputs up to `done`."""

    name: str
    seed: int
    done: int = 0
    read: int = 0
    refused: int = 0
    failed: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    base_mb: float = 0.0
    peak_mb: float = 0.0
    reasons: dict[str, int] = field(default_factory=dict)
    """How often a failure ended in this line."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    sys.exit(cli.guarded(lambda: run(tyro.cli(Fuzz, args=arguments)), "fuzz"))


def run(options: Fuzz) -> None:
    """Tries the readers and writes the table; ValueError at the end if one failed."""
    import importlib

    from experiments import fuzz_report

    readers = importlib.import_module(options.module).READERS
    if unknown := [name for name in options.reader if name not in readers]:
        raise ValueError(f"--reader {unknown[0]}: there are {', '.join(readers)}")
    for name in options.reader or readers:
        finish(options, name, load(options, name))
    results = [load(options, name) for name in readers if path_of(options, name).is_file()]
    fuzz_report.write(options.out, results)
    if failed := [result.name for result in results if result.failed]:
        raise ValueError(f"inputs failed: {', '.join(failed)}; see {options.out / 'failures'}")


def path_of(options: Fuzz, name: str) -> Path:
    """Where the counts of a reader are kept."""
    return options.out / "results" / f"{name}.json"


def load(options: Fuzz, name: str) -> Result:
    """The counts of a reader so far; ValueError if they are of another seed."""
    path = path_of(options, name)
    if not path.is_file():
        return Result(name=name, seed=options.seed)
    result = Result(**json.loads(path.read_text()))
    if result.seed != options.seed:
        raise ValueError(f"{path} has seed {result.seed}, --seed is {options.seed}; choose another --out")
    return result


def finish(options: Fuzz, name: str, result: Result) -> None:
    """Tries what is left of a reader's inputs, a child process after another."""
    begin, first, shown = time.monotonic(), result.done, 0.0
    while result.done < options.inputs:
        for number, outcome, seconds, peak, reason in answers(options, name, result.done):
            note(options, result, number, outcome, seconds, peak, reason)
            if time.monotonic() - shown > REPORT or result.done == options.inputs:
                shown = time.monotonic()
                rate = (result.done - first) / (shown - begin)
                left = (options.inputs - result.done) / rate
                counts = f"{result.done} of {options.inputs}, {result.failed} failed"
                print(f"{name}: {counts}, {rate:.0f}/s, {left:.0f} s left", flush=True)
                save(options, result)
        save(options, result)


def answers(options: Fuzz, name: str, first: int):
    """(number, outcome, seconds, megabytes, reason) of inputs as one child gives them; its end, too, is an answer."""
    place = (options.out / "work" / name).absolute()
    place.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "experiments.fuzz_worker", options.module, name, str(place)]
    command += [str(number) for number in (options.seed, first, options.inputs)]
    said, patience, number = b"", START, first
    with (place / "said.txt").open("wb") as errors:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, env=os.environ | CHILD, bufsize=0)
    assert child.stdout is not None
    try:
        while select.select([child.stdout], [], [], patience)[0]:
            new = child.stdout.read(65536)
            if not new:
                break
            *lines, said = (said + new).split(b"\n")
            for line in lines:
                yield json.loads(line)
                number, patience = number + 1, SECONDS + GRACE
    finally:
        silent = child.poll() is None and number < options.inputs
        child.kill()
        code = child.wait()
        child.stdout.close()
    if number < options.inputs:
        last = (place / "said.txt").read_text(errors="replace")[-4000:]
        if patience == START:
            raise ValueError(f"reader {name} does not begin; its process said: {last.strip().splitlines()[-1:]}")
        reason = f"silent for {patience:.0f} seconds" if silent and code == -9 else f"the process ended with {code}"
        yield number, "failed", patience if silent else 0.0, 0.0, f"{reason}\n{last}"


def note(options: Fuzz, result: Result, number: int, outcome: str, seconds: float, peak: float, reason: str) -> None:
    """Counts an input; one that failed is saved."""
    result.done = number + 1
    setattr(result, outcome, getattr(result, outcome) + 1)
    result.seconds += seconds
    result.slowest, result.peak_mb = max(result.slowest, seconds), max(result.peak_mb, peak)
    result.base_mb = result.base_mb or peak
    if outcome != "failed":
        return
    last = (reason.strip().splitlines() or ["nothing"])[-1][:200]
    result.reasons[last] = result.reasons.get(last, 0) + 1
    if result.failed <= KEPT_FAILURES:
        keep(options, result.name, number, reason)


def keep(options: Fuzz, name: str, number: int, reason: str) -> None:
    """Saves a failing input, its file first to be opened named, with the reason."""
    import importlib

    seeds = importlib.import_module(options.module).READERS[name].seeds()
    opened, files = make_input(seeds, options.seed, name, number)
    folder = options.out / "failures" / f"{name}-{number}"
    for file, content in files.items():
        write_whole(folder / "input" / file, content)
    write_whole(folder / "reason.txt", f"{opened}\n{reason}\n".encode())


def save(options: Fuzz, result: Result) -> None:
    """Keeps the counts, so that a stopped run goes on behind them."""
    stream = io.StringIO()
    json.dump(asdict(result), stream, indent=1)
    write_whole(path_of(options, result.name), stream.getvalue().encode())


if __name__ == "__main__":
    main()
