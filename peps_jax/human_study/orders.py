"""In which order each participant sees what, and on which sides."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence

from peps_jax.human_study.database.records import Place

AGREEING = 3  # people who see a shared pair
GAP = 5  # places at least between a pair and its repeat, where there is room
EARLY = 2 / 3  # of the order, in which pairs stand that are repeated


def pool(participants: int, asked: int, shared: float) -> tuple[int, int]:
    """How many pairs one person sees, and how many `AGREEING` do, so that all have enough."""
    number = round(participants * asked / (1 + (AGREEING - 1) * shared))
    three = round(shared * number)
    return max(number - three, asked), three


def of_pairs(
    seed: int, total: int, repeated: float = 0.0, shared: float = 0.0, checks: Sequence[int] = ()
) -> list[Place]:
    """A participant's order: which place is for what, and on which sides.

    Exactly half of an even number of pairs are swapped. A repeat comes later than its pair, on the other sides.

    Args:
      total: places, repeats and checks among them.
      repeated: share of them that are repeats.
      shared: share of the pairs that three people see.
      checks: numbers of the queries that check attention.
    """
    chance = random.Random(f"order {seed}")
    repeats = round(total * repeated)
    asked = total - repeats - len(checks)
    swapped = [place % 2 == 0 for place in range(asked - repeats + len(checks))]
    if len(swapped) % 2 and chance.random() < 0.5:
        swapped = [not side for side in swapped]
    chance.shuffle(swapped)
    both = [place % 2 == 0 for place in range(repeats)]  # first time; the second time they are the other way
    chance.shuffle(both)
    once = [Place("check", side, number=number) for number, side in zip(checks, swapped, strict=False)]
    once += [Place("ask", side) for side in [*swapped[len(checks) :], *both]]
    for place in chance.sample(range(len(checks), len(once)), round(asked * _share_of_places(shared))):
        once[place] = once[place]._replace(kind="shared")
    again = range(len(once) - repeats, len(once))  # of `once`: those that are repeated, none of them late
    order = chance.sample(range(len(once) - repeats), len(once) - repeats)
    for which in again:
        order.insert(chance.randint(0, int(EARLY * len(order))), which)
    for which in again:
        earliest = min(order.index(which) + 1 + GAP, len(order))
        order.insert(chance.randint(earliest, len(order)), which + len(once))
    repeat = lambda which: Place("repeat", not once[which].swapped, repeats=order.index(which))
    return [once[which] if which < len(once) else repeat(which - len(once)) for which in order]


def _share_of_places(shared: float) -> float:
    return AGREEING * shared / (1 + (AGREEING - 1) * shared)


def of_scenes(
    seed: int, rater: int, scenes: Mapping[str, Sequence[int]], each: int, shown: Mapping[int, int]
) -> list[Place]:
    """A rater's order: rounds in which every agent's scene comes once, by the rows of a balanced Latin square.

    Args:
      rater: how many raters there were before.
      scenes: numbers of each agent's.
      each: scenes of each agent that are shown.
      shown: how often each scene was shown to others; those that were shown least come first.
    """
    chance = random.Random(f"scenes {seed}")
    agents, square = sorted(scenes), latin_square(len(scenes))
    least = {
        agent: sorted(numbers, key=lambda number: (shown.get(number, 0), chance.random()))[:each]
        for agent, numbers in scenes.items()
    }
    rounds = min(map(len, least.values()), default=0)
    rows = [square[(rater + turn) % len(square)] for turn in range(rounds)]
    return [Place("rate", number=least[agents[agent]][turn]) for turn, row in enumerate(rows) for agent in row]


def latin_square(number: int) -> list[list[int]]:
    """Rows in which each of `number` is at each place equally often, and follows each other one equally often (Williams 1949).

    `number` rows, or twice as many where it is odd.
    """
    first = [place // 2 + 1 if place % 2 else (number - place // 2) % number for place in range(number)]
    rows = [[(entry + shift) % number for entry in first] for shift in range(number)]
    return rows + [row[::-1] for row in rows] * (number % 2)
