"""What is built for others: a wheel and an archive of the sources, which install and run where there is no checkout."""

import csv
import email
import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from compiler import QUICKLY

ROOT = Path(__file__).parents[2]
PACKAGES = {"peps_jax": ROOT / "peps_jax", "peps_envs": ROOT / "envs" / "peps_envs"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SCRIPTS = PROJECT.get("scripts", {})

# a sweep of one short training, with every size small
SWEEP = """--env nav-d1 --seeds 1 --episodes 2 --total-steps 1024 --num-envs 4 --rollout-length 256 --warmup-steps 0
    --updates-per-step 0.01 --batch-size 16 --hidden-sizes 8 --model-hidden-sizes 8 --ensemble-size 2 --num-queries 8
    --dynamics-updates 1 --surrogate-updates 1 --surrogate-batch-size 8""".split()


def python(*arguments: object, folder: Path, **environment: str) -> str:
    """What Python prints in `folder`, where nothing names the checkout and only packages that are needed are found."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"XLA_FLAGS": QUICKLY}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=folder, env=kept | environment, capture_output=True, text=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The archive of the sources, and the wheel that is made from what the archive holds."""
    folder = tmp_path_factory.mktemp("built")
    build = "import sys; from hatchling import build; print(getattr(build, f'build_{sys.argv[1]}')(sys.argv[2]))"
    archive = folder / python("-c", build, "sdist", folder, folder=ROOT).split()[-1]
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    sources = folder / archive.name.removesuffix(".tar.gz")
    wheel = folder / python("-c", build, "wheel", folder, folder=sources).split()[-1]
    return {"sdist": archive, "wheel": wheel, "sources": sources}


def tracked(folder: Path, pattern: str = "*.py") -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob(pattern)}


def test_the_wheel_holds_both_packages_and_their_types_and_nothing_else(built):
    with zipfile.ZipFile(built["wheel"]) as wheel:
        names = set(wheel.namelist())
    for package, folder in PACKAGES.items():
        own = {f"{package}/{name}" for name in tracked(folder)}
        assert own <= names
        assert f"{package}/py.typed" in names
    rest = {name for name in names if name.split("/")[0] not in PACKAGES}
    assert all(name.split("/")[0].endswith(".dist-info") for name in rest)
    assert not {name for name in names if "test" in Path(name).name or "__pycache__" in name}


def test_the_wheel_declares_what_it_needs_and_its_commands(built):
    with zipfile.ZipFile(built["wheel"]) as wheel:
        about = {Path(name).name: wheel.read(name).decode() for name in wheel.namelist() if ".dist-info/" in name}
    metadata = email.message_from_string(about["METADATA"])
    assert metadata["Requires-Python"] == PROJECT["requires-python"]
    needed = {text.split(";")[0].strip() for text in metadata.get_all("Requires-Dist") if "extra ==" not in text}
    assert {name.split(">=")[0] for name in needed} == {name.split(">=")[0] for name in PROJECT["dependencies"]}
    assert metadata.get_payload().startswith("# peps_jax")
    declared = about.get("entry_points.txt", "")
    assert all(f"{name} = {target}" in declared for name, target in SCRIPTS.items())


def test_the_archive_is_enough_to_test_and_to_document(built):
    held = tracked(built["sources"], "*")
    wanted = {"README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "mkdocs.yml"}
    wanted |= {f"tests/{name}" for name in tracked(ROOT / "tests")} | {
        f"docs/{n}" for n in tracked(ROOT / "docs", "*.md")
    }
    assert not wanted - held
    assert not {name for name in held if "__pycache__" in name or name.startswith(("results/", "site/", ".venv/"))}


@pytest.mark.slow
def test_the_wheel_runs_without_the_checkout(built, tmp_path):
    place, elsewhere = tmp_path / "installed", tmp_path / "elsewhere"
    elsewhere.mkdir()
    python("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-index", "--target",
           place, built["wheel"], folder=elsewhere)  # fmt: skip
    # before the packages that the tests run with, where the checkout may be installed too
    where = "import peps_jax, peps_envs; print(peps_jax.__file__, peps_envs.__file__)"
    found = python("-c", where, folder=elsewhere, PYTHONPATH=str(place)).split()
    assert all(Path(file).is_relative_to(place) for file in found)
    python("-m", "peps_jax.sweep", "--method", "sac", "--out", "x", *SWEEP, folder=elsewhere, PYTHONPATH=str(place))
    assert {"manifest.json", "results.csv", "curves.npz"} <= {path.name for path in (elsewhere / "x").iterdir()}
    with open(elsewhere / "x" / "results.csv", newline="", encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["env"] == "nav-d1"
    for command in SCRIPTS:
        script = place / "bin" / command
        assert "usage" in python(script, "--help", folder=elsewhere, PYTHONPATH=str(place)).lower()
