"""Errors that a user can fix, bugs of this project, and stops by Ctrl-C."""

import _thread
import contextlib
import importlib
import io
import math
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from types import UnionType
from typing import Any, NoReturn

JSON = (dict, list, str, int, float, bool, type(None))
LONGEST_LINE = 800  # characters of an error
PACKAGES = ("spnr_jax", "data_gen", "experiments")
STARVED = "RESOURCE_EXHAUSTED"  # how XLA begins an error about memory
STOPPED = 130  # exit code after Ctrl-C
AGAIN = 0.1  # seconds after which a stop that was swallowed is tried again


class UserError(ValueError):
    """An error that the user can fix; the message says what was expected, what was found, and what to do."""


def require(condition: bool, message: str) -> None:
    """UserError with the message, unless the condition holds."""
    if not condition:
        raise UserError(message)


def require_within(options: Any, low: float | int, high: float | int, *names: str) -> None:
    """UserError for the first of these options that is given and smaller or larger, or has such a number, or none."""
    wanted = f"{low} or more" if high == math.inf else f"{low} to {high}"
    for name in names:
        found = getattr(options, name)
        values = found if isinstance(found, tuple) else (found,)
        if not values or not all(value is None or low <= value <= high for value in values):
            got = " ".join(map(str, values)) or "nothing"
            raise UserError(f"--{name.replace('_', '-')}: expected {wanted}, got {got}")


def require_at_least(options: Any, least: float | int, *names: str) -> None:
    """UserError for the first of these options that is given and smaller."""
    require_within(options, least, math.inf, *names)


def is_bug(error: Exception) -> bool:
    """Whether code of this project used a name that does not exist, so that no broken file is the cause.

    A missing attribute of a JSON value is no bug: the file holds, for example, a list instead of an object.
    """
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    if not frames or frames[-1].f_globals.get("__name__", "").partition(".")[0] not in PACKAGES:
        return False
    return isinstance(error, NameError) or (isinstance(error, AttributeError) and not isinstance(error.obj, JSON))


def first_line(error: Exception) -> str:
    """First line of an error message (libraries may append call stacks); the type if there is no message."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
    python = re.match(r"(?:invalid literal for int\(\) with base \d+|could not convert string to float): (.*)", line)
    if found := python or re.match(r"could not convert string ('.*') to \w+ at", line):  # the latter NumPy's
        return f"expected a number, found {found[1]}"
    return line


def check_kind(value: Any, kind: type | UnionType, expected: str) -> None:
    """UserError, "EXPECTED, got TYPE", unless the value is of a kind."""
    if not isinstance(value, kind):
        raise UserError(f"{expected}, got {type(value).__name__}")


@contextlib.contextmanager
def refusing(what: str) -> Iterator[None]:
    """Context that turns a library's exception into UserError("<what> (<reason>)")."""
    try:
        yield
    except (UserError, MemoryError):
        raise
    except Exception as error:
        if is_bug(error):
            raise
        reason = f"there is no {error}" if isinstance(error, KeyError) else first_line(error)
        raise UserError(f"{what} ({reason})") from error


def one_line(error: Exception) -> str:
    """An error message on one line of limited length; errors of the disk with the path."""
    said = str(error) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        said = f"{error.filename or 'disk'}: {error.strerror}"
    if isinstance(error, MemoryError) or said.startswith(STARVED):
        said = f"not enough memory ({said}); give fewer points, or ask for fewer pixels"
    line = " ".join(said.split())
    # a name or number in a broken file may be of any length
    return line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 2 :]}"


def start_command(module: str, name: str) -> None:
    """Runs the `main` of a module; Ctrl-C also works while it is imported, which takes a second."""
    with stop_at_once(name):
        program = importlib.import_module(module)
    program.main()


@contextlib.contextmanager
def stop_at_once(name: str) -> Iterator[None]:
    """Ctrl-C ends the process while libraries are loaded: an exception would crash some of them."""

    def stop(number: int, frame: object) -> None:
        os.write(2, f"{name}: stopped\n".encode())
        os._exit(STOPPED)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def spnr() -> None:
    """The command `spnr`."""
    start_command("spnr_jax.cli", "spnr")


def guard(work: Callable[[], object], name: str, debug: bool = False) -> int:
    """Exit code of the work: 130 for a stop; 2, with one line on stderr, for an error that the user can fix.

    With `debug`, the call stack is printed before that line.
    """
    for stream in (sys.stdout, sys.stderr):  # a name that the terminal cannot print stops no picture
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with _obey_stops():
            try:
                work()
            finally:
                _flush(sys.stdout)
    except KeyboardInterrupt as stop:
        print(f"{name}: {str(stop) or 'stopped'}", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:
        with contextlib.suppress(OSError):  # Python flushes what is left at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print(f"{name}: stopped, as what read the output was closed", file=sys.stderr)
        return 2
    except (ValueError, OSError, MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not str(error).startswith(STARVED):
            raise
        if debug:
            traceback.print_exc()
        print(f"{name}: {one_line(error)}", file=sys.stderr)
        return 2
    return 0


def leave(code: int) -> NoReturn:
    """Ends the process; after a stop without Python's end, which crashes of what JAX still compiles or computes.

    A stop during Python's end, when the work is done, ends it at once with the same code.
    """
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(code))
    if code == STOPPED:
        _flush(sys.stdout, sys.stderr)
        os._exit(code)
    sys.exit(code)


def _flush(*streams: Any) -> None:
    for stream in streams:
        if stream is not None:  # closed before Python began
            stream.flush()


@contextlib.contextmanager
def _obey_stops() -> Iterator[None]:
    """Raises KeyboardInterrupt after Ctrl-C, even if the first one is lost.

    Where JAX calls Python, an exception may be dropped or replaced (jax-ml/jax#18246, #9082).  So it is raised again
    until it is handled, and an error that follows a stop counts as a stop.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    asked: list[int] = []
    arrived = threading.Event()
    thread, report, show = threading.get_ident(), sys.unraisablehook, sys.excepthook

    def stop(number: int, frame: object) -> None:
        asked.append(number)
        if len(asked) == 1:
            _thread.start_new_thread(insist, ())  # takes no lock that the interrupted code may hold
        raise KeyboardInterrupt

    def insist() -> None:
        while not arrived.wait(AGAIN):
            if not _is_stopping(thread):
                signal.pthread_kill(thread, signal.SIGINT)

    def notice(lost: "sys.UnraisableHookArgs") -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            report(lost)

    def print_others(kind: type[BaseException], error: BaseException, trace: Any) -> None:  # for C code that prints
        if not issubclass(kind, KeyboardInterrupt):
            show(kind, error, trace)

    signal.signal(signal.SIGINT, stop)
    sys.unraisablehook, sys.excepthook = notice, print_others
    try:
        yield
    except Exception as error:
        if asked:
            raise KeyboardInterrupt from error
        raise
    finally:
        arrived.set()
        sys.unraisablehook, sys.excepthook = report, show
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_stopping(thread: int) -> bool:
    """Whether a thread is handling a KeyboardInterrupt, for example in a `finally`, or closes a generator after one."""
    found: Any = sys._current_exceptions().get(thread)
    error = found[1] if isinstance(found, tuple) else found  # Python 3.11: with type and call stack
    while error is not None and not isinstance(error, KeyboardInterrupt | GeneratorExit):
        error = error.__context__
    return error is not None
