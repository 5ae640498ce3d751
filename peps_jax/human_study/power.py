"""How many raters a study needs: studies of so many are drawn from ratings that are there, simulated ones or a pilot's.

Power is the share of those studies in which the main test finds a difference, p < 0.05 with Greenhouse and Geisser's correction.
What it says of people is as good as the ratings it draws from: the synthetic ones are steadier than people are, and a pilot of
few raters repeats itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from peps_jax.human_study import statistics
from peps_jax.human_study.statistics import Share

ALPHA, POWER = 0.05, 0.8
FEWEST, SHOWN, MOST = 3, 10, 60  # raters that are tried: at least up to the second number
STUDIES = 1_000  # drawn for each number of raters


class Planned(NamedTuple):
    """Studies with so many raters."""

    raters: int
    main: Share  # of them in which the repeated-measures test finds a difference
    one_way: Share  # the paper's test, for comparison
    first_best: Share  # the main test does, and the first agent is rated highest


def power(ratings: ArrayLike, raters: int, studies: int = STUDIES, seed: int = 0) -> Planned:
    """What comes out of `studies` studies with `raters` raters each, drawn with replacement from ratings (raters, agents)."""
    from scipy import stats

    ratings = np.asarray(ratings, np.float64)
    agents = ratings.shape[1]
    chosen = np.random.default_rng((seed, raters)).integers(len(ratings), size=(studies, raters))
    drawn = ratings[chosen]
    mean = drawn.mean(1)
    f, _, epsilon = statistics.repeated_measures_of(drawn)
    differ = np.ptp(mean, axis=1) > 0
    p = stats.f.sf(f, epsilon * (agents - 1), epsilon * (agents - 1) * (raters - 1))
    found = np.where(np.isnan(f), differ, p < ALPHA)
    between = raters * np.sum((mean - mean.mean(1, keepdims=True)) ** 2, 1) / (agents - 1)
    within = np.sum((drawn - mean[:, None]) ** 2, (1, 2)) / (agents * (raters - 1))
    critical = stats.f.isf(ALPHA, agents - 1, agents * (raters - 1))
    first = np.argmax(mean, 1) == 0
    return Planned(
        raters,
        main=statistics.share(found),
        one_way=statistics.share((between > critical * within) & differ),
        first_best=statistics.share(found & first),
    )


def plan(ratings: ArrayLike, most: int = MOST) -> list[Planned]:
    """`power` for every number of raters up to twice the first that reaches `POWER`; up to `most` if none does.

    Raises:
      ValueError: fewer than two raters or agents.
    """
    statistics.one_way(ratings)  # its complaint is ours
    planned = []
    for raters in range(FEWEST, most + 1):
        planned.append(power(ratings, raters))
        enough = needed(planned)
        if enough is not None and raters >= max(2 * enough, SHOWN):
            break
    return planned


def needed(planned: list[Planned]) -> int | None:
    """The fewest raters with `POWER` or more, from where on it stays there; None if none of those tried has it."""
    enough = None
    for one in planned:
        enough = (enough or one.raters) if one.main.share >= POWER else None
    return enough


def said(planned: list[Planned], source: str) -> str:
    """What the analysis says, in a line.

    Args:
      source: of the ratings, such as "40 simulated raters".
    """
    enough = needed(planned)
    tried = f"in {STUDIES} studies drawn from {source}"
    if enough is None:
        last = planned[-1]
        return f"{last.raters} raters find a difference (p < {ALPHA}) with power {last.main.share:.2f} {tried}: more are needed"
    found = next(one for one in planned if one.raters == enough)
    return (
        f"{enough} raters find a difference (p < {ALPHA}) with power {found.main.share:.2f} {tried}; the paper's one-way test has "
        f"{found.one_way.share:.2f}"
    )
