"""The NumPy environment as Stable-Baselines3 wants it; for the same 16 environments its `DummyVecEnv` would call each by itself."""

from typing import Any

import numpy as np
from numpy_navigation import ManyNavigations, Navigation
from stable_baselines3.common.vec_env import VecEnv


class NavigationVecEnv(VecEnv):
    """`count` environments side by side."""

    def __init__(self, count: int, absorbing: bool = False):
        super().__init__(count, Navigation.observation_space, Navigation.action_space)
        self._environments, self._actions = ManyNavigations(count, absorbing), None

    def reset(self) -> np.ndarray:
        return self._environments.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        reached, following, rewards, terminated, truncated = self._environments.step(self._actions)
        over, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for place in np.flatnonzero(over):
            infos[place] = {"terminal_observation": reached[place], "TimeLimit.truncated": bool(truncated[place])}
        return following, rewards, over, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
