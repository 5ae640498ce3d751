"""An open file: reading, writing all or nothing, and what is noted of the study as a whole."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from peps_jax.human_study.database.schema import FORMAT, SCHEMA, connect


class Connection:
    """A file, opened; and what is noted of the study as a whole.

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
            self._connection = connect(self.path)
            found = self._connection.execute("PRAGMA user_version").fetchone()[0]
        except sqlite3.DatabaseError as error:
            raise ValueError(f"database {str(path)!r} can't be read: {error}") from None
        if found != FORMAT:
            self._connection.close()
            raise ValueError(f"database {str(path)!r} has format {found}, not {FORMAT}: this version can't read it")

    @classmethod
    def create(cls, path: Path, clock: Callable[[], float] = time.time) -> Self:
        """A new one, which only its owner may read. Raises ValueError if there is a file already."""
        if Path(path).exists():
            raise ValueError(f"database {str(path)!r} is there already")
        Path(path).touch(mode=0o600)  # SQLite gives its log the same rights
        connection = connect(Path(path))
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
