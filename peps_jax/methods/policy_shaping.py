"""Policy shaping (Griffith et al. 2013): one policy on the environment's reward, one on human feedback, and their product acts.

    pi(a|s) ~ pi_A(a|s) pi_H(a|s),

normalised over discrete actions; for continuous ones it is the product of the Gaussians before tanh, whose mean is weighed by
their precisions. Feedback is PEPS's r-hat, from the same teacher and budget: the two differ in what they make of it. While they
learn, the product acts in a third of the environments and each policy alone in another third (`train.collect_and_ask`): where
only the product acted, the policies' own mistakes were never carried out, and so never corrected.

Two policies that are sure of opposite actions make one that is sure of neither: (0.1, 0.9) and (0.9, 0.1) give (0.5, 0.5).
"""

from __future__ import annotations

from peps_jax.methods import preference_based

POLICY_SHAPING = preference_based.method(
    "policy_shaping",
    rewards=(lambda knowledge, transitions, config: transitions.reward, preference_based.reward),
)
