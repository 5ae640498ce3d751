"""What a study's answers tell: tests of the ratings, agreement, who is left out and why, r-hat beside what people said.

analysis.md     all of it in words and tables, and as numbers in analysis.json
figure3.png     the paper's Figure 3 with people's numbers: what the agents do, and how they are rated
ratings.png     every rater's mean of every agent, with intervals
agreement.png   which share of the answers r-hat, and each participant's own importance ratings, predict
power.png       how many raters find a difference
*.csv           the tables
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs.highway.environment import HighwayParams, Ratings
from peps_envs.navigation import Navigation
from peps_jax import methods
from peps_jax.drawing import scenes as drawing
from peps_jax.drawing.navigation_map import draw_map, draw_route, draw_start
from peps_jax.drawing.panels import INK, QUIET, colours, panels_of, save, tidy
from peps_jax.human_study import pairs, power, statistics
from peps_jax.human_study.database import Database
from peps_jax.human_study.settings import Folder
from peps_jax.human_study.statistics import Conduct, Limits
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving import report
from peps_jax.reproduce.driving.ratings import Group, analyse
from peps_jax.reproduce.summary import TITLES
from peps_jax.storage import files
from peps_jax.storage.arrays import read_arrays
from peps_jax.storage.tables import csv_bytes, markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOLDER, TEXT, NUMBERS = "analysis", "analysis.md", "analysis.json"
ROUTES = 12  # of an agent that a map shows

Row = dict[str, Any]


# --- what is there --------------------------------------------------------------------------------------------------------


class Rated(NamedTuple):
    """What raters said of agents."""

    agents: tuple[str, ...]
    raters: tuple[int, ...]  # participants' numbers, of those who have rated every agent
    means: np.ndarray  # (raters, agents) of each one's ratings
    scenes: np.ndarray  # (raters, scenes) every rating, nan where a rater didn't see a scene


def excluded(tables: Mapping[str, Sequence[Row]], phase: str, limits: Limits = Limits()) -> dict[int, str]:  # noqa: B008
    """Whose data don't count in a phase, and why."""
    found = {}
    for one in tables["participants"]:
        if one["phase"] != phase or not one["consented"]:
            continue
        mine = [row for kind in ("answers", "ratings") for row in tables[kind] if row["participant"] == one["number"]]
        sides = [row["choice"] == "left" for row in mine if row.get("choice") in ("left", "right")]
        conduct = Conduct(
            consented=True,
            finished=one["outcome"] == "finished",
            checks_failed=one["checks_failed"] or 0,
            chosen_left=sides,
            reaction=[row["reaction_ms"] / 1000 for row in mine],
        )
        why = statistics.exclusion(conduct, limits, needs_all=phase == "testing")
        if why is not None:
            found[one["number"]] = why
    return found


def left_out(folder: Folder, phase: str) -> dict[int, str]:
    """Whose data don't count in a phase of a folder's study, and why."""
    with contextlib.closing(Database(folder.database)) as database:
        return excluded(database.tables(), phase)


def rated(tables: Mapping[str, Sequence[Row]]) -> Rated | None:
    """The ratings of those who count and have rated every agent; None if there are fewer than two of them, or of agents."""
    without = excluded(tables, "testing")
    rows = [row for row in tables["ratings"] if row["participant"] not in without]
    known = list(methods.METHODS)
    order = lambda agent: (known.index(agent) if agent in known else len(known), agent)
    agents = tuple(sorted({row["agent"] for row in rows}, key=order))
    said: dict[tuple[int, str], list[int]] = {}
    for row in rows:
        said.setdefault((row["participant"], row["agent"]), []).append(row["rating"])
    people = sorted({row["participant"] for row in rows})
    raters = tuple(one for one in people if all((one, agent) in said for agent in agents))
    if len(raters) < 2 or len(agents) < 2:
        return None
    means = np.array([[np.mean(said[one, agent]) for agent in agents] for one in raters])
    return Rated(agents, raters, means, _matrix(rows, raters, "scene", "rating"))


def _matrix(rows: Iterable[Row], people: Sequence[int], unit: str, value: str) -> np.ndarray:
    """(people, units) of one value each, nan where somebody said nothing."""
    rows = [row for row in rows if row["participant"] in people and row[value] is not None]
    units = sorted({row[unit] for row in rows})
    made = np.full((len(people), len(units)), np.nan)
    for row in rows:
        made[people.index(row["participant"]), units.index(row[unit])] = row[value]
    return made


def compared(tables: Mapping[str, Sequence[Row]]) -> list[Row]:
    """The answers of those who count, checks left out."""
    phases = ("training", "label")
    without = {number for phase in phases for number in excluded(tables, phase)}
    return [row for row in tables["answers"] if row["participant"] not in without and not row["is_check"]]


# --- tables -----------------------------------------------------------------------------------------------------------------


def tests(found: Rated) -> list[Row]:
    """Whether raters tell the agents apart: the main test, a second one that needs no numbers, and the paper's."""
    main, plain = statistics.repeated_measures(found.means), statistics.one_way(found.means)
    rows = [
        {
            "test": "repeated-measures ANOVA (main)", "statistic": main.anova.f, "df": main.anova.df,
            "df error": main.anova.df_error, "p": main.anova.p, "corrected p": main.corrected_p,
            "effect": main.anova.eta_squared, "effect is": f"partial η²; ε = {main.epsilon:.3f}",
        }
    ]  # fmt: skip
    if len(found.agents) > 2:
        ranks = statistics.friedman(found.means)
        rows.append(
            {
                "test": "Friedman", "statistic": ranks.chi_squared, "df": ranks.df, "df error": None, "p": ranks.p,
                "corrected p": None, "effect": ranks.concordance, "effect is": "Kendall's W",
            }
        )  # fmt: skip
    rows.append(
        {
            "test": "one-way ANOVA (the paper's)", "statistic": plain.f, "df": plain.df, "df error": plain.df_error,
            "p": plain.p, "corrected p": None, "effect": plain.eta_squared, "effect is": "η²",
        }
    )  # fmt: skip
    return rows


def agents(found: Rated, road: bool) -> list[Row]:
    """Each agent's ratings, with intervals over raters; on a road the paper's beside them."""
    rows = []
    for place, agent in enumerate(found.agents):
        told = statistics.bootstrap(lambda rated: rated[..., place].mean(-1), found.means)  # noqa: B023
        row = {"agent": agent, "mean": told.value, "low": told.low, "high": told.high}
        row["sd"] = float(np.std(found.means[:, place], ddof=1))
        if road and agent in report.PAPER:
            row["paper's"] = "{} ± {}".format(*report.PAPER[agent])
        rows.append(row)
    return rows


def agents_by_pairs(found: Rated) -> list[Row]:
    """Every two agents compared."""
    rows = []
    for signed, tukey in zip(statistics.wilcoxon(found.means), statistics.tukey(found.means), strict=True):
        apart = statistics.bootstrap(
            lambda rated: (rated[..., signed.first] - rated[..., signed.second]).mean(-1),  # noqa: B023
            found.means,
        )
        rows.append(
            {
                "first": found.agents[signed.first], "second": found.agents[signed.second], "difference": apart.value,
                "low": apart.low, "high": apart.high, "Wilcoxon p": signed.p, "Holm p": signed.corrected_p,
                "rank-biserial": signed.rank_biserial, "Tukey p (one-way)": tukey.p,
            }
        )  # fmt: skip
    return rows


def agreement(tables: Mapping[str, Sequence[Row]], found: Rated | None) -> list[Row]:
    """How far people agree, with one another and with themselves."""
    answers, rows = compared(tables), []
    once = [row for row in answers if row["kind"] in ("ask", "shared")]
    people = sorted({row["participant"] for row in once})
    if people:
        matrix = _matrix(once, people, "query", "preferred")
        several = int(np.sum(np.isfinite(matrix).sum(0) > 1))
        about = f"{several} pairs seen by two people or more"
        rows += [
            {
                "what": f"Krippendorff's α of comparisons, {level}",
                "value": statistics.krippendorff(matrix, level),
                "of": about,
            }
            for level in ("nominal", "ordinal")
        ]
        left, p = statistics.left_share(
            [row["choice"] == "left" for row in answers if row["choice"] in ("left", "right")]
        )
        rows.append(_share("left chosen, where a side was", left, f"; p = {p:.2g} of a fair coin"))
        first, again = _repeated(answers)
        rows.append(_share("repeats answered alike", statistics.consistency(first, again)))
    if found is not None:
        scenes = f"{found.scenes.shape[1]} scenes, {len(found.raters)} raters"
        alpha = statistics.krippendorff(found.scenes, "interval")
        rows.append({"what": "Krippendorff's α of ratings, interval", "value": alpha, "of": scenes})
        icc = statistics.intraclass_correlation(found.means)
        means = f"{len(found.agents)} agents' means, {len(found.raters)} raters"
        rows.append({"what": "ICC(2,1), of one rater", "value": icc.single, "of": means})
        rows.append({"what": "ICC(2,k), of all raters' mean", "value": icc.mean, "of": means})
    return rows


def _share(what: str, found: statistics.Share, more: str = "") -> Row:
    return {"what": what, "value": found.share, "of": f"{found.of}; {found.low:.2f} to {found.high:.2f}{more}"}


def _repeated(answers: Sequence[Row]) -> tuple[list[float], list[float]]:
    """What was said the first time and the second."""
    said = {(row["participant"], row["place"]): row["preferred"] for row in answers}
    both = [
        (said.get((row["participant"], row["repeats"])), row["preferred"]) for row in answers if row["kind"] == "repeat"
    ]
    both = [pair for pair in both if None not in pair]
    return [pair[0] for pair in both], [pair[1] for pair in both]


def left_out_rows(tables: Mapping[str, Sequence[Row]]) -> list[Row]:
    """Who is left out, and why."""
    phases = ("training", "testing", "label")
    return [
        {"participant": who, "phase": one, "why": why} for one in phases for who, why in excluded(tables, one).items()
    ]


def predictions(database: Database, folder: Folder, tables: Mapping[str, Sequence[Row]]) -> list[Row]:
    """r-hat beside each participant's own ratings of importance: which share of their answers each predicts.

    What somebody finds important is taken for reward weights, as in the paper; the reward of a piece is its sum. Ties are left
    out. A row of an environment without such weights has r-hat alone.
    """
    settings = folder.settings()
    kept = folder.path / "surrogate-peps.npz"
    answers = [row for row in compared(tables) if row["kind"] in ("ask", "shared") and row["preferred"] in (0, 1)]
    if not kept.is_file() or not answers:
        return []
    arrays = read_arrays(kept, folder.database.name)
    logit = dict(zip(arrays["queries"].tolist(), arrays["logits"].tolist(), strict=True))
    problem = pairs.problem(settings.env)
    importance: dict[int, dict[str, int]] = {}
    for row in tables["importance"]:
        importance.setdefault(row["participant"], {})[row["name"]] = row["value"]
    rows = []
    for who in sorted({row["participant"] for row in answers}):
        mine = [row for row in answers if row["participant"] == who and row["query"] in logit]
        if not mine:
            continue
        said = np.array([row["preferred"] == 1 for row in mine])
        learned = np.array([logit[row["query"]] for row in mine])
        made: Row = {"participant": who, "answers": len(mine), "r̂ predicts": float(np.mean((learned > 0) == said))}
        own = importance.get(who, {})
        if isinstance(problem.params, HighwayParams) and set(own) == set(Ratings.__dataclass_fields__):
            segments = pairs.segments_of(problem, database.stimuli([row["query"] for row in mine]))
            wanted = np.asarray(_worth(segments, problem, Ratings(**{name: jnp.float32(own[name]) for name in own})))
            made |= {
                "importance predicts": float(np.mean((wanted > 0) == said)),
                "rank correlation of both": _rank_correlation(learned, wanted),
            }
        rows.append(made | {f"importance of {name}": value for name, value in own.items()})
    return rows


@jax.jit
def _worth(segments: Segments, problem: Any, wanted: Ratings) -> jax.Array:
    """(n,) sum of the reward that follows from importance ratings, of the first segment less that of the second."""
    params = problem.params.replace(ratings=wanted)
    reward = jax.vmap(jax.vmap(jax.vmap(problem.environment.reward, (0, 0, 0, None)), (0, 0, 0, None)), (0, 0, 0, None))
    rewards = reward(segments.state, segments.action, segments.next_state, params)
    sums = jnp.sum(jnp.where(segments.mask, rewards, 0.0), -1)
    return sums[:, 0] - sums[:, 1]


def _rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    from peps_jax.analysis.surrogate_maps import rank_correlation

    return rank_correlation(one, other)


# --- figures ----------------------------------------------------------------------------------------------------------------


def figure3(folder: Folder, database: Database, found: Rated, note: str) -> Figure:
    """The paper's Figure 3 with people's numbers: what each agent does, below how it was rated."""
    settings = folder.settings()
    problem = pairs.problem(settings.test_env)
    scenes = {agent: pairs.segments_of(problem, database.scene_stimuli(agent)) for agent in found.agents}
    group = _group(found)
    if pairs.is_road(settings.test_env):
        return report.figure(report.shown(scenes, group), note)
    title = lambda agent: f"{TITLES.get(agent, agent)} (μ = {group.mean[agent]:.1f}, σ = {group.sd[agent]:.1f})"
    if isinstance(problem.environment, Navigation):
        return _routes({title(agent): (agent, rows) for agent, rows in scenes.items()}, problem.params, note)
    first = {title(agent): jax.tree.map(lambda rows: rows[0], rows) for agent, rows in scenes.items()}
    times = np.linspace(0, problem.environment.horizon, 4)
    states = {name: drawing.states_of(scene) for name, scene in first.items()}
    clips = {name: drawing.scenes_of(problem.environment, problem.params, rows, times) for name, rows in states.items()}
    return drawing.strips(clips, [f"step {time:.0f}" for time in times], note)


def _routes(scenes: Mapping[str, tuple[str, Segments]], params: Any, note: str) -> Figure:
    figure, grid = panels_of(1, len(scenes), 2.6, 3.15)
    for axes, (title, (agent, rows)) in zip(grid[0], scenes.items(), strict=True):
        draw_map(axes, params)
        for place in range(min(len(rows.mask), ROUTES)):
            scene = jax.tree.map(lambda leaf: leaf[place], rows)  # noqa: B023
            draw_route(axes, drawing.states_of(scene).position, agent, alpha=0.6)
        draw_start(axes, params)
        axes.set_title(title, color=INK, fontsize=9)
    figure.supxlabel(note, color=INK, fontsize=8)
    return figure


def _group(found: Rated) -> Group:
    return analyse({agent: found.means[:, place] for place, agent in enumerate(found.agents)})


def ratings_figure(found: Rated, rows: Sequence[Row], note: str) -> Figure:
    """Every rater's means, joined, and each agent's with its interval."""
    figure, ((axes,),) = panels_of(1, 1, 1.4 + 1.3 * len(found.agents), 3.4)
    tidy(axes)
    places = np.arange(len(found.agents))
    shift = np.random.default_rng(0).uniform(-0.08, 0.08, len(found.raters))
    for row, aside in zip(found.means, shift, strict=True):
        axes.plot(places + aside, row, color=QUIET, linewidth=0.6, alpha=0.4, marker="o", markersize=2.5)
    for place, (row, colour) in enumerate(zip(rows, _colours(found.agents), strict=True)):
        reach = [[row["mean"] - row["low"]], [row["high"] - row["mean"]]]
        axes.errorbar(
            place, row["mean"], reach, color=colour, marker="D", markersize=7, linewidth=2, capsize=4, zorder=4
        )
    axes.set_xticks(places, [TITLES.get(agent, agent) for agent in found.agents])
    axes.set(xlim=(-0.5, len(places) - 0.5), ylim=(0.7, 10.3), yticks=range(1, 11))
    axes.set_ylabel("rating", color=INK, fontsize=9)
    figure.supxlabel(note, color=INK, fontsize=8)
    return figure


def _colours(names: Sequence[str]) -> list[str]:
    known = list(methods.METHODS)
    by_name = dict(zip(known, colours(len(known)), strict=True))
    return [by_name.get(name, INK) for name in names]


def predictions_figure(rows: Sequence[Row]) -> Figure:
    """Which share of each participant's answers r-hat and their own importance ratings predict."""
    names = {"r̂ predicts": "predicted by r̂", "importance predicts": "by own importance ratings"}
    there = [name for name in names if any(name in row for row in rows)]
    figure, ((axes,),) = panels_of(1, 1, 1.0 + 1.8 * len(there), 3.4)
    tidy(axes)
    for column, (name, colour) in enumerate(zip(there, colours(len(there)), strict=True)):
        values = np.array([row[name] for row in rows if name in row])
        aside = np.random.default_rng(column).uniform(-0.1, 0.1, values.size)
        axes.plot(column + aside, values, "o", color=colour, markersize=4, alpha=0.6)
        axes.plot([column - 0.2, column + 0.2], [values.mean()] * 2, color=colour, linewidth=2.5)
    axes.axhline(0.5, color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_xticks(range(len(there)), [names[name] for name in there])
    axes.set(xlim=(-0.5, len(there) - 0.5), ylim=(0, 1.02))
    axes.set_ylabel("share of a participant's answers", color=INK, fontsize=9)
    return figure


def power_figure(plan: Sequence[power.Planned], note: str) -> Figure:
    """Power over the number of raters."""
    figure, ((axes,),) = panels_of(1, 1, 4.6, 3.4)
    tidy(axes)
    raters = [one.raters for one in plan]
    names = {"main": "repeated measures", "one_way": "one-way (the paper's)", "first_best": "and the first agent best"}
    for (field, name), colour, line in zip(names.items(), colours(3), ("-", "--", ":"), strict=True):
        shares = [getattr(one, field) for one in plan]
        axes.plot(raters, [one.share for one in shares], line, color=colour, label=name, marker="o", markersize=3)
        axes.fill_between(raters, [one.low for one in shares], [one.high for one in shares], color=colour, alpha=0.15)
    axes.axhline(power.POWER, color=QUIET, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set(ylim=(0, 1.04))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("raters", color=INK, fontsize=9)
    axes.set_ylabel(f"studies with p < {power.ALPHA}", color=INK, fontsize=9)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    figure.supxlabel(note, color=INK, fontsize=7, wrap=True)
    return figure


# --- all of it ----------------------------------------------------------------------------------------------------------------


def planned(folder: Folder) -> str:
    """How many raters a study needs, by the ratings that are there, in a line."""
    with contextlib.closing(Database(folder.database)) as database:
        found = rated(database.tables())
        if found is None:
            return "too few ratings to plan with: they need two raters and two agents or more"
        return power.said(power.plan(found.means), f"{len(found.raters)} {_who(database)}s")


def _who(database: Database) -> str:
    return "simulated rater" if database.noted("simulated") else "rater"


def write(folder: Folder) -> list[Path]:
    """Writes the analysis into the study's folder; returns the paths, the text first."""
    with contextlib.closing(Database(folder.database)) as database:
        return _write(folder, database)


def _write(folder: Folder, database: Database) -> list[Path]:
    tables, target = database.tables(), folder.path / FOLDER
    files.make_folder(target)
    found = rated(tables)
    made: dict[str, list[Row]] = {"exclusions": left_out_rows(tables), "agreement": agreement(tables, found)}
    made["predictions"] = predictions(database, folder, tables)
    figures: dict[str, Figure] = {}
    words = ""
    if found is not None:
        plan = power.plan(found.means)
        people = f"{len(found.raters)} {_who(database)}s"
        words = power.said(plan, people)
        main = statistics.repeated_measures(found.means)
        note = f"{people}; repeated-measures ANOVA: p = {main.corrected_p:.2g}"
        made |= {
            "agents": agents(found, pairs.is_road(folder.settings().test_env)),
            "tests": tests(found),
            "pairs": agents_by_pairs(found),
        }
        made["power"] = [
            {"raters": one.raters, "repeated measures": one.main.share, "one-way": one.one_way.share,
             "and the first agent best": one.first_best.share} for one in plan
        ]  # fmt: skip
        figures["figure3"] = figure3(folder, database, found, note)
        figures["ratings"] = ratings_figure(found, made["agents"], note)
        figures["power"] = power_figure(plan, words)
    if made["predictions"]:
        figures["predictions"] = predictions_figure(made["predictions"])
    paths = [target / TEXT, target / NUMBERS]
    files.write_whole(target / TEXT, text(tables, made, words).encode())
    files.write_whole(target / NUMBERS, files.json_bytes(_plain(made)))
    for name, rows in made.items():
        if rows:
            files.write_whole(target / f"{name}.csv", csv_bytes(rows))
            paths.append(target / f"{name}.csv")
    for name, figure in figures.items():
        paths += save(figure, target, name)
    return paths


def text(tables: Mapping[str, Sequence[Row]], made: Mapping[str, Sequence[Row]], words: str) -> str:
    """The analysis in Markdown."""
    begun = [one for one in tables["participants"] if one["consented"]]
    count = lambda phase: sum(one["phase"] == phase for one in begun)
    phases = ", ".join(
        f"{count(phase)} in the {phase} phase" for phase in ("training", "testing", "label") if count(phase)
    )
    parts = [
        "# What the study found\n",
        f"{len(begun)} participants began ({phases or 'nobody yet'}); {len(tables['answers'])} answers, "
        f"{len(tables['ratings'])} ratings. {len(made['exclusions'])} participants are left out.\n",
    ]
    titles = {
        "agents": "Ratings, with 95 % bootstrap intervals over raters",
        "tests": "Do the agents differ?",
        "pairs": "Every two agents",
        "agreement": "Agreement",
        "exclusions": "Left out, and why",
        "predictions": "r̂, and participants' own importance ratings, beside their answers",
    }
    for name, title in titles.items():
        if made.get(name):
            parts += [f"## {title}\n", _table(made[name])]
    if words:
        parts += ["## How many raters\n", f"{words}.\n"]
    return "\n".join(parts)


def _table(rows: Sequence[Row]) -> str:
    columns = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    return markdown(columns, [[_shown(row.get(name)) for name in columns] for row in rows])


def _shown(value: Any) -> str:
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return "–"
    return f"{value:.3f}" if value == 0 or abs(value) >= 1e-3 else f"{value:.1e}"


def _plain(made: Mapping[str, Sequence[Row]]) -> Any:
    finite = lambda value: None if isinstance(value, float) and not math.isfinite(value) else value
    return json.loads(
        json.dumps({name: [{k: finite(v) for k, v in row.items()} for row in rows] for name, rows in made.items()})
    )
