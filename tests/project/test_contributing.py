"""Who has read CONTRIBUTING only adds an environment with its picture, a belief and a method: one new file and one line each.

The examples are put into a copy of the sources as the page says, and the tests that it names have to pass there.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from compiler import QUICKLY
from test_layers import violations

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SMALL = (
    "--seeds 1 --episodes 2 --total-steps 80 --num-envs 4 --rollout-length 20 --warmup-steps 0 --batch-size 16".split()
)
SMALL += "--hidden-sizes 8 --model-hidden-sizes 8 --ensemble-size 2 --num-queries 8 --updates-per-step 0.1".split()


def chapter(title: str) -> str:
    """The text under a heading."""
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, flags=re.DOTALL | re.MULTILINE)[1]


def blocks(title: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", chapter(title), flags=re.DOTALL)


def named(title: str) -> list[str]:
    """The files that a chapter names, in its order."""
    return re.findall(r"`((?:envs|peps_jax|tests)/\S+\.py)`", chapter(title))


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    """The sources with all that CONTRIBUTING's examples add."""
    root = tmp_path_factory.mktemp("checkout")
    for folder in ("peps_jax", "envs", "tests"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "CONTRIBUTING.md"):
        shutil.copy(ROOT / file, root / file)
    environment, line = blocks("An environment")
    add_file(root, "envs/peps_envs/walk.py", environment)
    add_line(root / "envs/peps_envs/__init__.py", line)
    method, line = blocks("A method")
    add_file(root, "peps_jax/methods/timid.py", method)
    add_line(root / "peps_jax/methods/__init__.py", line, after="HUMAN_EXPECTATION as HUMAN_EXPECTATION\n")
    (belief,) = blocks("A belief")
    add_line(root / "envs/peps_envs/navigation/domains.py", belief, after='        "biased": bias,\n')
    return root


def add_file(root: Path, file: str, text: str) -> None:
    assert file in PAGE
    assert not (root / file).exists()
    ast.parse(text)
    (root / file).write_text(text, encoding="utf-8")


def add_line(path: Path, text: str, after: str = "") -> None:
    """One line, below what is said, or at the end."""
    assert len(text.strip().splitlines()) == 1
    content = path.read_text(encoding="utf-8")
    assert after in content
    place = content.index(after) + len(after) if after else len(content)
    path.write_text(content[:place] + text + content[place:], encoding="utf-8")


def run(root: Path, *command: object) -> subprocess.CompletedProcess:
    own = os.pathsep.join([str(root), str(root / "envs")])
    return subprocess.run(
        [sys.executable, *map(str, command)], cwd=root, capture_output=True, text=True, encoding="utf-8", check=False,
        env=os.environ | {"PYTHONPATH": own, "XLA_FLAGS": QUICKLY, "PEPS_JAX_CACHE": ""},
    )  # fmt: skip


@pytest.mark.slow
def test_the_tests_that_it_names_pass_with_what_was_added(checkout):
    wanted = {file for title in ("An environment", "A belief", "A method") for file in named(title) if "every" in file}
    assert wanted == {"tests/environments/test_every_environment.py", "tests/methods/test_every_method.py"}
    done = run(checkout, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *sorted(wanted), "-k",
               "walk or timid or nav-d1")  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "test_every" not in done.stdout.partition("short test summary")[2]


@pytest.mark.slow
def test_commands_know_what_was_added(checkout):
    out = checkout / "out"
    done = run(checkout, "-m", "peps_jax.sweep", "--env", "walk", "--method", "timid", "--out", out, *SMALL)
    assert done.returncode == 0, done.stderr
    assert "walk-timid-lam2.4-seed0" in (out / "results.csv").read_text(encoding="utf-8")
    assert (out / "routes.png").stat().st_size > 2000
    code = "import peps_envs; print(float(peps_envs.make('nav-d1').beliefs['timid'].pit_range))"
    assert run(checkout, "-c", code).stdout.strip().startswith("0.8")


def test_the_layers_hold_with_what_was_added(checkout):
    assert violations(checkout) == []
