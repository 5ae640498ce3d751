"""The tables, and how a file of them is opened."""

from __future__ import annotations

import sqlite3
from pathlib import Path

FORMAT = 1

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


def connect(path: Path) -> sqlite3.Connection:
    """What is committed is on the disk; what is removed is overwritten."""
    connection = sqlite3.connect(path, timeout=30.0, isolation_level=None, check_same_thread=False)
    connection.row_factory = sqlite3.Row
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA secure_delete = ON")
    return connection
