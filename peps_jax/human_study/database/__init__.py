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

`Database` is put together of what its modules know of these tables: `stimuli`, `participants`, `answers`, `rounds` upon answers,
and `assignments` and `reports` upon rounds.
"""

from __future__ import annotations

from peps_jax.human_study.database.assignments import Assignments
from peps_jax.human_study.database.participants import Participants
from peps_jax.human_study.database.reports import Reports
from peps_jax.human_study.database.stimuli import Stimuli


class Database(Stimuli, Participants, Assignments, Reports):
    """A study's database, opened. Several threads may share it; every process opens its own."""
