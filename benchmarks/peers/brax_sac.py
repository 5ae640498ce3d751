"""Brax's SAC on the JAX environment, through `peps_envs.bridges.to_brax`; see `protocol`."""

import functools

import protocol
from brax.training.agents.sac import networks, train

import peps_envs
from peps_envs.bridges.to_brax import BraxEnvironment


def main() -> None:
    wanted = protocol.arguments(__doc__)
    task = peps_envs.make("nav-d1")
    answers, preparation = [], []

    def progress(steps: int, metrics: dict) -> None:
        """After the evaluation at the start, and after each half: what is timed is the second, without its evaluation."""
        answers.append((steps, metrics.get("training/sps")))
        if len(answers) == 2:
            preparation.append(protocol.get_ready(wanted.wait))

    train.train(
        BraxEnvironment(task.environment, task.params), num_timesteps=2 * wanted.steps, episode_length=protocol.HORIZON,
        num_envs=protocol.NUM_ENVS, num_eval_envs=1, learning_rate=protocol.LEARNING_RATE, discounting=protocol.DISCOUNT,
        seed=wanted.seed, batch_size=protocol.BATCH, num_evals=3, reward_scaling=0.1, tau=protocol.TARGET_RATE,
        min_replay_size=protocol.BATCH, grad_updates_per_step=protocol.UPDATES_PER_VECTOR_STEP, progress_fn=progress,
        network_factory=functools.partial(networks.make_sac_networks, hidden_layer_sizes=(wanted.width, wanted.width)),
    )  # fmt: skip
    steps = answers[2][0] - answers[1][0]
    protocol.report(steps, steps / float(answers[2][1]), preparation[0])


if __name__ == "__main__":
    main()
