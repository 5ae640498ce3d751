"""What people say of what they are shown."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any

from peps_jax.human_study.database.connection import Connection
from peps_jax.human_study.database.records import ConflictError, Said, Watching

_SAID = "query, asked, participant, preferred, round, late, kind"


class Answers(Connection):
    """Answers and ratings. The same request again changes nothing."""

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


def _said(row: sqlite3.Row) -> Said:
    said = Said(*row)
    return said._replace(preferred=None if said.preferred is None else float(said.preferred), late=bool(said.late))


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
