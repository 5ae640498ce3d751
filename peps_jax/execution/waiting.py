"""What takes longer than ten seconds says so: nobody should have to guess what a silent command is at."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

EVERY = 10.0  # s between two reminders


def print_line(text: str) -> None:
    """Prints to stderr, if anybody still listens there."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


class Reminder:
    """Says every ten seconds what is being done or waited for, and for how long, as long as it lasts.

        with Reminder("drawing"):
            ...

    Args:
      doing: what; a function if that changes meanwhile. `about` says what comes next.
      say: gets each line.
    """

    def __init__(self, doing: str | Callable[[], str], say: Callable[[str], None] = print_line):
        self._say = say
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self.about(doing)

    def about(self, doing: str | Callable[[], str]) -> None:
        """From now on it is about that: the time starts again."""
        self._doing = doing
        self._since = time.monotonic()
        self._due = self._since + EVERY

    def __enter__(self) -> Reminder:
        self._over.clear()
        self._thread = threading.Thread(target=self._remind, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _remind(self) -> None:
        while not self._over.wait(max(0.0, self._due - time.monotonic())):
            now = time.monotonic()
            if now >= self._due:  # `about` may have put it off meanwhile
                self._due = now + EVERY
                doing = self._doing if isinstance(self._doing, str) else self._doing()
                self._say(f"{doing}, {now - self._since:.0f} s so far")
