"""Teachers: who answers queries. Three of them, behind one door: `train(config, teacher=...)`.

SYNTHETIC            the synthetic human answers inside the program, from its biased belief
recorded(set)        everything was said before: nothing is asked, and answers count from the round on that they came in
host(function)       `function` is called between the halves of a round: a person, a web page, another program
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from peps_jax.config import Problem
from peps_jax.preferences import data, synthetic_human
from peps_jax.preferences.data import Answers, PreferenceSet, Queries
from peps_jax.settings import HumanSettings, Settings


class Teacher(NamedTuple):
    """Who answers.

    `answer(key, queries, problem, settings)` gives `Answers` to the queries of a round, inside the program.
    """

    answer: Callable[[Array, Queries, Problem, HumanSettings], Answers] = synthetic_human.answer
    recorded: PreferenceSet | None = None  # what was said before the training begins
    # (queries as numpy arrays, round) -> Answers to any queries so far, or None; called outside the program
    host: Callable[[Queries, int], Answers | None] | None = None
    asks: bool = True  # whether anything is asked in the training

    def check(self, asks: bool, settings: Settings, num_rounds: int) -> None:
        """Raises ValueError, in one line, if what was recorded doesn't fit a training of so many rounds with such settings.

        Args:
          asks: whether the training's method makes anything of preferences.
        """
        if self.recorded is None or not asks:
            return
        data.check(self.recorded, settings.agent.observation_size, settings.agent.action_space)
        if isinstance(self.recorded.since, jax.core.Tracer):
            return
        last = np.asarray(self.recorded.since).max()
        if last >= num_rounds:
            raise ValueError(
                f"preferences were given until round {last}, and this training has {num_rounds} rounds: raise "
                "total_steps, or take all from the start with preferences.data.at_once"
            )


SYNTHETIC = Teacher()


def recorded(preferences: PreferenceSet, then: Teacher | None = None) -> Teacher:
    """A teacher whose answers are recorded; `then` answers new queries beside them, by default nobody does.

    An answer counts from the round on in which it was given, so that a training from a recording of its own has its numbers.
    """
    return Teacher(recorded=preferences, asks=False) if then is None else then._replace(recorded=preferences)


def host(function: Callable[[Queries, int], Answers | None]) -> Teacher:
    """A teacher outside the program: `function(queries, round)` is called between the halves of each round.

    It returns `Answers`, of this round's queries or of earlier ones (late ones count from then on), or None for none. The
    training then runs round by round from the host, and can't be inside `jax.jit` or `jax.vmap`.
    """
    return Teacher(host=function)
