"""The human's expectation: SAC on r_H in the human's own MDP, where the belief is what happens (the paper's Figure 2, "Human").

No agent, but what a human who is right about the dynamics and the reward would do. Its scores are those of that MDP: the return
is sum r_H, l_H = l_A, and so the explicability is the return.
"""

from __future__ import annotations

from peps_jax.methods.method import register
from peps_jax.methods.sac import SAC

HUMAN_EXPECTATION = register(
    SAC._replace(name="human_expectation", acts_in=lambda problem: problem.replace(params=problem.belief))
)
