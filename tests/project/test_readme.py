"""What the README and the pages under docs/ say is so: their Python runs as it stands there, but for shorter trainings, their
commands are understood, their tables are what was measured, and the code and tests that they name exist."""

import contextlib
import importlib
import importlib.util
import io
import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import numpy as jnp

import peps_jax.reproduce.__main__
import peps_jax.sweep.arguments

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = (README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
EXECUTED = (
    README,
    *sorted((ROOT / "docs").glob("*.md")),
)  # CONTRIBUTING's files are put into place by test_contributing.py

# sizes of a training that is only to run through
SHORT = dict(
    num_envs=4, rollout_length=25, warmup_steps=0, batch_size=16, updates_per_step=0.05, hidden_sizes=(8,),
    model_hidden_sizes=(8,), ensemble_size=2, dynamics_updates=1, surrogate_updates=1, surrogate_batch_size=8, num_queries=8,
)  # fmt: skip


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def python_of(page: Path) -> str:
    """All the Python of a page, in its order: later blocks may use what earlier ones made."""
    return "\n".join(re.findall(r"```python\n(.*?)```", text_of(page), flags=re.DOTALL))


def shortened(code: str) -> str:
    """`code` with short trainings instead of long ones, and with few episodes."""
    sizes = ", ".join(f"{name}={value}" for name, value in SHORT.items() if name != "hidden_sizes")
    code = re.sub(r"hidden_sizes=\(32, 32\)", "hidden_sizes=(8,)", code)
    code = re.sub(r"total_steps=[\d_]+", f"total_steps=400, {sizes}", code)
    return re.sub(r"(evaluate\(result(?:, config)?), \d+\)", r"\1, 2)", code)


# what needs other ecosystems runs in test_bridges_page.py, where they are installed
WITH_PYTHON = [page for page in EXECUTED if python_of(page) and page.stem != "bridges"]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON, ids=[page.stem for page in WITH_PYTHON])
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = python_of(page)
    shorter = shortened(code)
    assert "total_steps" not in code or shorter != code
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(shorter, str(page), "exec"), {"__name__": page.stem})


def readmes_environment() -> tuple[str, dict]:
    """The README's environment as it stands there, without the training, and what it defines."""
    (block,) = (
        found
        for found in re.findall(r"```python\n(.*?)```", text_of(README), flags=re.DOTALL)
        if "(Environment)" in found
    )
    lines = block.strip().splitlines()
    assert "train(" in lines[-1]
    names = {"__name__": "readme"}
    exec(compile("\n".join(lines[:-1]), str(README), "exec"), names)
    return block, names


def test_the_readmes_environment_is_complete_in_25_lines_and_walks():
    block, names = readmes_environment()
    body = block[block.index("class Track") :].strip().splitlines()
    assert len([line for line in body if line.strip()]) <= 25
    walk, track = names["Walk"](), names["Track"](0.2)
    state, _ = walk.reset(jax.random.key(0), track)
    rewards = []
    for _ in range(5):
        after = walk.step(jax.random.key(0), state, jnp.ones(1), track)
        state = after.state
        rewards.append(float(after.reward))
    np.testing.assert_allclose(rewards, [-1, -1, -1, -1, 9])
    assert bool(after.terminated)
    assert not bool(after.truncated)
    expected = walk.next_state_distribution(walk.reset(jax.random.key(0), track)[0], jnp.ones(1), names["Track"](0.25))
    np.testing.assert_allclose(expected.relative_log_prob(jnp.array([0.2])), -(0.5**2) / 2, rtol=1e-4)


# --- commands -------------------------------------------------------------------------------------------------------------

PARSERS = {
    "peps_jax.sweep": peps_jax.sweep.arguments.parser,
    "peps_jax.reproduce": peps_jax.reproduce.__main__.parser,
}
SCRIPTS = {"peps-sweep": "peps_jax.sweep", "peps-reproduce": "peps_jax.reproduce"}
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))


def commands_of(text: str) -> list[list[str]]:
    """Every command line of a page, in words: of indented lines, blocks of bash, and code within a line."""
    blocks = re.findall(r"```bash\n(.*?)```", text, flags=re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"^    (?=\S)(.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), flags=re.MULTILINE)
    lines += re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = []
    for line in lines:
        with contextlib.suppress(ValueError):  # an apostrophe: no command
            words = [word for word in shlex.split(line, comments=True) if word != "..."]
            starts = [
                place for place, word in enumerate(words) if re.fullmatch(r"\S*python|make|jupytext|peps-\w+", word)
            ]
            if starts and len(words) > starts[0] + 1:
                found.append(words[starts[0] :])
    return found


def complaint(words: list[str]) -> str | None:
    """Why a command line can't be right; None if it can."""
    first, *rest = words
    if first == "make":
        unknown = [word for word in rest if "=" not in word and word not in TARGETS]
        return f"no such target: {unknown}" if unknown else None
    if first in SCRIPTS:
        rest = ["-m", SCRIPTS[first], *rest]
    if rest[0] == "-m":
        module, arguments = rest[1], rest[2:]
        if module not in PARSERS:
            return None if importlib.util.find_spec(module) else f"no module {module}"
        printed = io.StringIO()
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
            try:
                PARSERS[module]().parse(arguments)
            except SystemExit as exit:
                return printed.getvalue() if exit.code else None
        return None
    if rest[0].endswith(".py"):
        if not (ROOT / rest[0]).exists():
            return f"no file {rest[0]}"
        flags = [word for word in rest if word.startswith("--")]
        missing = [flag for flag in flags if f'"{flag}"' not in (ROOT / rest[0]).read_text(encoding="utf-8")]
        return f"{rest[0]} has no {missing}" if missing else None
    return None


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_commands_are_understood(page):
    complaints = {shlex.join(words): complaint(words) for words in commands_of(text_of(page))}
    assert not {line: why for line, why in complaints.items() if why}


def test_the_readme_shows_how_to_test_and_both_jobs():
    shown = [words[:2] for words in commands_of(text_of(README))]
    for target in ("sweep", "reproduce", "test", "docs"):
        assert ["make", target] in shown
    assert ["python", "-m"] in shown


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("    make sweeep", "no such target"),
        ("    python -m peps_jax.sweep --lamb 2.4", "did you mean --lam"),
        ("    python -m peps_jax.reproduce table1 --seed 3", "did you mean --seeds"),
        ("`python benchmarks/cluster.py results/x --cell 3`", "has no"),
        ("`python -m peps_jax.sweeps`", "no module"),
    ],
)
def test_a_wrong_command_is_noticed(line, why):
    (words,) = commands_of(line)
    assert why in complaint(words)


# --- what pages name ------------------------------------------------------------------------------------------------------


def resolves(name: str) -> bool:
    """Whether a dotted name is a module or something in one."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_code_and_tests_that_a_page_names_exist(page):
    text = re.sub(r"```.*?```", "", text_of(page), flags=re.DOTALL)
    names = set(re.findall(r"`((?:peps_jax|peps_envs)(?:\.\w+)+)[`(]", text))
    names |= set(re.findall(r"^::: (\S+)", text, flags=re.MULTILINE))
    assert not {name for name in names if not resolves(name)}
    for file, test in re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text):
        assert (ROOT / file).exists() or page.stem == "CONTRIBUTING", file
        assert f"def {test or ''}" in text_of(ROOT / file)


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_links_and_pictures_are_there(page):
    generated = {
        ROOT / "docs" / "contributing.md",
        ROOT / "docs" / "tour.md",
    }  # made from the root's pages and the tour
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", re.sub(r"```.*?```", "", text_of(page), flags=re.DOTALL)):
        if "://" not in link:
            assert (page.parent / link).exists() or page.parent / link in generated, link


def test_no_figure_is_typed_by_hand():
    """Tables are what was measured, or follow from the code."""
    path = ROOT / "benchmarks" / "readme.py"
    spec = importlib.util.spec_from_file_location("readme", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert set(module.PAGES) >= set(EXECUTED)
    for page in module.PAGES:
        assert module.embedded(text_of(page), page) == text_of(page), "run `make readme`"
    assert "| D1 | 20 / 20 /" in module.embedded(
        "<!-- begin headline benchmarks/results/table1.csv -->\n<!-- end -->", README
    )


# --- shape ----------------------------------------------------------------------------------------------------------------


def test_the_readme_is_one_screen():
    lines = text_of(README).splitlines()
    assert len(lines) <= 120
    inside = False
    for place, line in enumerate(lines):
        inside ^= line.startswith("```")
        if not inside and not line.startswith(("|", "![", "    ")):
            assert len(line) <= 130, f"line {place + 1}"


def test_the_film_is_small_and_shows_several_moments():
    from PIL import Image

    film = ROOT / "docs" / "film.gif"
    assert film.stat().st_size < 10**6
    with Image.open(film) as pictures:
        assert pictures.n_frames > 20


@pytest.mark.slow
def test_the_tour_runs(tmp_path, monkeypatch):
    tour = ROOT / "docs" / "tour.py"
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(shortened(text_of(tour)), str(tour), "exec"), {"__name__": "tour"})
    assert "rank correlation" in printed.getvalue()
    assert {path.name for path in (tmp_path / "results" / "tour").iterdir()} == {"routes.png", "surrogate.png"}
