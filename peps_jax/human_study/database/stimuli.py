"""Pairs of segments and scenes: what there is to show."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence

from peps_jax.human_study.database.connection import Connection
from peps_jax.human_study.database.records import Stimulus


class Stimuli(Connection):
    """Pairs that belong to no round, and scenes."""

    def add_queries(self, kind: str, stimuli: Sequence[Stimulus], people: Sequence[int] | None = None) -> list[int]:
        """Pairs that don't belong to a round; returns their numbers.

        Args:
          kind: 'ask'; 'check', of which the first segment is the right one; or 'practice'.
          people: who are to answer each, by default one.
        """
        people = [1] * len(stimuli) if people is None else people
        with self._writing() as connection:
            rows = zip(stimuli, people, strict=True)
            return [insert_query(connection, kind, one, None, None, wanted) for one, wanted in rows]

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


def insert_query(
    connection: sqlite3.Connection, kind: str, one: Stimulus, round: int | None, asked: int | None, people: int
) -> int:
    """The number of a new pair, of a round or of none."""
    luck = int(one.digest[:8], 16)  # pairs of one count come in an order that means nothing
    return connection.execute(
        "INSERT INTO query (kind, round, asked, people, digest, arrays, first, second, luck) VALUES (?,?,?,?,?,?,?,?,?)",
        (kind, round, asked, people, one.digest, one.arrays, *one.drawings, luck),
    ).lastrowid
