"""The paper's driving study (Sec. 5.2) with synthetic participants: labels on a dry road, agents in the rain, ratings of them.

    python -m peps_jax.study --seeds 10 --out results/study

One group of participants compares pieces of scenes on a dry road, in none of which anybody crashes; a sanity check leaves out
who prefers a collision. From their answers each method learns, and acts in the rain. Other participants then rate what was
learned, from 1 to 10, by what they themselves believe and want. Nobody is told which method made a scene.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

import peps_envs
from peps_envs.highway.environment import HighwayParams, Ratings
from peps_envs.highway.vehicle import IDLE, LANE_WIDTH, SLOWER
from peps_jax import explicability, rollout
from peps_jax.config import Config
from peps_jax.parts import human, queries
from peps_jax.parts.trajectory import Preferences, Segments
from peps_jax.train import Result, train

METHODS = ("peps", "sac", "drlhp", "policy_shaping")
BEHAVIOURS = ("steers at once", "brakes, then steers", "stays in the lane")

# A scene pays about 7, where a way through navigation's maze pays about 100: entropies weigh less, rewards needn't be scaled.
SETTINGS = dict(
    lam=2.0, gamma=0.99, num_envs=16, rollout_length=24, warmup_steps=1_920,
    hold_steps=2, reward_scale=1.0, policy_entropy_weight=0.02, initial_temperature=2.0, temperature=0.01,
    segment_length=8, num_queries=4_000,
)  # fmt: skip

ONSET = (0.0, 0.4)  # s, when the car in front begins to brake: nobody can count on it and brake before

TRAINERS, ANSWERS = 15, 200  # participants who compare, and how many pairs each of them
RATERS, SHOWN = 15, 3  # participants who rate, and scenes of each method that they see
GROUPS = 100  # of raters, re-drawn
CARELESS = 0.1  # share of participants who answer at random


def road(name: str, **changes: Any) -> Config:
    """A `Config` of "highway-dry", the regular condition, or "highway-rain", with the scene of the study on it."""
    task = peps_envs.make(name)
    onset = jnp.asarray(ONSET, jnp.result_type(float))
    begin = lambda params: params.replace(scenario=params.scenario.replace(onset=onset))
    return Config(env=name, params=begin(task.params), belief=begin(task.beliefs["both"]), **changes)


# --- participants ---------------------------------------------------------------------------------------------------------


@struct.dataclass
class Participants:
    """What each believes, wants, and how reliably they answer; every leaf has a leading axis of participants."""

    ratings: Ratings  # importance, 1 to 5
    lane_change_cost: Array
    swerve_cost: Array
    dry_share: Array  # of the way from the road's true friction to a dry one's that is believed: 1 is the paper's bias
    rationality: Array  # coefficient of Eq. (2), 0 of who answers at random


def recruit(key: Array, number: int) -> Participants:
    """`number` participants, scattered around the presets' human.

    Importance is rated on a 5-point scale around the paper's means with a standard deviation of 0.8; costs are log-normal;
    how dry the road is taken for is triangular on [0, 1] with its peak at 1.
    """
    key_ratings, key_costs, key_dry, key_rationality, key_careless = jax.random.split(key, 5)
    task = peps_envs.make("highway-dry")
    mean, want = jnp.stack(jax.tree.leaves(task.params.ratings)), task.beliefs["reward"]
    scores = jnp.clip(mean[:, None] + 0.8 * jax.random.normal(key_ratings, (mean.shape[0], number)), 1.0, 5.0)
    timidity = jnp.exp(0.3 * jax.random.normal(key_costs, (number,)))
    careless = jax.random.bernoulli(key_careless, CARELESS, (number,))
    rationality = 2.0 * jnp.exp(0.3 * jax.random.normal(key_rationality, (number,)))
    return Participants(
        ratings=jax.tree.unflatten(jax.tree.structure(task.params.ratings), list(scores)),
        lane_change_cost=want.lane_change_cost * timidity,
        swerve_cost=want.swerve_cost * timidity,
        dry_share=jnp.sqrt(jax.random.uniform(key_dry, (number,))),
        rationality=jnp.where(careless, 0.0, rationality),
    )


def mind(participant: Participants, params: HighwayParams) -> HighwayParams:
    """The belief of one participant about the road `params`."""
    dry, friction = peps_envs.make("highway-dry").params.physics.friction, params.physics.friction
    believed = jax.tree.map(lambda true, dry: true + participant.dry_share * (dry - true), friction, dry)
    return params.replace(
        physics=params.physics.replace(friction=believed),
        ratings=participant.ratings,
        lane_change_cost=participant.lane_change_cost,
        swerve_cost=participant.swerve_cost,
    )


def answers(key: Array, participants: Participants, segments: Segments, config: Config) -> Preferences:
    """Each participant's answers to pairs of their own: rows (participants, pairs, ...) of segments and answers."""
    _, params, _ = config.task()

    def one(key: Array, participant: Participants, segments: Segments) -> Preferences:
        own = config.replace(belief=mind(participant, params), rationality=participant.rationality)
        return human.answer(key, segments, own)

    return jax.vmap(one)(jax.random.split(key, participants.rationality.shape[0]), participants, segments)


def attentive(key: Array, participants: Participants) -> Array:
    """(participants,) bool: the sanity check, on a dry road. Who prefers a collision to braking before it fails."""
    config = road("highway-dry")
    plans = [lambda observation, key, time, action=action: jnp.full(1, action) for action in (SLOWER, IDLE)]
    pair = jax.tree.map(lambda *rows: jnp.stack(rows, 1), *(watch(plan, config, key, 1) for plan in plans))
    number = participants.rationality.shape[0]
    shown = jax.tree.map(lambda rows: jnp.broadcast_to(rows, (number, *rows.shape)), pair)
    return answers(key, participants, shown, config).answers[:, 0] == 1.0


# --- scenes ---------------------------------------------------------------------------------------------------------------


def watch(act: Callable[[Array, Array, Array], Array], config: Config, key: Array, number: int) -> Segments:
    """`number` scenes of `config`'s world, whole: (number, horizon, ...), masked after a crash. `act` as in `rollout.collect`."""
    environment, _, _ = config.task()
    config = config.replace(num_envs=number, rollout_length=environment.horizon)
    key_start, key_steps = jax.random.split(key)
    _, trajectory, _ = rollout.collect(rollout.init(key_start, config), act, key_steps, config)
    rows = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), trajectory)
    over = rows.transition.terminated
    return Segments(
        observation=rows.transition.observation,
        action=rows.transition.action,
        mask=jnp.where(jnp.cumsum(over, 1) - over > 0, 0.0, 1.0),
        state=rows.state,
        next_state=rows.next_state,
    )


def watch_agent(result: Result, key: Array, number: int) -> Segments:
    """`number` scenes of a trained agent, which acts by its policy's mode."""
    return watch(lambda observation, key, time: result.policy()(observation, None)[0], result.config, key, number)


def crashed(scenes: Segments) -> Array:
    """(...,) bool: whether the ego crashes in what a scene, or a piece of one, shows."""
    return jnp.any(scenes.next_state.vehicles.crashed[..., 0] & (scenes.mask > 0), -1)


def behaviour(scenes: Segments) -> Array:
    """(n,) place in `BEHAVIOURS` of each whole scene, by what can be seen: whether it changes lane, and what came before.

    It brakes when it is 2 m/s slower than at the start, and steers when it is 0.5 m off its line, after a policy step each.
    """
    ego = jax.tree.map(lambda rows: rows[..., 0], scenes.next_state.vehicles)
    start = scenes.state.vehicles
    first = lambda happens: jnp.where(jnp.any(happens, 1), jnp.argmax(happens, 1), happens.shape[1])
    seen = scenes.mask > 0
    slower = first((ego.speed < start.speed[:, :1, 0] - 2.0) & seen)
    aside = first((jnp.abs(ego.y - start.y[:, :1, 0]) > 0.5) & seen)
    leaves = jnp.any((jnp.abs(ego.y - start.y[:, :1, 0]) > LANE_WIDTH / 2) & seen, 1)
    return jnp.where(leaves, jnp.where(slower < aside, 1, 0), 2)


# --- the training group's answers -----------------------------------------------------------------------------------------


def compare(key: Array) -> Preferences:
    """What the training group says of pieces of scenes on the dry road: TRAINERS * ANSWERS pairs, in none a collision.

    Meta-actions are random, each held for one to four steps. Who fails the sanity check doesn't count.
    """
    key_group, key_start, key_drive, key_pairs, key_answer, key_check = jax.random.split(key, 6)
    number, drivers = TRAINERS * ANSWERS, jnp.arange(128)
    config = road(
        "highway-dry", num_envs=128, rollout_length=24, total_steps=128 * 24, num_queries=number,
        segment_length=SETTINGS["segment_length"],
    )  # fmt: skip

    def act(observation: Array, key: Array, time: Array) -> Array:
        drawn = lambda driver: jax.random.fold_in(jax.random.fold_in(key_drive, driver), time // (1 + driver % 4))
        return jax.vmap(lambda driver: jax.random.randint(drawn(driver), (), 0, 5))(drivers)

    _, trajectory, _ = rollout.collect(rollout.init(key_start, config), act, key_drive, config)
    candidates = queries.candidates(trajectory, key_pairs, config)
    safe = jnp.argsort(jnp.any(crashed(candidates), -1), stable=True)[:number]
    pairs = jax.tree.map(lambda rows: rows[safe].reshape(TRAINERS, ANSWERS, *rows.shape[1:]), candidates)
    participants = recruit(key_group, TRAINERS)
    given = answers(key_answer, participants, pairs, config)
    counted = given.answered * attentive(key_check, participants)[:, None]
    return jax.tree.map(lambda rows: rows.reshape(number, *rows.shape[2:]), given._replace(answered=counted))


def teacher(given: Preferences) -> human.Teacher:
    """Answers that were given beforehand: each query of a training is replaced by one of them, drawn at random."""

    def answer(key: Array, segments: Segments, config: Config) -> Preferences:
        number = given.answers.shape[0]
        index = jax.random.randint(key, (segments.mask.shape[0],), 0, number)
        return jax.tree.map(lambda rows: rows[index], given)

    return human.Teacher(answer=answer)


# --- ratings --------------------------------------------------------------------------------------------------------------


def worth(participant: Participants, scenes: Segments, config: Config) -> Array:
    """(n,) explicability of `scenes` (n, horizon, ...) to one participant: sum r_H + sum (l_H - l_A) by their own belief."""
    environment, params, _ = config.task()
    belief = mind(participant, params)
    score = lambda *transition: explicability.score(environment, params, belief, *transition)
    scores = jax.vmap(jax.vmap(score))(scenes.state, scenes.action, scenes.next_state)
    return jnp.sum(scores.explicability * scenes.mask, -1)


def rate(key: Array, participants: Participants, scenes: Segments, config: Config) -> Array:
    """(participants, n) ratings from 1 to 10 of `scenes` (n, horizon, ...), which each participant has seen all of.

    rating_i = 1 + 9 mean_j sigmoid(rationality (E_i - E_j)): how often they would prefer the scene to another one that they
    saw, by their own Eq. (2). On the form it gets noise of standard deviation 1 and is a whole number.
    """

    def one(key: Array, participant: Participants) -> Array:
        value = worth(participant, scenes, config)
        wins = jax.nn.sigmoid(participant.rationality * (value[:, None] - value[None]))
        felt = 1 + 9 * jnp.mean(wins, 1) + jax.random.normal(key, value.shape)
        return jnp.clip(jnp.round(felt), 1.0, 10.0)

    return jax.lax.map(lambda row: one(*row), (jax.random.split(key, participants.rationality.shape[0]), participants))


class Group(NamedTuple):
    """What one group of raters said."""

    mean: dict[str, float]  # by method, over raters
    sd: dict[str, float]
    p: float  # of a one-way ANOVA over the raters' means
    eta_squared: float  # share of the variance that lies between methods


def analyse(ratings: dict[str, np.ndarray]) -> Group:
    """One-way ANOVA of each rater's mean rating, (raters,) for each method."""
    from scipy import stats

    values = list(ratings.values())
    together = np.concatenate(values)
    between = sum(len(one) * (np.mean(one) - np.mean(together)) ** 2 for one in values)
    return Group(
        mean={method: float(np.mean(one)) for method, one in ratings.items()},
        sd={method: float(np.std(one, ddof=1)) for method, one in ratings.items()},
        p=float(stats.f_oneway(*values).pvalue),
        eta_squared=float(between / np.sum((together - np.mean(together)) ** 2)),
    )


def groups(key: Array, scenes: dict[str, Segments], config: Config, number: int = GROUPS) -> list[Group]:
    """`number` re-drawn groups of RATERS who passed the sanity check; each is shown SHOWN scenes of each method, drawn anew."""
    together = jax.tree.map(lambda *rows: jnp.stack(rows), *scenes.values())  # (methods, n, horizon, ...)
    methods, pool = together.mask.shape[:2]

    def one(key: Array) -> tuple[Array, Array]:
        key_recruit, key_check, key_show, key_rate = jax.random.split(key, 4)
        volunteers = recruit(key_recruit, 2 * RATERS)
        failed = ~attentive(key_check, volunteers)
        order = jnp.argsort(failed, stable=True)[:RATERS]
        raters = jax.tree.map(lambda rows: rows[order], volunteers)
        shown = jax.random.randint(key_show, (methods, SHOWN), 0, pool)
        drawn = jax.tree.map(lambda rows: jax.vmap(lambda row, which: row[which])(rows, shown), together)
        flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), drawn)
        return rate(key_rate, raters, flat, config).reshape(RATERS, methods, SHOWN).mean(-1)

    ratings = np.asarray(jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(key, number)))
    return [analyse(dict(zip(scenes, group.T, strict=True))) for group in ratings]


# --- the study ------------------------------------------------------------------------------------------------------------


class Findings(NamedTuple):
    """What the study found."""

    scenes: dict[str, Segments]  # by method: (seeds * episodes, horizon, ...)
    behaviour: dict[str, list[list[float]]]  # by method and seed: the share of scenes with each of `BEHAVIOURS`
    crash_rate: dict[str, list[float]]  # by method and seed
    groups: list[Group]  # of raters; the first is the study's own

    def summary(self) -> dict[str, Any]:
        """As JSON knows it."""
        highest = [max(group.mean, key=group.mean.get) == "peps" for group in self.groups]
        significant = [group.p < 0.05 for group in self.groups]
        share = lambda flags: float(np.mean(flags))
        return {
            "behaviours": BEHAVIOURS,
            "behaviour": self.behaviour,
            "crash_rate": self.crash_rate,
            "ratings": self.groups[0]._asdict(),
            "groups": len(self.groups),
            "peps_highest": share(highest),
            "significant": share(significant),
            "peps_highest_and_significant": share(np.logical_and(highest, significant)),
        }


def learn(method: str, seeds: Sequence[int], steps: int, episodes: int) -> Segments:
    """Scenes in the rain of an agent for each seed, each taught by a group of its own: (seeds, episodes, horizon, ...)."""

    def one(seed: Array) -> Segments:
        config = road("highway-rain", method=method, total_steps=steps, **SETTINGS).replace(seed=seed)
        key_group, key_watch = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
        return watch_agent(train(config, teacher(compare(key_group))), key_watch, episodes)

    return jax.jit(lambda seeds: jax.lax.map(one, seeds))(jnp.asarray(seeds))


def run(
    seeds: Sequence[int],
    steps: int = 20_000,
    episodes: int = 100,
    methods: Sequence[str] = METHODS,
    number: int = GROUPS,
) -> Findings:
    """The whole study: labels, agents, and `number` groups of raters."""
    scenes, behaviours, crashes = {}, {}, {}
    for method in methods:
        print(f"training {method}, {len(seeds)} seeds", file=sys.stderr, flush=True)
        learned = learn(method, seeds, steps, episodes)
        kinds = np.asarray(jax.vmap(behaviour)(learned))
        behaviours[method] = [[float(np.mean(row == kind)) for kind in range(len(BEHAVIOURS))] for row in kinds]
        crashes[method] = np.mean(np.asarray(crashed(learned)), 1).tolist()
        scenes[method] = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), learned)
    print(f"{number} groups of raters", file=sys.stderr, flush=True)
    rated = groups(jax.random.fold_in(jax.random.key(seeds[0]), 2), scenes, road("highway-rain"), number)
    return Findings(scenes, behaviours, crashes, rated)


def figure3(
    out: str | Path, seeds: Sequence[int] = range(10), steps: int = 20_000, methods: Sequence[str] = METHODS
) -> dict[str, Any]:
    """Runs the study and writes figure3.png, figure3.gif and study.json into `out`; returns what study.json holds."""
    from peps_jax import film

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    findings = run(seeds, steps, methods=methods)
    summary = findings.summary()
    rated = findings.groups[0]
    shown = {
        f"{method} (μ = {rated.mean[method]:.1f}, σ = {rated.sd[method]:.1f})": typical(scenes)
        for method, scenes in findings.scenes.items()
    }
    film.strips(shown, f"one-way ANOVA: p = {rated.p:.2g}").savefig(out / "figure3.png", dpi=150)
    film.animate(shown, out / "figure3.gif")
    (out / "study.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def typical(scenes: Segments) -> Segments:
    """The first of `scenes` (n, horizon, ...) that behaves as most of them do: (horizon, ...)."""
    kinds = np.asarray(behaviour(scenes))
    most = np.bincount(kinds, minlength=len(BEHAVIOURS)).argmax()
    return jax.tree.map(lambda rows: rows[int(np.argmax(kinds == most))], scenes)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m peps_jax.study", description="The paper's driving study, simulated."
    )
    parser.add_argument("--out", default="results/study", help="folder to write [results/study]")
    parser.add_argument(
        "--seeds", type=int, default=10, help="agents of each method, each with trainers of its own [10]"
    )
    parser.add_argument("--seed", type=int, default=0, help="the first of them [0]")
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps of a training [20000]")
    values = parser.parse_args(arguments)
    if min(values.seeds, values.steps) < 1 or values.seed < 0:
        parser.error("seeds and steps are whole numbers from 1 on, seed from 0 on")
    summary = figure3(values.out, range(values.seed, values.seed + values.seeds), values.steps)
    for method, shares in summary["behaviour"].items():
        kinds = ", ".join(f"{kind} {share:.0%}" for kind, share in zip(BEHAVIOURS, np.mean(shares, 0), strict=True))
        rated = f"rated {summary['ratings']['mean'][method]:.1f} ± {summary['ratings']['sd'][method]:.1f}"
        print(f"{method}: {kinds}; crashes {np.mean(summary['crash_rate'][method]):.0%}; {rated}")
    print(
        f"p = {summary['ratings']['p']:.2g}, eta squared {summary['ratings']['eta_squared']:.2f}; of {summary['groups']} groups "
        f"{summary['peps_highest_and_significant']:.0%} rate PEPS highest with p < 0.05"
    )
    print(f"in {values.out}: figure3.png, figure3.gif, study.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
