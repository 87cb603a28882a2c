"""The child process that reads damaged files, one after another, and says of each what came of it.

    python -m experiments.fuzz_worker MODULE READER FOLDER SEED FIRST LAST

Input number i of a reader follows from (seed, reader, i) alone.  A line of JSON a input goes to standard output: [i,
outcome, seconds, megabytes, reason], outcome one of OUTCOMES.  The parent (experiments/fuzz.py) sees a crash, or a
silence of more than SECONDS, as such.  What the process may do is watched by Python's audit hooks: files opened,
made, moved and removed, programs started, addresses connected to, pickles loaded; a limit on its memory makes any
allocation of more than MEMORY bytes fail.
"""

import contextlib
import dataclasses
import importlib
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.fuzz_mutations import DECOY, Files, mutated
from spnr_jax.cli import one_line

Outcome = Literal["read", "refused", "failed"]
SECONDS = 10.0  # that an input may take
MEMORY = 2**30  # bytes of address space beyond what the process has after reading all seeds
LONGEST_REASON = 1000  # characters of a line that a person should read
FORBIDDEN: tuple[str, ...]
FORBIDDEN = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class")
FORBIDDEN += ("os.fork", "os.forkpty", "ctypes.dlopen", "urllib.Request", "webbrowser.open", "exec")
CHANGES = {
    "os.mkdir": (0,),
    "os.rmdir": (0,),
    "os.remove": (0,),
    "os.rename": (0, 1),
    "os.link": (1,),
    "os.symlink": (1,),
}
CHANGES |= {
    "os.chmod": (0,),
    "shutil.rmtree": (0,),
    "tempfile.mkstemp": (0,),
    "tempfile.mkdtemp": (0,),
}
PROGRAM = tuple(
    os.path.realpath(place) for place in (sys.prefix, sys.base_prefix, Path(__file__).parents[1], "/proc", "/sys")
)
PROGRAM += ("/usr", "/lib", "/etc/ssl", "/etc/localtime", "/dev")


@dataclasses.dataclass
class Watch:
    """What an audit hook notices while it is on: `broken` names what must not happen."""

    inside: str = ""
    on: bool = False
    broken: list[str] = dataclasses.field(default_factory=list)

    def install(self) -> None:
        """Begin to look; an audit hook stays for the life of the process."""
        sys.addaudithook(self._see)

    def _see(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open" and isinstance(arguments[0], str | bytes):
            path, flags = os.fsdecode(arguments[0]), arguments[2] if isinstance(arguments[2], int) else 0
            writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            named = not path.startswith("<")  # a traceback looks for the source of code that has no file
            if named and not self._within(path) and (writes or self._beside(path) or not self._of_program(path)):
                self.broken.append(f"{'writes' if writes else 'reads'} {path[:200]}")
        elif event in CHANGES:
            places = [
                _place(arguments, i) for i in CHANGES[event] if isinstance(arguments[i], str | bytes | os.PathLike)
            ]
            self.broken += [f"{event} {place[:200]}" for place in places if not self._within(place)]
        elif event in FORBIDDEN and not (event == "exec" and _of_import(arguments)):
            self.broken.append(f"{event} {str(arguments)[:200]}")

    def _within(self, path: str) -> bool:
        return os.path.realpath(path).startswith(self.inside) or os.path.realpath(path) == self.inside.rstrip("/")

    def _beside(self, path: str) -> bool:
        return os.path.realpath(path).startswith(os.path.dirname(self.inside.rstrip("/")))

    def _of_program(self, path: str) -> bool:
        return os.path.realpath(path).startswith(PROGRAM)


def _place(arguments: tuple[Any, ...], i: int) -> str:
    """The path among an event's arguments, with the open folder that it is relative to, if there is one."""
    opened = arguments[-1]  # os.remove, os.rmdir, os.mkdir and shutil.rmtree end with it
    relative = isinstance(opened, int) and opened >= 0 and not os.path.isabs(os.fsdecode(arguments[i]))
    return os.path.join(os.readlink(f"/proc/self/fd/{opened}") if relative else "", os.fsdecode(arguments[i]))


def _of_import(arguments: tuple[Any, ...]) -> bool:
    """Whether an exec runs a module's code, or that of a class made by a library."""
    name = getattr(arguments[0], "co_filename", "")
    return name.startswith("<") or os.path.realpath(name).startswith(PROGRAM)


WATCH = Watch()


def random_of(seed: int, name: str, number: int) -> np.random.Generator:
    """The generator of one input."""
    return np.random.default_rng((seed, zlib.crc32(name.encode()), number))


def make_input(seeds: list[Files], seed: int, name: str, number: int) -> tuple[str, Files]:
    """(file to be opened, files) of an input; every hundredth is a seed as it is."""
    rng = random_of(seed, name, number)
    files = seeds[rng.integers(len(seeds))]
    main = next(iter(files))
    return main, files if number % 100 == 0 else mutated(files, rng)


def write_input(folder: Path, files: Files, there: Files) -> None:
    """Makes a folder hold these files; `there` says what it holds, all else in it is left as it is."""
    for name in there.keys() - files.keys():
        (folder / name).unlink(missing_ok=True)
    for name, content in files.items():
        path = folder / name
        if there.get(name) != content or not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def around(folder: Path) -> set[str]:
    """Every file and folder beside the input's folder."""
    return {str(path) for path in folder.parent.iterdir()}


def attempt(reader: Any, folder: Path, main: str) -> tuple[Outcome, float, str]:
    """(outcome, seconds, reason) of reading what lies in a folder; the reason of a failure is its call stack."""
    WATCH.inside, WATCH.broken = f"{os.path.realpath(folder)}{os.sep}", []
    before, start, WATCH.on = around(folder), time.perf_counter(), True
    outcome, reason = _read(reader, folder, main)
    WATCH.on, seconds = False, time.perf_counter() - start
    broken = [*WATCH.broken, *sorted(around(folder) ^ before)]
    if broken:
        return "failed", seconds, f"touches what is not its own: {'; '.join(broken)[:1000]}\n{reason}"
    if seconds > SECONDS:
        return "failed", seconds, f"took {seconds:.1f} seconds\n{reason}"
    return outcome, seconds, reason


def _read(reader: Any, folder: Path, main: str) -> tuple[Outcome, str]:
    try:
        with warnings.catch_warnings(record=True) as said, contextlib.redirect_stdout(sys.stderr):
            warnings.simplefilter("always")
            reader.read(folder, main)
    except (ValueError, OSError) as error:  # what the commands turn into one line and exit code 2
        line = one_line(error)
        if not 3 < len(line) <= LONGEST_REASON:
            return "failed", f"says {len(line)} characters\n{traceback.format_exc()[-4000:]}"
        return "refused", line
    except BaseException:  # noqa: BLE001 - the law is that nothing else is raised; what was is the finding
        return "failed", traceback.format_exc()[-6000:]
    if said:
        return "failed", f"warns: {said[0].category.__name__} {said[0].message} ({said[0].filename}:{said[0].lineno})"
    return "read", ""


def main(arguments: list[str]) -> None:
    """Read the inputs from FIRST up to LAST."""
    module, name, place, seed, first, last = arguments
    reader = importlib.import_module(module).READERS[name]
    folder = Path(place) / "input"
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a reader prints is no answer
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder.parent / DECOY).write_bytes(b"nobody reads this")
    os.chdir(folder.parent)
    tempfile.tempdir = str(folder)
    there: Files = {}
    seeds = reader.seeds()
    for files in seeds:  # loads what is loaded on demand, before memory and files are watched
        write_input(folder, files, there)
        there = files
        reader.read(folder, next(iter(files)))
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
    WATCH.install()
    for number in range(int(first), int(last)):
        opened, files = make_input(seeds, int(seed), name, number)
        write_input(folder, files, there)
        there = files
        outcome, seconds, reason = attempt(reader, folder, opened)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        answers.write(json.dumps([number, outcome, round(seconds, 4), round(peak, 1), reason]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
