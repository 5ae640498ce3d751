"""Compiled programs are found again by another process, and only by one that would make the same."""

import dataclasses
import gc
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from conftest import Line, LineParams
from jax.experimental.compilation_cache.compilation_cache import reset_cache

import peps_envs
from peps_jax import methods
from peps_jax.execution import batches, compilation_cache, program
from peps_jax.storage import files

EPISODES = 2


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv(compilation_cache.VARIABLE, str(tmp_path / "kept"))
    tests_own = jax.config.jax_compilation_cache_dir  # what JAX has isn't kept once more
    jax.config.update("jax_compilation_cache_dir", None)
    reset_cache()
    yield tmp_path / "kept"
    jax.config.update("jax_compilation_cache_dir", tests_own)
    reset_cache()


def kept(about, make):
    return compilation_cache.kept(about, make, jax.devices()[:1])


def double():
    return {"double": jax.jit(lambda x: 2 * x).lower(np.float32(1)), "beside": (1, "two")}


def refuse():
    raise AssertionError("made again")


def test_what_was_made_is_found_again(place):
    kept("a", double)
    found = kept("a", refuse)
    assert found["double"](np.float32(3)) == 6
    assert found["beside"] == (1, "two")
    assert [path.suffix for path in place.iterdir()] == [".program"]


@pytest.mark.parametrize("collects", [True, False])
def test_garbage_is_collected_afterwards_as_before(place, collects):
    before = gc.isenabled()
    seen = []

    def fail():
        seen.append(gc.isenabled())
        raise ValueError("no program")

    try:
        (gc.enable if collects else gc.disable)()
        with pytest.raises(ValueError, match="no program"):
            kept("a", fail)
        assert (seen, gc.isenabled()) == ([False], collects)
    finally:
        (gc.enable if before else gc.disable)()


BESIDE_JAX = """
import sys
import jax, jax.numpy as jnp
from peps_jax.execution import compilation_cache
function = jax.jit(lambda x: jnp.sum(x * jax.random.uniform(jax.random.key(0), x.shape)) + jnp.arange(3).astype(float))
make = lambda: {"function": function.lower(jnp.ones(1000))}
program = (
    make()["function"].compile() if sys.argv[1:] else compilation_cache.kept("a", make, jax.devices()[:1])["function"]
)
print(program(jnp.ones(1000)))
"""


@pytest.mark.parametrize("known_to_jax", [False, True])
def test_jaxs_own_cache_beside_it_does_no_harm(known_to_jax, place, tmp_path):
    """What JAX has read from its cache can't be written again: it would lack functions when it runs."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
             "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}  # fmt: skip
    flags = {"XLA_FLAGS": ""}  # as users have it

    def run(*arguments: str) -> str:
        done = subprocess.run([sys.executable, "-c", BESIDE_JAX, *arguments], env=os.environ | cache | flags, check=True,
                              capture_output=True, encoding="utf-8")  # fmt: skip
        return done.stdout

    expected = run("by JAX alone") if known_to_jax else run()
    for lost in (False, True, False):
        for path in place.glob("*.program") if lost else ():
            path.unlink()
        assert run() == expected
    assert len(list(place.glob("*.program"))) == (not known_to_jax)


@pytest.mark.parametrize("change", ["about", "code", "setting", "flags"])
def test_what_would_differ_is_made_anew(place, monkeypatch, change):
    kept("a", double)
    if change == "code":
        monkeypatch.setattr(compilation_cache, "_code", lambda: "other code")
    if change == "flags":
        monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    if change == "setting":
        monkeypatch.setattr(type(jax.config), "values", {"jax_enable_x64": True})
    kept("b" if change == "about" else "a", lambda: {"number": 1})
    assert len(list(place.iterdir())) == 2


@pytest.mark.parametrize(
    "damage", [lambda content: content[:-1], lambda content: b"", lambda content: files.seal(b"no pickle")]
)
def test_a_damaged_file_is_made_anew(place, damage):
    kept("a", double)
    (path,) = place.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    assert kept("a", double)["double"](np.float32(3)) == 6
    assert kept("a", refuse)["double"](np.float32(3)) == 6


def test_the_longest_unused_make_room(place, monkeypatch):
    monkeypatch.setattr(compilation_cache, "LIMIT", 3_000)
    for age, name in enumerate("abc"):
        kept(name, lambda: {"bytes": b"0" * 1_000})
        newest = max(place.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.utime(newest, (1_000 - age if name != "c" else 2_000,) * 2)
    assert len(list(place.iterdir())) == 2
    kept("a", refuse)
    with pytest.raises(AssertionError):
        kept("b", refuse)


def test_nothing_is_kept_where_that_is_turned_off_or_impossible(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for value in ("", str(tmp_path / "file")):
        monkeypatch.setenv(compilation_cache.VARIABLE, value)
        assert kept("a", double)["double"](np.float32(3)) == 6
        with pytest.raises(AssertionError):
            kept("a", refuse)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_no_other_process_can_tell_has_no_name(tiny):
    """A compiled model, say: printed, it is a place in memory."""
    task = peps_envs.make("nav-d1")
    fields, bases = [("model", object, object())], (type(task.environment),)
    made = dataclasses.make_dataclass("Modelled", fields, bases=bases, frozen=True)
    made.__module__ = "peps_envs.bridges"
    config = tiny.replace(env=task.environment, params=task.params, belief=task.params)
    assert program.written(config) is not None
    assert program.written(config.replace(env=made())) is None


def test_foreign_code_has_no_name(tiny, monkeypatch):
    assert program.written(tiny) == program.written(tiny.replace(seed=1, lam=3.0))
    assert program.written(tiny) != program.written(tiny.replace(batch_size=17))
    assert program.written(tiny.replace(env=Line(), params=LineParams(), belief=LineParams())) is None
    mine = methods.get("sac")._replace(name="mine", init=lambda key, settings: ())
    monkeypatch.setitem(methods.METHODS, "mine", mine)
    assert program.written(tiny.replace(method="mine")) is None


PROGRAM = """
import sys
import numpy as np
from peps_jax import Config
from peps_jax.execution import batches, program
sizes = dict(total_steps=40, num_envs=4, rollout_length=10, warmup_steps=0, batch_size=8, hidden_sizes=(4,), updates_per_step=0.1)
configs = [Config(method="sac", seed=seed, **sizes) for seed in range(2)]
(planned,) = batches.plan(configs, 2)
if sys.argv[1] == "known":
    program.Program._lowered = None
compiled, _ = program.program(configs[0], planned.slots, 2, planned.devices)
finished, _ = compiled.run(configs, 2)
print([one.evaluation.return_.tolist() for one in finished], compiled.bytes_used)
"""


def test_another_process_finds_a_trainings_programs(place):
    run = lambda word: (
        subprocess.run([sys.executable, "-c", PROGRAM, word], capture_output=True, encoding="utf-8", check=True).stdout
    )
    assert run("new") == run("known")


@pytest.mark.slow
def test_other_lengths_episodes_and_numbers_of_runs_compile_nothing(line, train, monkeypatch):
    """What has room in a program uses it, and has the numbers of a training by itself."""
    compiled = []
    compile_ = program.Program.compile
    monkeypatch.setattr(program.Program, "compile", lambda self: compiled.append(self) or compile_(self))
    monkeypatch.setattr(program, "_PROGRAMS", {})
    base = line.replace(method="peps", total_steps=8 * line.steps_per_round, num_queries=16)
    shorter = base.replace(total_steps=7 * line.steps_per_round, warmup_steps=0, num_queries=13)
    few, many = [base], [shorter.replace(seed=seed) for seed in range(3)]
    assert few[0].num_rounds != many[0].num_rounds
    finished = []
    for configs, episodes in ((few * 2, 8), (many, 7)):
        watch = batches.Watch()
        watch.finished = lambda batch, runs, times: finished.extend(runs)
        planned = batches.plan(configs, episodes, most=batches.runs_soon_done(jax.devices()))
        batches.run(configs, planned, episodes, watch)
    assert len(compiled) == 1
    assert [run.evaluation.return_.shape for run in finished] == [(8,)] * 2 + [(7,)] * 3
    assert finished[-1].curves["return_"].shape == (many[0].num_rounds,)
    assert np.sum(finished[-1].preferences.weight > 0) == 13
    alone = train(many[2])
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)
    jax.tree.map(close, (finished[-1].curves, finished[-1].agents), (alone.curves, alone.agents))


def test_what_is_trained_as_a_whole_has_no_spare_rounds(tiny):
    """`train` fills the room that its settings name; a program that is advanced by rounds may have more."""
    config = tiny.replace(total_steps=7 * tiny.steps_per_round)
    assert (program.shared(config).num_rounds, program.roomy(config).num_rounds) == (7, 8)
    assert program.roomy(config).lengths.num_rounds == 7


def test_a_process_holds_few_programs_at_once(line, monkeypatch):
    monkeypatch.setattr(program.Program, "compile", lambda self: 1.0)
    monkeypatch.setattr(program, "_PROGRAMS", {})
    one = lambda width: program.program(line.replace(hidden_sizes=(width,)), 1, EPISODES, tuple(jax.devices()[:1]))
    first, taken = one(1)
    assert taken.compile == 1
    for width in range(2, program.MOST_PROGRAMS + 1):
        one(width)
    assert one(1) == (first, program.Times()), "used again, it is the latest"
    one(program.MOST_PROGRAMS + 1)
    assert len(program._PROGRAMS) == program.MOST_PROGRAMS
    assert one(1)[0] is first
    assert one(2)[1].compile == 1, "the one that was longest not used is gone"
