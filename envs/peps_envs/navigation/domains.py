"""The four domains of Sec. 5.1, D1-D4, and what a human may believe about them."""

from __future__ import annotations

from peps_envs.navigation.parameters import NavigationParams, make_params

_CROSSING = dict(
    goal=(4.8, 4.8, 6.0, 6.0), pit=(5.0, 0.0, 6.0, 1.0), walls=((1.5, 1.5, 4.5, 4.5),),
    ice=(1.5, 0.0, 4.5, 1.5), sand=(0.0, 1.5, 1.5, 4.5),
)  # fmt: skip

# Where things stand in the paper's Figure 2, and what is true there. Reaching the goal past the pit takes 7 steps in D1 and in
# D2, the detour that a human expects 8; the ice takes 10 in D3 and D4, the sand 13 in D4. Each of these ways is still had in as
# many steps, or in one more on the ice, by who is 5 % slower: a way without slack is none for a policy that acts a little noisily.
DOMAINS = {
    "d1": dict(start=(0.5, 0.5), pit=(2.0, 0.0, 4.0, 1.0)),
    "d2": dict(start=(0.5, 0.5), pit=(2.0, 0.3, 4.0, 1.0)),
    "d3": _CROSSING | dict(sand_gain=0.1, sand_stuck=0.5),
    "d4": _CROSSING | dict(sand_gain=0.67),
}

# What the human thinks instead: unsteady near the pit, slipping on ice and slow there, moving readily on sand. In D4 so readily
# that the agent's slower steps there surprise it too: the sand is worth its way from a lambda between 1 and 2.4 on, not from 0.5.
# In D3, where the agent is stuck, the same made PEPS loiter in two of ten trainings.
_BIAS = dict(pit_noise=1.5, pit_range=0.35, ice_noise=0.8, ice_gain=0.7, sand_gain=0.77, sand_stuck=0.0)
DYNAMICS_BIAS = {"d1": _BIAS, "d2": _BIAS, "d3": _BIAS, "d4": _BIAS | dict(sand_gain=0.95)}

# What the human wants instead, in the presets with a biased reward: no hurry, and more fear of the pit.
REWARD_BIAS = dict(step_reward=-0.5, progress_reward=2.0, pit_reward=-200.0)


def domain(name: str) -> tuple[NavigationParams, dict[str, NavigationParams]]:
    """The true parameters of domain "d1" ... "d4", and the beliefs about it by their names.

    `biased` is the paper's human, `unbiased` believes the truth, `reward` wants something else in the true dynamics, and
    `both` has both biases.
    """
    truth = DOMAINS[name]
    bias = DYNAMICS_BIAS[name]
    beliefs = {
        "biased": bias,
        "unbiased": {},
        "reward": REWARD_BIAS,
        "both": bias | REWARD_BIAS,
    }
    return make_params(**truth), {belief: make_params(**(truth | told)) for belief, told in beliefs.items()}
