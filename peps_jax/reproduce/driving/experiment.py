"""The experiment: agents learn from the training group's answers, drive in the rain, and are rated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_jax import generator, methods
from peps_jax.config import Config
from peps_jax.execution.devices import compile_over_devices
from peps_jax.execution.program import shared
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving.comparisons import ANSWERS, compare
from peps_jax.reproduce.driving.ratings import GROUPS, Group, groups
from peps_jax.reproduce.driving.scenes import BEHAVIOURS, HORIZON, RAIN, behaviour, crashed, road, watch_agent
from peps_jax.reproduce.store import settings_of
from peps_jax.storage import code, files
from peps_jax.train import train

METHODS = ("peps", "sac", "drlhp", "policy_shaping")
RATED = METHODS[:3]  # by the paper's participants. A rating says how a scene compares with the others that a rater saw
STEPS, EPISODES = 30_000, 100  # environment steps of a training, and scenes in which it is seen
FEW_SEEDS = 3  # at each lambda and number of answers beside the study's own

# A scene pays about 7, where a way through navigation's maze pays about 100: entropies weigh less, rewards needn't be scaled.
SETTINGS = dict(
    lam=2.0, gamma=0.99, num_envs=16, rollout_length=24, warmup_steps=1_920, updates_per_step=0.5,
    hold_steps=2, reward_scale=0.25, policy_entropy_weight=0.02, initial_temperature=2.0, temperature=0.01,
    segment_length=HORIZON, num_queries=1, surrogate_learning_rate=2e-3,  # nothing is asked: all was said before
    # answers are many, and r-hat is learned from them alone, as in the paper
    prior="none", surrogate_updates=40, exploration=0.2, critic_normalisation=False, learning_rate=1e-3, batch_size=256,
    product="gaussians",  # of discrete actions
    entropy_fade_share=0.0,  # people watch the mode, and it weighs next to nothing
)  # fmt: skip
LAMS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)  # over which PEPS is shown
EACH = (20, 50, 100, ANSWERS)  # answers of each participant, over which PEPS is shown


def settings(method: str, seed: int, steps: int = STEPS, **changes: Any) -> Config:
    """The training of one agent, in the rain."""
    return road(RAIN, method=method, total_steps=steps, **(SETTINGS | changes)).replace(seed=seed)


class Seen(NamedTuple):
    """What is seen of one agent in the rain."""

    scenes: Segments  # (episodes, HORIZON, ...)
    kind: Array  # (episodes,) place in `BEHAVIOURS`
    crashed: Array  # (episodes,) bool
    return_: Array  # (episodes,) sum of r_A
    finite: Array  # () bool: what was learned is

    def arrays(self) -> dict[str, np.ndarray]:
        """What a file holds of it: its leaves, numbered."""
        return {str(place): np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(self))}


def learn(config: Config, each: Array | int, episodes: int) -> Seen:
    """One agent, taught by a group of its own with `each` answers of everybody, in the rain."""
    key_group, key_watch = jax.random.split(jax.random.fold_in(generator.key(config.seed), 1))
    asks = methods.get(config.method).asks  # what nobody hears needn't be traced
    teacher = teachers.recorded(data.recording(*compare(key_group, each))) if asks else teachers.SYNTHETIC
    result = train(config, teacher)
    scenes = watch_agent(result, key_watch, episodes)
    problem = result.training.problem
    reward = jax.vmap(jax.vmap(problem.environment.reward, (0, 0, 0, None)), (0, 0, 0, None))
    rewards = reward(scenes.state, scenes.action, scenes.next_state, problem.params)
    leaves = jax.tree.leaves((result.agents, result.knowledge))
    learned = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return Seen(
        scenes=scenes,
        kind=behaviour(scenes),
        crashed=crashed(scenes),
        return_=jnp.sum(jnp.where(scenes.mask, rewards, 0.0), -1),
        finite=jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in learned])),
    )


class Variant(NamedTuple):
    """What the study is tried with."""

    lam: float = SETTINGS["lam"]
    each: int = ANSWERS  # answers of every participant


OWN = Variant()


class Part(NamedTuple):
    """Agents that are trained by one program: one method's, in every variant and with every seed."""

    method: str
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    steps: int
    episodes: int
    over: str = ""  # what the variants differ in; nothing of the study's own

    @property
    def name(self) -> str:
        return f"driving-{self.method}{self.over and f'-over-{self.over}'}-{len(self.seeds)}-seeds"

    @property
    def doing(self) -> str:
        return f"training {len(self.agents)} agents, {self.name}"

    @property
    def agents(self) -> list[tuple[Config, int]]:
        """Their settings, and how many answers each of their teachers gives."""
        return [
            (settings(self.method, seed, self.steps, lam=variant.lam), variant.each)
            for variant in self.variants
            for seed in self.seeds
        ]

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers: every setting, road and belief by their numbers, and the code."""
        agents = [_recipe(config) | {"each": each} for config, each in self.agents]
        return {"agents": agents, "scenes": self.episodes, "code": code.digest(__name__)}

    def of(self, arrays: Mapping[str, np.ndarray]) -> Seen:
        """What a file's arrays were made of."""
        like = jax.eval_shape(lambda config, each: learn(config, each, self.episodes), *self.agents[0])
        return jax.tree.unflatten(jax.tree.structure(like), [arrays[str(place)] for place in range(len(arrays))])

    def make(self, num_episodes: int = 0) -> Seen:
        """Trains and watches its agents over all devices: numpy arrays, (variants, seeds, ...)."""
        del num_episodes  # the driving study has its own
        agents = [(shared(config), each) for config, each in self.agents]
        program, leaves = compile_over_devices(lambda agent: learn(*agent, self.episodes), agents)
        number, shape = len(agents), (len(self.variants), len(self.seeds))
        shaped = lambda rows: np.asarray(rows)[:number].reshape(*shape, *rows.shape[1:])
        return jax.tree.map(shaped, program(leaves))


def _recipe(config: Config) -> dict[str, Any]:
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves((config.params, config.belief))]
    return settings_of(config.replace(params=None, belief=None)) | {"numbers": files.plain(numbers)}


def parts(seeds: Sequence[int], steps: int = STEPS) -> list[Part]:
    """What is trained: each of `METHODS` with all seeds, and PEPS in variants beside the study's own with fewer."""
    made = [Part(method, (OWN,), tuple(seeds), steps, EPISODES) for method in METHODS]
    variants = {"lambda": [Variant(lam=lam) for lam in LAMS], "answers": [Variant(each=each) for each in EACH]}
    for over, tried in variants.items():
        others = tuple(variant for variant in tried if variant != OWN)
        made += [Part("peps", others, tuple(seeds[:FEW_SEEDS]), steps, EPISODES, over)] * bool(others)
    return made


class Conduct(NamedTuple):
    """How the agents of one method behave, with a number or a row for each seed that didn't fail."""

    shares: list[list[float]]  # of scenes with each of `BEHAVIOURS`
    crash_rate: list[float]
    return_: list[float]  # mean sum of r_A
    failed: int  # seeds whose agent isn't finite

    def seeds_that(self, kind: int) -> int:
        """How many seeds show a behaviour in most scenes."""
        return sum(int(np.argmax(shares)) == kind for shares in self.shares)


def conduct(seen: Seen) -> Conduct:
    """Of `seen` (seeds, ...)."""
    good = np.flatnonzero(seen.finite)
    shares = np.stack([np.mean(seen.kind[good] == kind, 1) for kind in range(len(BEHAVIOURS))], 1)
    mean = lambda rows: np.mean(rows[good], 1).tolist()
    return Conduct(shares.tolist(), mean(seen.crashed), mean(seen.return_), len(seen.finite) - len(good))


class Findings(NamedTuple):
    """What the study found."""

    scenes: dict[str, Segments]  # by method, at the study's own lambda: (seeds * episodes, HORIZON, ...)
    conduct: dict[str, Conduct]  # by method
    variants: dict[Variant, Conduct]  # of PEPS
    groups: list[Group]  # of raters, who see what the paper's saw; the first is the study's own
    wider: list[Group]  # the same raters after they have seen every method; none if that is no more

    def over(self, name: str) -> dict[float, Conduct]:
        """How PEPS behaves over a field of `Variant`, everything else being the study's own."""
        own = {name: getattr(OWN, name)}
        found = {
            getattr(variant, name): conduct
            for variant, conduct in self.variants.items()
            if variant._replace(**own) == OWN
        }
        return dict(sorted(found.items()))


def findings(parts: Sequence[Part], seen: Sequence[Seen], number: int = GROUPS) -> Findings:
    """How the agents of `parts` behave, and how `number` groups of raters rate them."""
    scenes, conducts, variants = {}, {}, {}
    for part, shown in zip(parts, seen, strict=True):
        for place, variant in enumerate(part.variants):
            found = conduct(jax.tree.map(lambda rows: rows[place], shown))  # noqa: B023, used at once
            if part.method == "peps":
                variants[variant] = found
            if variant == OWN:
                conducts[part.method] = found
                good = np.flatnonzero(shown.finite[place])
                pool = lambda rows: rows[place, good].reshape(-1, *rows.shape[3:])  # noqa: B023
                scenes[part.method] = jax.tree.map(pool, shown.scenes)
    key = jax.random.fold_in(generator.key(parts[0].seeds[0]), 2)
    papers = {method: shown for method, shown in scenes.items() if method in RATED}
    wider = groups(key, scenes, road(RAIN).problem(), number) if len(scenes) > len(papers) else []
    rated = groups(key, papers, road(RAIN).problem(), number)
    return Findings(scenes, conducts, variants, rated, wider)
