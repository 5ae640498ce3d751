"""What the programs of a training are made of, and what compiling them takes; writes benchmarks/results/compilation.md.

    python benchmarks/compilation.py [--envs nav-d1 mjx-box] [--methods peps sac] [--lines]

Each method in fresh processes without any cache, in CPU-seconds: its programs as `jax.jit` compiles them, and all of them as a
sweep does, which doesn't optimize what runs once. `--lines` prints, of each program, the lines of StableHLO by the functions that
they come from: with all that a function calls, and its own.
"""

from __future__ import annotations

import argparse
import ast
import collections
import functools
import importlib
import itertools
import os
import pathlib
import re
import resource
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp

from peps_jax import Config
from peps_jax.execution.program import Program, advance, begin, roomy, score
from peps_jax.storage.tables import markdown

OUT = pathlib.Path(__file__).parent / "results" / "compilation.md"
ROUNDS, EPISODES, STEPS = 10, 100, 8_000
SHOWN = 30  # functions


def programs(env: str, method: str) -> dict[str, tuple[Any, tuple[Any, ...]]]:
    """Functions and arguments: how a training begins, goes on for some rounds, and is evaluated."""
    config = roomy(Config(env=env, method=method, total_steps=STEPS))
    state = jax.eval_shape(begin, config)
    evaluation = lambda state, config: score(state, config, EPISODES)
    return {
        "begin": (begin, (config,)),
        "rounds": (advance, (state, jnp.array([0, ROUNDS]), config)),
        "evaluate": (evaluation, (state, config)),
    }


def seconds() -> float:
    """Of CPU, by this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def measure(env: str, method: str) -> list[list[str]]:
    """A row for each program: lines, fusions, and CPU-seconds to trace and lower and to compile it."""
    rows = []
    for name, (function, arguments) in programs(env, method).items():
        start = seconds()
        lowered = jax.jit(function).lower(*arguments)
        between = seconds()
        compiled = lowered.compile()
        end = seconds()
        lines, fusions = len(lowered.as_text().splitlines()), compiled.as_text().count(" fusion(")
        rows.append([env, method, name, f"{lines:,}", f"{fusions:,}", f"{between - start:.1f}", f"{end - between:.1f}"])
    return rows


def measure_sweep(env: str, method: str) -> list[list[str]]:
    """A row for all that a sweep compiles for a training: CPU-seconds from tracing on."""
    program = Program(Config(env=env, method=method, total_steps=STEPS), 1, EPISODES, jax.devices()[:1])
    start = seconds()
    program.compile()
    return [[env, method, "**all, by a sweep**", "", "", "", f"**{seconds() - start:.1f}**"]]


MEASURED = {"programs": measure, "sweep": measure_sweep}


# --- where lines come from ------------------------------------------------------------------------------------------------


@functools.cache
def function_at(file: str, line: int) -> str:
    """The innermost function around a line."""
    around = [
        node
        for node in ast.walk(ast.parse(pathlib.Path(file).read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.Lambda) and node.lineno <= line <= node.end_lineno
    ]
    inner = min(around, key=lambda node: node.end_lineno - node.lineno, default=None)
    name = "module" if inner is None else getattr(inner, "name", f"lambda in line {inner.lineno}")
    return f"{pathlib.Path(file).stem}.{name}"


def by_function(text: str) -> tuple[collections.Counter[str], collections.Counter[str]]:
    """Lines of StableHLO by this project's functions: with all that they call, and their own."""
    places = dict(re.findall(r"^(#loc\d*) = loc\((.*)\)$", text, flags=re.MULTILINE))

    @functools.cache
    def calls(place: str) -> tuple[str, ...]:
        """Functions that led to a place, the innermost first."""
        described = places.get(place, "")
        found = re.match(r'"([^"]+\.py)":(\d+)', described)
        if found:
            return (function_at(found[1], int(found[2])),) if "/peps_" in found[1] else ()
        return tuple(name for inner in re.findall(r"#loc\d*", described) for name in calls(inner))

    whole, own = collections.Counter(), collections.Counter()
    for place in re.findall(r"^(?!#).* loc\((#loc\d*)\)$", text, flags=re.MULTILINE):
        names = calls(place)
        own[names[0] if names else "JAX's own: random bits and the like"] += 1
        whole.update(set(names))
    return whole, own


def print_lines(env: str, method: str) -> None:
    """The largest pieces of each program."""
    for name, (function, arguments) in programs(env, method).items():
        whole, own = by_function(jax.jit(function).lower(*arguments).as_text(debug_info=True))
        for title, counted in (("with what they call", whole), ("their own", own)):
            print(f"\n{env} {method}, {name}: lines by functions, {title}")
            for function_name, number in counted.most_common(SHOWN):
                print(f"{number:7,} {function_name}")


def in_a_fresh_process(env: str, method: str, what: str) -> list[list[str]]:
    """The rows of one of `MEASURED`."""
    command = [sys.executable, __file__, "--envs", env, "--methods", method, "--one", what]
    environment = os.environ | {"PEPS_JAX_CACHE": "", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, encoding="utf-8")
    return [line.split("\t") for line in done.stdout.splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--envs", nargs="+", default=["nav-d1", "mjx-box"])
    parser.add_argument("--methods", nargs="+", default=["peps", "sac"])
    parser.add_argument("--lines", action="store_true", help="print what programs are made of, and compile nothing")
    parser.add_argument("--one", choices=list(MEASURED), help=argparse.SUPPRESS)  # this process measures one method's
    given = parser.parse_args()
    if given.one:
        importlib.import_module("distrax")  # at a training's first sight of it, which isn't compilation
        print("\n".join("\t".join(row) for row in MEASURED[given.one](*given.envs, *given.methods)))
        return
    asked = list(itertools.product(given.envs, given.methods))
    if given.lines:
        for env, method in asked:
            print_lines(env, method)
        return
    rows = []
    for env, method in asked:
        found = in_a_fresh_process(env, method, "programs")
        sums = [f"**{sum(float(row[place]) for row in found):.1f}**" for place in (-2, -1)]
        rows += [*found, [env, method, "**all**", "", "", *sums], *in_a_fresh_process(env, method, "sweep")]
    head = [
        "task",
        "method",
        "program",
        "lines of StableHLO",
        "fusions",
        "CPU-s to trace and lower",
        "CPU-s to compile",
    ]
    text = f"Defaults, cold in a fresh process:\n\n{markdown(head, rows)}"
    OUT.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
