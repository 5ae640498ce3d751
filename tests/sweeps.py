"""A small sweep of a small environment, in this process and in others."""

import os
import subprocess
import sys
from pathlib import Path

from commands import exit_code

import peps_envs
from peps_jax.execution import compilation_cache
from peps_jax.sweep import command, pictures

SIZES = [
    *("--num-envs", "4", "--rollout-length", "10", "--warmup-steps", "40", "--batch-size", "16"),
    *("--updates-per-step", "0.1", "--hidden-sizes", "8", "--model-hidden-sizes", "8", "--ensemble-size", "3"),
    *("--episodes", "4", "--checkpoint-every", "0"),
]
LINE = ["--env", "line", "--method", "sac", "--seeds", "4", "--total-steps", "160", *SIZES]  # two batches of two runs


def with_line(patch, line) -> None:
    """The line as an environment that command lines know, in batches of two runs, and a moment's drawing."""
    task = peps_envs.Task(line.env, line.params, {"noisy": line.belief, "true": line.params})
    patch.setitem(peps_envs.registry._TASKS, "line", lambda: task)
    patch.setattr(pictures, "draw", lambda rows, folder: [])


def call(*arguments: object) -> int:
    """The exit code of a sweep in this process."""
    return exit_code(command.main, *arguments)


def compiling_into(cache: Path) -> dict[str, str]:
    """The environment of processes that share what they compile."""
    return os.environ | {
        compilation_cache.VARIABLE: str(cache),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def start(environment: dict[str, str], *arguments: object) -> subprocess.Popen:
    """A sweep in a process of its own."""
    words = [sys.executable, "-m", "peps_jax.sweep", *map(str, arguments)]
    return subprocess.Popen(words, env=environment, encoding="utf-8", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
