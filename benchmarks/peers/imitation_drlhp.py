"""Preference comparisons of the `imitation` library with Stable-Baselines3's SAC, on the NumPy environment; see `protocol`.

    python peers/imitation_drlhp.py --width 64 --steps 2000 [--wait]

In a round of 400 steps 30 pairs are answered by r_A and every network of r-hat makes 20 steps on 32 pairs, as in peps_jax.
"""

import contextlib
import functools
import os
import time
from collections.abc import Callable

import numpy as np
import protocol
import torch
from imitation.algorithms import preference_comparisons as comparisons
from imitation.policies.replay_buffer_wrapper import ReplayBufferRewardWrapper
from imitation.rewards.reward_nets import AddSTDRewardWrapper, BasicRewardNet, RewardEnsemble
from imitation.util.logger import configure
from numpy_navigation import Navigation
from sb3_environment import NavigationVecEnv
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

STEPS_PER_ROUND, QUERIES_PER_ROUND, SEGMENT_LENGTH = 400, 30, 5
MEMBERS, UPDATES, PAIRS, LEARNING_RATE = 5, 20, 32, 5e-3  # of r-hat
WARMUP_ROUNDS = 2  # imitation makes a first round in any case


class EqualWork(comparisons.EnsembleTrainer):
    """As many gradient steps in a round, however many answers there are."""

    def _train(self, dataset: comparisons.PreferenceDataset, epoch_multiplier: float = 1.0) -> None:
        super()._train(dataset, max(1, round(UPDATES * PAIRS / len(dataset))))


def prepare(width: int, steps: int, seed: int, *, as_advised: bool = False) -> tuple[comparisons.AgentTrainer, dict]:
    """What trains the agent, and what else `PreferenceComparisons` is given.

    `as_advised` makes episodes of one length, and takes replay's rewards from r-hat as it is now: more work than is needed.
    """
    random, venv = np.random.default_rng(seed), NavigationVecEnv(protocol.NUM_ENVS, absorbing=as_advised)
    spaces = Navigation.observation_space, Navigation.action_space
    small = dict(use_next_state=False, hid_sizes=(32, 32))
    networks = RewardEnsemble(*spaces, [BasicRewardNet(*spaces, **small) for _ in range(MEMBERS)])
    reward = AddSTDRewardWrapper(networks)
    now = dict(
        replay_buffer_class=ReplayBuffer, reward_fn=functools.partial(reward.predict_processed, update_stats=False)
    )
    relabelled = dict(replay_buffer_class=ReplayBufferRewardWrapper, replay_buffer_kwargs=now) if as_advised else {}
    model = SAC(
        "MlpPolicy", venv, learning_rate=protocol.LEARNING_RATE, buffer_size=steps + WARMUP_ROUNDS * STEPS_PER_ROUND,
        learning_starts=STEPS_PER_ROUND, batch_size=protocol.BATCH, tau=protocol.TARGET_RATE, gamma=protocol.DISCOUNT,
        train_freq=(1, "step"), gradient_steps=protocol.UPDATES_PER_VECTOR_STEP, ent_coef=0.002,
        policy_kwargs={"net_arch": [width, width]}, seed=seed, device="cpu", **relabelled,
    )  # fmt: skip
    trainer = EqualWork(
        comparisons.PreferenceModel(reward), comparisons.CrossEntropyRewardLoss(), rng=random, batch_size=PAIRS,
        lr=LEARNING_RATE,
    )  # fmt: skip
    agent = comparisons.AgentTrainer(model, reward, venv, rng=random, exploration_frac=0.2)
    beside = dict(
        reward_model=reward, reward_trainer=trainer, fragment_length=SEGMENT_LENGTH, allow_variable_horizon=not as_advised,
        fragmenter=comparisons.RandomFragmenter(rng=random), preference_gatherer=comparisons.SyntheticGatherer(rng=random),
        query_schedule="constant", initial_epoch_multiplier=1.0, custom_logger=configure(format_strs=[]),
    )  # fmt: skip
    return agent, beside


def rounds(
    agent: comparisons.AgentTrainer, beside: dict, number: int, after: Callable[[int], None] | None = None
) -> None:
    """So many rounds, with a call of `after` at the end of each."""
    # the library's first round comes on top of its iterations, with a share of the answers of its own
    loop = comparisons.PreferenceComparisons(
        agent, num_iterations=number - 1, initial_comparison_frac=1 / number, **beside
    )
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        loop.train((number - 1) * STEPS_PER_ROUND, number * QUERIES_PER_ROUND, after)


def main() -> None:
    wanted = protocol.arguments(__doc__)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    agent, beside = prepare(wanted.width, wanted.steps, wanted.seed)
    rounds(agent, beside, WARMUP_ROUNDS)
    preparation = protocol.get_ready(wanted.wait)
    start = time.perf_counter()
    rounds(agent, beside, wanted.steps // STEPS_PER_ROUND)
    protocol.report(wanted.steps, time.perf_counter() - start, preparation)


if __name__ == "__main__":
    main()
