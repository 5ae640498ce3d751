"""Stable-Baselines3's SAC on the NumPy environment; see `protocol`."""

import os
import time

import protocol
import torch
from sb3_environment import NavigationVecEnv
from stable_baselines3 import SAC

WARMUP = 1_024  # environment steps before those that are timed


def main() -> None:
    wanted = protocol.arguments(__doc__)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    model = SAC(
        "MlpPolicy", NavigationVecEnv(protocol.NUM_ENVS), learning_rate=protocol.LEARNING_RATE,
        buffer_size=WARMUP + wanted.steps, learning_starts=WARMUP // 2, batch_size=protocol.BATCH, tau=protocol.TARGET_RATE,
        gamma=protocol.DISCOUNT, train_freq=(1, "step"), gradient_steps=protocol.UPDATES_PER_VECTOR_STEP, ent_coef=0.002,
        policy_kwargs={"net_arch": [wanted.width, wanted.width]}, seed=wanted.seed, device="cpu",
    )  # fmt: skip
    model.learn(WARMUP)
    preparation = protocol.get_ready(wanted.wait)
    start = time.perf_counter()
    model.learn(wanted.steps, reset_num_timesteps=False)
    protocol.report(wanted.steps, time.perf_counter() - start, preparation)


if __name__ == "__main__":
    main()
