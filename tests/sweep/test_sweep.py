"""The sweep: what it refuses, what it writes, and that a run in a batch is the run alone."""

import csv
import json
import os
import subprocess
import sys
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import exit_code, is_one_complaint
from conftest import untrained

import peps_envs
import peps_jax
from peps_jax import command_line
from peps_jax.execution import batches, memory, program
from peps_jax.preferences import data
from peps_jax.sweep import command, pictures, results

EPISODES = 4


def tiny_flags(tiny) -> list[str]:
    """The command line of the `tiny` configuration."""
    names = (
        "total_steps", "num_envs", "rollout_length", "warmup_steps", "batch_size", "updates_per_step", "hidden_sizes",
        "model_hidden_sizes", "ensemble_size", "dynamics_updates", "surrogate_updates", "surrogate_batch_size", "num_queries",
        "segment_length",
    )  # fmt: skip
    flags = []
    for name in names:
        value = getattr(tiny, name)
        flags += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    return [*flags, "--episodes", str(EPISODES)]


def call(arguments: list[str]) -> int:
    return exit_code(command.main, *arguments)


def refuse_to_compile(*arguments):
    raise AssertionError("compiled")


# --- bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ("--env nav-d9", ("env 'nav-d9'", "did you mean 'nav-d", "nav-d1, nav-d2, nav-d3, nav-d4")),
        ("--env nav-d1 moon", ("env 'moon'", "known are")),
        ("--method pesp", ("method 'pesp'", "did you mean 'peps'")),
        ("--belief baised", ("belief 'baised'", "did you mean 'biased'")),
        ("--query-strategy randon", ("query_strategy 'randon'", "did you mean 'random'")),
        ("--lam 2.4 -1", ("lam -1.0", "0 or more")),
        ("--lam nan", ("lam nan", "0 or more")),
        ("--lam much", ("--lam", "'much' is not a number", "2.4")),
        ("--num-envs 2.5", ("--num-envs", "'2.5' is not a whole number")),
        ("--num-envs 0", ("num_envs 0", "from 1 to")),
        ("--hidden-sizes 64 0", ("hidden_sizes (64, 0)",)),
        ("--segment-length 30 --rollout-length 20", ("segment_length 30", "rollout_length is 20")),
        ("--gamma 1.5", ("gamma 1.5", "from 0 to 1")),
        ("--seeds 0", ("seeds 0", "choose 1 to")),
        ("--seed -3", ("seed -3", "choose 0 to")),
        ("--episodes 0", ("episodes 0", "choose 1 to")),
        ("--num-env 3", ("'--num-env'", "did you mean --num-envs?")),
        ("--lam", ("--lam", "expected at least one")),
        ("nav-d1", ("'nav-d1' is unknown",)),
        ("--total-steps 100000000000000", ("total_steps 100000000000000", "from 1 to")),
        ("--total-steps 2000000000", ("needs about", "lower total_steps")),
        ("--batch-size 1000000000", ("needs about", "batch_size")),
    ],
)
def test_bad_input_is_one_line(arguments, parts, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(program, "Program", refuse_to_compile)
    assert call([*arguments.split(), "--out", str(tmp_path / "out")]) == 2
    assert is_one_complaint(capsys.readouterr(), command.PROG, parts)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", [results.MANIFEST, results.TABLE])
def test_a_folder_with_results_is_not_written(file, tmp_path, capsys):
    (tmp_path / file).write_text("precious", encoding="utf-8")
    assert call(["--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "--overwrite" in error
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_a_file_is_no_folder(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert call(["--out", str(tmp_path / "file" / "out")]) == 2
    assert "is a file" in capsys.readouterr().err


def test_too_little_memory_is_said_before_compiling(tmp_path, capsys, monkeypatch, tiny):
    monkeypatch.setattr(program, "Program", refuse_to_compile)
    monkeypatch.setattr(memory, "available_bytes", lambda devices: 10_000)
    assert call([*tiny_flags(tiny), "--out", str(tmp_path / "out")]) == 2
    *reminders, error = capsys.readouterr().err.splitlines()  # on a slow machine planning may take its time
    assert all(line.startswith("planning") for line in reminders)
    assert "each of 2 devices has 8 kB" in error


def test_every_field_is_a_flag(capsys):
    assert call(["--help"]) == 0
    text = capsys.readouterr().out.replace(",", " ")
    for name in peps_jax.Config.__dataclass_fields__:
        assert (f"--{name.replace('_', '-')} " in text) == (name not in ("params", "lengths")), name


def test_one_device_per_core_unless_told_otherwise(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--some_flag=1")
    command_line.use_every_core()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert os.environ["XLA_FLAGS"] == f"--some_flag=1 --xla_force_host_platform_device_count={cores}"
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=7")
    command_line.use_every_core()
    assert os.environ["XLA_FLAGS"] == "--xla_force_host_platform_device_count=7"


def test_importing_the_library_meets_no_device():
    program = (
        "import sys, peps_jax.sweep; from jax._src import xla_bridge; "
        "print(xla_bridge.backends_are_initialized(), 'matplotlib' in sys.modules)"
    )
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, encoding="utf-8", check=True).stdout
    assert printed.split() == ["False", "False"]


# --- running --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swept(tmp_path_factory, tiny):
    """A folder that a whole sweep wrote: two methods, lambdas and seeds."""
    folder = tmp_path_factory.mktemp("sweep") / "results"
    flags = ["--env", "nav-d1", "--method", "peps", "sac", "--lam", "1.0", "2.4", "--seeds", "2", "--seed", "3"]
    assert call([*flags, *tiny_flags(tiny), "--out", str(folder)]) == 0
    return folder


def table(folder) -> list[dict[str, str]]:
    with open(folder / results.TABLE, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_sweep_writes_the_whole_grid(swept):
    rows = table(swept)
    manifest = json.loads((swept / results.MANIFEST).read_text(encoding="utf-8"))
    assert [(row["method"], float(row["lam"]), int(row["seed"])) for row in rows] == [
        (method, lam, seed) for method in ("peps", "sac") for lam in (1.0, 2.4) for seed in (3, 4)
    ]
    assert [row["name"] for row in rows] == [row["name"] for row in manifest["rows"]]
    assert {row["status"] for row in rows} == {"ok"}
    for column in ("return_mean", "explicability_mean", "belief_gap_mean", "length_mean", "goal_rate", "pit_rate"):
        assert all(np.isfinite(float(row[column])) for row in rows), column
    policies = [jax.tree.leaves(peps_jax.load(swept, row).agents) for row in (0, 2)]
    assert not all(map(np.array_equal, *policies)), "lambda changes what PEPS learns"
    sac = [{**row, "lam": "", "name": ""} for row in rows if row["method"] == "sac"]
    assert sac[:2] == sac[2:], "and nothing of what SAC does"

    assert manifest["status"] == "complete"
    assert manifest["configuration"]["lam"] == [1.0, 2.4]
    assert manifest["configuration"]["rationality"] == 1.0
    assert len(manifest["devices"]) == len(jax.devices())
    assert manifest["env_steps"] == 6 * 160, "four trainings of PEPS and two of SAC"
    for name in ("compile_seconds", "run_seconds", "env_steps_per_second"):
        assert manifest[name] > 0
    assert "jax" in manifest["versions"]

    curves = np.load(swept / results.CURVES)
    assert curves["return_"].shape == (8, 4)
    np.testing.assert_array_equal(curves["env_steps"], [40, 80, 120, 160])
    assert np.isfinite(curves["dynamics_loss"][:4]).all()
    assert np.isnan(curves["dynamics_loss"][4:]).all()

    files = Counter(path.suffix for path in swept.rglob("*") if path.is_file())
    assert files == {".json": 1, ".csv": 1, ".npz": 1, ".msgpack": 6, ".png": 4}


@pytest.mark.slow
def test_a_loaded_row_acts_and_scores_as_it_did(swept, tiny):
    row = table(swept)[3]
    assert (row["lam"], row["seed"]) == ("2.4", "4")
    result = peps_jax.load(swept, 3)
    assert (result.config.lam, result.config.seed, result.config.hidden_sizes) == (2.4, 4, tiny.hidden_sizes)
    again = peps_jax.load(str(swept), "nav-d1-peps-lam2.4-seed4")
    third = peps_jax.load(swept, {"method": "peps", "lam": 2.4, "seed": 4})
    for other in (again, third):
        jax.tree.map(np.testing.assert_array_equal, result.agents, other.agents)
    assert result.act(jnp.zeros(tiny.problem().environment.observation_size)).shape == (2,)
    evaluation = jax.jit(peps_jax.evaluate, static_argnums=1)(result, EPISODES)
    np.testing.assert_allclose(evaluation.return_.mean(), float(row["return_mean"]), rtol=1e-4)
    np.testing.assert_allclose(evaluation.explicability.mean(), float(row["explicability_mean"]), rtol=1e-4)
    assert result.curves["preference_accuracy"].shape == (4,)


@pytest.fixture
def line_task(line, monkeypatch):
    """The line as an environment that command lines know."""
    beliefs = {"noisy": line.belief, "true": line.params}
    monkeypatch.setitem(peps_envs.registry._TASKS, "line", lambda: peps_envs.Task(line.env, line.params, beliefs))


@pytest.mark.slow
def test_every_method_is_swept_and_loaded(line, line_task, tmp_path):
    names = ("drlhp", "policy_shaping", "human_expectation")
    flags = ["--env", "line", "--method", *names, "--lam", "1.0", "2.4", "--seeds", "1"]
    assert call([*flags, *tiny_flags(line), "--out", str(tmp_path)]) == 0
    rows = table(tmp_path)
    assert [(row["method"], row["status"]) for row in rows] == [(name, "ok") for name in names for _ in range(2)]
    assert len(list((tmp_path / results.RUNS).iterdir())) == 3, "none of them uses lambda"
    curves = np.load(tmp_path / results.CURVES)
    assert np.isfinite(curves["surrogate_decay"][:2]).all()
    assert np.isnan(curves["surrogate_decay"][2:]).all(), "only drlhp adapts its weight decay"
    for name, agents in zip(names, (1, 2, 1), strict=True):
        result = peps_jax.load(tmp_path, {"method": name, "lam": 2.4})
        assert len(result.agents) == agents
        assert result.act(jnp.zeros(1)).shape == (1,)


@pytest.mark.long
def test_a_mujoco_models_numbers_are_kept_with_what_was_learned(line, tmp_path):
    pytest.importorskip("mujoco")
    flags = ["--env", "mjx-box", "--method", "sac", "--belief", "heavy", "--seeds", "1", *tiny_flags(line)]
    assert call([*flags, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "routes.png").exists()
    result = peps_jax.load(tmp_path, 0)
    task = peps_envs.make("mjx-box")
    equal = lambda one, other: jax.tree.all(jax.tree.map(np.array_equal, one, other))
    assert equal(result.training.problem.params, task.params)
    assert equal(result.training.problem.belief, task.beliefs["heavy"])
    assert result.act(jnp.zeros(task.environment.observation_size)).shape == (2,)


@pytest.mark.slow
def test_every_method_with_a_surrogate_reward_has_its_heat_map(tiny):
    rows = []
    for method in ("peps", "sac", "drlhp"):
        config = tiny.replace(method=method)
        rows += [results.Row(results.Key("nav-d1", method, 2.4, seed, "any"), untrained(config)) for seed in (0, 1)]
    titles = [axes.get_ylabel() for axes in pictures.surrogate_maps(rows).axes]
    assert [title for title in titles if title.startswith("nav")] == ["nav-d1, peps, seed 0", "nav-d1, drlhp, seed 0"]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (8, "row 8 is out of range: choose 0 to 7"),
        (-1, "choose 0 to 7"),
        ("nav-d1-peps-lam2.4-seed5", "the nearest are .*nav-d1-peps-lam2.4-seed"),
        ({"method": "sac"}, "matches 4 of 8 rows"),
        ({"method": "sac", "seed": 9}, "matches 0 of 8 rows"),
        ({"sead": 3}, "did you mean 'seed'"),
    ],
)
def test_a_row_that_is_not_there(swept, row, message):
    with pytest.raises(ValueError, match=message):
        peps_jax.load(swept, row)


def test_a_folder_without_results_is_said(tmp_path):
    with pytest.raises(ValueError, match="holds no sweep's results"):
        peps_jax.load(tmp_path, 0)


def test_a_folder_of_an_older_version_is_said(tmp_path):
    (tmp_path / results.MANIFEST).write_text(json.dumps({"cells": [], "configuration": {}}), encoding="utf-8")
    with pytest.raises(ValueError, match="a version that doesn't fit this one: no 'rows'"):
        peps_jax.load(tmp_path, 0)


def test_an_interrupted_sweep_keeps_what_is_finished(line, line_task, tmp_path, capsys, monkeypatch):
    for name in (results.TABLE, results.PICTURES[0]):
        (tmp_path / name).write_text("an earlier run's", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    compiled, asked = batches.program, []

    def interrupt_the_second(*arguments):
        asked.append(arguments)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return compiled(*arguments)

    monkeypatch.setattr(batches, "program", interrupt_the_second)
    flags = ["--env", "line", "--method", "sac", "peps", "--lam", "1.0", "2.4", "--seeds", "2", "--overwrite"]
    assert call([*flags, *tiny_flags(line), "--out", str(tmp_path)]) == 130
    assert f"4 of 8 rows are finished and kept in {tmp_path}" in capsys.readouterr().err
    assert [row["name"] for row in table(tmp_path)] == [
        f"line-sac-lam{lam}-seed{seed}" for lam in (1.0, 2.4) for seed in (0, 1)
    ]
    assert json.loads((tmp_path / results.MANIFEST).read_text(encoding="utf-8"))["status"] == "interrupted"
    assert peps_jax.load(tmp_path, 1).act(jnp.zeros(1)).shape == (1,)
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"
    drawn = (tmp_path / results.PICTURES[0]).read_bytes()
    assert drawn.startswith(b"\x89PNG"), "of what is finished, not an earlier run's"


@pytest.mark.slow
def test_a_run_alone_in_a_split_batch_and_beside_a_failing_one(line, train):
    configs = [line.replace(method="peps", seed=seed) for seed in (3, 4, 5)]
    configs[1] = configs[1].replace(learning_rate=float("nan"))
    need = program.memory_need(configs[0], EPISODES)
    one_per_device = int((memory.bytes_needed(need, 1, together=False) + 100) / memory.AVAILABLE_SHARE)
    planned = batches.plan(configs, EPISODES, free=one_per_device)
    assert [one.runs for one in planned] == [(0, 1), (2,)]
    reported, finished = [], []

    class Listener(batches.Watch):
        def advanced(self, batch, rounds, curves, snapshot):
            reported.append(rounds)

        def finished(self, batch, runs, times):
            finished.extend(runs)
            assert times.run > 0

    batches.run(configs, planned, EPISODES, Listener())
    assert [run.failed for run in finished] == [False, True, False]
    assert reported == [1, 2, 3, 4] * 2

    alone = train(configs[2])
    for name, curve in alone.curves.items():
        np.testing.assert_allclose(finished[2].curves[name], curve, rtol=1e-3, atol=1e-4, err_msg=name)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    jax.tree.map(close, finished[2].agents[0].policy, alone.agents[0].policy)


def test_a_failed_run_is_a_row_that_says_so(line):
    evaluation = peps_jax.Evaluation(
        score=peps_jax.explicability.Score(*np.full((4, 2), np.nan)),
        log_policy=np.zeros(2),
        length=np.ones(2),
        events={"goal_reached": np.array([True, False])},
        perceived=np.zeros((2, 3, 2)),
    )
    failed = untrained(line).replace(evaluation=evaluation, failed=True)
    record = results.record(results.Row(results.Key("nav-d1", "peps", 2.4, 0, training="x"), failed))
    assert record["status"] == "failed"
    assert record["goal_rate"] == 0.5
    assert np.isnan(record["return_mean"])


# --- preferences that are kept and taught from ----------------------------------------------------------------------------


@pytest.mark.slow
def test_what_a_teacher_said_is_kept_and_teaches_again_bit_by_bit(line, line_task, tmp_path):
    first, again = tmp_path / "first", tmp_path / "again"
    flags = ["--env", "line", "--method", "peps", "sac", "--lam", "2.4", "--seeds", "2", *tiny_flags(line)]
    assert call([*flags, "--keep-answers", "--out", str(first)]) == 0
    kept = first / results.ANSWERS / "line-peps-lam2.4-seed1.npz"
    assert {path.name for path in kept.parent.iterdir()} == {"line-peps-lam2.4-seed0.npz", kept.name}, (
        "sac asks nothing"
    )
    assert peps_jax.load(first, 1).preferences.number.shape == (line.num_queries,)
    assert call([*flags, "--preferences", str(kept), "--out", str(again)]) == 0
    taught, recorded = table(first), table(again)
    assert recorded[1] == taught[1], "its own recording"
    assert recorded[0] != taught[0], "another's"
    assert recorded[2:] == taught[2:]
    one, other = (peps_jax.load(folder, 1) for folder in (first, again))
    jax.tree.map(np.testing.assert_array_equal, (one.agents, one.knowledge), (other.agents, other.knowledge))
    assert not (again / results.ANSWERS).exists()


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        ("--preferences none.npz", ("preferences", "none.npz", "can't be read: No such file")),
        ("--preferences bad.npz", ("preferences", "bad.npz", "no file that")),
        ("--preferences good.npz", ("preferences have observations of shape", "environment's are")),
        ("--preferences good.npz --method sac", ("would teach nothing", "peps, drlhp, policy_shaping")),
    ],
)
def test_preferences_that_do_not_fit_are_refused_in_one_line(flags, parts, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(program, "Program", refuse_to_compile)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.npz").write_bytes(b"bad")
    some = data.empty(3, 5, 1, peps_envs.Box(1))
    data.save("good.npz", some.replace(number=jnp.arange(3), weight=jnp.ones(3)))
    assert call([*flags.split(), "--out", "out"]) == 2
    assert is_one_complaint(capsys.readouterr(), command.PROG, parts)
    assert not (tmp_path / "out").exists()
