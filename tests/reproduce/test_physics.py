"""Physics: its table, its pictures, and how humans of other beliefs judge what was learned, of a stand-in with closed forms."""

import csv
import dataclasses
import functools
import importlib.util
import sys
import types
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import exit_code, is_one_complaint
from conftest import untrained
from records import EPISODES, made_up

import peps_envs
from peps_envs import Box, Environment, Step, registry
from peps_envs import physics as tasks
from peps_envs.scene import Circle, Rectangle, Scene
from peps_jax import Config, evaluate
from peps_jax.analysis import episodes
from peps_jax.drawing import panels
from peps_jax.reproduce import __main__ as command
from peps_jax.reproduce import physics, store
from peps_jax.reproduce.physics import Watched
from peps_jax.reproduce.plan import Plan
from peps_jax.reproduce.store import Store

WIDTH = 0.1  # m, sigma_p


class Ice(NamedTuple):
    """How far a full push moves a sled, m: in truth, or as is believed."""

    glide: float


@dataclasses.dataclass(frozen=True)
class Sled(Environment):
    """A sled is pushed along a line until it is 0.5 m away. Its state is (place, time)."""

    horizon: int = 8
    observation_size = 1
    action_space = Box(1)
    event_names = ("goal_reached",)

    def reset(self, key, params):
        return (jnp.zeros(1), jnp.int32(0)), jnp.ones(1)

    def step(self, key, state, action, params):
        place, time = after = state[0] + params.glide * jnp.clip(action, -1, 1), state[1] + 1
        there = place[0] >= 0.5
        truncated = (time >= self.horizon) & ~there
        return Step(after, 1 - place, self.reward(state, action, after, params), there, truncated, there[None])

    def reward(self, state, action, next_state, params):
        return 10.0 * (next_state[0][0] >= 0.5) - 0.1

    def perceive(self, state):
        return state[0]

    def perception_width(self, params):
        return jnp.full(1, WIDTH)

    def model(self, compiled):
        return compiled

    def scene(self, state, params):
        goal = Rectangle(0.75, 0.0, 0.5, 0.4, "goal")
        return Scene((goal, Circle(float(state[0][0]), 0.0, 0.1, "agent")), (-1.0, 1.0, -0.2, 0.2))


def module(true: float, believed: float) -> types.ModuleType:
    """What a task's module offers."""
    made = types.ModuleType("sled")
    made.domain = lambda: (Sled(), Ice(true), {"biased": Ice(believed), "unbiased": Ice(true)})
    made.MISJUDGED = ("glide of the sled, m", true, believed)
    made.model = Ice
    return made


@pytest.fixture(autouse=True)
def two_tasks(monkeypatch):
    """Two sleds are all there is."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    for name, numbers in {"sled": (0.2, 0.3), "slow": (0.1, 0.3)}.items():
        monkeypatch.setitem(sys.modules, f"{tasks.__name__}.{name}", module(*numbers))
        registry.register(f"mjx-{name}", registry._once(functools.partial(registry._physics, name)))
    monkeypatch.setattr(physics, "TASKS", ("mjx-sled", "mjx-slow"))
    monkeypatch.setattr(panels, "DOTS", 30)


@pytest.fixture(scope="module")
def seen():
    """What is seen of an agent that has learned nothing, by its task."""
    return {}


def look(task: str, tiny: Config, seen: dict):
    if task not in seen:
        seen[task] = Watched(task).of(untrained(tiny.replace(env=task, method="sac")))
    return seen[task]


def ahead(result, start):
    """The actions and places of an untrained agent from `start` on, by hand."""
    environment, params = result.training.problem.environment, result.training.problem.params
    state, observation = start
    actions, places = [], [float(state[0][0])]
    for _ in range(environment.horizon):
        action = np.asarray(result.act(observation))
        after = environment.step(jax.random.key(0), state, action, params)
        state, observation = after.state, after.observation
        actions.append(float(action[0]))
        places.append(float(state[0][0]))
        if bool(after.terminated):
            break
    return np.array(actions), np.array(places)


# --- what is kept of a training -------------------------------------------------------------------------------------------


def test_what_a_task_says_that_its_human_misjudges():
    about = tasks.misjudged("mjx-sled")
    assert (about.words, about.true, about.believed) == ("glide of the sled, m", 0.2, 0.3)
    task = peps_envs.make("mjx-sled")
    assert about.belief(about.true) == task.params
    assert about.belief(about.believed) == task.beliefs[task.default_belief]
    values = physics.quantities("mjx-sled")
    assert values == sorted(values)
    assert {0.1, 0.2, 0.3, 0.8} <= set(values), "from half to four times the true one, and what is believed"


def test_an_episode_and_what_was_expected_in_it(tiny):
    run = untrained(tiny.replace(env="mjx-sled", method="sac"))
    key, steps = jax.random.key(0), 3
    found = jax.tree.map(np.asarray, episodes.episode(run, key))
    problem = run.training.problem
    actions, places = ahead(run, problem.environment.reset(key, problem.params))
    assert int(found.length) == len(actions)
    assert np.abs(actions).min() > 0.01
    np.testing.assert_allclose(found.states[0][: len(places), 0], places, rtol=1e-5)
    expected = np.asarray(episodes.expected(problem, found, steps)[0][:, 0])
    for time in range(len(places)):
        before = max(time - steps, 0)
        np.testing.assert_allclose(expected[time], places[before] + 0.3 * actions[before:time].sum(), rtol=1e-5)


def test_after_an_end_nothing_more_is_expected(tiny):
    problem = untrained(tiny.replace(env="mjx-sled", method="sac")).training.problem
    places = np.array([0.0, 0.2, 0.4, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6], np.float32)[:, None]
    found = episodes.Episode((places, np.arange(9, dtype=np.int32)), np.ones((8, 1), np.float32), np.int32(3))
    expected = np.asarray(episodes.expected(problem, found, 2)[0][:, 0])
    np.testing.assert_allclose(expected, [0.0, 0.3, 0.6, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8], rtol=1e-5)


def test_humans_of_other_beliefs_judge_by_what_they_believe(tiny):
    run = untrained(tiny.replace(env="mjx-sled", method="sac"))
    glides = np.array([0.1, 0.2, 0.3], np.float32)
    judged = np.asarray(episodes.judged(run, Ice(glides), 2))
    own = evaluate(run, 2)
    np.testing.assert_allclose(judged[2], own.explicability, rtol=1e-5)  # the training's own human
    np.testing.assert_allclose(judged[1], own.return_, rtol=1e-5)  # who knows the truth
    pushes = np.diff(own.perceived[..., 0]) / 0.2
    surprise = -0.5 * np.sum((0.1 * pushes / WIDTH) ** 2, 1)
    np.testing.assert_allclose(judged[0], own.return_ + surprise, rtol=1e-4)


def test_a_record_brings_back_what_was_seen(tiny, seen):
    record = made_up(80.0)._replace(seen=look("mjx-sled", tiny, seen))
    again = store.Record.of(record.arrays())
    assert again.seen["judged"].shape == (len(physics.quantities("mjx-sled")), physics.JUDGED)
    shown = Watched("mjx-sled").scenes(again, np.array([0.0, 2.0]))
    goal, sled, ghost = shown[1].shapes
    assert (goal.colour, sled.colour) == ("goal", "agent")
    assert ghost.x == pytest.approx(1.5 * sled.x, rel=1e-4), "a human who believes in 0.3 m where there are 0.2"
    assert ghost.outline == "ink"
    assert len(shown[0].shapes) == 2, "at the start nothing is expected to be elsewhere"


# --- trainings ------------------------------------------------------------------------------------------------------------


def test_a_tasks_own_settings_but_for_a_length_that_was_asked_for(monkeypatch, tiny):
    monkeypatch.setattr(physics, "SETTINGS", {"mjx-sled": {"total_steps": 40_000, "hold_steps": 3}})
    first = lambda base: physics.needs(Plan(base, 2, EPISODES))[0].config
    assert (first(Config()).total_steps, first(Config()).hold_steps) == (40_000, 3)
    assert (first(tiny).total_steps, first(tiny).hold_steps) == (160, 3)


def test_names_tell_recipes_apart(tiny, monkeypatch):
    wanted = physics.needs(Plan(tiny, 2, EPISODES))
    assert len({what.name for what in wanted}) == len(wanted) == 2 * len(physics.METHODS) * 2
    before = [what.recipe for what in wanted]
    monkeypatch.setattr(physics, "AHEAD", 2)
    changed = [what.recipe != old for what, old in zip(wanted, before, strict=True)]
    assert changed == [what.config.method in physics.SHOWN for what in wanted]


def test_an_environments_code_counts_where_trainings_does_not_hold_it():
    assert store.code_of(peps_envs.make("nav-d1").environment) is None
    assert store.code_of(Sled()) is None, "others' code is theirs"
    pytest.importorskip("mujoco")
    from peps_envs.bridges.from_mjx import FromMjx

    made = object.__new__(FromMjx)
    assert store.code_of(made) is not None


def test_without_mujoco_it_is_one_line(tmp_path, capsys, tiny, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    arguments = ["physics", "--seeds", 2, "--out", tmp_path / "out"]
    assert exit_code(lambda given: command.main(given, tiny, EPISODES), *arguments) == 2
    assert is_one_complaint(capsys.readouterr(), command.PROG, ("physics", "pip install"))


# --- files ----------------------------------------------------------------------------------------------------------------

FILES = {"physics.md", "physics.csv", "physics_improvement.csv", "physics.png", "physics.gif"} | {
    f"physics_beliefs.{kind}" for kind in ("csv", "png", "pdf")
}
VALUE = {"peps": 90.0, "sac": 50.0, "oracle": 100.0, "drlhp": 10.0, "policy_shaping": 20.0, "darc": 95.0}


def kept(folder, base, tiny, seen, methods=physics.METHODS):
    """A folder with trainings of `methods`, all made up; each seed is worth a little more."""
    made, filled = Plan(base, 3, EPISODES), Store(folder, base, EPISODES, seeds=3)
    filled.open()
    for what in physics.needs(made):
        if what.config.method in methods:
            record = made_up(VALUE[what.config.method] + what.config.seed)
            shown = look(what.config.env, tiny, seen) if what.view else {}
            filled.save(what.name, what.recipe, record._replace(heat={}, seen=shown).arrays())
    filled.close()


def call(folder, base) -> int:
    return exit_code(lambda given: command.main(given, base, EPISODES), "physics", "--seeds", 3, "--out", folder)


def lines_of(path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_it_is_written_from_what_is_there(tmp_path, tiny, seen):
    kept(tmp_path, tiny, tiny, seen)
    assert call(tmp_path, tiny) == 0
    assert {path.name for path in tmp_path.iterdir()} == FILES | {store.HEAD, store.KEPT}
    text = (tmp_path / "physics.md").read_text(encoding="utf-8")
    assert "| mjx-sled | 50.0 | 80% | yes | -78.4 |" in text
    assert "| mjx-sled | SAC | 1.00 [1.00, 1.00] | 1.00 [1.00, 1.00] |" in text
    assert "| 3 of 3 |" in text
    assert "| mjx-sled: glide of the sled, m |" in text
    assert "| *0.2* |" in text
    assert "| **0.3** |" in text
    lines = lines_of(tmp_path / "physics.csv")
    assert len(lines) == 3 * len(physics.METHODS)
    beliefs = lines_of(tmp_path / "physics_beliefs.csv")
    assert {line["method"] for line in beliefs} == set(physics.SHOWN)
    assert {float(line["believed"]) for line in beliefs if line["task"] == "mjx-sled"} == set(
        physics.quantities("mjx-sled")
    )
    from PIL import Image

    with Image.open(tmp_path / "physics.gif") as film:
        assert film.n_frames > physics.REST


def test_intervals_that_overlap_are_not_apart(tmp_path, tiny, seen, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "VALUE", VALUE | {"sac": 89.0})
    monkeypatch.setattr(physics, "_pictures", lambda plan, folder: [])
    kept(tmp_path, tiny, tiny, seen)
    assert call(tmp_path, tiny) == 0
    assert "| mjx-sled | 11.0 | 9% | no |" in (tmp_path / "physics.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_trainings_from_end_to_end(tmp_path, tiny, seen, monkeypatch):
    """PEPS and SAC are trained: without a map r-hat has no heat, and an episode is kept."""
    monkeypatch.setattr(physics, "FACTORS", (1.0,))
    kept(tmp_path, tiny, tiny, {}, methods=("drlhp", "policy_shaping", "oracle", "darc"))
    assert call(tmp_path, tiny) == 0
    made = Plan(tiny, 3, EPISODES)
    wanted = physics.needs(made)
    assert made.missing(wanted, Store(tmp_path, tiny, EPISODES, seeds=3)) == []
    peps = made.record(wanted[0])
    assert wanted[0].config.method == "peps"
    assert not peps.heat
    assert np.isfinite(peps.mode["believed_return"]).all()
    assert np.isfinite(peps.seen["judged"]).all()
    assert {path.name for path in tmp_path.iterdir()} == FILES | {store.HEAD, store.KEPT}
