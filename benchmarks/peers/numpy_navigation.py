"""Navigation D1 as one would write it with NumPy: a Gymnasium environment, and many at a time for vectorised training.

D1's true dynamics have no walls, ice, sand or noise, so neither has this environment, which only makes it faster.

    python peers/numpy_navigation.py check TRANSITIONS.json     prints the largest difference to those of the JAX environment
    python peers/numpy_navigation.py rate COUNT SECONDS         prints a rate as `protocol` says; COUNT 1 is the Gymnasium one
"""

import json
import sys
import time

import gymnasium
import numpy as np
import protocol

SIZE = np.array([6.0, 6.0])
START = np.array([0.5, 0.5])
GOAL = np.array([5.0, 0.0, 6.0, 1.0])
PIT = np.array([2.0, 0.0, 4.0, 1.0])
STEP_LENGTH, FULL_ACTION = 0.75, 0.85
GOAL_REWARD, PIT_REWARD, STEP_REWARD, PROGRESS_REWARD = 100.0, -100.0, -1.0, 1.0
OBSERVATION_SIZE = 10
PHASES = 0.5 * np.pi * np.array([1.0, 2.0])


def inside(positions: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Whether each of `positions` (n, 2) lies in the closed `area` (4,)."""
    return ((positions >= area[:2]) & (positions <= area[2:])).all(-1)


def distance(positions: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Euclidean distances from `positions` (n, 2) to `area` (4,), 0 inside."""
    outside = np.maximum(np.maximum(area[:2] - positions, positions - area[2:]), 0.0)
    return np.sqrt((outside**2).sum(-1))


def observe(positions: np.ndarray) -> np.ndarray:
    """Positions scaled to [-1, 1], with sines and cosines of them: (n, 10) from (n, 2)."""
    scaled = 2 * positions / SIZE - 1
    waves = [wave(phase * scaled) for phase in PHASES for wave in (np.sin, np.cos)]
    return np.concatenate([scaled, *waves], -1).astype(np.float32)


def move(positions: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Next positions (n, 2), rewards (n,) and whether the episodes ended (n,)."""
    actions = np.clip(actions, -1.0, 1.0)
    norm = np.maximum(np.sqrt((actions**2).sum(-1, keepdims=True)), FULL_ACTION)
    after = np.clip(positions + STEP_LENGTH * actions / norm, 0.0, SIZE)
    goal, pit = inside(after, GOAL), inside(after, PIT)
    progress = distance(positions, GOAL) - distance(after, GOAL)
    rewards = STEP_REWARD + PROGRESS_REWARD * progress + GOAL_REWARD * goal + PIT_REWARD * pit
    return after, rewards, goal | pit


class Navigation(gymnasium.Env):
    """One environment."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (OBSERVATION_SIZE,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._position, self._time = START[None], 0
        return observe(self._position)[0], {}

    def step(self, action):
        self._position, rewards, ended = move(self._position, action[None])
        self._time += 1
        terminated = bool(ended[0])
        truncated = self._time >= protocol.HORIZON and not terminated
        return observe(self._position)[0], float(rewards[0]), terminated, truncated, {}


class ManyNavigations:
    """`count` environments in one array; what ends begins anew, or, `absorbing`, stays for nothing until the time is up."""

    def __init__(self, count: int, absorbing: bool = False):
        self.count, self.absorbing = count, absorbing
        self.reset()

    def reset(self) -> np.ndarray:
        self._positions, self._times = np.tile(START, (self.count, 1)), np.zeros(self.count, int)
        self._absorbed = np.zeros(self.count, bool)
        return observe(self._positions)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Observations after the step, those to act on next, rewards, terminated and truncated."""
        after, rewards, terminated = move(self._positions, actions)
        if self.absorbing:
            after = np.where(self._absorbed[:, None], self._positions, after)
            rewards = np.where(self._absorbed, 0.0, rewards)
            self._absorbed, terminated = self._absorbed | terminated, np.zeros(self.count, bool)
        self._positions = after
        self._times += 1
        truncated = (self._times >= protocol.HORIZON) & ~terminated
        reached = following = observe(self._positions)
        over = terminated | truncated
        if over.any():
            self._positions[over], self._times[over], self._absorbed[over] = START, 0, False
            following = np.where(over[:, None], observe(START[None]), reached)
        return reached, following, rewards.astype(np.float32), terminated, truncated


def largest_difference(transitions: dict[str, list]) -> float:
    """Between what `move` and `observe` say and `transitions` of D1: observations, and rewards relative to 100."""
    given = {name: np.asarray(values) for name, values in transitions.items()}
    after, rewards, ended = move(given["position"], given["action"])
    if (ended != given["terminated"]).any():
        return np.inf
    differences = observe(after) - given["observation"], (rewards - given["reward"]) / GOAL_REWARD
    return float(max(np.abs(difference).max() for difference in differences))


def rate(count: int, seconds: float, wait: bool) -> None:
    """Steps of random actions for about `seconds`."""
    random = np.random.default_rng(0)
    if count == 1:
        environment = Navigation()
        environment.reset(seed=0)

        def step() -> None:
            _, _, terminated, truncated, _ = environment.step(random.uniform(-1.0, 1.0, 2))
            if terminated or truncated:
                environment.reset()
    else:
        environments = ManyNavigations(count)
        step = lambda: environments.step(random.uniform(-1.0, 1.0, (count, 2)))
    for _ in range(10):
        step()
    preparation = protocol.get_ready(wait)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        for _ in range(10):
            step()
        steps += 10 * count
    protocol.report(steps, time.perf_counter() - start, preparation)


def main() -> None:
    task, *values = [argument for argument in sys.argv[1:] if argument != "--wait"]
    if task == "check":
        with open(values[0], encoding="utf-8") as file:
            print(json.dumps({"difference": largest_difference(json.load(file))}))
    else:
        rate(int(values[0]), float(values[1]), "--wait" in sys.argv)


if __name__ == "__main__":
    main()
