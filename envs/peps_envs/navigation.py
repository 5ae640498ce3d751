"""Continuous navigation: the four domains of Sec. 5.1, D1-D4, with their biased beliefs.

A point moves in a walled arena, x to the right and y downwards, towards a goal area and past a pit. One step displaces it by

    m = walk(s, s + gain(s) * step_length * a / max(full_action, |a|)),    s' = walk(m, m + noise(s) * xi),    xi ~ N(0, I),

and, on sand, not at all with probability `sand_stuck`: a step, then a slip. Walls stop a movement and let it slide along:
x moves first, as far as the free interval of its row allows, then y in the new column. Gain and noise depend on the ground
where the step begins, and the noise also on the distance to the pit:

    noise^2 = pit_noise^2 exp(-(distance / pit_range)^2) + ice_noise^2 [on ice].

All of this is data (`NavigationParams`): the true domain and the human's belief are two values of it.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.scipy.special import log_ndtr, ndtr

from peps_envs.environment import Box, Environment, NextState, Step

NOWHERE = (-9.0, -9.0, -9.0, -9.0)  # an area that no position is in
_SLACK = 1e-4  # arena units: a position that was read back from an observation may lie off a face or an edge
_TINY = 1e-30  # a probability of which the logarithm is still finite in float32


@struct.dataclass
class NavigationParams:
    """A domain, or a belief about one. Areas are (x0, y0, x1, y1), closed, in arena units."""

    size: Array  # (2,) width and height of the arena
    start: Array  # (2,)
    goal: Array  # (4,) area
    pit: Array  # (4,) area
    walls: Array  # (n, 4) areas that nothing enters
    ice: Array  # (4,) area
    sand: Array  # (4,) area
    step_length: Array  # arena units a step
    full_action: Array  # norm of the action from which on a step has its full length
    ice_gain: Array  # share of a step that is made on ice
    sand_gain: Array  # share of a step that is made on sand
    sand_stuck: Array  # probability of not moving at all on sand
    ice_noise: Array  # standard deviation of the displacement on ice, arena units
    pit_noise: Array  # the same at the pit's edge
    pit_range: Array  # distance over which the pit's noise fades, arena units
    perception_width: Array  # sigma_p, arena units
    goal_reward: Array  # on reaching the goal, which ends the episode
    pit_reward: Array  # on falling into the pit, which ends the episode
    step_reward: Array  # every step
    progress_reward: Array  # per arena unit that the distance to the goal area shrinks


@struct.dataclass
class NavigationState:
    """Where the agent is, and when."""

    position: Array  # (2,)
    time: Array  # () int, steps since the start


def inside(position: Array, area: Array) -> Array:
    """Whether `position` (2,) lies in the closed `area` (4,)."""
    return jnp.all((position >= area[:2]) & (position <= area[2:]))


def distance(position: Array, area: Array) -> Array:
    """Euclidean distance from `position` (2,) to `area` (4,), 0 inside."""
    outside = jnp.maximum(jnp.maximum(area[:2] - position, position - area[2:]), 0.0)
    # the square root's derivative at 0 is infinite: keep it away from there
    squared = jnp.sum(outside**2)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def free_interval(position: Array, axis: int, params: NavigationParams) -> tuple[Array, Array]:
    """How far a point may move along `axis` from `position` (2,) until a wall or the arena's edge stops it: (low, high)."""
    other = 1 - axis
    walls = params.walls
    # a point on a wall's face may slide along it
    in_the_way = (walls[:, other] + _SLACK < position[other]) & (position[other] < walls[:, 2 + other] - _SLACK)
    before = in_the_way & (walls[:, 2 + axis] <= position[axis] + _SLACK)
    after = in_the_way & (walls[:, axis] >= position[axis] - _SLACK)
    low = jnp.max(jnp.where(before, walls[:, 2 + axis], 0.0), initial=0.0)
    high = jnp.min(jnp.where(after, walls[:, axis], params.size[axis]), initial=jnp.inf)
    return low, jnp.minimum(high, params.size[axis])


def walk(position: Array, target: Array, params: NavigationParams) -> Array:
    """Where a movement from `position` (2,) to `target` (2,) ends: x first, then y in the new column, each stopped by walls."""
    x = jnp.clip(target[0], *free_interval(position, 0, params))
    y = jnp.clip(target[1], *free_interval(jnp.array([x, position[1]]), 1, params))
    return jnp.array([x, y])


def _log_normal(value: Array, mean: Array, variance: Array) -> Array:
    return -0.5 * ((value - mean) ** 2 / variance + jnp.log(2 * math.pi * variance))


def _log_interval(value: Array, mean: Array, noise: Array, width: Array, low: Array, high: Array) -> Array:
    """log of the integral over x in [low, high] of N(x; mean, noise^2) N(value; x, width^2), exact for noise = 0 too."""
    variance = noise**2 + width**2
    posterior_mean = (mean * width**2 + value * noise**2) / variance
    posterior_sd = jnp.maximum(noise * width / jnp.sqrt(variance), 1e-6)
    upper, lower = (high - posterior_mean) / posterior_sd, (low - posterior_mean) / posterior_sd
    # the difference of two tails keeps its digits on the side where both are small
    upper, lower = jnp.where(lower > 0, -lower, upper), jnp.where(lower > 0, -upper, lower)
    mass = jnp.maximum(ndtr(upper) - ndtr(lower), _TINY)
    return _log_normal(value, mean, variance) + jnp.log(mass)


def _log_tail(distance_to_edge: Array, noise: Array) -> Array:
    """log P(noise * xi > distance_to_edge), exact for noise = 0 too, floored to stay finite."""
    return jnp.maximum(log_ndtr(-distance_to_edge / jnp.maximum(noise, 1e-6)), math.log(_TINY))


def _log_stopped(value: Array, mean: Array, noise: Array, width: Array, low: Array, high: Array) -> Array:
    """log-density at `value` of clip(N(mean, noise^2), low, high) + N(0, width^2): the middle, and what both edges stop."""
    middle = _log_interval(value, mean, noise, width, low, high)
    at_low = _log_tail(mean - low, noise) + _log_normal(value, low, width**2)
    at_high = _log_tail(high - mean, noise) + _log_normal(value, high, width**2)
    return jnp.logaddexp(middle, jnp.logaddexp(at_low, at_high))


@struct.dataclass
class NavigationNextState(NextState):
    """The next position as perceived. Exact: walls turn part of the Gaussian into atoms on their faces, which K then blurs."""

    position: Array  # (2,) before the step
    target: Array  # (2,) where the step leads before it slips
    noise: Array  # () standard deviation of the slip
    stuck: Array  # () probability of staying where it is
    params: NavigationParams

    def _log_moving(self, perceived: Array) -> Array:
        """log-density, given that it moves. x is integrated piece by piece, because the limits of y change where a wall starts."""
        params, width, noise = self.params, self.params.perception_width, self.noise
        low, high = free_interval(self.target, 0, params)
        edges = jnp.sort(jnp.concatenate([params.walls[:, 0], params.walls[:, 2]]))
        edges = jnp.clip(jnp.concatenate([low[None], edges, high[None]]), low, high)

        def log_y(x: Array) -> Array:
            limits = free_interval(jnp.array([x, self.target[1]]), 1, params)
            return _log_stopped(perceived[1], self.target[1], noise, width, *limits)

        def piece(start: Array, end: Array) -> Array:
            log_x = _log_interval(perceived[0], self.target[0], noise, width, start, end)
            return jnp.where(end > start, log_x + log_y((start + end) / 2), -jnp.inf)

        pieces = jax.vmap(piece)(edges[:-1], edges[1:])
        at_low = _log_tail(self.target[0] - low, noise) + _log_normal(perceived[0], low, width**2) + log_y(low)
        at_high = _log_tail(high - self.target[0], noise) + _log_normal(perceived[0], high, width**2) + log_y(high)
        return jax.nn.logsumexp(jnp.concatenate([pieces, at_low[None], at_high[None]]))

    def log_prob(self, perceived: Array) -> Array:
        staying = jnp.sum(_log_normal(perceived, self.position, self.params.perception_width**2))
        return jnp.logaddexp(
            jnp.log(jnp.maximum(1 - self.stuck, _TINY)) + self._log_moving(perceived),
            jnp.log(jnp.maximum(self.stuck, _TINY)) + staying,
        )

    def relative_log_prob(self, perceived: Array) -> Array:
        log_kernel_at_zero = -jnp.log(2 * math.pi * self.params.perception_width**2)
        return jnp.minimum(self.log_prob(perceived) - log_kernel_at_zero, 0.0)  # rounding must not make it positive

    def relative_entropy(self) -> Array:
        weights, positions = self.quadrature(7)
        mean = weights @ positions
        variance = weights @ (positions - mean[None]) ** 2
        return 0.5 * jnp.sum(jnp.log1p(variance / self.params.perception_width**2))

    def sample(self, key: Array) -> Array:
        key_move, key_see = jax.random.split(key)
        return self.move(key_move) + self.params.perception_width * jax.random.normal(key_see, (2,))

    def move(self, key: Array) -> Array:
        """The true next position, before anybody looks at it."""
        key_noise, key_stuck = jax.random.split(key)
        moved = walk(self.target, self.target + self.noise * jax.random.normal(key_noise, (2,)), self.params)
        return jnp.where(jax.random.uniform(key_stuck) < self.stuck, self.position, moved)

    def quadrature(self, points: int) -> tuple[Array, Array]:
        nodes, node_weights = np.polynomial.hermite_e.hermegauss(points)
        node_weights = node_weights / node_weights.sum()
        offsets = jnp.asarray(np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2), self.target.dtype)
        moved = jax.vmap(lambda offset: walk(self.target, self.target + self.noise * offset, self.params))(offsets)
        weights = jnp.asarray(np.outer(node_weights, node_weights).reshape(-1), self.target.dtype) * (1 - self.stuck)
        return jnp.append(weights, self.stuck), jnp.concatenate([moved, self.position[None]])


@dataclasses.dataclass(frozen=True)
class Navigation(Environment):
    """Move a point to the goal area; see the module's text. Events: `goal_reached`, `pit_reached`."""

    horizon: int = 200
    waves: int = 2  # wavelengths of the observed sines and cosines: the arena's width twice, once, a half, ...

    action_space = Box(2)
    event_names = ("goal_reached", "pit_reached")

    @property
    def observation_size(self) -> int:
        return 2 + 4 * self.waves

    def reset(self, key: Array, params: NavigationParams) -> tuple[NavigationState, Array]:
        del key  # one start state
        state = NavigationState(position=jnp.asarray(params.start), time=jnp.zeros((), jnp.int32))
        return state, self.observe(state, params)

    def step(self, key: Array, state: NavigationState, action: Array, params: NavigationParams) -> Step:
        position = self.next_state_distribution(state, action, params).move(key)
        next_state = NavigationState(position=position, time=state.time + 1)
        goal, pit = inside(position, params.goal), inside(position, params.pit)
        return Step(
            state=next_state,
            observation=self.observe(next_state, params),
            reward=self.reward(state, action, next_state, params),
            terminated=goal | pit,
            truncated=(next_state.time >= self.horizon) & ~(goal | pit),
            events=jnp.stack([goal, pit]),
        )

    def reward(
        self, state: NavigationState, action: Array, next_state: NavigationState, params: NavigationParams
    ) -> Array:
        del action  # what counts is where it led
        progress = distance(state.position, params.goal) - distance(next_state.position, params.goal)
        return (
            params.step_reward
            + params.progress_reward * progress
            + params.goal_reward * inside(next_state.position, params.goal)
            + params.pit_reward * inside(next_state.position, params.pit)
        )

    def next_state_distribution(
        self, state: NavigationState, action: Array, params: NavigationParams
    ) -> NavigationNextState:
        position = state.position
        on_ice, on_sand = distance(position, params.ice) <= _SLACK, distance(position, params.sand) <= _SLACK
        gain = jnp.where(on_sand, params.sand_gain, jnp.where(on_ice, params.ice_gain, 1.0))
        # A step's length is bounded, not its components: the square's corners are no faster. Full length is had below the
        # square's edge already, which a policy that is squashed into it never reaches.
        action = jnp.clip(action, -1.0, 1.0)
        direction = action / jnp.sqrt(jnp.maximum(jnp.sum(action**2), params.full_action**2))
        near_pit = params.pit_noise * jnp.exp(-0.5 * (distance(position, params.pit) / params.pit_range) ** 2)
        return NavigationNextState(
            position=position,
            target=walk(position, position + gain * params.step_length * direction, params),
            noise=jnp.sqrt(near_pit**2 + jnp.where(on_ice, params.ice_noise, 0.0) ** 2),
            stuck=jnp.where(on_sand, params.sand_stuck, 0.0),
            params=params,
        )

    def observe(self, state: NavigationState, params: NavigationParams) -> Array:
        """The position, scaled to [-1, 1], with sines and cosines of it.

        The pit's edge is sharp against the arena, and a step is worth little against the pit: without the waves, small
        networks blur the values so much that walking on and standing still look alike.
        """
        scaled = 2 * state.position / params.size - 1
        phases = [0.5 * jnp.pi * 2.0**wave * scaled for wave in range(self.waves)]
        return jnp.concatenate([scaled, *(wave(phase) for phase in phases for wave in (jnp.sin, jnp.cos))])

    def perceive(self, state: NavigationState) -> Array:
        return state.position

    def perceive_observation(self, observation: Array, params: NavigationParams) -> Array:
        return (observation[..., :2] + 1) / 2 * params.size

    def perception_width(self, params: NavigationParams) -> Array:
        return jnp.broadcast_to(params.perception_width, (2,))


def make_params(**changes) -> NavigationParams:
    """A 6 x 6 arena without pit, walls, ice or sand, the goal in the upper right corner; `changes` replace fields.

    Raises:
      ValueError: a field that `NavigationParams` doesn't have.
    """
    fields = dict(
        size=(6.0, 6.0), start=(0.5, 0.5), goal=(5.0, 0.0, 6.0, 1.0), pit=NOWHERE, walls=(NOWHERE,), ice=NOWHERE, sand=NOWHERE,
        step_length=0.75, full_action=0.85, ice_gain=1.0, sand_gain=1.0, sand_stuck=0.0, ice_noise=0.0, pit_noise=0.0,
        pit_range=0.6, perception_width=0.2, goal_reward=100.0, pit_reward=-100.0, step_reward=-1.0, progress_reward=1.0,
    )  # fmt: skip
    unknown = sorted(set(changes) - set(fields))
    if unknown:
        raise ValueError(f"navigation parameter {unknown[0]!r}: known are {', '.join(fields)}")
    return NavigationParams(**{name: jnp.asarray(value, jnp.float32) for name, value in (fields | changes).items()})


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
    beliefs = {"biased": bias, "unbiased": {}, "reward": REWARD_BIAS, "both": bias | REWARD_BIAS}
    return make_params(**truth), {belief: make_params(**(truth | told)) for belief, told in beliefs.items()}
