"""A training that waits for people: it asks in rounds, and each is closed before the next is opened."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

from peps_jax.human_study.database.answers import Answers
from peps_jax.human_study.database.records import ConflictError, Round, Stimulus
from peps_jax.human_study.database.stimuli import insert_query

ENOUGH, HALF = 0.8, 0.5  # shares of a round's queries: to close it after its time; and by hand


class Rounds(Answers):
    """Rounds, and whether a training asks them."""

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
                    insert_query(connection, "ask", one, round, int(number), people)
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


def digest_of(rows: Sequence[Sequence[Any]]) -> str:
    """SHA-256 of rows of numbers and texts."""
    plain = [[value if isinstance(value, str | float | None) else int(value) for value in row] for row in rows]
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()
