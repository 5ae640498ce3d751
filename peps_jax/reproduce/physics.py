"""Physics: tasks on MuJoCo models about which the human believes another one, such as a box that is heavier than it looks.

No planner reaches here: the oracle, which is told what the human thinks, stands in its place. Beside scores the trainings of
`SHOWN` keep an episode, what the human expected in it, and how explicable their policy is to humans of other beliefs.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

import peps_envs
from peps_envs import Scene, physics, registry
from peps_envs.environment import side_by_side
from peps_jax.analysis import episodes
from peps_jax.config import Config
from peps_jax.drawing import scenes
from peps_jax.drawing.panels import INK, QUIET, colour_of, legend_below, panels_of, tidy
from peps_jax.reproduce.plan import BASELINES, Need, Plan, Training
from peps_jax.reproduce.store import Record
from peps_jax.reproduce.summary import (
    TITLES,
    Line,
    cells,
    decimal,
    explicability,
    from_columns,
    head,
    improvement_cells,
    improvements,
    in_columns,
    interval,
    line,
    mean,
    percent,
    way_covered,
    with_interval,
    write_picture,
    write_texts,
)
from peps_jax.storage import code, files
from peps_jax.storage.tables import csv_bytes, markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ABOUT = "tasks on MuJoCo models, of which the human believes another one"
TASKS = tuple(f"mjx-{module}" for module in registry.PHYSICS)
METHODS = ("peps", *BASELINES, "oracle", "darc")
SHOWN = ("sac", "peps")  # in pictures, and judged by humans of other beliefs
# Changes of the plan's settings by task, for methods that learn T_A. Where a step takes long, learning keeps pace with the physics:
# the belief is stepped in every fourth environment, and every network has fewer updates for a step. T_A learns at the policy's
# rate there: at the default one it isn't sure yet how things move when the policy settles, and H_T pays for staying where it isn't
_KEEPING_PACE = {"watched_every": 4, "dynamics_learning_rate": 3e-3}
SETTINGS: dict[str, dict[str, Any]] = {
    "mjx-box": _KEEPING_PACE | {"updates_per_step": 0.2, "dynamics_updates": 8, "surrogate_updates": 16},
    "mjx-ice": _KEEPING_PACE | {"updates_per_step": 0.25, "dynamics_updates": 10, "surrogate_updates": 20},
}
LEARN_DYNAMICS = ("peps", "oracle")

FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)  # of the true quantity, to be believed
JUDGED = 20  # episodes that each of these humans judges
AHEAD = 5  # control steps, over which the human's expectation is followed: over one it is hardly to be told from what happens
MOMENTS = 5  # of an episode, in a strip
FRAMES_PER_STEP, RATE = 2, 10  # pictures of the film for a control step, and for a second
REST = 10  # pictures that the film's end stands still
CLIP = 2.4  # inches, width of a clip in the film

_NOTE = """\
{answers:,} answers. Arrive: seeds whose mode reaches the goal. IQM: interquartile mean over seeds, with a 95 % stratified
bootstrap interval; {episodes} episodes a seed by the policy's mode, "sampled" by its samples. Two yardsticks ask nobody: the oracle
is told ℓ_H + r_H in r̂'s place, DARC may step the believed model; λ = {lam:g} for them and for PEPS.
"""
_WAY = """\
How far it is from SAC's to the oracle's explicability, the share of it that PEPS covers, whether the intervals of PEPS and SAC are
apart, and what PEPS returns less than SAC, in percent of SAC's return; means over seeds:
"""
_BELIEFS = """\
Explicability of the same policies for humans who believe other values: interquartile means over seeds with their 95 % intervals.
PEPS learned from a human who believes the value in bold; the true one is in italics.
"""
_GHOST = "pale: where the human, who saw everything {ahead} steps before and knows what was done since, expected things to be"


@dataclasses.dataclass(frozen=True)
class Watched:
    """An episode, what the human expected in it, and the explicability of what was learned for humans of other beliefs."""

    task: str

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers."""
        told = {"ahead": AHEAD, "values": quantities(self.task), "episodes": JUDGED}
        return told | {"code": code.digest(episodes.__name__)[:16]}

    def of(self, run: Any) -> dict[str, np.ndarray]:
        """`length` (), `judged` (quantities, episodes), and the leaves of states and of expected states, numbered."""
        seen = episodes.episode(run, jax.random.key(0))  # all that is shown has one start
        expected = episodes.expected(run.training.problem, seen, AHEAD)
        believe = physics.misjudged(self.task).belief
        beliefs = side_by_side(*map(believe, quantities(self.task)))
        judged = episodes.judged(run, beliefs, JUDGED)
        kept = {"length": seen.length, "judged": judged}
        for name, states in {"states": seen.states, "expected": expected}.items():
            kept |= {f"{name}/{place}": leaf for place, leaf in enumerate(jax.tree.leaves(states))}
        return {name: np.asarray(values) for name, values in kept.items()}

    def scenes(self, record: Record, times: np.ndarray) -> list[Scene]:
        """The episode at `times` (steps), with what was expected then."""
        task = peps_envs.make(self.task)
        like = jax.eval_shape(lambda key: task.environment.reset(key, task.params)[0], jax.random.key(0))
        leaves, tree = jax.tree.flatten(like)

        def shown(name: str) -> list[Scene]:
            states = jax.tree.unflatten(tree, [record.seen[f"{name}/{place}"] for place in range(len(leaves))])
            return scenes.scenes_of(task.environment, task.params, states, times)

        return list(map(scenes.with_ghost, shown("states"), shown("expected")))


def quantities(task: str) -> list[float]:
    """Values of what is misjudged in `task`: multiples of the true one, and what its human believes."""
    about = physics.misjudged(task)
    return sorted({round(float(value), 6) for value in (*(about.true * factor for factor in FACTORS), about.believed)})


# --- trainings ------------------------------------------------------------------------------------------------------------


def needs(plan: Plan) -> list[Need]:
    """Every method in every task."""
    if TASKS and importlib.util.find_spec("mujoco") is None:
        raise ValueError("result 'physics' needs MuJoCo and MJX: pip install 'peps-jax[physics]'")
    return [training for task in TASKS for method in METHODS for training in _trainings(plan, task, method)]


def _trainings(plan: Plan, task: str, method: str) -> list[Training]:
    changes = dict(SETTINGS.get(task, {})) if method in LEARN_DYNAMICS else {}
    if plan.base.total_steps != Config().total_steps:  # a length that was asked for is a task's of its own, too
        changes.pop("total_steps", None)
    return plan.trainings(task, method, view=Watched(task) if method in SHOWN else None, **changes)


def _typical(plan: Plan) -> dict[str, Training]:
    """A training of each of `SHOWN` in each task, by its caption; without those all of whose seeds failed."""
    found = {}
    for task in TASKS:
        for method in SHOWN:
            training = plan.typical(_trainings(plan, task, method), explicability)
            if training is not None:
                record = plan.record(training)
                scores = f"return {decimal(record.mean('return'))}, explicability {decimal(explicability(record))}"
                found[f"{task}, {TITLES[method]}: {scores}"] = training
    return found


# --- files ----------------------------------------------------------------------------------------------------------------


def write(plan: Plan, folder: Path) -> list[Path]:
    """physics.{md,csv,png,gif}, physics_improvement.csv, and physics_beliefs.{csv,png,pdf}."""
    groups = {method: [plan.records(_trainings(plan, task, method)) for task in TASKS] for method in METHODS}
    lines = [
        line([task], method, [groups[method][place]], plan.seeds)
        for place, task in enumerate(TASKS)
        for method in METHODS
    ]
    lines += [line(TASKS, method, groups[method], plan.seeds * len(TASKS)) for method in METHODS]
    better, beliefs = improvements(groups, TASKS, BASELINES), _belief_lines(groups)
    pictures = _pictures(plan, folder)
    text = [
        *(f"![{_GHOST.format(ahead=AHEAD).capitalize()}]({path.name})\n" for path in pictures),
        markdown(head(paper=False), [cells(made, paper=False) for made in lines]),
        _NOTE.format(answers=plan.base.num_queries, episodes=plan.num_episodes, lam=plan.base.lam),
        _WAY,
        markdown(
            ["task", "oracle − SAC", "PEPS covers", "apart", "return lost"],
            [_way(task, lines, {method: groups[method][place] for method in METHODS})
             for place, task in enumerate(TASKS)],
        ),
        "Probability that a training of PEPS scores higher than one of the baseline, with its 95 % interval:\n",
        markdown(["task", "baseline", "return", "explicability"], list(map(improvement_cells, better))),
        _BELIEFS,
        "![Explicability over what the human believes](physics_beliefs.png)\n",
        *(_belief_table(task, beliefs) for task in TASKS),
    ]  # fmt: skip
    contents = {
        "physics.md": "\n".join(text),
        "physics.csv": csv_bytes(lines),
        "physics_improvement.csv": csv_bytes(better),
    }
    written = write_texts(folder, contents)
    written += write_picture(_belief_picture(beliefs), beliefs, folder, "physics_beliefs")
    return [*written, *pictures]


def _way(task: str, lines: Sequence[Line], records: Mapping[str, Sequence[Record]]) -> list[str]:
    """What PEPS gains in a task, from the table's `lines` and from the task's `records` by method."""
    gap, share = way_covered(records["peps"], records["sac"], mean(list(map(explicability, records["oracle"]))))
    ours, base = (
        next(made for made in lines if (made["domain"], made["method"]) == (task, method)) for method in ("peps", "sac")
    )
    apart = from_columns(ours, "explicability").low > from_columns(base, "explicability").high
    lost = (base["return_mean"] - ours["return_mean"]) / abs(base["return_mean"])
    return [task, decimal(gap), percent(share), "yes" if apart else "no", f"{100 * lost:.1f}"]


# --- how humans of other beliefs judge it ---------------------------------------------------------------------------------


def _belief_lines(groups: Mapping[str, Sequence[Sequence[Record]]]) -> list[Line]:
    lines = []
    for place, task in enumerate(TASKS):
        for method in SHOWN:
            judged = [record.seen["judged"].mean(1) for record in groups[method][place]]
            for number, value in enumerate(quantities(task)):
                made = {"task": task, "method": method, "believed": value, "seeds": len(judged)}
                lines.append(made | in_columns("explicability", interval([[seed[number] for seed in judged]])))
    return lines


def _belief_table(task: str, lines: Sequence[Line]) -> str:
    about = physics.misjudged(task)
    marked = lambda value: f"**{value:g}**" if value == about.believed else f"*{value:g}*"
    shown = lambda value: marked(value) if value in (about.true, about.believed) else f"{value:g}"
    rows = [
        [TITLES[method], *(with_interval(from_columns(made, "explicability")) for made in lines
                           if (made["task"], made["method"]) == (task, method))]
        for method in SHOWN
    ]  # fmt: skip
    return markdown([f"{task}: {about.words}", *map(shown, quantities(task))], rows)


def _belief_picture(lines: Sequence[Line]) -> Figure:
    figure, panels = panels_of(1, len(TASKS), 3.6, 2.9)
    for axes, task in zip(panels[0], TASKS, strict=True):
        tidy(axes)
        for method in SHOWN:
            own = [made for made in lines if (made["task"], made["method"]) == (task, method)]
            _belief_line(axes, own, method)
        about = physics.misjudged(task)
        axes.axvline(about.true, color=INK, linewidth=0.9, label="the truth")
        axes.axvline(about.believed, color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)), label="believed in training")
        axes.set_xscale("log")
        shown = quantities(task)
        axes.set_xticks(shown, [f"{value:.2g}" for value in shown])
        axes.minorticks_off()
        axes.set_title(task, color=INK, fontsize=11)
        axes.set_xlabel(f"believed: {about.words}", color=INK, fontsize=9)
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    legend_below(figure, panels[0, 0])
    return figure


def _belief_line(axes: Axes, lines: Sequence[Line], method: str) -> None:
    """A method's line over the values believed, with its interval."""
    places = [made["believed"] for made in lines]
    value, low, high = np.array([from_columns(made, "explicability") for made in lines]).T
    colour = colour_of(method)
    axes.fill_between(places, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(places, value, color=colour, marker="o", markersize=4, linewidth=1.6, label=TITLES[method])


# --- strips and film ------------------------------------------------------------------------------------------------------


def _pictures(plan: Plan, folder: Path) -> list[Path]:
    """physics.png and physics.gif: the typical training of each of `SHOWN`; nothing where all failed."""
    typical = _typical(plan)
    if not typical:
        return []
    strips, film = folder / "physics.png", folder / "physics.gif"
    clips = {caption: _strip(training.view, plan.record(training)) for caption, training in typical.items()}
    figure = scenes.strips_across(clips, _GHOST.format(ahead=AHEAD))
    files.write_with(strips, lambda path: figure.savefig(path, dpi=150))
    moving = {
        caption.replace(": ", "\n"): _film(training.view, plan.record(training))
        for caption, training in typical.items()
    }
    files.write_with(film, lambda path: scenes.small_film(moving, path, RATE, len(SHOWN), CLIP, REST))
    return [strips, film]


def _strip(view: Watched, record: Record) -> dict[str, Scene]:
    times = np.linspace(0, int(record.seen["length"]), MOMENTS + 1)[1:].round()
    return {f"step {time:.0f}": scene for time, scene in zip(times, view.scenes(record, times), strict=True)}


def _film(view: Watched, record: Record) -> list[Scene]:
    return view.scenes(record, np.arange(int(record.seen["length"]) * FRAMES_PER_STEP + 1) / FRAMES_PER_STEP)
