"""How far the work is, on a terminal or in a log."""

import sys
import time
from collections.abc import Callable

LINE_EVERY = 10.0
"""seconds between lines in a log"""


class Progress:
    """Says what is being done: `True` writes to standard error, a function is called with
    (units done, units), `False` is silent."""

    def __init__(self, progress: bool | Callable[[int, int], None], label: str) -> None:
        self._told = progress
        self._label = label
        self._begin = self._last = time.monotonic()
        self._first = 0
        self._is_terminal = sys.stderr.isatty()

    def say(self, text: str) -> None:
        """A line, if lines are written."""
        if self._told is True:
            end = "\n" if not self._is_terminal else "  \r"
            print(f"{self._label}: {text}", end=end, file=sys.stderr, flush=True)

    def start(self, done: int, total: int) -> None:
        """Before the first unit, of which `done` are there from before."""
        self._first = done
        before = f", {done} of them from before" if done else ""
        self.say(f"{total} units of work{before}; compiling first")

    def step(self, done: int, total: int) -> None:
        """After each unit."""
        if callable(self._told):
            self._told(done, total)
            return
        now = time.monotonic()
        is_last = done >= total
        if not self._is_terminal and not is_last and now - self._last < LINE_EVERY:
            return
        self._last = now
        spent = now - self._begin
        left = spent / max(done - self._first, 1) * (total - done)
        rest = f"took {spent:.0f} s" if is_last else f"about {left:.0f} s left"
        self.say(f"{done} of {total} units, {rest}")
        if is_last and self._told is True and self._is_terminal:
            print(file=sys.stderr)
