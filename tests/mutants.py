"""Does the suite notice when a kernel is broken?  Every mutant is one named fault; what survives is a missing test.

    make mutants                      all of them: ends with "N of N mutants caught"
    python tests/mutants.py softplus  those whose name holds the word

A mutant replaces one piece of source text, which must occur exactly once, in a copy of the project, and runs the test
files that own the kernel.  The copy is first tested as it is: a mutant counts as caught only by tests that pass without
it.  The table is tests/mutants.toml; tests/test_mutants.py keeps it applicable.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = Path(__file__).with_suffix(".toml")
COPIED = ("spnr_jax", "data_gen", "experiments", "tests", "docs", "pyproject.toml")
LIMIT = 1800  # seconds for one call of pytest
PASSED, FAILED = 0, 1  # exit codes of pytest; any other is a fault of the mutant or of the machine


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One fault: `old` becomes `new` in `file` (of spnr_jax), and one of the test files has to fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def test_file(name: str) -> str:
    """Path of tests/**/test_NAME.py from the project's root; ValueError unless there is one."""
    (found,) = (ROOT / "tests").rglob(f"test_{name}.py")
    return found.relative_to(ROOT).as_posix()


def read_table(path: Path = TABLE) -> tuple[Mutant, ...]:
    """The mutants of tests/mutants.toml."""
    return tuple(
        Mutant(name=name, file=module["file"], old=old, new=new, tests=tuple(map(test_file, module["tests"])))
        for module in tomllib.loads(path.read_text())["module"]
        for name, old, new in module["fault"]
    )


def apply(mutant: Mutant, root: Path) -> None:
    """Break the copy at `root`; ValueError if the text that should be replaced does not occur exactly once."""
    path = root / "spnr_jax" / mutant.file
    source = path.read_text()
    if (count := source.count(mutant.old)) != 1:
        raise ValueError(f"mutant '{mutant.name}': its text occurs {count} times in {mutant.file}, expected once")
    path.write_text(source.replace(mutant.old, mutant.new))


def copy_project(folder: Path) -> Path:
    """A copy of the project's sources and tests in an empty folder."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "images"))
        else:
            shutil.copy(source, folder / name)
    return folder


def run_tests(root: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Exit code of pytest on the copy (it stops at the first failure), and the end of what it printed."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return -1, f"no result after {LIMIT} s"
    return done.returncode, done.stdout[-2000:] + done.stderr[-2000:]


def judge(mutant: Mutant) -> tuple[Mutant, int, str, float]:
    """(mutant, exit code, end of the output, seconds) of the tests of a broken copy."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        root = copy_project(Path(folder))
        apply(mutant, root)
        code, output = run_tests(root, mutant.tests)
    return mutant, code, output, time.monotonic() - start


def check_unbroken(tests: Sequence[str]) -> None:
    """ValueError unless the tests pass on a copy that nothing was done to."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        code, output = run_tests(copy_project(Path(folder)), ("-n", "2", *tests))
    if code != PASSED:
        raise ValueError(f"the tests fail without any mutant:\n{output}")


def main(words: Sequence[str], jobs: int) -> int:
    """Run the mutants whose name holds one of the words (or all); the number that was not caught."""
    chosen = [mutant for mutant in read_table() if not words or any(word in mutant.name for word in words)]
    if not chosen:
        raise SystemExit(f"no mutant is named by {' or '.join(words)}; see {TABLE.name}")
    print(f"{len(chosen)} mutants; first the tests without any", flush=True)
    check_unbroken(sorted({test for mutant in chosen for test in mutant.tests}))
    missed = 0
    with ThreadPoolExecutor(jobs) as pool:
        for number, (mutant, code, output, seconds) in enumerate(pool.map(judge, chosen), start=1):
            verdict = {FAILED: "caught", PASSED: "SURVIVED"}.get(code, f"ERROR {code}")
            print(f"[{number}/{len(chosen)}] {verdict:9} {mutant.file}: {mutant.name} ({seconds:.0f} s)", flush=True)
            if code != FAILED:
                missed += 1
            if code not in (PASSED, FAILED):
                print(output)
    print(f"{len(chosen) - missed} of {len(chosen)} mutants caught")
    return missed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Break kernels on purpose and see the tests fail.")
    parser.add_argument("words", nargs="*", help="only mutants whose name holds one of these words")
    parser.add_argument("--jobs", type=int, default=2, help="mutants tested at once")
    options = parser.parse_args()
    sys.exit(min(1, main(options.words, options.jobs)))
