"""Synthetic participants in people's chairs: they come with a token and do over HTTP what the pages do.

They see what people see. A clip that comes over HTTP is recognised among those that the study's database holds, and its segment
is judged as the synthetic human judges it, from a belief of each participant's own. On a road they are the driving study's
participants; elsewhere they have the task's biased belief, and differ in how reliably they answer. Some answer at random.
"""

from __future__ import annotations

import http.client
import json
import urllib.parse
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_jax import explicability, generator
from peps_jax.config import Config, Problem
from peps_jax.human_study import pairs, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Stimulus
from peps_jax.preferences import synthetic_human
from peps_jax.preferences.data import Queries, Segments
from peps_jax.reproduce.driving import participants as drivers
from peps_jax.settings import HumanSettings, settings_of

SPREAD = 0.3  # of the logarithm of rationality, between people
MISTAKES = 0.02  # share of answers that are slips of the finger
NOISE = 1.0  # standard deviation of what a rating has beside what is felt
FRAMES = 30  # that are said to have been drawn
REACTION = 1_200  # ms, median


@struct.dataclass
class Minds:
    """What people believe and how they answer; every leaf has a leading axis of people."""

    belief: Any
    manner: HumanSettings
    importance: Array  # (people, 4) from 1 to 5, of what a road's participants are asked


def minds(env: str, seed: int, number: int) -> Minds:
    """`number` people who know an environment: their belief of it, and how reliably they answer."""
    problem, key = pairs.problem(env), jax.random.fold_in(generator.key(seed), 3)
    if pairs.is_road(env):
        people = drivers.recruit(key, number)
        believed = jax.vmap(drivers.mind, in_axes=(0, None))(people, problem.params)
        asked = jnp.stack(jax.tree.leaves(people.ratings), 1)
        return Minds(believed, jax.vmap(drivers.manner)(people), jnp.clip(jnp.round(asked), 1, 5))
    key_rationality, key_careless, key_importance = jax.random.split(key, 3)
    human = settings_of(Config(env=env), problem).human
    repeat = lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (number, *jnp.shape(leaf)))
    rationality = human.rationality * jnp.exp(SPREAD * jax.random.normal(key_rationality, (number,)))
    careless = jax.random.bernoulli(key_careless, drivers.CARELESS, (number,))
    manner = jax.tree.map(repeat, human).replace(
        rationality=jnp.where(careless, 0.0, rationality).astype(jnp.float32),
        mistake_rate=jnp.full(number, MISTAKES, jnp.float32),
    )
    importance = jax.random.randint(key_importance, (number, 4), 1, 6)
    return Minds(jax.tree.map(repeat, problem.belief), manner, importance)


@jax.jit
def prefers(key: Array, left: Segments, right: Segments, problem: Problem, manner: HumanSettings) -> Array:
    """P(left preferred) that one person states: 1, 0, or 1/2 for a tie; -1 of who can't tell."""
    both = jax.tree.map(lambda *rows: jnp.stack(rows)[None], left, right)
    said = synthetic_human.answer(key, Queries(jnp.zeros(1, jnp.int32), both), problem, manner)
    return jnp.where(said.weight > 0, said.preferred, -1.0)[0]


def worth(scenes: Segments, problem: Problem) -> Array:
    """(n,) explicability of `scenes` (n, horizon, ...) to who has the problem's belief: sum r_H + sum (l_H - l_A)."""
    score = lambda *transition: explicability.score(problem, *transition)
    scores = jax.vmap(jax.vmap(score))(scenes.state, scenes.action, scenes.next_state)
    return jnp.sum(jnp.where(scenes.mask, scores.explicability, 0.0), -1)


@jax.jit
def ratings(key: Array, scenes: Segments, problem: Problem, rationality: Array) -> Array:
    """(n,) what one person rates `scenes` (n, horizon, ...): how often they would prefer each to another one, and noise.

    rating_i = 1 + 9 mean_j sigmoid(rationality (E_i - E_j)), E the explicability by their own belief, as in the driving study.
    """
    value = worth(scenes, problem)
    wins = jax.nn.sigmoid(rationality * (value[:, None] - value[None]))
    felt = 1 + 9 * jnp.mean(wins, 1) + NOISE * jax.random.normal(key, value.shape)
    return jnp.clip(jnp.round(felt), 1, 10).astype(jnp.int32)


# --- seeing -----------------------------------------------------------------------------------------------------------------


class Eyes:
    """Recognises clips: which segment of the study's a drawing shows.

    Args:
      load: gives all pairs, or all scenes, that there are by now.
    """

    def __init__(self, problem: Problem, load: Callable[[], Sequence[Stimulus]]):
        self._problem, self._load = problem, load
        self._known: dict[str, Segments] = {}

    def see(self, clip: Any) -> Segments:
        """The segment that is shown. Raises ValueError if there is none."""
        name = _canonical(clip)
        if name not in self._known:
            self._look_around()
        if name not in self._known:
            raise ValueError("a clip is shown that the study's database doesn't hold")
        return self._known[name]

    def _look_around(self) -> None:
        for one in self._load():
            names = [_canonical(json.loads(drawing)) for drawing in one.drawings]
            if all(name in self._known for name in names):
                continue
            segments = jax.tree.map(lambda rows: rows[0], pairs.segments_of(self._problem, [one]))
            for side, name in enumerate(names):
                shown = segments if len(names) == 1 else jax.tree.map(lambda rows: rows[side], segments)  # noqa: B023
                self._known.setdefault(name, shown)


def _canonical(drawing: Any) -> str:
    return json.dumps(drawing, sort_keys=True)


# --- taking part ------------------------------------------------------------------------------------------------------------


class RefusedError(Exception):
    """The server refused a request; its status and line."""


class Door:
    """The study's server, as one token's holder reaches it."""

    def __init__(self, address: str, token: str):
        where = urllib.parse.urlsplit(address)
        self._connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=60)
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}

    def get(self, path: str) -> Any:
        return self._ask("GET", path, None)

    def post(self, path: str, **body: Any) -> Any:
        return self._ask("POST", path, json.dumps(body))

    def close(self) -> None:
        self._connection.close()

    def _ask(self, method: str, path: str, body: str | None) -> Any:
        for again in (True, False):
            try:
                self._connection.request(method, f"/api/{path}", body, self._headers)
                reply = self._connection.getresponse()
                content = json.loads(reply.read())
                break
            except ConnectionError:  # closed meanwhile; a request that is made twice does what it does once
                self._connection.close()
                if not again:
                    raise
        if reply.status != 200:
            raise RefusedError(f"{method} /api/{path}: {reply.status}, {content.get('error')}")
        return content


class Participant:
    """One person at the study's pages, who goes on a page, a pair or a scene at a time.

    Args:
      mind: what they believe and how they answer, a row of `minds`.
      seed: of their own chance.
      eyes: for pairs, or for scenes.
      pool: all scenes that raters see, which they compare with; None of who compares pairs.
    """

    def __init__(self, door: Door, mind: Minds, seed: int, problem: Problem, eyes: Eyes, pool: Segments | None = None):
        self._door, self._mind, self._eyes = door, mind, eyes
        self._problem, self._key = problem.replace(belief=mind.belief), generator.key(seed)
        self._chance = np.random.default_rng(seed)
        self._pool, self._felt = pool, None if pool is None else self._ratings(pool)
        self._state = door.get("state")

    @property
    def page(self) -> str:
        """Where they are in the study."""
        return self._state["page"]

    @property
    def code(self) -> str | None:
        """That the last page gives them."""
        return self._state["code"]

    def go_on(self) -> bool:
        """One step; whether there was one, or all there is at present is done."""
        steps: Mapping[str, Callable[[], Any]] = {
            "consent": lambda: self._door.post("consent", agreed=True, platform={}),
            "check": lambda: self._door.post("proceed", page="check", report={"simulated": True}),
            "instructions": lambda: self._door.post("proceed", page="instructions"),
            "importance": self._say_importance,
            "pairs": self._compare,
            "ratings": self._rate,
        }
        if self.page in steps:
            self._state = steps[self.page]()
            return True
        if self.page == "wait":
            self._state = self._door.get("state")
        return self.page not in ("wait", "done")

    def leave(self) -> None:
        """They close the page."""
        self._door.close()

    def _say_importance(self) -> Any:
        names = [one["name"] for one in self._state["importance"]]
        answers = {
            name: int(value) for name, value in zip(names, np.resize(self._mind.importance, len(names)), strict=True)
        }
        return self._door.post("importance", answers=answers, request=_request())

    def _compare(self) -> Any:
        shown = self._door.get("pair")
        if "place" not in shown:
            return self._door.get("state")
        left, right = (self._eyes.see(shown[side]) for side in ("left", "right"))
        key = jax.random.fold_in(self._key, shown["place"])
        said = float(prefers(key, left, right, self._problem, self._mind.manner))
        choice = {1.0: "left", 0.0: "right", 0.5: "equal", -1.0: "unclear"}[said]
        frames = {"left": FRAMES, "right": FRAMES}
        return self._door.post("answer", place=shown["place"], choice=choice, frames=frames, **self._watched())["state"]

    def _rate(self) -> Any:
        shown = self._door.get("scene")
        if "place" not in shown:
            return self._door.get("state")
        rating = self._rating_of(self._eyes.see(shown["clip"]))
        return self._door.post("rating", place=shown["place"], rating=rating, frames=FRAMES, **self._watched())["state"]

    def _ratings(self, pool: Segments) -> np.ndarray:
        return np.asarray(ratings(self._key, pool, self._problem, self._mind.manner.rationality))

    def _rating_of(self, scene: Segments) -> int:
        alike = [
            np.all(
                [
                    np.array_equal(one[row], other)
                    for one, other in zip(*map(jax.tree.leaves, (self._pool, scene)), strict=True)
                ]
            )
            for row in range(len(self._felt))
        ]
        return int(self._felt[int(np.argmax(alike))])

    def _watched(self) -> dict[str, Any]:
        reaction = REACTION * float(np.exp(0.4 * self._chance.standard_normal()))
        return {
            "reaction_ms": round(reaction), "watched_ms": round(2_000 + reaction), "hidden_ms": 0, "replays": 0,
            "request": _request(),
        }  # fmt: skip


def _request() -> str:
    return str(uuid.uuid4())


def all_pairs(database: Database) -> list[Stimulus]:
    """Every pair that is or was to be compared, checks among them."""
    return database.stimuli([row["number"] for row in database.tables()["queries"]])


def all_scenes(database: Database) -> list[Stimulus]:
    """Every scene that is to be rated."""
    return [one for agent in database.scenes() for one in database.scene_stimuli(agent)]


def take_seats(
    database: Database, address: str, env: str, phase: str, number: int, seed: int, given: Sequence[str] | None = None
) -> list[Participant]:
    """`number` synthetic participants, at the first page.

    Args:
      given: tokens that they come with; by default they are invited here.
    """
    if given is None:
        given = [tokens.new() for _ in range(number)]
        database.invite(phase, [tokens.digest(token) for token in given])
    problem, people = pairs.problem(env), minds(env, seed, number)
    scenes = all_scenes(database) if phase == "testing" else []
    pool = pairs.segments_of(problem, scenes) if scenes else None
    eyes = Eyes(problem, (lambda: scenes) if scenes else lambda: all_pairs(database))

    def sit(place: int) -> Participant:
        mind = jax.tree.map(lambda rows: rows[place], people)
        return Participant(Door(address, given[place]), mind, 1_000 * seed + place, problem, eyes, pool)

    return list(map(sit, range(number)))


def take_part(people: Sequence[Participant]) -> None:
    """All of them, by turns, until nobody has anything more to do; then they leave."""
    try:
        while sum(person.go_on() for person in people):
            pass
    finally:
        for person in people:
            person.leave()
