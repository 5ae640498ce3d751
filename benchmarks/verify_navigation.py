"""What PEPS and SAC reach on D1-D4 beside the exact planner; writes benchmarks/results/navigation.{md,json}.

    make verify-navigation [ARGS="--seeds 8 --steps 30000"]

Trainings use the package's defaults and the seeds 0, 1, ...; defaults were tuned on seeds from 100 on. Evaluation: 100
episodes with the policy's mode, and the same with samples beside it.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import peps_envs
from peps_envs.navigation import NavigationState
from peps_jax import Config, evaluate
from peps_jax.analysis import navigation_planner
from peps_jax.analysis.intervals import estimate, mean
from peps_jax.command_line import print_whatever_can_be_shown, use_every_core
from peps_jax.execution.devices import compile_over_devices
from peps_jax.learning import surrogate
from peps_jax.preferences import synthetic_human
from peps_jax.train import finish, init, prepare, run_rounds

DOMAINS = ("nav-d1", "nav-d2", "nav-d3", "nav-d4")
ROUTES = {  # the paper's Figure 2: PEPS's and SAC's
    "nav-d1": ("detour", "along the pit"),
    "nav-d2": ("below", "corridor"),
    "nav-d3": ("ice", "ice"),
    "nav-d4": ("sand", "ice"),
}
CHOICES = ("nav-d1", "nav-d2", "nav-d4")  # where being explicable costs something
LAMBDAS = (0.0, 0.5, 1.0, 2.0, 2.4, 2.8)
FOLDER = pathlib.Path(__file__).parent / "results"


def route(domain: str, places: np.ndarray, arrived: bool = True) -> str:
    """Names the way that `places` (steps + 1, 2) take through a domain: "none" if it didn't arrive.

    D1: "detour" if, past the pit, its clearance is above 0.6 on average. D2: below or above the pit. D3, D4: on which side of
    the diagonal the way keeps its largest distance.
    """
    if not arrived:
        return "none"
    x, y = places.T
    if domain in ("nav-d1", "nav-d2"):
        pit = np.asarray(peps_envs.make(domain).params.pit)
        past = y[(x > pit[0]) & (x < pit[2])]
        if domain == "nav-d1":
            return "detour" if past.mean() - pit[3] > 0.6 else "along the pit"
        return "below" if past.mean() > pit[1] else "corridor"
    return "sand" if (y - x).max() > (x - y).max() else "ice"


def measure(config: Config) -> dict[str, jax.Array]:
    """One cell: train, evaluate, and compare r-hat with what the human feels, over everything visited."""
    training = prepare(config)
    state, curves = run_rounds(init(training), jnp.arange(config.num_rounds), training)
    result = finish(state, curves, training)
    mode, sampled = (evaluate(result, 100, stochastic=stochastic) for stochastic in (False, True))
    figures = {
        "return": mode.return_.mean(),
        "explicability": mode.explicability.mean(),
        "goal": mode.goal_reached.mean(),
        "places": mode.perceived[0],
        "sampled_return": sampled.return_.mean(),
        "sampled_explicability": sampled.explicability.mean(),
    }
    if config.method == "peps":
        problem = training.problem
        environment, params, belief = problem.environment, problem.params, problem.belief
        rows = jax.tree.map(lambda values: values[:: max(1, values.shape[0] // 3000)], state.replay)
        place = lambda observation: NavigationState(environment.position_of(observation, params), jnp.int32(0))
        felt = jax.vmap(lambda row: sum(synthetic_human.log_weight(
            environment, belief, place(row.observation), row.action, place(row.next_observation))))(rows)  # fmt: skip
        figures["felt"] = felt
        figures["predicted"] = surrogate.predict(
            result.surrogate, rows.observation, rows.action, training.settings.surrogate
        )
    return figures


def run_cells(configs: list[Config]) -> dict[str, np.ndarray]:
    """`measure` for each cell, spread over the devices, one at a time on each."""
    start = time.perf_counter()
    program, cells = compile_over_devices(measure, configs)
    figures = jax.tree.map(lambda values: np.asarray(values)[: len(configs)], program(cells))
    print(f"  {len(configs)} trainings, {time.perf_counter() - start:.0f} s with compilation", flush=True)
    return figures


planned_episodes = jax.jit(navigation_planner.walk, static_argnames=("environment", "objective", "num_episodes"))


def bound(domain: str, lam: float, objective: str) -> tuple[float, float, str]:
    """The exact planner's return, explicability and route."""
    task = peps_envs.make(domain)
    episodes = planned_episodes(task.environment, task.params, task.beliefs[task.default_belief], objective, lam, 20)
    way = route(domain, np.asarray(episodes.perceived[0]), bool(episodes.goal_reached[0]))
    return float(episodes.return_.mean()), float(episodes.explicability.mean()), way


def measured_domains(base: Config, seeds: Sequence[int]) -> dict[str, dict[str, Any]]:
    """By domain: the planner's figures, each method's by seed, and how r-hat ranks what was visited."""
    print("planner", flush=True)
    planned = {
        domain: {objective: bound(domain, float(base.lam), objective) for objective in ("return", "peps")}
        for domain in DOMAINS
    }
    entries = {domain: {"planner": planned[domain]} for domain in DOMAINS}
    for method in ("sac", "peps"):
        print(method, flush=True)
        figures = run_cells(
            [base.replace(env=domain, method=method, seed=seed) for domain in DOMAINS for seed in seeds]
        )
        for number, domain in enumerate(DOMAINS):
            rows = {name: values[number * len(seeds) : (number + 1) * len(seeds)] for name, values in figures.items()}
            ways = zip(rows["places"], rows["goal"] > 0.5, strict=True)
            entries[domain][method] = {name: values.tolist() for name, values in rows.items() if values.ndim == 1} | {
                "routes": [route(domain, *way) for way in ways]
            }
            if "felt" in rows:
                pairs = zip(rows["predicted"], rows["felt"], strict=True)
                entries[domain]["rank_correlation"] = [float(stats.spearmanr(*pair)[0]) for pair in pairs]
    return entries


def measured_lambdas(base: Config, seeds: Sequence[int]) -> dict[str, dict[str, list[float]]]:
    """By domain: explicability at each of `LAMBDAS`, the planner's and PEPS's mean over `seeds`."""
    print("lambda", flush=True)
    figures = run_cells([
        base.replace(env=domain, method="peps", lam=lam, seed=seed)
        for domain in CHOICES for lam in LAMBDAS for seed in seeds
    ])  # fmt: skip
    by_lam = figures["explicability"].reshape(len(CHOICES), len(LAMBDAS), -1).mean(-1)
    return {
        domain: {"planner": [bound(domain, lam, "peps")[1] for lam in LAMBDAS], "peps": values.tolist()}
        for domain, values in zip(CHOICES, by_lam, strict=True)
    }


def tables(record: dict[str, Any]) -> str:
    """What was measured, in Markdown."""
    lines = [
        "| domain | method | return | explicability (95 %) | sampled: return / explicability | goal, worst seed | as in Figure 2 |",
        "|---|---|---|---|---|---|---|",
    ]
    for domain, entry in record["domains"].items():
        for place, (objective, method) in enumerate((("peps", "peps"), ("return", "sac"))):
            value, exact, way = entry["planner"][objective]
            lines.append(f"| {domain} | planner, {objective} | {value:.1f} | {exact:.1f} | | | {way} |")
            figures = entry[method]
            found = estimate(mean, np.asarray(figures["explicability"])[:, None])
            average = {name: np.mean(figures[name]) for name in ("return", "sampled_return", "sampled_explicability")}
            lines.append(
                f"| {domain} | {method} | {average['return']:.1f} | {found.value:.1f} ({found.low:.1f} to {found.high:.1f}) "
                f"| {average['sampled_return']:.1f} / {average['sampled_explicability']:.1f} | {min(figures['goal']):.2f} "
                f"| {figures['routes'].count(ROUTES[domain][place])} of {len(figures['routes'])} |"
            )
    lines += [
        "",
        "| domain | way from SAC's to the planner's explicability | rank correlation of r-hat and truth |",
        "|---|---|---|",
    ]
    for domain, entry in record["domains"].items():
        ours, base, exact = (
            np.mean(value)
            for value in (entry["peps"]["explicability"], entry["sac"]["explicability"], entry["planner"]["peps"][1])
        )
        covered = (ours - base) / (exact - base)
        lines.append(f"| {domain} | {covered:.0%} | {np.mean(entry['rank_correlation']):.2f} |")
    lines += ["", "| explicability at lambda | " + " | ".join(map(str, LAMBDAS)) + " | Spearman |"]
    lines += ["|---" * (len(LAMBDAS) + 2) + "|"]
    for domain, rows in record["lambda"].items():
        for who, values in rows.items():
            cells = " | ".join(f"{value:.1f}" for value in values)
            lines.append(f"| {domain}, {who} | {cells} | {stats.spearmanr(LAMBDAS, values)[0]:.2f} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=8, help="trainings per domain and method")
    parser.add_argument("--lam-seeds", type=int, default=4, help="trainings per domain and lambda")
    parser.add_argument("--steps", type=int, default=Config().total_steps, help="environment steps of a training")
    arguments = parser.parse_args()
    print_whatever_can_be_shown()
    use_every_core()
    base = Config(total_steps=arguments.steps)
    record = {"seeds": arguments.seeds, "steps": arguments.steps}
    record["domains"] = measured_domains(base, range(arguments.seeds))
    record["lambda"] = measured_lambdas(base, range(arguments.lam_seeds))
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "navigation.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (FOLDER / "navigation.md").write_text(tables(record), encoding="utf-8")
    print(tables(record))


if __name__ == "__main__":
    main()
