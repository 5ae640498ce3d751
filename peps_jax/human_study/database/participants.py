"""Who takes part: how they come, what they agree to, and how far they are."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from peps_jax.human_study.database.connection import Connection
from peps_jax.human_study.database.records import ConflictError, Link, Participant, Place, Recruit

_PARTICIPANT = "number, phase, page, consented, outcome, code"


class Participants(Connection):
    """Participants, the links that they come by, and the places of their orders."""

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

    def finish(self, participant: int, page: str, code: str) -> None:
        """They have answered all there is."""
        with self._writing() as connection:
            connection.execute(
                "UPDATE participant SET page = 'done', outcome = 'finished', finished = ?, code = ? "
                "WHERE number = ? AND page = ?",
                (self._clock(), code, participant, page),
            )
