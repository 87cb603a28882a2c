"""Every file of a folder or pattern drawn in one go: `spnr render FOLDER`.

    here          a thread reads and encodes the next cloud, this one draws, another one writes
    by workers    on a Dask scheduler (devices/cluster.py), each object by one of them

A file that cannot be drawn is listed with its reason and stops no other; errors of the disk that is written to end the
run.  What is drawn stands, however the run ends (catalogue_files.py), and the same command goes on.
"""

import dataclasses
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from spnr_jax.devices import allocator, compilation
from spnr_jax.devices.side_by_side import beside
from spnr_jax.errors import UserError, one_line
from spnr_jax.tools import catalogue_files, catalogue_page
from spnr_jax.tools.catalogue_files import Item, Record, folder_of
from spnr_jax.tools.pictures import Ready, Written, check_writable, drawn, load_named, made_ready
from spnr_jax.tools.render_command import Render
from spnr_jax.training.weights import SHIPPED, load

AHEAD = 2  # clouds that are read before they are drawn
Result = TypeVar("Result")
loaded = cache(load)  # of a process that draws many clouds


class UndrawnError(Exception):
    """Why one file cannot be drawn."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What is needed for any file: the options, with absolute paths, and their digest."""

    options: Render
    digest: str


@dataclass(frozen=True, kw_only=True)
class Begun:
    """A cloud that is read and encoded, and the record to be."""

    ready: Ready
    record: Record


def render_catalogue(options: Render) -> Iterator[str]:
    """Draws what does not stand yet; yields what became of it.  ValueError if there is nothing that can be drawn."""
    if options.seconds is not None:
        raise UserError("--seconds: of a single file; give --quality and --resolution to a folder or pattern")
    check_writable(options.out)
    options = _with_absolute_paths(options)
    items = catalogue_files.find(options.cloud, options.out)
    load_named(options, loaded)  # a run that is none is said before anything is read
    bench = Bench(options=options, digest=catalogue_files.digest(options))
    missing = [item for item in items if not catalogue_files.standing(item, options.out, bench.digest)]
    begin, faults, made = time.monotonic(), dict[str, str](), 0
    try:
        with tqdm(total=len(items), initial=len(items) - len(missing), unit="file", dynamic_ncols=True) as bar:
            for item, fault in _outcomes(bench, missing):
                if fault is None:
                    made += 1
                else:
                    faults[item.name] = fault
                    tqdm.write(f"left out {item.cloud}: {fault}", file=sys.stderr)
                bar.update()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped: what is drawn stands, and the same command goes on") from None
    finally:  # also after Ctrl-C: what stands is shown
        page = catalogue_page.write_pages(items, options.out, bench.digest, faults)
    rate = made / max(time.monotonic() - begin, 1e-9)
    standing = len(items) - len(missing)
    if not made + standing:
        raise UserError(f"{options.cloud}: none of the {len(items)} files can be drawn; {page} says why")
    yield f"drew {made} of {len(items)} files ({60 * rate:.1f} a minute), {standing} stood, {len(faults)} left out"
    yield f"wrote {page}"


def _with_absolute_paths(options: Render) -> Render:
    """The options as processes in other folders understand them."""
    run, light = options.run, options.lighting.light
    if run and str(run) not in SHIPPED:
        run = run.absolute()
    if light and Path(light).suffix:  # a file, not a name of the package
        light = str(Path(light).absolute())
    lighting = dataclasses.replace(options.lighting, light=light)
    return dataclasses.replace(options, out=options.out.absolute(), run=run, lighting=lighting)


def _outcomes(bench: Bench, items: Sequence[Item]) -> Iterator[tuple[Item, str | None]]:
    """Each file and, if it could not be drawn, why: as they are finished."""
    if not items:
        return
    if bench.options.cluster is None and bench.options.workers is None:
        yield from draw_here(bench, items)
        return
    try:
        from spnr_jax.devices import cluster
    except ModuleNotFoundError as error:
        raise UserError(f"--cluster and --workers need {error.name}; pip install 'spnr-jax[cluster]'") from None
    with cluster.connect(bench.options.cluster, min(bench.options.workers or 1, len(items))) as client:
        for item, fault in cluster.run_tasks(client, draw_item, bench, items):
            if isinstance(fault, cluster.Died):
                fault = f"the process that drew it died {fault.times} times; out of memory?"
            yield item, fault


def draw_here(bench: Bench, items: Sequence[Item]) -> Iterator[tuple[Item, str | None]]:
    """Each file and why it could not be drawn, in their order: reading, drawing and writing side by side."""
    reading = beside((partial(_tried, partial(read, bench, item)) for item in items), AHEAD)
    # the pictures of two objects are in memory at most
    yield from zip(items, beside(map(partial(_begin_to_draw, bench), items, reading), 1), strict=True)


def _begin_to_draw(bench: Bench, item: Item, begun: Begun | UndrawnError) -> Callable[[], str | None]:
    """Draws a file that is read; what writes it, and says why it cannot be drawn."""
    jobs = begun if isinstance(begun, UndrawnError) else _tried(lambda: list(_jobs(bench, item, begun.ready)))
    if isinstance(jobs, UndrawnError) or isinstance(begun, UndrawnError):
        return partial(str, jobs)
    return partial(_written, bench, item, begun, jobs)


def _written(bench: Bench, item: Item, begun: Begun, jobs: Iterable[Callable[[], Written]]) -> str | None:
    """Writes what is drawn of a file, its record last; None, or why it cannot be drawn."""
    done = _tried(lambda: [_perform(job) for job in jobs])
    if isinstance(done, UndrawnError):
        return str(done)
    names = tuple(path.name for one in done for path in one.paths)
    catalogue_files.finish(item, bench.options.out, dataclasses.replace(begun.record, files=names))
    return None


def _tried(work: Callable[[], Result]) -> Result | UndrawnError:
    try:
        return work()
    except UndrawnError as fault:
        return fault


def draw_item(bench: Bench, item: Item) -> str | None:
    """Draws a file in a worker; None, or the reason why it cannot be drawn.

    What is wrong with the worker and not with the file is raised: errors of the disk, a file that it does not see.
    """
    if catalogue_files.standing(item, bench.options.out, bench.digest):  # another run was faster
        return None
    if not item.cloud.exists():
        raise UserError(f"{item.cloud}: worker {socket.gethostname()} does not see this file; mount it there")
    allocator.keep_arrays()
    compilation.keep_programs()
    return _begin_to_draw(bench, item, _tried(partial(read, bench, item)))()


def read(bench: Bench, item: Item) -> Begun:
    """A file read and encoded; what was drawn of it before is gone."""
    record = catalogue_files.begin(item, bench.options.out, bench.digest)
    notes: list[str] = []
    with _blamed():
        ready = made_ready(dataclasses.replace(bench.options, cloud=item.cloud), notes.append, loaded)
    return Begun(ready=ready, record=dataclasses.replace(record, notes=tuple(notes)))


def _jobs(bench: Bench, item: Item, ready: Ready) -> Iterator[Callable[[], Written]]:
    options = dataclasses.replace(bench.options, cloud=item.cloud)
    with _blamed():
        yield from drawn(ready, options, folder_of(item, options.out) / item.cloud.stem)


def _perform(job: Callable[[], Written]) -> Written:
    """Writes; errors of the disk are the run's business, values that are no picture the file's."""
    try:
        return job()
    except ValueError as error:
        raise UndrawnError(one_line(error)) from error


@contextmanager
def _blamed() -> Iterator[None]:
    """Whatever is wrong with one file must not stop the others; its reason says what it was."""
    try:
        yield
    except ValueError as error:
        raise UndrawnError(one_line(error)) from error
    except Exception as error:
        raise UndrawnError(f"unexpected {type(error).__name__}: {one_line(error)}") from error
