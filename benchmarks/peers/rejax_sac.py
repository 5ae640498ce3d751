"""rejax's SAC on the JAX environment, which a thin adapter shows as gymnax has it; see `protocol`.

Its evaluations are left out. Its targets follow once for each step of all environments, not once for each update, and it
tunes its temperature: neither makes it slower by much.
"""

import time

import jax
import protocol
from gymnax.environments import environment, spaces
from rejax import SAC

import peps_envs

WARMUP = 512  # environment steps before the first update


class Navigation(environment.Environment):
    """A peps_envs environment; parameters are the true ones."""

    def __init__(self, task: peps_envs.Task):
        self._task = task

    def step_env(self, key, state, action, params):
        after = self._task.environment.step(key, state, action, self._task.params)
        return after.observation, after.state, after.reward, after.terminated | after.truncated, {}

    def reset_env(self, key, params):
        state, observation = self._task.environment.reset(key, self._task.params)
        return observation, state

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (self._task.environment.action_space.size,))

    def observation_space(self, params):
        return spaces.Box(-1.0, 1.0, (self._task.environment.observation_size,))


def main() -> None:
    wanted = protocol.arguments(__doc__)
    steps = -(-wanted.steps // protocol.NUM_ENVS) * protocol.NUM_ENVS
    algorithm = SAC.create(
        env=Navigation(peps_envs.make("nav-d1")), env_params=environment.EnvParams(protocol.HORIZON), total_timesteps=steps,
        eval_freq=steps, skip_initial_evaluation=True, num_envs=protocol.NUM_ENVS, buffer_size=WARMUP + 2 * steps,
        fill_buffer=WARMUP, batch_size=protocol.BATCH, num_epochs=protocol.UPDATES_PER_VECTOR_STEP,
        learning_rate=protocol.LEARNING_RATE, gamma=protocol.DISCOUNT, polyak=1 - protocol.TARGET_RATE,
        hidden_layer_sizes=(wanted.width, wanted.width),
    ).replace(eval_callback=lambda algorithm, state, key: ())  # fmt: skip
    train = jax.jit(lambda state: algorithm.train(train_state=state)[0])
    state = jax.block_until_ready(train(jax.jit(algorithm.init_state)(jax.random.PRNGKey(wanted.seed))))
    preparation = protocol.get_ready(wanted.wait)
    start = time.perf_counter()
    jax.block_until_ready(train(state))
    protocol.report(steps, time.perf_counter() - start, preparation)


if __name__ == "__main__":
    main()
