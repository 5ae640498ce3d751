"""The reproduction: what it refuses, what it keeps, what its tables say, and that a stopped command continues."""

import csv
import json
import math

import jax
import numpy as np
import pytest
from commands import exit_code, is_one_complaint
from records import EPISODES, made_up

import peps_envs
from peps_jax import Config
from peps_jax.analysis.intervals import Estimate
from peps_jax.drawing import panels
from peps_jax.execution import batches, program
from peps_jax.reproduce import __main__ as command
from peps_jax.reproduce import (
    answers,
    bias,
    figure1,
    figure3,
    frontier,
    physics,
    plan,
    queries,
    store,
    summary,
    table1,
    teachers,
    ways,
)
from peps_jax.reproduce.driving import experiment
from peps_jax.reproduce.plan import DOMAINS, Plan, believed
from peps_jax.reproduce.store import Store
from peps_jax.storage.tables import latex, markdown


def call(arguments, tiny) -> int:
    return exit_code(lambda arguments: command.main(arguments, tiny, EPISODES), *arguments)


@pytest.fixture(autouse=True)
def no_physics(monkeypatch):
    """`test_physics.py` is about it; MuJoCo takes a while to import."""
    monkeypatch.setattr(physics, "TASKS", ())


@pytest.fixture
def no_training(monkeypatch):
    """Nothing may be compiled or planned."""

    def refuse(*arguments, **settings):
        raise AssertionError("compiled")

    monkeypatch.setattr(program, "Program", refuse)
    monkeypatch.setattr(plan, "_plan_and_walk", refuse)


def fill(folder, base, seeds: int) -> None:
    """A folder that has every training and plan, all made up."""
    made, kept = Plan(base, seeds, EPISODES), Store(folder, base, EPISODES, seeds)
    kept.open()
    for place, what in enumerate(every_need(made).values()):
        if not isinstance(what, experiment.Part):
            kept.save(what.name, what.recipe, made_up(80 + place % 7, failed="drlhp-seed1" in what.name).arrays())


def every_need(made: Plan) -> dict:
    return {what.name: what for result in command.RESULTS.values() for what in result.needs(made)}


def lines_of(path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# --- bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ("tabel1", ("result 'tabel1'", "did you mean 'table1'")),
        ("--seeds 1", ("seeds 1", "choose 2 to")),
        ("--seeds few", ("--seeds", "'few' is not a whole number")),
        ("--steps 0", ("total_steps 0", "from 1 to")),
        ("--step 3", ("'--step'", "did you mean --steps?")),
        ("--steps 2000000000", ("needs about", "lower total_steps")),
    ],
)
def test_bad_input_is_one_line(arguments, parts, tmp_path, capsys, tiny, no_training):
    assert call([*arguments.split(), "--out", tmp_path / "out"], tiny) == 2
    assert is_one_complaint(capsys.readouterr(), command.PROG, parts)
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_is_not_written(tmp_path, capsys, tiny, no_training):
    (tmp_path / "table1.md").write_text("precious", encoding="utf-8")
    assert call(["--out", tmp_path], tiny) == 2
    assert "holds no reproduction" in capsys.readouterr().err
    assert [path.read_text(encoding="utf-8") for path in tmp_path.iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("arguments", "changes", "message"),
    [
        (["--steps", 80], {}, "made with total_steps 160, not 80"),
        ([], {"lam": 1.0}, "made with lam 2.4, not 1.0"),
        (["--seeds", 2], {}, "has tables of 3 seeds, more than 2"),
    ],
)
def test_a_folder_of_another_configuration_is_refused(arguments, changes, message, tmp_path, capsys, tiny, no_training):
    Store(tmp_path, tiny, EPISODES, seeds=3).open()
    before = (tmp_path / store.HEAD).read_bytes()
    assert call(["--seeds", 3, *arguments, "--out", tmp_path], tiny.replace(**changes)) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert (tmp_path / store.HEAD).read_bytes() == before


def test_a_folder_made_by_other_code_is_refused(tmp_path, tiny, monkeypatch):
    Store(tmp_path, tiny, EPISODES, seeds=3).open()
    Store(tmp_path, tiny, EPISODES, seeds=4)
    monkeypatch.setattr(store, "code_digest", lambda: "another")
    with pytest.raises(ValueError, match="made by other code"):
        Store(tmp_path, tiny, EPISODES, seeds=3)


# --- trainings ------------------------------------------------------------------------------------------------------------


def test_a_change_that_changes_nothing_is_the_same_training(tiny):
    made = Plan(tiny, 3, EPISODES)
    plain = made.training("nav-d1", "peps", 2)
    assert plain.name == "nav-d1-peps-seed2"
    assert made.training("nav-d1", "peps", 2, lam=tiny.lam, num_queries=tiny.num_queries) == plain
    other = made.training("nav-d1", "peps", 2, lam=1.0)
    assert other.name == "nav-d1-peps-lam-1.0-seed2"
    assert other.config == plain.config.replace(lam=1.0)
    assert len(made.trainings("nav-d1", "peps", 9)) == 3, "never more seeds than the study's"


def test_a_beliefs_error_is_as_strong_as_told():
    task = peps_envs.make("nav-d3")
    truth, belief = task.params, task.beliefs[task.default_belief]
    jax.tree.map(np.testing.assert_array_equal, believed("nav-d3", 0.0), truth)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-6), believed("nav-d3", 1.0), belief)
    twice = believed("nav-d3", 2.0)
    np.testing.assert_allclose(twice.ice_gain, truth.ice_gain + 2 * (belief.ice_gain - truth.ice_gain), rtol=1e-6)
    assert float(twice.sand_stuck) == 0.0, "no probability below 0"
    np.testing.assert_array_equal(twice.pit, truth.pit)


def test_names_tell_recipes_apart(tiny):
    made = Plan(tiny, 3, EPISODES)
    by_name: dict[str, set[str]] = {}
    for result in command.RESULTS.values():
        for what in result.needs(made):
            by_name.setdefault(what.name, set()).add(json.dumps(what.recipe, sort_keys=True))
    assert all(len(recipes) == 1 for recipes in by_name.values())
    assert len({recipe for recipes in by_name.values() for recipe in recipes}) == len(by_name)


def test_the_typical_training_is_the_median_one(tiny, monkeypatch):
    made = Plan(tiny, 4, EPISODES)
    trainings = made.trainings("nav-d1", "peps")
    values = dict(zip(trainings, (made_up(5.0), made_up(1.0), made_up(4.0), made_up(4.4, failed=True)), strict=True))
    monkeypatch.setattr(made, "record", values.__getitem__)
    assert made.typical(trainings, lambda record: record.mean("return")) == trainings[2]
    assert made.typical(trainings[3:], lambda record: record.mean("return")) is None


# --- driving --------------------------------------------------------------------------------------------------------------


def test_what_the_driving_study_trained_is_kept(tmp_path, tiny, capsys, monkeypatch):
    monkeypatch.setattr(experiment, "METHODS", ("sac",))
    made, asked = Plan(tiny, 2, EPISODES), []
    part, over_lam, over_answers = figure3.needs(made)
    assert len({part.name, over_lam.name, over_answers.name}) == 3
    assert part.steps == tiny.total_steps, "the length that was asked for"
    assert figure3.needs(Plan(Config(), 2, EPISODES))[0].steps == experiment.STEPS

    def pretend(part, num_episodes):
        asked.append(part)
        like = jax.eval_shape(lambda config, each: experiment.learn(config, each, part.episodes), *part.agents[0])
        return jax.tree.map(lambda leaf: np.full((1, 2, *leaf.shape), 3, leaf.dtype), like)

    monkeypatch.setattr(experiment.Part, "make", pretend)
    kept = Store(tmp_path, tiny, EPISODES, seeds=2)
    kept.open()
    made.make([part], kept)
    again = Plan(tiny, 2, EPISODES)
    assert again.missing([part], kept) == []
    assert asked == [part], "the second time from the file"
    jax.tree.map(np.testing.assert_array_equal, made.record(part), again.record(part))
    monkeypatch.setattr(experiment, "SETTINGS", experiment.SETTINGS | {"gamma": 0.5})
    with pytest.raises(ValueError, match="made with other settings"):
        Plan(tiny, 2, EPISODES).missing([part], kept)
    Store(tmp_path / "other", tiny, EPISODES, seeds=2).open()
    (tmp_path / "other" / store.KEPT / f"{part.name}.npz").write_bytes(b"PK half a file")
    capsys.readouterr()
    assert call(["figure3", "--seeds", 2, "--out", tmp_path / "other"], tiny) == 2
    error = capsys.readouterr().err
    assert "can't be read: remove it" in error
    assert error.count("\n") == 1


# --- tables ---------------------------------------------------------------------------------------------------------------


def test_numbers_in_a_table():
    assert summary.with_interval(Estimate(1.04, -2.0, 3.96)) == "1.0 [-2.0, 4.0]"
    assert summary.with_interval(Estimate(math.nan, math.nan, math.nan)) == "–"
    assert summary.decimal(None) == "–"
    assert summary.decimal(0.5, 2) == "0.50"


def test_markdown_and_latex():
    head, rows = ["a", "b", "c"], [["x", "50 %", "1 ± 2"], ["x", "a_b", "–"], ["y", "r̂", "λ"]]
    assert markdown(head, rows).splitlines()[1:3] == ["|---|---|---|", "| x | 50 % | 1 ± 2 |"]
    text = latex(head, rows)
    assert text.startswith("\\begin{tabular}{llr}\n\\toprule\na & b & c \\\\\n\\midrule\n")
    assert r"x & 50 \% & 1 $\pm$ 2 \\" in text
    assert text.count(r"\midrule") == 2, "one under the head, and one between x and y"
    assert r"y & $\hat r$ & $\lambda$ \\" in text


def test_a_line_of_known_scores():
    records = [made_up(value) for value in (0.0, 10.0, 20.0, 90.0)]
    made = summary.line(["nav-d1"], "peps", [records], trained=5)
    assert (made["domain"], made["seeds"], made["failed"]) == ("nav-d1", 4, 1)
    assert made["return"] == 15.0, "the middle half"
    assert made["return_mean"] == 30.0
    assert made["return_low"] <= 15.0 <= made["return_high"]
    assert made["return_sd"] == pytest.approx(np.std([0, 10, 20, 90]))
    everywhere = summary.line(DOMAINS, "peps", [records] * 3 + [records[:2]], trained=16)
    assert (everywhere["domain"], everywhere["failed"]) == ("all", 2)
    assert everywhere["explicability"] == 5.0, "as many seeds of each domain as the fewest"


@pytest.mark.parametrize(
    ("values", "needed"), [([1.0, 2.0, 3.0], 100 * np.sqrt(10)), ([1.5, 0.0, 0.0], 100), ([0.0, 1.0, 1.4], np.inf)]
)
def test_the_queries_that_it_takes(values, needed):
    assert queries.queries_needed([100, 1000, 10_000], values, 1.5) == pytest.approx(needed)


def test_one_seed_has_no_interval():
    made = summary.line(["nav-d1"], "peps", [[made_up(1.0)]], trained=2)
    assert math.isnan(made["return"])
    assert made["return_mean"] == 1.0


def test_the_papers_numbers_say_what_the_paper_says():
    """Sec. 5.1: PEPS has the highest explicability everywhere, and its return is close to the best."""
    for place in range(len(DOMAINS)):
        explicability = {method: values[place] for method, values in table1.PAPER["explicability"].items()}
        returns = {method: values[place] for method, values in table1.PAPER["return"].items()}
        assert max(explicability, key=explicability.get) == "peps"
        assert max(returns.values()) - returns["peps"] < 2
        assert all(explicability[method] <= returns[method] for method in returns), "l_H - l_A costs on average"


def test_ways_have_the_names_of_figure_2():
    x = np.linspace(0.5, 19.5, 200)
    pit = {domain: np.asarray(peps_envs.make(domain).params.pit) for domain in ("nav-d1", "nav-d2")}
    level = lambda y: np.stack([x, np.full_like(x, y)], 1)
    over, under = pit["nav-d1"][3], pit["nav-d2"][1]
    assert ways.way("nav-d1", level(over + 0.3), True) == "along the pit"
    assert ways.way("nav-d1", level(over + 1.0), True) == "detour"
    assert ways.way("nav-d2", level(under - 1.0), True) == "corridor"
    assert ways.way("nav-d2", level(under + 1.0), True) == "below"
    corner = np.array([[0.0, 0.0], [1.0, 4.0], [5.0, 5.0]])
    assert ways.way("nav-d4", corner, True) == "sand"
    assert ways.way("nav-d4", corner[:, ::-1], True) == "ice"
    assert ways.way("nav-d4", corner, False) == "none"


def test_points_at_one_place_share_a_label():
    places = np.array([[0.1, 0.1], [0.5, 0.1], [0.13, 0.08], [0.1, 0.5]])
    assert frontier._at_one_place(places) == [[0, 2], [1], [3]]


# --- the whole ------------------------------------------------------------------------------------------------------------


def test_everything_is_written_from_what_is_there(tmp_path, capsys, tiny, no_training, monkeypatch):
    monkeypatch.setattr(panels, "DOTS", 30)
    monkeypatch.setattr(experiment.Part, "make", lambda part, num_episodes: made_up(1.0))
    monkeypatch.setattr(experiment, "findings", lambda parts, seen: {part.method for part in parts})
    monkeypatch.setattr(figure3.report, "write", lambda found, folder: [folder / f"figure3 of {len(found)} methods"])
    monkeypatch.setattr(physics, "write", lambda plan, folder: [])
    fill(tmp_path, tiny, seeds=3)
    assert call(["all", "--seeds", 3, "--out", tmp_path], tiny) == 0
    written = {path.name for path in tmp_path.iterdir()} - {store.HEAD, store.KEPT}
    pictures = ("figure1", "figure2", "frontier", "queries", "answers", "bias")
    texts = {f"{name}.md" for name in ("queries", "frontier", "answers", "bias", "teachers")}
    assert written == texts | {"improvement.csv", "improvement_many.csv", "teachers.csv"} | {
        f"{name}.{kind}" for name in pictures for kind in ("png", "pdf", "csv")
    } | {
        f"{name}.{kind}"
        for name in ("table1", "table1_many", "baselines", "ablations")
        for kind in ("md", "csv", "tex")
    }
    lines = lines_of(tmp_path / "table1.csv")
    assert len(lines) == len(DOMAINS) * (len(table1.ROWS) + 3) + len(table1.ROWS)
    failing = next(line for line in lines if (line["domain"], line["method"]) == ("nav-d1", "drlhp"))
    assert (failing["seeds"], failing["failed"], failing["return_paper"]) == ("2", "1", "74.51")
    assert failing["arrived"] == "2"
    assert "| 2 of 3 |" in (tmp_path / "table1.md").read_text(encoding="utf-8"), "one that failed doesn't arrive"
    assert "200 answers" in (tmp_path / "table1_many.md").read_text(encoding="utf-8")
    rows = {line["method"] for line in lines_of(tmp_path / "baselines.csv")}
    assert rows >= {"DARC", "policy shaping, Gaussians", "policy shaping, Gaussians, 200 answers"}
    assert {line["bias"] for line in lines_of(tmp_path / "bias.csv")} == {str(bias_) for bias_ in bias.STRENGTHS}
    assert {line["method"] for line in lines_of(tmp_path / "teachers.csv")} == set(teachers.TEACHERS)
    assert all(line["inflation"] for line in lines_of(tmp_path / "frontier.csv") if line["method"] == "peps")
    printed = capsys.readouterr().out
    assert "table1.tex" in printed
    assert "figure3 of 4 methods" in printed
    assert {line["strategy"] for line in lines_of(tmp_path / "queries.csv")} > {"information_gain", "random"}
    told = {(line["method"], int(line["answers"])) for line in lines_of(tmp_path / "answers.csv")}
    assert told == {("SAC", 0), ("PEPS", 0)} | {(name, some) for name in answers.VARIANTS for some in (7, 20, 200)}
    assert {line["method"] for line in lines_of(tmp_path / "frontier.csv")} > {"planner", "peps", "sac"}
    before = {path: path.read_bytes() for path in tmp_path.glob("*.p*")}
    assert call(["figure2", "--seeds", 3, "--out", tmp_path], tiny) == 0
    assert {path: path.read_bytes() for path in before} == before, "the same numbers make the same files"


@pytest.mark.slow
def test_a_stopped_table_continues(tmp_path, capsys, tiny, monkeypatch):
    monkeypatch.setattr(plan, "PLANNER", {name: dict(points=1, resolution=13) for name in plan.PLANNER})
    monkeypatch.setattr(table1, "ROWS", ("peps", "sac"))
    monkeypatch.setattr(table1, "BASELINES", ("sac",))
    for module in (table1, figure1):
        monkeypatch.setattr(module, "DOMAINS", ("nav-d1",))
    seeds, compiled, asked = 4, batches.program, []
    made, kept = Plan(tiny, seeds, EPISODES), Store(tmp_path, tiny, EPISODES, seeds)
    kept.open()
    plans = [made.planned("nav-d1", objective) for objective in ("peps", "human")]
    for what in [*plans, *made.trainings("nav-d1", "sac")]:  # one method and one plan are enough to compile
        kept.save(what.name, what.recipe, made_up(80.0).arrays())

    def interrupt_the_last(config, *arguments):
        asked.append(config.method)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return compiled(config, *arguments)

    monkeypatch.setattr(batches, "program", interrupt_the_last)
    arguments = ["table1", "--seeds", seeds, "--out", tmp_path]
    assert call(arguments, tiny) == 130
    assert "the same command continues" in capsys.readouterr().err
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / store.KEPT).iterdir()}
    assert len(kept) == 3 + seeds + 2, "plans, SAC, and a batch of PEPS"
    assert not (tmp_path / "table1.md").exists()

    assert call(arguments, tiny) == 0
    assert asked == ["peps"] * 3
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    trained = next(line for line in lines_of(tmp_path / "table1.csv") if line["method"] == "peps")
    assert trained["seeds"] == "4"
    assert np.isfinite([float(trained[name]) for name in ("explicability_low", "sampled_return")]).all()

    assert call(["figure1", *arguments], tiny) == 0
    assert len(asked) == 3, "nothing is left to train"
    columns = ("x", "y", "learned", "true")
    heat = np.array([[float(line[name]) for name in columns] for line in lines_of(tmp_path / "figure1.csv")])
    assert np.isfinite(heat).all()
