"""Everything that is known of a study, in one SQLite file: all SQL is here.

No acknowledged answer is ever lost: a method that writes does all of it or nothing, and returns when it is on the disk (WAL
with `synchronous=FULL`). What somebody is shown is the exception: that is sure as soon as the next answer is. The file may be
opened by several processes at once, a server and a training for instance; what they tell one another they tell through it.

    study        configuration, and what the pages need of the environments
    link         tokens that many may use, who then get one of their own
    participant  phase, digest of the token, consent, how far they are, outcome
    recruitment  keyed hash of a platform's id; the id itself only here, and only until `erase`
    query        a pair of segments: digest, arrays, what is drawn, round, kind
    scene        what an agent did
    assignment   what a participant is shown at which place, on which sides, and until when nobody else is
    answer, rating, likert
    round        of a training that waits for people

A training that waits for people uses `begin_live`, `open_round`, `settle_round`, `answers` and `end_live`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import random
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

FORMAT = 1
ENOUGH, HALF = 0.8, 0.5  # shares of a round's queries: to close it after its time; and by hand
AGREEING = 3  # people who see a shared pair
DRAWN_FROM = 30  # least-answered pairs from which one is drawn for a participant
PATIENCE = 0.5  # s until a page that waits asks again
CHOICES = ("left", "right", "equal", "unclear")

SCHEMA = """
CREATE TABLE study (name TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE link (token TEXT PRIMARY KEY, phase TEXT NOT NULL, platform TEXT NOT NULL) STRICT;
CREATE TABLE participant (
  number INTEGER PRIMARY KEY,
  phase TEXT NOT NULL CHECK (phase IN ('training', 'testing', 'label')),
  token TEXT NOT NULL UNIQUE,
  page TEXT NOT NULL DEFAULT 'consent',
  invited REAL NOT NULL,
  consented REAL,
  seed INTEGER,
  report TEXT,
  outcome TEXT CHECK (outcome IN ('declined', 'finished')),
  finished REAL,
  code TEXT
) STRICT;
CREATE TABLE recruitment (
  participant INTEGER PRIMARY KEY REFERENCES participant,
  platform TEXT NOT NULL,
  person TEXT NOT NULL UNIQUE,
  session TEXT NOT NULL,
  raw TEXT
) STRICT;
CREATE TABLE round (
  number INTEGER PRIMARY KEY,
  queries TEXT NOT NULL,
  opened REAL NOT NULL,
  closed REAL,
  why TEXT,
  answers TEXT
) STRICT;
CREATE TABLE query (
  number INTEGER PRIMARY KEY,
  kind TEXT NOT NULL CHECK (kind IN ('ask', 'check', 'practice')),
  round INTEGER REFERENCES round,
  asked INTEGER,
  people INTEGER NOT NULL DEFAULT 1,
  digest TEXT NOT NULL,
  arrays BLOB NOT NULL,
  first TEXT NOT NULL,
  second TEXT NOT NULL,
  luck INTEGER NOT NULL,
  answered INTEGER NOT NULL DEFAULT 0,
  UNIQUE (round, asked)
) STRICT;
CREATE INDEX query_next ON query (kind, round, people, answered, luck);
CREATE TABLE scene (
  number INTEGER PRIMARY KEY,
  agent TEXT NOT NULL,
  digest TEXT NOT NULL,
  arrays BLOB NOT NULL,
  drawing TEXT NOT NULL,
  UNIQUE (agent, digest)
) STRICT;
CREATE TABLE assignment (
  number INTEGER PRIMARY KEY,
  participant INTEGER NOT NULL REFERENCES participant,
  place INTEGER NOT NULL,
  kind TEXT NOT NULL CHECK (kind IN ('ask', 'shared', 'check', 'repeat', 'rate')),
  swapped INTEGER NOT NULL,
  repeats INTEGER,
  query INTEGER REFERENCES query,
  scene INTEGER REFERENCES scene,
  lease REAL,
  answered INTEGER NOT NULL DEFAULT 0,
  UNIQUE (participant, place)
) STRICT;
CREATE INDEX assignment_query ON assignment (query);
CREATE INDEX assignment_lease ON assignment (lease) WHERE answered = 0 AND lease IS NOT NULL;
CREATE TABLE answer (
  assignment INTEGER PRIMARY KEY REFERENCES assignment,
  choice TEXT NOT NULL CHECK (choice IN ('left', 'right', 'equal', 'unclear')),
  reaction_ms INTEGER NOT NULL,
  watched_ms INTEGER NOT NULL,
  frames_left INTEGER NOT NULL,
  frames_right INTEGER NOT NULL,
  hidden_ms INTEGER NOT NULL,
  replays INTEGER NOT NULL,
  late INTEGER NOT NULL,
  request TEXT NOT NULL UNIQUE,
  time REAL NOT NULL
) STRICT;
CREATE TABLE rating (
  assignment INTEGER PRIMARY KEY REFERENCES assignment,
  rating INTEGER NOT NULL CHECK (rating BETWEEN 1 AND 10),
  reaction_ms INTEGER NOT NULL,
  watched_ms INTEGER NOT NULL,
  frames INTEGER NOT NULL,
  hidden_ms INTEGER NOT NULL,
  replays INTEGER NOT NULL,
  request TEXT NOT NULL UNIQUE,
  time REAL NOT NULL
) STRICT;
CREATE TABLE likert (
  participant INTEGER NOT NULL REFERENCES participant,
  name TEXT NOT NULL,
  value INTEGER NOT NULL CHECK (value BETWEEN 1 AND 5),
  request TEXT NOT NULL,
  time REAL NOT NULL,
  PRIMARY KEY (participant, name)
) STRICT;
CREATE VIEW said AS
  SELECT assignment.participant, assignment.place, assignment.kind, assignment.query, assignment.repeats,
    query.kind = 'check' AS is_check, query.round, query.asked, query.digest, assignment.swapped, answer.*,
    CASE answer.choice WHEN 'equal' THEN 0.5 WHEN 'unclear' THEN NULL
      ELSE (answer.choice = 'left') != assignment.swapped END AS preferred
  FROM answer JOIN assignment ON assignment.number = answer.assignment JOIN query ON query.number = assignment.query;
"""


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


class Database:
    """A study's database, opened. Several threads may share it; every process opens its own.

    Args:
      path: a file that `create` made.
      clock: seconds since 1970.

    Raises:
      ValueError: it can't be read or isn't a study's database; one line says why.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.time):
        self.path, self._clock, self._lock = Path(path), clock, threading.RLock()
        if not self.path.is_file():
            raise ValueError(f"database {str(path)!r} isn't there: make a study first")
        try:
            self._connection = _connect(self.path)
            found = self._connection.execute("PRAGMA user_version").fetchone()[0]
        except sqlite3.DatabaseError as error:
            raise ValueError(f"database {str(path)!r} can't be read: {error}") from None
        if found != FORMAT:
            self._connection.close()
            raise ValueError(f"database {str(path)!r} has format {found}, not {FORMAT}: this version can't read it")

    @classmethod
    def create(cls, path: Path, clock: Callable[[], float] = time.time) -> Database:
        """A new one, which only its owner may read. Raises ValueError if there is a file already."""
        if Path(path).exists():
            raise ValueError(f"database {str(path)!r} is there already")
        Path(path).touch(mode=0o600)  # SQLite gives its log the same rights
        connection = _connect(Path(path))
        connection.executescript(f"BEGIN IMMEDIATE; {SCHEMA} PRAGMA user_version = {FORMAT}; COMMIT;")
        connection.close()
        return cls(path, clock)

    def close(self) -> None:
        with self._lock:
            self._connection.close()

    @contextlib.contextmanager
    def _writing(self, synced: bool = True) -> Iterator[sqlite3.Connection]:
        """All or nothing; on the disk at the end.

        Args:
          synced: False of what may be lost if the power fails before the next answer, though not if the process is killed.
        """
        with self._lock:
            self._connection.execute(f"PRAGMA synchronous = {'FULL' if synced else 'NORMAL'}")
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    def _rows(self, query: str, *values: Any) -> list[sqlite3.Row]:
        with self._lock:
            return self._connection.execute(query, values).fetchall()

    def _row(self, query: str, *values: Any) -> sqlite3.Row | None:
        with self._lock:
            return self._connection.execute(query, values).fetchone()

    def _value(self, query: str, *values: Any) -> Any:
        row = self._row(query, *values)
        return None if row is None else row[0]

    # --- the study ------------------------------------------------------------------------------------------------------------

    def note(self, name: str, value: Any) -> None:
        """Keeps something about the study, as JSON, under a name."""
        with self._writing() as connection:
            connection.execute("INSERT OR REPLACE INTO study VALUES (?, ?)", (name, json.dumps(value)))

    def noted(self, name: str) -> Any:
        """What `note` kept; None if nothing."""
        value = self._value("SELECT value FROM study WHERE name = ?", name)
        return None if value is None else json.loads(value)

    def check_integrity(self) -> list[str]:
        """What is wrong with the file: nothing, if it is whole and its counts agree with its rows."""
        wrong = [row[0] for row in self._rows("PRAGMA integrity_check") if row[0] != "ok"]
        wrong += [f"{row[0]} refers to nothing" for row in self._rows("PRAGMA foreign_key_check")]
        miscounted = self._value(
            "SELECT count(*) FROM query WHERE answered != "
            "(SELECT count(*) FROM said WHERE query = query.number AND kind != 'repeat' AND preferred IS NOT NULL)"
        )
        unmarked = self._value(
            "SELECT count(*) FROM assignment LEFT JOIN answer ON answer.assignment = number LEFT JOIN rating ON "
            "rating.assignment = number WHERE answered != (answer.choice IS NOT NULL OR rating.rating IS NOT NULL)"
        )
        wrong += [f"{miscounted} queries are miscounted"] * bool(miscounted)
        return wrong + [f"{unmarked} assignments are marked wrongly"] * bool(unmarked)

    # --- pairs and scenes ------------------------------------------------------------------------------------------------------

    def add_queries(self, kind: str, stimuli: Sequence[Stimulus], people: Sequence[int] | None = None) -> list[int]:
        """Pairs that don't belong to a round; returns their numbers.

        Args:
          kind: 'ask'; 'check', of which the first segment is the right one; or 'practice'.
          people: who are to answer each, by default one.
        """
        people = [1] * len(stimuli) if people is None else people
        with self._writing() as connection:
            rows = zip(stimuli, people, strict=True)
            return [_insert_query(connection, kind, one, None, None, wanted) for one, wanted in rows]

    def query_numbers(self, kind: str) -> list[int]:
        """Of the pairs of a kind that don't belong to a round."""
        return [
            row[0] for row in self._rows("SELECT number FROM query WHERE kind = ? AND round IS NULL ORDER BY 1", kind)
        ]

    def stimuli(self, numbers: Sequence[int]) -> list[Stimulus]:
        """Pairs by their numbers."""
        made = []
        for number in numbers:
            row = self._row("SELECT digest, arrays, first, second FROM query WHERE number = ?", number)
            if row is None:
                raise ValueError(f"query {number} isn't in the database")
            made.append(Stimulus(row[0], row[1], (row[2], row[3])))
        return made

    def add_scenes(self, agent_label: str, scenes: Sequence[Stimulus]) -> int:
        """What an agent did, for the testing phase; returns how many of the scenes are new.

        `pairs.scenes_of` makes them of whole scenes. The label (a method's name, usually) is never shown to participants. Scenes
        that are there already are left out, so that a training which is repeated adds nothing.
        """
        with self._writing() as connection:
            before = connection.total_changes
            connection.executemany(
                "INSERT OR IGNORE INTO scene (agent, digest, arrays, drawing) VALUES (?, ?, ?, ?)",
                [(agent_label, one.digest, one.arrays, one.drawings[0]) for one in scenes],
            )
            return connection.total_changes - before

    def scenes(self) -> dict[str, list[int]]:
        """Numbers of the scenes of each agent, by its label."""
        found: dict[str, list[int]] = {}
        for row in self._rows("SELECT agent, number FROM scene ORDER BY agent, number"):
            found.setdefault(row["agent"], []).append(row["number"])
        return found

    def scene_stimuli(self, agent_label: str) -> list[Stimulus]:
        """The scenes of an agent."""
        rows = self._rows("SELECT digest, arrays, drawing FROM scene WHERE agent = ? ORDER BY number", agent_label)
        return [Stimulus(row[0], row[1], (row[2],)) for row in rows]

    def times_shown(self) -> dict[int, int]:
        """How often each scene is in a rater's order."""
        return dict(self._rows("SELECT scene, count(*) FROM assignment WHERE scene IS NOT NULL GROUP BY scene"))

    # --- participants ----------------------------------------------------------------------------------------------------------

    def invite(self, phase: str, token_digests: Sequence[str]) -> list[int]:
        """A participant for each token; returns their numbers."""
        with self._writing() as connection:
            return [self._insert_participant(connection, phase, digest) for digest in token_digests]

    def _insert_participant(self, connection: sqlite3.Connection, phase: str, token_digest: str) -> int:
        return connection.execute(
            "INSERT INTO participant (phase, token, invited) VALUES (?, ?, ?)", (phase, token_digest, self._clock())
        ).lastrowid

    def add_link(self, token_digest: str, phase: str, platform: str) -> None:
        """A token that everybody whom a platform sends comes with."""
        with self._writing() as connection:
            connection.execute("INSERT OR IGNORE INTO link VALUES (?, ?, ?)", (token_digest, phase, platform))

    def holder(self, token_digest: str) -> Participant | Link | None:
        """Whose token it is."""
        row = self._row(f"SELECT {_PARTICIPANT} FROM participant WHERE token = ?", token_digest)
        if row is not None:
            return Participant(*row)
        row = self._row("SELECT phase, platform FROM link WHERE token = ?", token_digest)
        return None if row is None else Link(*row)

    def participant(self, number: int) -> Participant:
        return Participant(*self._row(f"SELECT {_PARTICIPANT} FROM participant WHERE number = ?", number))

    def participants(self) -> list[Participant]:
        """All, in the order of their invitation."""
        return [Participant(*row) for row in self._rows(f"SELECT {_PARTICIPANT} FROM participant ORDER BY number")]

    def arrive(self, link: Link, recruit: Recruit, token_digest: Callable[[int], str]) -> int:
        """The number of who comes by a link: a new participant, or the one who comes back to what they have begun.

        Args:
          token_digest: gives the digest of a participant's own token from their number.

        Raises:
          ConflictError: they have taken part before, in whichever phase.
        """
        with self._writing() as connection:
            row = connection.execute(
                "SELECT participant, session, phase FROM recruitment JOIN participant ON number = participant WHERE person = ?",
                (recruit.person,),
            ).fetchone()
            if row is None:
                number = self._insert_participant(connection, link.phase, recruit.person)
                connection.execute("UPDATE participant SET token = ? WHERE number = ?", (token_digest(number), number))
                connection.execute("INSERT INTO recruitment VALUES (?, ?, ?, ?, ?)", (number, *recruit))
                return number
            if row["session"] != recruit.session or row["phase"] != link.phase:
                raise ConflictError("You have taken part in this study already, and nobody may do so twice.")
            return row["participant"]

    def recruit(self, participant: int, recruit: Recruit) -> None:
        """Notes which platform an invited participant comes from.

        Raises:
          ConflictError: that person takes part already.
        """
        with self._writing() as connection:
            row = connection.execute(
                "SELECT participant FROM recruitment WHERE person = ?", (recruit.person,)
            ).fetchone()
            if row is not None and row[0] != participant:
                raise ConflictError("You have taken part in this study already, and nobody may do so twice.")
            connection.execute(
                "INSERT INTO recruitment VALUES (?, ?, ?, ?, ?) ON CONFLICT (participant) DO NOTHING",
                (participant, *recruit),
            )

    def decline(self, participant: int) -> None:
        """They don't want to take part; they may change their mind. Raises ConflictError if they have begun."""
        with self._writing() as connection:
            changed = connection.execute(
                "UPDATE participant SET outcome = 'declined' WHERE number = ? AND consented IS NULL", (participant,)
            )
            if not changed.rowcount:
                raise ConflictError("You have agreed already: to stop, close the page.")

    def begin(self, participant: int, page: str, seed: int, order: Callable[[int], Sequence[Place]]) -> None:
        """They have agreed: what they'll be shown is laid down, and they are at `page`. A second time changes nothing.

        Args:
          order: gives the places from how many began the same phase before.
        """
        with self._writing() as connection:
            row = connection.execute("SELECT phase, consented FROM participant WHERE number = ?", (participant,))
            phase, consented = row.fetchone()
            if consented is not None:
                return
            before = connection.execute(
                "SELECT count(*) FROM participant WHERE phase = ? AND consented IS NOT NULL", (phase,)
            ).fetchone()[0]
            connection.execute(
                "UPDATE participant SET consented = ?, page = ?, seed = ?, outcome = NULL WHERE number = ?",
                (self._clock(), page, seed, participant),
            )
            connection.executemany(
                "INSERT INTO assignment (participant, place, kind, swapped, repeats, query, scene) VALUES (?,?,?,?,?,?,?)",
                [
                    (
                        participant, place, one.kind, int(one.swapped), one.repeats,
                        one.number if one.kind != "rate" else None, one.number if one.kind == "rate" else None,
                    )
                    for place, one in enumerate(order(before))
                ],
            )  # fmt: skip

    def turn(self, participant: int, page: str, to: str, report: Mapping[str, Any] | None = None) -> bool:
        """They are done with `page` and go on; whether they were there."""
        with self._writing() as connection:
            changed = connection.execute(
                "UPDATE participant SET page = ?, report = coalesce(?, report) WHERE number = ? AND page = ?",
                (to, None if report is None else json.dumps(report), participant, page),
            )
            return changed.rowcount == 1

    def rate_importance(self, participant: int, answers: Mapping[str, int], request: str, page: str, to: str) -> None:
        """Keeps how important somebody finds things, from 1 to 5.

        Raises:
          ConflictError: they aren't at `page`, and haven't said the same by the same request before.
        """
        with self._writing() as connection:
            there = dict(
                connection.execute(
                    "SELECT name, value FROM likert WHERE participant = ? AND request = ?", (participant, request)
                ).fetchall()
            )
            if there:
                if there != dict(answers):
                    raise ConflictError("These ratings were given already, and differ.")
                return
            turned = connection.execute(
                "UPDATE participant SET page = ? WHERE number = ? AND page = ?", (to, participant, page)
            )
            if not turned.rowcount:
                raise ConflictError("The ratings of importance aren't asked for now.")
            connection.executemany(
                "INSERT INTO likert VALUES (?, ?, ?, ?, ?)",
                [(participant, name, value, request, self._clock()) for name, value in answers.items()],
            )

    def progress(self, participant: int) -> tuple[int, int]:
        """How many of their places somebody is done with, and how many they have."""
        row = self._row(
            "SELECT coalesce(sum(answered), 0), count(*) FROM assignment WHERE participant = ?", participant
        )
        return row[0], row[1]

    # --- what is shown next ----------------------------------------------------------------------------------------------------

    def next_shown(self, participant: int, lease: float) -> Next | Wait | None:
        """What somebody is shown now: the same until it is answered. None when there is nothing more.

        Nobody else gets their pair for `lease` seconds. A pair is drawn among the least-answered ones that they haven't seen.
        """
        with self._writing(synced=False) as connection:
            while True:
                row = connection.execute(
                    "SELECT * FROM assignment WHERE participant = ? AND answered = 0 ORDER BY place LIMIT 1",
                    (participant,),
                ).fetchone()
                if row is None:
                    return None
                if row["query"] is None and row["scene"] is None:
                    number = self._query_for(connection, row)
                    if number is None and self._awaits():
                        return Wait(PATIENCE)
                    if number is None:
                        _drop(connection, row)
                        continue
                    connection.execute("UPDATE assignment SET query = ? WHERE number = ?", (number, row["number"]))
                connection.execute(
                    "UPDATE assignment SET lease = ? WHERE number = ?", (self._clock() + lease, row["number"])
                )
                return self._next(connection, row["number"])

    def has_more(self, participant: int) -> bool | None:
        """Whether there is something to show to somebody; None if there isn't at present, but may be. Changes nothing."""
        with self._lock:
            connection = self._connection
            rows = connection.execute(
                "SELECT * FROM assignment WHERE participant = ? AND answered = 0 ORDER BY place", (participant,)
            ).fetchall()
            if not rows:
                return False
            if rows[0]["query"] is not None or rows[0]["scene"] is not None:
                return True
            if self._query_for(connection, rows[0]) is not None:
                return True
            if self._awaits():
                return None
            return any(row["kind"] == "check" or self._query_for(connection, row) is not None for row in rows)

    @staticmethod
    def _next(connection: sqlite3.Connection, assignment: int) -> Next:
        row = connection.execute(
            "SELECT place, swapped, first, second, drawing FROM assignment LEFT JOIN query ON query.number = query "
            "LEFT JOIN scene ON scene.number = scene WHERE assignment.number = ?",
            (assignment,),
        ).fetchone()
        if row["drawing"] is not None:
            return Next(row["place"], (row["drawing"],))
        sides = (row["second"], row["first"]) if row["swapped"] else (row["first"], row["second"])
        return Next(row["place"], sides)

    def _awaits(self) -> bool:
        """Whether there may be more to ask later."""
        return self.live == "running"

    def _query_for(self, connection: sqlite3.Connection, assignment: sqlite3.Row) -> int | None:
        """The query that somebody is shown at an assignment that has none yet; None if there is none."""
        participant = assignment["participant"]
        if assignment["kind"] == "repeat":
            row = connection.execute(
                "SELECT query FROM assignment WHERE participant = ? AND place = ?", (participant, assignment["repeats"])
            ).fetchone()
            return None if row is None else row[0]
        if assignment["kind"] not in ("ask", "shared"):
            return None
        seed = connection.execute("SELECT seed FROM participant WHERE number = ?", (participant,)).fetchone()[0]
        for where, order in self._wishes(assignment["kind"]):
            found = connection.execute(
                f"SELECT number, answered FROM query WHERE kind = 'ask' AND {where} AND {_UNSEEN} "
                f"ORDER BY {order} LIMIT {DRAWN_FROM}",
                {"participant": participant, "now": self._clock()},
            ).fetchall()
            alike = [row["number"] for row in found if row["answered"] == found[0]["answered"]]
            if alike:
                return random.Random(f"{seed} {assignment['place']}").choice(alike)
        return None

    def _wishes(self, kind: str) -> list[tuple[str, str]]:
        """Among which queries one is drawn, and which come first: the next wish counts if there is none of the one before."""
        if self.live:
            asked = "round IN (SELECT number FROM round WHERE closed IS NULL) AND answered < people"
            return [(f"{asked} AND {_FREE}", "answered, luck")]
        single = (f"round IS NULL AND people = 1 AND {_FREE}", "answered, luck")
        # those that somebody has seen already first: three who have seen the same tell more than three others
        shared = (f"round IS NULL AND people > 1 AND answered < people AND {_FREE}", "answered DESC, luck")
        return [*([shared, single] if kind == "shared" else [single, shared]), ("round IS NULL", "answered, luck")]

    # --- answers ---------------------------------------------------------------------------------------------------------------

    def answer(
        self, participant: int, place: int, choice: str, frames: tuple[int, int], watching: Watching, request: str
    ) -> None:
        """Keeps an answer. The same request again changes nothing.

        Raises:
          ConflictError: another answer was given there, nothing was shown there yet, or the request was for something else.
        """
        values = (choice, watching.reaction_ms, watching.watched_ms, *frames, watching.hidden_ms, watching.replays)
        with self._writing() as connection:
            assignment = _open_assignment(connection, "answer", participant, place, "query", values, request)
            if assignment is None:
                return
            late = connection.execute(
                "SELECT count(*) FROM query JOIN round ON round.number = round WHERE query.number = ? AND closed IS NOT NULL",
                (assignment["query"],),
            ).fetchone()[0]
            connection.execute(
                "INSERT INTO answer VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (assignment["number"], *values, late, request, self._clock()),
            )
            if assignment["kind"] != "repeat" and choice != "unclear":
                connection.execute("UPDATE query SET answered = answered + 1 WHERE number = ?", (assignment["query"],))
            connection.execute("UPDATE assignment SET answered = 1 WHERE number = ?", (assignment["number"],))

    def rate(self, participant: int, place: int, rating: int, frames: int, watching: Watching, request: str) -> None:
        """Keeps a rating, as `answer` does an answer."""
        values = (rating, watching.reaction_ms, watching.watched_ms, frames, watching.hidden_ms, watching.replays)
        with self._writing() as connection:
            assignment = _open_assignment(connection, "rating", participant, place, "scene", values, request)
            if assignment is None:
                return
            connection.execute(
                "INSERT INTO rating VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (assignment["number"], *values, request, self._clock()),
            )
            connection.execute("UPDATE assignment SET answered = 1 WHERE number = ?", (assignment["number"],))

    def finish(self, participant: int, page: str, code: str) -> None:
        """They have answered all there is."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE participant SET page = 'done', outcome = 'finished', finished = ?, code = ? "
                "WHERE number = ? AND page = ?",
                (self._clock(), code, participant, page),
            )

    def answers(self, round: int | None = None, excluded: Sequence[int] = ()) -> list[Said]:
        """What people have said, un-swapped, in the order of queries and participants.

        Repeats are left out, who answered a pair twice doesn't count twice; so are checks, late answers to a round, and those
        of `excluded` participants.

        Args:
          round: whose answers; by default of the pairs that belong to no round.
        """
        where = "round IS NULL" if round is None else "round = ?"
        rows = self._rows(
            f"SELECT {_SAID} FROM said WHERE {where} AND kind IN ('ask', 'shared') AND late = 0 ORDER BY query, participant",
            *([] if round is None else [round]),
        )
        return [_said(row) for row in rows if row["participant"] not in set(excluded)]

    def late_answers(self) -> list[Said]:
        """What came when its round was closed."""
        late = "late = 1 AND kind IN ('ask', 'shared')"
        rows = self._rows(f"SELECT {_SAID} FROM said WHERE {late} ORDER BY query, participant")
        return list(map(_said, rows))

    def checks_failed(self) -> dict[int, int]:
        """In how many checks each participant who began preferred the wrong side, by number."""
        return dict(
            self._rows(
                "SELECT participant.number, count(assignment) FROM participant LEFT JOIN said ON "
                "said.participant = participant.number AND is_check AND preferred = 0 WHERE consented IS NOT NULL "
                "GROUP BY participant.number"
            )
        )

    # --- a training that waits for people --------------------------------------------------------------------------------------

    def begin_live(self) -> None:
        """A training asks from now on, and it alone: participants without a pair wait for the next round."""
        self.note("live", "running")

    def end_live(self) -> None:
        """The training is over: nothing more is asked."""
        self.note("live", "over")

    @property
    def live(self) -> str:
        """Whether a training asks: "running", "over", or "" of a study in which none has."""
        return self.noted("live") or ""

    def open_round(self, round: int, numbers: Sequence[int], stimuli: Sequence[Stimulus], people: int = 1) -> Round:
        """Asks a round's queries; one that is open or closed already, with the same queries, stays as it is.

        So a training that was killed begins anew, gets its closed rounds' answers at once, and goes on.

        Args:
          numbers: that the training gave them, other than `data.NOBODY`.
          people: who are to answer each.

        Raises:
          ValueError: the round was asked with other queries; one line says so.
        """
        digest = digest_of([(number, one.digest) for number, one in zip(numbers, stimuli, strict=True)])
        with self._writing() as connection:
            row = connection.execute("SELECT queries FROM round WHERE number = ?", (round,)).fetchone()
            if row is None:
                connection.execute(
                    "INSERT INTO round (number, queries, opened) VALUES (?, ?, ?)", (round, digest, self._clock())
                )
                for number, one in zip(numbers, stimuli, strict=True):
                    _insert_query(connection, "ask", one, round, int(number), people)
            elif row[0] != digest:
                raise ValueError(
                    f"round {round} was asked with other queries ({row[0][:8]}, now {digest[:8]}): the settings, the code or the "
                    "machine differ; train in a new study"
                )
        return self.round(round)

    def round(self, number: int) -> Round:
        """A round. Raises ValueError if there is none."""
        row = self._row(
            "SELECT number, queries, opened, closed, why, answers, (SELECT count(*) FROM query WHERE round = round.number), "
            "(SELECT count(*) FROM query WHERE round = round.number AND people <= (SELECT count(*) FROM said "
            "WHERE said.query = query.number AND late = 0 AND kind != 'repeat')) FROM round WHERE number = ?",
            number,
        )
        if row is None:
            raise ValueError(f"round {number} isn't in the database")
        return Round(*row)

    def rounds(self) -> list[Round]:
        """All rounds so far."""
        return [self.round(row[0]) for row in self._rows("SELECT number FROM round ORDER BY number")]

    def settle_round(self, number: int, after: float) -> str | None:
        """Closes a round if it is due: all its queries are answered, or 80 % of them `after` seconds.

        Returns:
          Why it was closed, now or before; None if it is open.
        """
        now = self.round(number)
        if now.closed is not None:
            return now.why
        if now.answered == now.asked:
            return self._close(number, "all answered")
        if self._clock() - now.opened >= after and now.answered >= ENOUGH * now.asked:
            return self._close(number, f"{now.answered} of {now.asked} answered after {after:g} s")
        return None

    def close_round(self, number: int) -> str:
        """Closes a round by hand; returns why it is closed.

        Raises:
          ConflictError: less than half of it is answered.
        """
        now = self.round(number)
        if now.closed is not None:
            return now.why or ""
        if now.answered < HALF * now.asked:
            raise ConflictError(
                f"Round {number} has {now.answered} of {now.asked} answers: it waits until half of them are there."
            )
        return self._close(number, f"by hand, {now.answered} of {now.asked} answered")

    def waits_for(self, number: int) -> str:
        """What an open round waits for, in a line."""
        now = self.round(number)
        if now.answered < HALF * now.asked:
            return f"{now.answered} of {now.asked} answered: less than half, so it waits"
        return f"{now.answered} of {now.asked} answered"

    def _close(self, number: int, why: str) -> str:
        with self._writing() as connection:
            connection.execute(
                "UPDATE round SET closed = ?, why = ?, answers = ? WHERE number = ? AND closed IS NULL",
                (self._clock(), why, self.answers_digest(number), number),
            )
            return connection.execute("SELECT why FROM round WHERE number = ?", (number,)).fetchone()[0]

    def answers_digest(self, round: int) -> str:
        """SHA-256 of what was said in time in a round: of who said what, by query."""
        return digest_of([(said.asked, said.participant, said.preferred) for said in self.answers(round)])

    # --- what the researcher sees ----------------------------------------------------------------------------------------------

    def overview(self) -> dict[str, Any]:
        """Participants, counts and rates, as the researcher's page shows them."""
        now, failed = self._clock(), self.checks_failed()
        participants = [
            {
                "number": row["number"],
                "phase": row["phase"],
                "page": row["page"],
                "outcome": row["outcome"],
                "done": row["done"],
                "total": row["total"],
                "last_seen_s": None if row["seen"] is None else max(0.0, now - row["seen"]),
                "checks_failed": failed.get(row["number"], 0),
            }
            for row in self._rows(
                "SELECT participant.number, phase, page, outcome, coalesce(sum(assignment.answered), 0) AS done, "
                "count(assignment.number) AS total, max(coalesce(answer.time, rating.time, consented)) AS seen "
                "FROM participant LEFT JOIN assignment ON participant = participant.number "
                "LEFT JOIN answer ON answer.assignment = assignment.number LEFT JOIN rating ON "
                "rating.assignment = assignment.number GROUP BY participant.number ORDER BY participant.number"
            )
        ]
        lately = self._value("SELECT count(*) FROM answer WHERE time > ?", now - 60) + self._value(
            "SELECT count(*) FROM rating WHERE time > ?", now - 60
        )
        rounds = self._value("SELECT max(number) FROM round")
        return {
            "participants": participants,
            "answers": self._value("SELECT count(*) FROM answer"),
            "ratings": self._value("SELECT count(*) FROM rating"),
            "answers_per_minute": lately,
            "agreement": self.agreement(),
            "left_share": self._value("SELECT avg(choice = 'left') FROM answer WHERE choice IN ('left', 'right')"),
            "repeat_consistency": self.repeat_consistency(),
            "round": None if rounds is None else self._round_shown(rounds),
        }

    def _round_shown(self, number: int) -> dict[str, Any]:
        now = self.round(number)
        return {
            "number": number,
            "asked": now.asked,
            "answered": now.answered,
            "open_s": (self._clock() if now.closed is None else now.closed) - now.opened,
            "state": "open" if now.closed is None else "closed",
            "says": self.waits_for(number) if now.closed is None else now.why,
            "can_close": now.closed is None and now.answered >= HALF * now.asked,
        }

    def agreement(self) -> float | None:
        """Share of two people's answers to the same pair that are the same; None while no pair has two."""
        return self._value(
            "SELECT avg(a.preferred = b.preferred) FROM said a JOIN said b ON a.query = b.query AND "
            "a.participant < b.participant WHERE a.kind IN ('ask', 'shared') AND b.kind IN ('ask', 'shared') "
            "AND a.preferred IS NOT NULL AND b.preferred IS NOT NULL"
        )

    def repeat_consistency(self) -> float | None:
        """Share of the repeats that are answered as the first time; None while there is none."""
        return self._value(
            "SELECT avg(again.preferred = once.preferred) FROM said again JOIN said once ON "
            "once.participant = again.participant AND once.place = again.repeats WHERE again.kind = 'repeat' "
            "AND again.preferred IS NOT NULL AND once.preferred IS NOT NULL"
        )

    # --- export, and what is removed -------------------------------------------------------------------------------------------

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """All that may be published, by table: no platform's id, no address, nothing of a browser, no token, no code."""
        listed = lambda query: [dict(row) for row in self._rows(query)]
        failed = self.checks_failed()
        participants = listed(
            "SELECT number, phase, page, consented IS NOT NULL AS consented, seed, outcome, "
            "finished - consented AS seconds FROM participant ORDER BY number"
        )
        return {
            "participants": [row | {"checks_failed": failed.get(row["number"])} for row in participants],
            "queries": listed("SELECT number, kind, round, asked, people, digest FROM query ORDER BY number"),
            "scenes": listed("SELECT number, agent, digest FROM scene ORDER BY number"),
            "answers": listed(
                "SELECT participant, place, kind, is_check, query, round, asked, repeats, swapped, choice, preferred, "
                "reaction_ms, watched_ms, frames_left, frames_right, hidden_ms, replays, late, time - consented AS seconds "
                "FROM said JOIN participant ON participant.number = participant ORDER BY participant, place"
            ),
            "ratings": listed(
                "SELECT assignment.participant, place, scene, agent, rating, reaction_ms, watched_ms, frames, hidden_ms, "
                "replays, time - consented AS seconds FROM rating JOIN assignment ON assignment.number = rating.assignment "
                "JOIN scene ON scene.number = scene JOIN participant ON participant.number = assignment.participant "
                "ORDER BY 1, 2"
            ),
            "importance": listed("SELECT participant, name, value FROM likert ORDER BY participant, name"),
            "rounds": listed(
                "SELECT number, queries AS queries_digest, answers AS answers_digest, why, closed - opened AS seconds "
                "FROM round ORDER BY number"
            ),
        }

    def payments(self) -> list[dict[str, Any]]:
        """Who is to be paid: platforms' ids, until they are erased, and completion codes."""
        rows = self._rows(
            "SELECT number, phase, outcome, code, platform, raw FROM participant LEFT JOIN recruitment ON "
            "participant = number WHERE consented IS NOT NULL ORDER BY number"
        )
        return [dict(row) | {"raw": json.loads(row["raw"]) if row["raw"] else None} for row in rows]

    def erase(self) -> int:
        """Removes platforms' ids, from the file's free pages and its log too; returns how many there were.

        The keyed hashes stay, so that nobody takes part twice.
        """
        with self._writing() as connection:
            erased = connection.execute("UPDATE recruitment SET raw = NULL WHERE raw IS NOT NULL").rowcount
        with self._lock:
            self._connection.execute("VACUUM")
            busy = self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0]
        if busy:
            raise ConflictError("Ids are removed, but another process is reading: stop it and erase once more.")
        return erased


_PARTICIPANT = "number, phase, page, consented, outcome, code"
_UNSEEN = "NOT EXISTS (SELECT 1 FROM assignment WHERE query = query.number AND participant = :participant)"
_FREE = (
    "NOT EXISTS (SELECT 1 FROM assignment WHERE query = query.number AND answered = 0 AND lease > :now "
    "AND participant != :participant)"
)
_SAID = "query, asked, participant, preferred, round, late, kind"


def _said(row: sqlite3.Row) -> Said:
    said = Said(*row)
    return said._replace(preferred=None if said.preferred is None else float(said.preferred), late=bool(said.late))


def digest_of(rows: Sequence[Sequence[Any]]) -> str:
    """SHA-256 of rows of numbers and texts."""
    plain = [[value if isinstance(value, str | float | None) else int(value) for value in row] for row in rows]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, timeout=30.0, isolation_level=None, check_same_thread=False)
    connection.row_factory = sqlite3.Row
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA secure_delete = ON")
    return connection


def _insert_query(
    connection: sqlite3.Connection, kind: str, one: Stimulus, round: int | None, asked: int | None, people: int
) -> int:
    luck = int(one.digest[:8], 16)  # pairs of one count come in an order that means nothing
    return connection.execute(
        "INSERT INTO query (kind, round, asked, people, digest, arrays, first, second, luck) VALUES (?,?,?,?,?,?,?,?,?)",
        (kind, round, asked, people, one.digest, one.arrays, *one.drawings, luck),
    ).lastrowid


def _drop(connection: sqlite3.Connection, assignment: sqlite3.Row) -> None:
    """Takes a place for which there is no pair out of somebody's order, and the repeats of it."""
    connection.execute(
        "DELETE FROM assignment WHERE participant = ? AND answered = 0 AND (number = ? OR repeats = ?)",
        (assignment["participant"], assignment["number"], assignment["place"]),
    )


def _open_assignment(
    connection: sqlite3.Connection,
    table: str,
    participant: int,
    place: int,
    shown: str,
    values: tuple[Any, ...],
    request: str,
) -> sqlite3.Row | None:
    """The assignment that waits for an answer at a place; None if the same request has given the same before.

    Raises:
      ConflictError: it can't be answered, or not so.
    """
    assignment = connection.execute(
        "SELECT * FROM assignment WHERE participant = ? AND place = ?", (participant, place)
    ).fetchone()
    before = connection.execute(f"SELECT * FROM {table} WHERE request = ?", (request,)).fetchone()
    if before is not None:
        own = assignment is not None and before["assignment"] == assignment["number"]
        if own and tuple(before)[1 : 1 + len(values)] == values:
            return None
        raise ConflictError("This request was made before, with another answer.")
    if assignment is None or assignment["lease"] is None or assignment[shown] is None:
        raise ConflictError(f"Nothing was shown at place {place} yet.")
    if assignment["answered"]:
        raise ConflictError(f"Place {place} is answered already.")
    return assignment
