"""What a participant is shown next: the place that is theirs, and the pair that is drawn for it."""

from __future__ import annotations

import random
import sqlite3

from peps_jax.human_study.database.records import Next, Wait
from peps_jax.human_study.database.rounds import Rounds

DRAWN_FROM = 30  # least-answered pairs from which one is drawn for a participant
PATIENCE = 0.5  # s until a page that waits asks again
_UNSEEN = "NOT EXISTS (SELECT 1 FROM assignment WHERE query = query.number AND participant = :participant)"
_FREE = (
    "NOT EXISTS (SELECT 1 FROM assignment WHERE query = query.number AND answered = 0 AND lease > :now "
    "AND participant != :participant)"
)


class Assignments(Rounds):
    """Places of participants' orders as they are come to. While a training asks, its round's pairs are drawn, and no others."""

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


def _drop(connection: sqlite3.Connection, assignment: sqlite3.Row) -> None:
    """Takes a place for which there is no pair out of somebody's order, and the repeats of it."""
    connection.execute(
        "DELETE FROM assignment WHERE participant = ? AND answered = 0 AND (number = ? OR repeats = ?)",
        (assignment["participant"], assignment["number"], assignment["place"]),
    )
