"""Sweeps over environments, methods, lambdas and seeds: `python -m peps_jax.sweep`."""
