"""What reading a file may do to its process: an audit hook that looks while a block lasts, and a limit on memory."""

import contextlib
import os
import resource
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MEMORY = 2**30  # bytes of address space beyond what the process has when the block begins
FORBIDDEN = {
    *("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class", "os.fork"),
    *("os.forkpty", "ctypes.dlopen", "urllib.Request", "webbrowser.open", "exec"),
}
PROGRAM = tuple(map(os.path.realpath, (sys.prefix, sys.base_prefix, Path(__file__).parents[2], "/proc", "/sys")))
PROGRAM += ("/usr", "/lib", "/etc/ssl", "/etc/localtime", "/dev")


@dataclass
class Watch:
    """`broken` names what a block did that it must not; the hook stays for the life of the process, mostly asleep."""

    inside: str = ""
    thread: int | None = None
    installed: bool = False
    broken: list[str] = field(default_factory=list)

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """The audit hook."""
        if self.thread != threading.get_ident():
            return
        if event == "open" and isinstance(arguments[0], str | bytes):
            path, flags = os.fsdecode(arguments[0]), arguments[2] if isinstance(arguments[2], int) else 0
            writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            # a traceback looks for the source of code that has no file
            if not path.startswith("<") and not self.within(path) and (writes or not self.of_program(path)):
                self.broken.append(f"{'writes' if writes else 'reads'} {path[:200]}")
        elif event in FORBIDDEN and not (event == "exec" and _of_import(arguments)):
            self.broken.append(f"{event} {str(arguments)[:200]}")

    def within(self, path: str) -> bool:
        """Whether a path is the folder of the input or lies in it."""
        return f"{os.path.realpath(path)}{os.sep}".startswith(self.inside)

    def of_program(self, path: str) -> bool:
        """Whether a path belongs to the interpreter, a package or the system, and not to what lies beside the input."""
        real = os.path.realpath(path)
        return real.startswith(PROGRAM) and not real.startswith(os.path.dirname(self.inside.rstrip(os.sep)))


def _of_import(arguments: tuple[Any, ...]) -> bool:
    """Whether an exec runs a module's code, or that of a class made by a library."""
    name = getattr(arguments[0], "co_filename", "")
    return name.startswith("<") or os.path.realpath(name).startswith(PROGRAM)


WATCH = Watch()


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """What this thread does meanwhile that touches anything but the folder, as a list that grows."""
    if not WATCH.installed:
        sys.addaudithook(WATCH.see)
        WATCH.installed = True
    WATCH.inside, WATCH.broken = f"{os.path.realpath(folder)}{os.sep}", []
    beside = set(folder.parent.iterdir())
    WATCH.thread = threading.get_ident()
    try:
        yield WATCH.broken
    finally:
        WATCH.thread = None
        WATCH.broken += map(str, set(folder.parent.iterdir()) ^ beside)


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    """Any allocation of more than MEMORY bytes fails meanwhile."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))
