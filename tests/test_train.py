"""A whole training as one pure function: under jit, vmap and scan, round by round, and with a person as the teacher."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams

import peps_jax
from peps_jax import grid
from peps_jax.preferences import synthetic_human
from peps_jax.preferences.synthetic_human import Teacher
from peps_jax.train import annealed_temperature, collect_and_ask, finish, init, learn_and_improve, run_round, run_rounds
from peps_jax.trajectory import Preferences

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
    """Three cells as one batch, traced once whatever their leaves are."""
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


def three_cells(line, seeds, lams):
    """A batch that varies what there is of kinds of leaves: the seed, weights, rates, and a belief's numbers."""
    return grid(
        line, seed=seeds, lam=lams, learning_rate=[1e-3, 2e-3, 1e-3],
        belief=LineParams(noise=jnp.array([0.1, 0.2, 0.3]), slope=jnp.ones(3), width=jnp.full(3, 0.1)),
    )  # fmt: skip


def cell_of(batch, cell):
    return jax.tree.map(lambda leaf: leaf[cell], batch)


def test_a_vmapped_cell_matches_its_single_run(line, train, train_three):
    cells = three_cells(line, [0, 0, 5], [0.0, 2.0, 2.4])
    batch = train_three(cells)
    for cell in range(3):
        single = train(cell_of(cells, cell))
        assert_close(cell_of(batch.agents, cell), single.agents, rtol=1e-2, atol=1e-3)
        for name in ("return_", "explicability", "surrogate_loss", "critic_loss"):
            np.testing.assert_allclose(
                batch.curves[name][cell], single.curves[name], rtol=1e-2, atol=1e-3, err_msg=name
            )


def test_other_leaves_compile_nothing(line, train_three):
    one = train_three(three_cells(line, [0, 0, 5], [0.0, 2.0, 2.4]))
    two = train_three(three_cells(line.replace(gamma=0.9, rationality=2.0), [1, 2, 3], [0.5, 2.8, 1.0]))
    assert not np.allclose(one.curves["surrogate_loss"], two.curves["surrogate_loss"])


@pytest.mark.slow
def test_a_vmapped_cell_matches_its_single_run_in_a_navigation_domain(tiny, train):
    cells = grid(tiny.replace(method="sac"), seed=[0, 1], temperature=[1.0, 0.5])
    batch = jax.jit(jax.vmap(peps_jax.train))(cells)
    assert_close(cell_of(batch.agents, 1), train(cell_of(cells, 1)).agents, rtol=1e-2, atol=1e-3)


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
    whole, curves = rounds(first_state(line), jnp.arange(line.num_rounds), line)
    state = first_state(line)
    for index in range(line.num_rounds):
        # the teacher's key is the round's third, as in `run_round`
        key_teacher = jax.random.split(jax.random.fold_in(state.key, index), 5)[2]
        state, queries, collected = collect(state, jnp.asarray(index), line)
        preferences = jax.jit(synthetic_human.answer)(key_teacher, queries, line)
        state, learned = learn(state, jnp.asarray(index), preferences, line)
        for name, value in (collected | learned).items():
            np.testing.assert_allclose(value, curves[name][index], rtol=1e-3, atol=1e-4, err_msg=name)
    assert_close(state, whole, rtol=1e-3, atol=1e-4)


def test_a_round_at_a_time_gives_the_scans_numbers(line, first_state, rounds, step):
    whole, _ = rounds(first_state(line), jnp.arange(line.num_rounds), line)
    state = first_state(line)
    for index in range(line.num_rounds):
        state, _ = step(state, jnp.asarray(index), line)
    assert_close(state, whole, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("method", ["peps", "policy_shaping"])
def test_nothing_makes_nan_in_a_round_in_which_no_episode_ends(line, method):
    config = line.replace(env=Line(horizon=1000), method=method, warmup_steps=0, exploration=0.0, total_steps=80)
    with jax.debug_nans(True):
        curves = jax.jit(peps_jax.train)(config).curves
    assert not np.all(curves["episodes"] > 0)
    assert all(np.all(np.isfinite(curve)) for curve in curves.values())
    assert np.all(np.asarray(curves["return_"])[np.asarray(curves["episodes"]) == 0] == 0)


def test_a_saved_state_continues_as_if_nothing_had_been(line, first_state, step, tmp_path):
    state, _ = step(first_state(line), jnp.asarray(0), line)
    raw = state.replace(key=jax.random.key_data(state.key))
    np.savez(tmp_path / "state.npz", *jax.tree.leaves(raw))
    with np.load(tmp_path / "state.npz") as file:
        leaves = [jnp.asarray(file[name]) for name in file.files]
    loaded = jax.tree.unflatten(jax.tree.structure(raw), leaves)
    loaded = loaded.replace(key=jax.random.wrap_key_data(loaded.key))
    whole, curves = step(state, jnp.asarray(1), line)
    resumed, after = step(loaded, jnp.asarray(1), line)
    assert_close(resumed, whole, rtol=0, atol=0)
    chex.assert_trees_all_equal(after, curves)
    assert finish(resumed, after, line).act(jnp.zeros(1)).shape == (1,)


def test_a_person_is_a_teacher(line, train):
    """Somebody who always prefers the segment that ends further to the right, and skips every other query."""

    def answer(key, segments, config):
        del key, config
        end = jnp.sum(segments.mask, -1, keepdims=True).astype(int) - 1
        last = jnp.take_along_axis(segments.next_state.place[..., 0], end, -1)[..., 0]
        answers = (last[:, 0] > last[:, 1]).astype(jnp.float32)
        return Preferences(segments, answers, jnp.arange(answers.size) % 2.0)

    person = Teacher(answer=answer)
    result = jax.jit(lambda config: peps_jax.train(config, person))(line)
    surrogate = result.knowledge.surrogate
    by_round = surrogate.weights.reshape(line.num_rounds, line.queries_per_round, line.ensemble_size)
    assert bool(jnp.all(by_round[:, ::2] == 0)), "a skipped query teaches nothing"
    assert bool(jnp.any(by_round[:, 1::2] > 0))
    assert set(np.unique(surrogate.answers)) <= {0.0, 1.0}
    assert not np.allclose(result.curves["surrogate_loss"], train(line).curves["surrogate_loss"])


def test_a_persons_answers_enter_between_the_halves(line, first_state):
    state, queries, _ = jax.jit(collect_and_ask)(first_state(line), jnp.asarray(0), line)
    number = line.queries_per_round
    assert queries.mask.shape == (number, 2, line.segment_length)
    answers = jnp.resize(jnp.array([1.0, 0.0, 0.5]), number)  # from a file, say
    preferences = Preferences(queries, answers, jnp.ones(number))
    state, info = jax.jit(learn_and_improve)(state, jnp.asarray(0), preferences, line)
    np.testing.assert_array_equal(state.knowledge.surrogate.answers[:number], answers)
    assert np.isfinite(float(info["surrogate_loss"]))


def test_sac_asks_nothing(line, first_state):
    config = line.replace(method="sac")
    _, queries, _ = jax.jit(collect_and_ask)(first_state(config), jnp.asarray(0), config)
    assert queries is None


def test_an_unbiased_human_has_no_belief_gap(line, train):
    """Belief and truth agree: l_H = l_A in every step, and explicability is the return."""
    curves = train(line.replace(belief=line.params)).curves
    ended = np.asarray(curves["episodes"]) > 0
    assert ended.any()
    np.testing.assert_allclose(curves["belief_gap"][ended], 0.0, atol=1e-5)
    np.testing.assert_allclose(curves["explicability"][ended], curves["return_"][ended], rtol=1e-5)


def test_the_unbiased_preset_is_the_truth(tiny):
    _, params, belief = tiny.replace(belief="unbiased").task()
    chex.assert_trees_all_equal(params, belief)


def test_replay_holds_what_happened(line, first_state, rounds):
    state, _ = rounds(first_state(line), jnp.arange(line.num_rounds), line)
    buffer = state.replay
    assert buffer.reward.shape == (line.num_rounds * line.steps_per_round,)
    np.testing.assert_allclose(buffer.next_observation, buffer.observation + 0.1 * buffer.action, atol=1e-5)
    np.testing.assert_allclose(buffer.reward, buffer.next_observation[:, 0], atol=1e-5)  # r_A alone, nothing relabelled
    np.testing.assert_array_equal(buffer.terminated > 0, buffer.next_observation[:, 0] > 0.25)


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
    at = lambda index: float(annealed_temperature(jnp.asarray(index), config))
    assert config.num_rounds == 10
    assert at(0) == pytest.approx(4.0)
    assert at(2.5) == pytest.approx(2.0)  # half of the way on a logarithmic scale
    assert at(5) == pytest.approx(1.0)
    assert at(9) == pytest.approx(1.0)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_exploring_environments_hold_random_actions(line, share):
    config = line.replace(warmup_steps=0, exploration=share, hold_steps=5)
    state, _, _ = jax.jit(collect_and_ask)(init(config), jnp.asarray(0), config)
    rows = config.rollout_length // 5 * 5
    actions = state.replay.action[: config.steps_per_round].reshape(config.rollout_length, config.num_envs, -1)[:rows]
    blocks = actions.reshape(-1, 5, *actions.shape[1:])
    held = jnp.all(blocks == blocks[:, :1])
    assert bool(held) == (share == 1.0)
    assert len(jnp.unique(blocks[:, 0])) > 1
