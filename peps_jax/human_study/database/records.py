"""What goes into a study's database and comes out of it."""

from __future__ import annotations

from typing import NamedTuple

CHOICES = ("left", "right", "equal", "unclear")


class ConflictError(Exception):
    """What is asked for can't be done any more, or not yet; one line says why."""


class Stimulus(NamedTuple):
    """Something to be shown: a pair of segments, or a scene."""

    digest: str  # of the arrays
    arrays: bytes  # .npz; `pairs.segments` reads it
    drawings: tuple[str, ...]  # JSON that the pages draw: of both segments, or of the scene


class Place(NamedTuple):
    """What a participant is going to be shown at one place of their order."""

    kind: str  # 'ask', 'shared', 'check', 'repeat' or 'rate'
    swapped: bool = False  # the pair's first segment is on the right
    repeats: int | None = None  # the place whose pair comes again
    number: int | None = None  # of the query or the scene, where it is known beforehand


class Participant(NamedTuple):
    """Somebody who takes part."""

    number: int
    phase: str
    page: str
    consented: float | None
    outcome: str | None
    code: str | None


class Link(NamedTuple):
    """A token that many use to come in."""

    phase: str
    platform: str


class Recruit(NamedTuple):
    """Who comes from a platform."""

    platform: str
    person: str  # keyed hash of the platform's id
    session: str  # keyed hash of what they took on
    raw: str  # the ids themselves, as JSON


class Next(NamedTuple):
    """What a participant is shown now."""

    place: int
    drawings: tuple[str, ...]  # of the left and the right side, or of the scene


class Wait(NamedTuple):
    """There is nothing at present, but there may be."""

    seconds: float


class Watching(NamedTuple):
    """How somebody watched before they answered."""

    reaction_ms: int
    watched_ms: int
    hidden_ms: int
    replays: int


class Said(NamedTuple):
    """An answer by one person to a query, un-swapped."""

    query: int  # number in this database
    asked: int | None  # the number that the training which asked gave it
    participant: int
    preferred: float | None  # P(first preferred): 1, 0, or 1/2 for a tie; None of who couldn't tell
    round: int | None
    late: bool  # it came when its round was closed
    kind: str  # 'ask', 'shared', 'check' or 'repeat'


class Round(NamedTuple):
    """A round of a training that waits for people."""

    number: int
    queries_digest: str
    opened: float
    closed: float | None
    why: str | None
    answers_digest: str | None
    asked: int  # queries
    answered: int  # of them, in time and by as many people as were wanted
