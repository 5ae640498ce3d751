"""Who may come in: tokens, of which only digests are kept, and the keyed hashes of platforms' ids.

A token is 192 random bits in the fragment of a link, so that neither a server's log nor a referring page sees it. Those that a
study has one of (the researcher's, and one for each participant whom a platform sends) are derived from the study's key, so
that the same link works after a restart and in a second tab.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from peps_jax.storage.files import NotWrittenError

BYTES = 24  # of a token
WRONG, WINDOW = 20, 60.0  # wrong tokens that an address may try, and in how many seconds
ADDRESSES = 10_000  # that are remembered


class Platform(NamedTuple):
    """What a recruiting platform appends to a study's address."""

    person: str  # name of the parameter with the participant's id
    session: str  # and with that of what they took on: who comes back with it goes on
    others: tuple[str, ...]  # that may be there too
    link: str  # what the researcher enters there, behind the address; the platform fills it in

    @property
    def names(self) -> tuple[str, ...]:
        return (self.person, self.session, *self.others)


PLATFORMS = {
    "prolific": Platform(
        "PROLIFIC_PID",
        "SESSION_ID",
        ("STUDY_ID",),
        "?PROLIFIC_PID={{%PROLIFIC_PID%}}&STUDY_ID={{%STUDY_ID%}}&SESSION_ID={{%SESSION_ID%}}",
    ),
    # MTurk itself appends its parameters to the address of an external question
    "mturk": Platform("workerId", "assignmentId", ("hitId", "turkSubmitTo"), ""),
}
PREVIEW = "ASSIGNMENT_ID_NOT_AVAILABLE"  # MTurk's session while a worker only looks at the task


def new() -> str:
    """A token that nobody has."""
    return secrets.token_urlsafe(BYTES)


def digest(token: str) -> str:
    """SHA-256 of a token, which is what the database keeps."""
    return hashlib.sha256(token.encode()).hexdigest()


def derived(key: bytes, purpose: str) -> str:
    """The study's token for `purpose`."""
    return base64.urlsafe_b64encode(_hmac(key, f"token\0{purpose}")[:BYTES]).decode()


def identity(key: bytes, platform: str, person: str) -> str:
    """A person's keyed hash: without the key nobody can find out, by trying ids, who took part."""
    return _hmac(key, f"person\0{platform}\0{person}").hex()


def code(key: bytes, participant: int) -> str:
    """A participant's completion code."""
    return base64.b32encode(_hmac(key, f"code\0{participant}")[:5]).decode()


def _hmac(key: bytes, message: str) -> bytes:
    return hmac.new(key, message.encode(), hashlib.sha256).digest()


def make_key(path: Path) -> None:
    """Writes a new key that only its owner may read. Raises NotWrittenError."""
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(number, "w", encoding="ascii") as file:
            file.write(secrets.token_hex(32) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise NotWrittenError(f"{str(path)!r} can't be written: {error.strerror or error}") from None


def read_key(path: Path) -> bytes:
    """The key that `make_key` wrote. Raises ValueError."""
    try:
        key = bytes.fromhex(path.read_text(encoding="ascii").strip())
    except OSError as error:
        raise ValueError(f"key {str(path)!r} can't be read: {error.strerror or error}") from None
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ValueError(f"key {str(path)!r} is damaged: it has to hold 64 hexadecimal digits")
    return key


class WrongGuesses:
    """Limits how many wrong tokens an address may try.

    An address over the limit is refused whatever it shows, but for tokens that were right before: several people may share one
    address, and one of them mustn't lock the others out.
    """

    def __init__(self, limit: int = WRONG, window: float = WINDOW, clock: Callable[[], float] = time.monotonic):
        self._limit, self._window, self._clock = limit, window, clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()
        self._right: set[str] = set()

    def refuses(self, address: str, token_digest: str) -> bool:
        """Whether a token isn't even looked up."""
        tries = self._wrong.get(address)
        if tries is None or token_digest in self._right:
            return False
        while tries and tries[0] < self._clock() - self._window:
            tries.popleft()
        return len(tries) >= self._limit

    def wrong(self, address: str) -> None:
        """A token from `address` was wrong."""
        tries = self._wrong.setdefault(address, deque(maxlen=self._limit))
        tries.append(self._clock())
        self._wrong.move_to_end(address)
        if len(self._wrong) > ADDRESSES:
            self._wrong.popitem(last=False)

    def right(self, token_digest: str) -> None:
        """A token was right."""
        self._right.add(token_digest)
