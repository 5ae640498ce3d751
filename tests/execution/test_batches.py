"""How runs are divided into batches: which share a program, and how many fit into memory."""

import jax
import jax.numpy as jnp
import pytest

import peps_jax
from peps_jax.config import capacity
from peps_jax.execution import batches, devices, memory, program

EPISODES = 4


def test_environments_share_a_program_and_methods_do_not(tiny, monkeypatch):
    monkeypatch.setattr(batches, "memory_need", lambda *_: memory.Need(1000, 1000))
    configs = [tiny.replace(env=env, method=method) for env in ("nav-d1", "nav-d3") for method in ("peps", "sac")]
    planned = batches.plan(configs, EPISODES, free=10**9)
    assert [one.runs for one in planned] == [(0, 2), (1, 3)]


def test_arrays_without_entries_are_divided_like_all_others():
    """What a program puts out it takes in again, as a training does with a MuJoCo model that has no activations."""
    used = jax.devices()
    rows = jax.device_put((jnp.zeros((2, 3)), jnp.zeros((2, 4, 0))), devices.sharding(used))
    once = devices.over_devices(lambda rows: (rows[0] + 1, rows[1] * 2), used).lower(rows).compile()
    twice, empty = once(once(rows))
    assert float(twice[0, 0]) == 2
    assert empty.shape == (2, 4, 0)


def test_what_does_not_fit_is_split_into_batches_of_one_size(line):
    configs = [line.replace(seed=seed) for seed in range(7)]
    need = program.memory_need(line, EPISODES)
    two_per_device = int((memory.bytes_needed(need, 2, together=False) + 100) / memory.AVAILABLE_SHARE)
    planned = batches.plan(configs, EPISODES, free=two_per_device)
    assert [one.slots for one in planned] == [4, 4]
    assert [place for one in planned for place in one.runs] == list(range(7))
    with pytest.raises(memory.OutOfMemoryError, match="each of 2 devices"):
        batches.plan(configs, EPISODES, free=need.working)


def test_side_by_side_every_run_needs_its_working_memory():
    need = memory.Need(state=100, working=1000)
    free = int(10_000 / memory.AVAILABLE_SHARE)
    assert memory.runs_that_fit(need, free, together=False) == 44
    assert memory.runs_that_fit(need, free, together=True) == 8
    assert memory.runs_that_fit(need, 0, together=False) == 0


def test_predicted_memory_grows_as_what_it_counts(line):
    need = lambda **changes: program.memory_need(line.replace(method="sac", **changes), EPISODES)
    base, wider, longer = need(batch_size=1024), need(batch_size=2048), need(total_steps=16_000)
    assert 1.5 * base.working < wider.working < 2.5 * base.working
    transition = 4 * 7 + 1  # bytes: two observations, action, reward, movement, human_reward, log_belief; terminated
    rounds = lambda steps: capacity(steps // line.steps_per_round)
    assert longer.state - base.state == (rounds(16_000) - rounds(160)) * line.steps_per_round * transition


@pytest.mark.slow
@pytest.mark.parametrize(("method", "width", "size"), [("sac", 128, 256), ("peps", 64, 256)])
def test_predicted_memory_is_what_xla_reports(method, width, size):
    sizes = dict(batch_size=size, total_steps=32_000, updates_per_step=0.25, num_queries=3_000)
    config = peps_jax.Config(method=method, hidden_sizes=(width, width), **sizes)
    compiled = program.Program(config, 2, 100, jax.devices()[:1])
    compiled.compile()
    used = compiled.bytes_used
    predicted = memory.bytes_needed(program.memory_need(config, 100), 2, together=False)
    assert 0.97 * used < predicted < 1.2 * used


def test_values_in_use_at_once_are_counted():
    kilobyte = jnp.zeros(256)

    def chain(x):  # never more than an operation's argument and result
        for _ in range(10):
            x = jnp.sin(x)
        return jnp.sum(x)

    def fan(x):  # all ten wait for their sum
        return jnp.sum(jnp.stack([jnp.sin(x * k) for k in range(10)]))

    assert memory.most_in_use(jax.make_jaxpr(chain)(kilobyte).jaxpr) <= 2 * 1024 + 4
    assert memory.most_in_use(jax.make_jaxpr(fan)(kilobyte).jaxpr) >= 20 * 1024


@pytest.mark.parametrize("num_rounds", [1, 2, 4, 39, 75, 97, 400, 997, 5003, 10_000])
def test_a_training_reports_often(num_rounds):
    length = program.chunk_length(num_rounds)
    assert 1 <= length <= program.CHUNK
    assert num_rounds / length >= min(num_rounds, program.REPORTS)
