"""A whole training as one pure function: under jit, vmap and scan, round by round, and with a person as the teacher."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams

import peps_jax
from peps_jax import generator, grid
from peps_jax.preferences import data
from peps_jax.preferences.data import Answers
from peps_jax.preferences.teachers import Teacher
from peps_jax.round import annealed_temperature, round_at
from peps_jax.train import (
    collect_and_ask,
    finish,
    hear,
    init,
    learn_and_improve,
    prepare,
    relabelled,
    run_round,
    run_rounds,
    values,
)

CURVES = {"return_", "explicability", "belief_gap", "length", "critic_loss", "policy_entropy", "temperature"}
LEARNED = {"dynamics_loss", "surrogate_loss", "preference_accuracy"}


def assert_close(one, two, rtol=1e-4, atol=1e-5):
    """Two trainings agree up to rounding, which a few Adam steps magnify."""
    numbers = lambda tree: jax.tree.map(
        lambda leaf: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf, tree
    )
    chex.assert_trees_all_close(numbers(one), numbers(two), rtol=rtol, atol=atol)


@pytest.fixture(scope="module")
def rounds():
    """`run_rounds`, compiled once for every structure and number of rounds."""
    return jax.jit(run_rounds)


@pytest.fixture(scope="module")
def step():
    """`run_round`, compiled once for every structure."""
    return jax.jit(run_round)


@pytest.fixture(scope="module")
def first_state():
    return jax.jit(init)


@pytest.fixture(scope="module")
def train_three():
    """Three runs as one batch, traced once whatever their leaves are."""
    chex.clear_trace_counter()  # a worker that is given this module's tests twice makes this fixture twice
    return jax.jit(jax.vmap(chex.assert_max_traces(peps_jax.train, n=1)))


def test_curves_have_a_point_for_every_round(line, train):
    peps, sac = train(line), train(line.replace(method="sac"))
    assert set(peps.curves) >= CURVES | LEARNED
    assert set(sac.curves) >= CURVES
    assert not set(sac.curves) & LEARNED
    assert all(curve.shape == (line.num_rounds,) for curve in peps.curves.values())
    for name in LEARNED | {"critic_loss", "policy_entropy"}:
        assert bool(jnp.all(jnp.isfinite(peps.curves[name]))), name


def test_the_same_seed_gives_the_same_numbers_and_another_does_not(line, train):
    chex.assert_trees_all_equal(train(line).agents, train(line).agents)
    other = train(line.replace(seed=1)).agents[0]
    assert not np.allclose(jax.tree.leaves(other.policy)[1], jax.tree.leaves(train(line).agents[0].policy)[1])


def test_peps_at_lam_0_is_sac(line, train):
    peps, sac = train(line.replace(lam=0.0)), train(line.replace(method="sac"))
    assert_close(peps.agents, sac.agents)
    for name in sac.curves:
        np.testing.assert_allclose(peps.curves[name], sac.curves[name], rtol=1e-4, atol=1e-5, err_msg=name)


def test_lam_changes_what_peps_learns(line, train):
    still, moved = train(line.replace(lam=0.0)).agents[0].critics, train(line.replace(lam=2.4)).agents[0].critics
    differences = jax.tree.map(lambda one, two: float(jnp.max(jnp.abs(one - two))), still, moved)
    assert max(jax.tree.leaves(differences)) > 1e-3


def three_runs(line, seeds, lams):
    """A batch that varies what there is of kinds of leaves: the seed, weights, rates, and a belief's numbers."""
    return grid(
        line, seed=seeds, lam=lams, learning_rate=[1e-3, 2e-3, 1e-3],
        belief=LineParams(noise=jnp.array([0.1, 0.2, 0.3]), slope=jnp.ones(3), width=jnp.full(3, 0.1)),
    )  # fmt: skip


def run_of(batch, place):
    return jax.tree.map(lambda leaf: leaf[place], batch)


def test_a_vmapped_run_matches_its_single_run(line, train, train_three):
    runs = three_runs(line, [0, 0, 5], [0.0, 2.0, 2.4])
    batch = train_three(runs)
    for place in range(3):
        single = train(run_of(runs, place))
        assert_close(run_of(batch.agents, place), single.agents, rtol=1e-2, atol=1e-3)
        for name in ("return_", "explicability", "surrogate_loss", "critic_loss"):
            np.testing.assert_allclose(
                batch.curves[name][place], single.curves[name], rtol=1e-2, atol=1e-3, err_msg=name
            )


def test_other_leaves_compile_nothing(line, train_three):
    one = train_three(three_runs(line, [0, 0, 5], [0.0, 2.0, 2.4]))
    two = train_three(three_runs(line.replace(gamma=0.9, rationality=2.0), [1, 2, 3], [0.5, 2.8, 1.0]))
    assert not np.allclose(one.curves["surrogate_loss"], two.curves["surrogate_loss"])


@pytest.mark.slow
def test_a_vmapped_run_matches_its_single_run_in_a_navigation_domain(tiny, train):
    runs = grid(tiny.replace(method="sac"), seed=[0, 1], temperature=[1.0, 0.5])
    batch = jax.jit(jax.vmap(peps_jax.train))(runs)
    assert_close(run_of(batch.agents, 1), train(run_of(runs, 1)).agents, rtol=1e-2, atol=1e-3)


def test_inside_somebody_elses_scan(line, train):
    def outer(total, lam):
        result = peps_jax.train(line.replace(lam=lam))
        return total + jnp.sum(result.curves["critic_loss"]), result.curves["critic_loss"]

    lams = jnp.array([0.0, 2.4])
    total, losses = jax.jit(lambda lams: jax.lax.scan(outer, 0.0, lams))(lams)
    for lam, loss in zip(lams, losses, strict=True):
        np.testing.assert_allclose(loss, train(line.replace(lam=lam)).curves["critic_loss"], rtol=1e-3)
    np.testing.assert_allclose(total, jnp.sum(losses), rtol=1e-5)


def test_a_host_loop_gives_the_scans_numbers(line, first_state, rounds):
    """Rounds one by one, in two halves with the teacher between them."""
    collect, learn = jax.jit(collect_and_ask), jax.jit(learn_and_improve)
    training = prepare(line)
    answer = jax.jit(training.answer)
    whole, curves = rounds(first_state(training), jnp.arange(line.num_rounds), training)
    state = first_state(training)
    for index in range(line.num_rounds):
        now = round_at(jnp.asarray(index), state.key, training.settings.schedule)
        state, queries, collected = collect(state, now, training)
        answers = answer(now.keys.answer, queries, training.problem, training.settings.human)
        state, learned = learn(hear(state, answers, now), now, training)
        for name, value in (collected | learned).items():
            np.testing.assert_allclose(value, curves[name][index], rtol=1e-3, atol=1e-4, err_msg=name)
    assert_close(state, whole, rtol=1e-3, atol=1e-4)


def test_a_round_at_a_time_gives_the_scans_numbers(line, first_state, rounds, step):
    training = prepare(line)
    whole, _ = rounds(first_state(training), jnp.arange(line.num_rounds), training)
    state = first_state(training)
    for index in range(line.num_rounds):
        state, _ = step(state, jnp.asarray(index), training)
    assert_close(state, whole, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("method", ["peps", "policy_shaping"])
def test_nothing_makes_nan_in_a_round_in_which_no_episode_ends(line, method):
    config = line.replace(
        env=Line(horizon=1000), method=method, warmup_steps=0, exploration=0.0, total_steps=80, seed=1
    )
    with jax.debug_nans(True):
        curves = jax.jit(peps_jax.train)(config).curves
    assert not np.all(curves["episodes"] > 0)
    assert all(np.all(np.isfinite(curve)) for curve in curves.values())
    assert np.all(np.asarray(curves["return_"])[np.asarray(curves["episodes"]) == 0] == 0)


def test_a_saved_state_continues_as_if_nothing_had_been(line, first_state, step, tmp_path):
    training = prepare(line)
    state, _ = step(first_state(training), jnp.asarray(0), training)
    raw = state.replace(key=jax.random.key_data(state.key))
    np.savez(tmp_path / "state.npz", *jax.tree.leaves(raw))
    with np.load(tmp_path / "state.npz") as file:
        leaves = [jnp.asarray(file[name]) for name in file.files]
    loaded = jax.tree.unflatten(jax.tree.structure(raw), leaves)
    loaded = loaded.replace(key=generator.wrap(loaded.key))
    whole, curves = step(state, jnp.asarray(1), training)
    resumed, after = step(loaded, jnp.asarray(1), training)
    assert_close(resumed, whole, rtol=0, atol=0)
    chex.assert_trees_all_equal(after, curves)
    assert finish(resumed, after, training).act(jnp.zeros(1)).shape == (1,)


def further_right(key, queries, problem, settings):
    """Somebody who always prefers the segment that ends further to the right, and skips every other query."""
    del key, problem, settings
    segments = queries.segments
    end = jnp.sum(segments.mask, -1, keepdims=True).astype(int) - 1
    last = jnp.take_along_axis(segments.next_state.place[..., 0], end, -1)[..., 0]
    preferred = (last[:, 0] > last[:, 1]).astype(jnp.float32)
    return Answers(queries.number, preferred, jnp.arange(preferred.size) % 2.0)


def test_queries_begin_when_they_are_said_to(line, train):
    config = line.replace(unasked_steps=2 * line.steps_per_round)
    result = train(config)
    by_round = result.preferences.number.reshape(line.num_rounds, config.queries_per_round)
    assert config.queries_per_round == 10
    np.testing.assert_array_equal(by_round[:2], data.NOBODY)
    np.testing.assert_array_equal(by_round[2:].ravel(), np.arange(20))
    np.testing.assert_array_equal(result.preferences.weight, np.repeat([0, 1], 20))
    untaught = result.curves["surrogate_loss"][:2]
    np.testing.assert_array_equal(untaught, 0)


def test_anybody_is_a_teacher(line, train):
    result = jax.jit(lambda config: peps_jax.train(config, Teacher(answer=further_right)))(line)
    given = jax.tree.map(np.asarray, result.preferences)
    by_round = given.weight.reshape(line.num_rounds, line.queries_per_round)
    np.testing.assert_array_equal(by_round, np.tile(np.arange(line.queries_per_round) % 2.0, (line.num_rounds, 1)))
    assert set(np.unique(given.preferred)) <= {0.0, 1.0}
    np.testing.assert_array_equal(given.number, np.arange(line.num_queries))
    assert not np.allclose(result.curves["surrogate_loss"], train(line).curves["surrogate_loss"])


def test_sac_asks_nothing(line, first_state):
    training = prepare(line.replace(method="sac"))
    state = first_state(training)
    now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
    state, queries, _ = jax.jit(collect_and_ask)(state, now, training)
    assert queries is None
    assert state.preferences is None


def test_an_unbiased_human_has_no_belief_gap(line, train):
    """Belief and truth agree: l_H = l_A in every step, and explicability is the return."""
    curves = train(line.replace(belief=line.params)).curves
    ended = np.asarray(curves["episodes"]) > 0
    assert ended.any()
    np.testing.assert_allclose(curves["belief_gap"][ended], 0.0, atol=1e-5)
    np.testing.assert_allclose(curves["explicability"][ended], curves["return_"][ended], rtol=1e-5)


def test_the_unbiased_preset_is_the_truth(tiny):
    problem = tiny.replace(belief="unbiased").problem()
    chex.assert_trees_all_equal(problem.params, problem.belief)


def test_replay_holds_what_happened(line, first_state, rounds):
    training = prepare(line)
    state, _ = rounds(first_state(training), jnp.arange(line.num_rounds), training)
    buffer = state.replay
    assert buffer.reward.shape == (line.num_rounds * line.steps_per_round,)
    np.testing.assert_allclose(buffer.next_observation, buffer.observation + 0.1 * buffer.action, atol=1e-5)
    np.testing.assert_allclose(buffer.reward, buffer.next_observation[:, 0], atol=1e-5)  # r_A alone, nothing relabelled
    np.testing.assert_allclose(buffer.movement, buffer.action, atol=1e-4)  # 0.1 of it, in perceptual widths of 0.1
    assert buffer.terminated.dtype == bool
    np.testing.assert_array_equal(buffer.terminated, buffer.next_observation[:, 0] > 0.25)


def test_rewards_are_the_same_of_minibatches_and_of_all_replay(line, first_state, rounds):
    """Whichever is less work."""
    training = prepare(line)
    state, _ = rounds(first_state(training), jnp.arange(2, dtype=jnp.int32), training)
    now = round_at(jnp.asarray(1, jnp.int32), state.key, training.settings.schedule)
    filled, capacity = int(now.filled), state.replay.reward.shape[0]
    assert filled < capacity
    reward = lambda rows: training.method.rewards[0](state.knowledge, rows, training.settings)
    few = jnp.arange(filled // 2)[None]
    many = jnp.tile(jnp.arange(filled)[None], (2, 1))
    assert few.size < capacity / 2 <= many.size
    ways = [values(reward, state.replay, index, now, training.settings) for index in (few, many)]
    assert [way.shape for way in ways] == [few.shape, many.shape]
    for way in ways:
        np.testing.assert_allclose(
            way, np.broadcast_to(reward(state.replay)[: way.shape[1]], way.shape), rtol=1e-5, atol=1e-6
        )
    relabels = relabelled(reward, state.replay, now, training.settings.schedule)
    np.testing.assert_array_equal(relabels[filled:], 0, "what isn't there yet costs nothing")
    traced = [
        jax.make_jaxpr(lambda index: values(reward, state.replay, index, now, training.settings))(index)
        for index in (few, many)
    ]
    assert ["while" in str(one) for one in traced] == [False, True]


def test_result_acts_by_mode_and_by_samples(line, train):
    result = train(line)
    observation = jnp.zeros(1)
    np.testing.assert_array_equal(result.act(observation), result.act(observation))
    keys = jax.random.split(jax.random.key(0), 50)
    actions = jax.vmap(result.act, in_axes=(None, 0))(observation, keys)
    assert actions.shape == (50, 1)
    assert float(jnp.std(actions)) > 0
    assert float(jnp.max(jnp.abs(actions))) <= 1


def test_the_temperature_fades_geometrically(line):
    config = line.replace(
        initial_temperature=4.0, temperature=1.0, anneal_share=0.5, total_steps=10 * line.steps_per_round
    )
    schedule = prepare(config).settings.schedule
    at = lambda index: float(annealed_temperature(jnp.asarray(index), schedule))
    assert config.num_rounds == 10
    assert at(0) == pytest.approx(4.0)
    assert at(2.5) == pytest.approx(2.0)  # half of the way on a logarithmic scale
    assert at(5) == pytest.approx(1.0)
    assert at(9) == pytest.approx(1.0)


def test_eq_6s_policy_entropy_falls_to_a_tenth_at_the_end(line, train):
    """SAC's own temperature, which is constant here, stays."""
    config = line.replace(
        initial_temperature=1.0,
        temperature=1.0,
        lam=2.0,
        policy_entropy_weight=0.5,
        total_steps=10 * line.steps_per_round,
    )

    def temperatures(**changes):
        return np.asarray(train(config.replace(**changes)).curves["temperature"]) / config.reward_scale

    paid = [1.0] * 6 + [1.0, 0.75, 0.5, 0.25]  # the weight of round 6 is whole: 4 of 10 rounds are left when it begins
    np.testing.assert_allclose(temperatures(entropy_fade_share=0.4), 1.0 + np.asarray(paid), rtol=1e-5)
    np.testing.assert_allclose(temperatures(entropy_fade_share=0.0), 2.0, rtol=1e-5)
    np.testing.assert_allclose(temperatures(entropy_fade_share=0.4, lam=0.0), 1.0, rtol=1e-5)


@pytest.mark.parametrize("method", ["peps", "oracle", "darc"])
def test_what_the_human_watches_is_asked_about_and_reported(line, method):
    """Nothing else changes: the same is done, and seen by the agent. Who is told of every step watches all."""

    def first_round(watched_every):
        training = prepare(line.replace(method=method, watched_every=watched_every, rollout_length=20))
        state = init(training)
        now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
        state, queries, info = jax.jit(collect_and_ask)(state, now, training)
        rows = jax.tree.map(lambda rows: rows[: 20 * line.num_envs].reshape(20, line.num_envs, -1), state.replay)
        return rows, queries, info

    (rows, _, whole), (seen, queries, info) = first_round(1), first_round(2)
    np.testing.assert_allclose(seen.next_observation, rows.next_observation, rtol=1e-6)
    if method != "peps":
        np.testing.assert_allclose(seen.log_belief, rows.log_belief, rtol=1e-6)
        return
    assert seen.log_belief is seen.human_reward is None
    watched = rows.observation[:, : line.num_envs // 2]
    assert np.isin(queries.segments.observation, watched).all()
    over = seen.terminated[:, : line.num_envs // 2, 0] | (seen.next_observation[:, : line.num_envs // 2, 0] > 0.25)
    assert 0 < np.sum(over) <= info["episodes"] < whole["episodes"]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_exploring_environments_hold_random_actions(line, share):
    config = line.replace(warmup_steps=0, exploration=share, hold_steps=5)
    training = prepare(config)
    state = init(training)
    now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
    state, _, _ = jax.jit(collect_and_ask)(state, now, training)
    rows = config.rollout_length // 5 * 5
    actions = state.replay.action[: config.steps_per_round].reshape(config.rollout_length, config.num_envs, -1)[:rows]
    blocks = actions.reshape(-1, 5, *actions.shape[1:])
    held = jnp.all(blocks == blocks[:, :1])
    assert bool(held) == (share == 1.0)
    assert len(jnp.unique(blocks[:, 0])) > 1
