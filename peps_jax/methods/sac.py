"""SAC on the environment's reward alone (Haarnoja et al. 2018a, b): learns nothing beside, changes nothing."""

from __future__ import annotations

from peps_jax.methods.method import Method, true_world

SAC = Method(
    name="sac",
    uses_lam=False,
    world=true_world,
    init=lambda key, config: (),
    ask=lambda knowledge, trajectory, key, config: None,
    learn=lambda knowledge, buffer, filled, preferences, index, key, config: (knowledge, {}),
    rewards=(lambda knowledge, transitions, config: transitions.reward,),
    entropy_weight=lambda config: 0.0,
)
