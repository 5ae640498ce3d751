"""How long `imitation` trains until the policy's mode returns `protocol.LEVEL` on D1; see `protocol`.

    python peers/imitation_return.py --width 64 --steps 40000 [--seed 0] [--wait]

Set up as its authors advise and its own command does: episodes of one length, for they would tell r-hat of an end otherwise (what
has arrived stays, for nothing), and rewards of replay by r-hat as it is now. Prints {"returns": [[steps, seconds, return], ...]}
beside what `protocol` says; evaluations aren't counted.
"""

import contextlib
import json
import time

import numpy as np
import protocol
import torch
from imitation.algorithms.preference_comparisons import AgentTrainer
from imitation_drlhp import STEPS_PER_ROUND, WARMUP_ROUNDS, prepare, rounds
from numpy_navigation import ManyNavigations


class Reached(Exception):
    """The policy returns as much as was wanted."""


def mode_return(agent: AgentTrainer) -> float:
    """Of the mean episode that the policy's mode makes."""
    environments = ManyNavigations(protocol.NUM_ENVS, absorbing=True)
    observation, total = environments.reset(), np.zeros(protocol.NUM_ENVS)
    for _ in range(protocol.HORIZON):
        action, _ = agent.algorithm.predict(observation, deterministic=True)
        _, observation, rewards, _, _ = environments.step(action)
        total += rewards
    return float(total.mean())


class Watch:
    """Evaluates every few rounds, and stops the training when it is good enough."""

    def __init__(self, agent: AgentTrainer):
        self.agent, self.returns, self.rounds = agent, [], 0
        self.seconds, self.resumed = 0.0, time.perf_counter()

    def __call__(self, iteration: int) -> None:
        self.rounds += 1
        if self.rounds % protocol.WATCHED_EVERY:
            return
        self.seconds += time.perf_counter() - self.resumed
        value = mode_return(self.agent)
        self.returns.append([self.rounds * STEPS_PER_ROUND, self.seconds, value])
        if value >= protocol.LEVEL:
            raise Reached
        self.resumed = time.perf_counter()


def main() -> None:
    wanted = protocol.arguments(__doc__)
    torch.set_num_threads(1)
    agent, beside = prepare(wanted.width, wanted.steps, wanted.seed, as_advised=True)
    rounds(agent, beside, WARMUP_ROUNDS)
    agent, beside = prepare(wanted.width, wanted.steps, wanted.seed, as_advised=True)
    preparation = protocol.get_ready(wanted.wait)
    watch = Watch(agent)
    with contextlib.suppress(Reached):
        rounds(agent, beside, wanted.steps // STEPS_PER_ROUND, watch)
    steps, seconds, _ = watch.returns[-1]
    print(
        json.dumps({"steps": steps, "seconds": seconds, "preparation": preparation, "returns": watch.returns}),
        flush=True,
    )


if __name__ == "__main__":
    main()
