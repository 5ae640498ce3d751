"""What must not change: short trainings of every method, and a small sweep's table, against numbers that were recorded once.

    python tests/test_recorded.py     # records them anew

That is right only where a random stream or an order of operations had to change; the commit says which, and why.
"""

import os
import sys
from pathlib import Path

if __name__ == "__main__":  # the same compiler as in the tests
    sys.path.insert(0, str(Path(__file__).parent))
    import conftest  # noqa: F401

import csv
import tempfile

import jax
import numpy as np
import pytest

from peps_jax import Config, evaluate, train
from peps_jax.execution.program import shared
from peps_jax.sweep import command

NUMBERS, TABLE = (Path(__file__).parent / "recorded" / name for name in ("numbers.npz", "table.csv"))
METHODS = ("peps", "sac", "drlhp", "policy_shaping", "human_expectation")
ENVIRONMENTS = ("nav-d1", "nav-d4", "highway-rain")
# three rounds, the first with random actions; every size is given, so that no number hangs on a default
SETTINGS = dict(
    seed=3, lam=1.7, total_steps=120, num_envs=4, rollout_length=10, warmup_steps=40, exploration=0.2, hold_steps=3,
    learning_rate=1e-3, fade_share=0.3, temperature=0.02, initial_temperature=3.0, anneal_share=0.8,
    saturation_penalty=0.02, target_rate=0.01, reward_scale=0.1, updates_per_step=0.1, batch_size=16, hidden_sizes=(8,),
    ensemble_size=3, model_hidden_sizes=(8,), dynamics_learning_rate=1e-3, dynamics_updates=3, dynamics_batch_size=16,
    surrogate_learning_rate=5e-3, surrogate_updates=3, surrogate_batch_size=8, surrogate_decay=1e-4, num_queries=18,
    segment_length=5, min_segment_length=2, query_strategy="information_gain", candidates_per_query=10, gamma=0.995,
    policy_entropy_weight=0.3, mistake_rate=0.1, myopia=0.95, prior="observed", bound=1.0, uniform_answers=0.0,
    critic_normalisation=True, product="gaussians", informed=0.0, entropy_fade_share=0.0,
)  # fmt: skip
SWEEP = """
    --env nav-d1 --method peps sac --lam 0.5 2.0 --seeds 2 --seed 3 --total-steps 120 --num-envs 4 --rollout-length 10
    --warmup-steps 40 --updates-per-step 0.1 --batch-size 16 --hidden-sizes 8 --ensemble-size 3 --model-hidden-sizes 8
    --dynamics-updates 3 --dynamics-batch-size 16 --surrogate-updates 3 --surrogate-batch-size 8 --num-queries 18 --episodes 4
"""
EPISODES = 3


def learned(result) -> dict[str, jax.Array]:
    """Everything that a training has learned, by name."""
    parts = {f"agent {place}": (agent.policy, agent.critics) for place, agent in enumerate(result.agents)}
    for name in ("dynamics", "surrogate"):
        if hasattr(result.knowledge, name):
            parts[name] = getattr(result.knowledge, name).params
    found = {}
    for name, tree in parts.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            found[f"{name} {jax.tree_util.keystr(path)}"] = leaf
    return found


def figures(config: Config) -> dict[str, jax.Array]:
    """What a training has learned, its curves, and its evaluation."""
    result = train(config)
    evaluation = evaluate(result, EPISODES, stochastic=True)
    scored = dict(zip(evaluation.score._fields, evaluation.score, strict=True))
    scored |= {"log_policy": evaluation.log_policy, "length": evaluation.length}
    named = {"learned": learned(result), "curve": result.curves, "evaluation": scored}
    return {f"{part}: {name}": value for part, values in named.items() for name, value in values.items()}


def training(environment: str, method: str) -> dict[str, np.ndarray]:
    """One training's figures. Environments that share code share a program."""
    level = "standard" if method == "drlhp" else "none"
    config = shared(Config(env=environment, method=method, level=level, **SETTINGS))
    return jax.tree.map(np.asarray, _figures(config))


_figures = jax.jit(figures)


def table(folder: Path) -> list[dict[str, str]]:
    """The rows of a small sweep."""
    assert command.main([*SWEEP.split(), "--out", str(folder)]) == 0
    with open(folder / "results.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("method", METHODS)
def test_a_short_training_has_the_recorded_numbers(method):
    with np.load(NUMBERS) as recorded:
        for environment in ENVIRONMENTS:
            found = training(environment, method)
            prefix = f"{environment} {method} "
            assert {name.removeprefix(prefix) for name in recorded if name.startswith(prefix)} == set(found)
            for name, values in found.items():
                np.testing.assert_allclose(values, recorded[prefix + name], rtol=1e-5, atol=1e-5, err_msg=prefix + name)


def test_a_small_sweep_has_the_recorded_table(tmp_path):
    with open(TABLE, newline="", encoding="utf-8") as file:
        recorded = list(csv.DictReader(file))
    found = table(tmp_path / "sweep")
    assert [list(row) for row in found] == [list(row) for row in recorded]
    for row, expected in zip(found, recorded, strict=True):
        for name, value in expected.items():
            try:
                np.testing.assert_allclose(float(row[name]), float(value), rtol=1e-5, atol=1e-5, err_msg=name)
            except ValueError:
                assert row[name] == value, name


def record() -> None:
    """Writes the numbers of today's code."""
    NUMBERS.parent.mkdir(exist_ok=True)
    numbers = {
        f"{environment} {method} {name}": values
        for method in METHODS
        for environment in ENVIRONMENTS
        for name, values in training(environment, method).items()
    }
    np.savez_compressed(NUMBERS, **numbers)
    with tempfile.TemporaryDirectory() as folder:
        rows = table(Path(folder) / "sweep")
    with open(TABLE, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"{len(numbers)} arrays in {NUMBERS}, {os.path.getsize(NUMBERS)} bytes; {len(rows)} rows in {TABLE}")


if __name__ == "__main__":
    record()
