"""The training that is measured: what `peers/protocol.py` makes the others do, whatever the package's defaults are."""

from __future__ import annotations

from peps_jax import Config


def measured(method: str = "peps", width: int = 64) -> Config:
    """A training of D1 by `method`, with two hidden layers of `width` units; in 400 steps 30 queries."""
    return Config(
        env="nav-d1", method=method, hidden_sizes=(width, width), total_steps=40_000, num_queries=3_000,
        warmup_steps=3_200, updates_per_step=0.25, batch_size=256, learning_rate=1e-3, exploration=0.2, critic_normalisation=False,
        surrogate_updates=20, surrogate_batch_size=32,
    )  # fmt: skip
