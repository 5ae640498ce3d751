"""SAC on the environment's reward alone (Haarnoja et al. 2018a, b): learns nothing beside, changes nothing."""

from __future__ import annotations

from peps_jax.methods.method import Method, register

SAC = register(Method(name="sac", rewards=(lambda knowledge, transitions, settings: transitions.reward,)))
