"""Preference-based explicable policy search: whole trainings as pure JAX functions."""

from peps_jax.config import Config, grid
from peps_jax.evaluate import Evaluation, evaluate
from peps_jax.sweep.results import load
from peps_jax.train import Result, train

__all__ = ["Config", "Evaluation", "Result", "evaluate", "grid", "load", "train"]
