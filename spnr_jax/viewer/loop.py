"""A thread that draws for one browser: at once while things change, once more and better when they rest.

Changes are functions from state to state, of any thread; all that wait are applied, in order, before the next picture.
"""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

State = TypeVar("State")
REST = 0.2  # seconds without a change after which the better picture is drawn


class Loop(Generic[State]):
    """Draws `show(state, moving)` after changes (moving), and when none came for `rest` seconds (not moving)."""

    def __init__(self, state: State, show: Callable[[State, bool], State], rest: float = REST) -> None:
        self.state, self.stopped = state, False
        self._show, self._rest = show, rest
        self._changes: list[Callable[[State], State]] = []
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.start, self.join = self._thread.start, self._thread.join

    def submit(self, change: Callable[[State], State]) -> None:
        """Have a change applied before the next picture."""
        with self._wake:
            self._changes.append(change)
            self._wake.notify()

    @property
    def superseded(self) -> bool:
        """Whether a change waits: a picture of the state as it is would be old before it is seen."""
        return bool(self._changes) or self.stopped

    def stop(self) -> None:
        """End the thread after the picture that it draws, without waiting: that may be a browser's callback."""
        with self._wake:
            self.stopped = True
            self._wake.notify()

    def _run(self) -> None:
        moving = True
        while not self.stopped:
            self.state = self._show(self.state, moving)
            with self._wake:
                self._wake.wait_for(lambda: self.superseded, self._rest if moving else None)
                changes, self._changes = self._changes, []
            moving = bool(changes)
            for change in changes:
                self.state = change(self.state)
