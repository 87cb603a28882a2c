"""A thread that draws for one browser: at once while things change, once more and better when they rest.

Changes are functions from state to state, submitted from any thread and applied here, in order, all that wait before
the next picture: the state has one owner and needs no lock, and a slow picture never lets changes pile up.
"""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

State = TypeVar("State")
REST = 0.2  # seconds without a change after which the better picture is drawn


class Loop(Generic[State]):
    """Draws `show(state, moving)` after changes (moving), and when none came for `rest` seconds (not moving)."""

    def __init__(self, state: State, show: Callable[[State, bool], State], rest: float = REST) -> None:
        self.state = state
        self._show, self._rest = show, rest
        self._changes: list[Callable[[State], State]] = []
        self._wake = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin to draw, the first picture at once."""
        self._thread.start()

    def submit(self, change: Callable[[State], State]) -> None:
        """Have a change applied before the next picture."""
        with self._wake:
            self._changes.append(change)
            self._wake.notify()

    @property
    def superseded(self) -> bool:
        """Whether a change waits: a picture of the state as it is would be old before it is seen."""
        return bool(self._changes) or self._stopped

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped

    def stop(self) -> None:
        """End the thread after the picture that it draws; without waiting, because that may be a browser's callback."""
        with self._wake:
            self._stopped = True
            self._wake.notify()

    def join(self, timeout: float) -> None:
        """Wait until the thread has ended."""
        self._thread.join(timeout)

    def _run(self) -> None:
        moving = True
        while not self._stopped:
            self.state = self._show(self.state, moving)
            changes = self._next_changes(self._rest if moving else None)
            moving = bool(changes)
            for change in changes:
                self.state = change(self.state)

    def _next_changes(self, timeout: float | None) -> list[Callable[[State], State]]:
        """The changes that wait; none after `timeout` seconds without any."""
        with self._wake:
            self._wake.wait_for(lambda: self.superseded, timeout)
            changes, self._changes = self._changes, []
        return changes
