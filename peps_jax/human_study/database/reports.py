"""What the researcher sees and takes along, and what is removed in the end."""

from __future__ import annotations

import json
from typing import Any

from peps_jax.human_study.database.records import ConflictError
from peps_jax.human_study.database.rounds import HALF, Rounds


class Reports(Rounds):
    """Overview, export, payments."""

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
