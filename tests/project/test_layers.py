"""Who may import whom. A module that is added to the source has to be given a place here."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Bottom to top: rooms, and modules where a room has floors of its own. A module imports from the rows below its own, and from
# its own row. What is named first counts: a module, then the room that it lies in.
LAYERS = (
    ("peps_envs.perception", "peps_envs.scene"),
    ("peps_envs.environment", "peps_envs.pictures"),
    ("peps_envs.navigation", "peps_envs.highway.vehicle"),
    ("peps_envs.highway.collision", "peps_envs.highway.traffic"),
    ("peps_envs.highway.simulation", "peps_envs.highway.classic"),
    ("peps_envs.highway",),
    ("peps_envs.registry",),
    ("peps_envs.*",),  # environments of one file, which register themselves
    ("peps_envs",),
    ("peps_envs.bridges",),
    ("peps_envs.physics",),
    ("peps_jax.storage", "peps_jax.trajectory", "peps_jax.generator"),
    ("peps_jax.fields",),
    ("peps_jax.config",),
    ("peps_jax.settings",),
    ("peps_jax.round", "peps_jax.preferences"),  # below learning: what r-hat is fitted to is a set of preferences
    ("peps_jax.learning.networks", "peps_jax.learning.replay", "peps_jax.learning.policy_heads"),
    *(tuple(f"peps_jax.learning.{name}" for name in ("classifier", "dynamics", "sac", "surrogate")),),
    ("peps_jax.learning",),
    ("peps_jax.methods.method",),
    ("peps_jax.methods.preference_based", "peps_jax.methods.sac"),
    *(tuple(f"peps_jax.methods.{name}" for name in ("drlhp", "human_expectation", "peps", "policy_shaping")),),
    ("peps_jax.methods.oracle", "peps_jax.methods.darc"),
    ("peps_jax.methods",),
    ("peps_jax.train", "peps_jax.rollout", "peps_jax.explicability"),
    ("peps_jax.evaluate",),
    ("peps_jax.analysis", "peps_jax.drawing"),
    *(
        tuple(
            f"peps_jax.execution.{name}" for name in ("memory", "compilation_cache", "machine", "devices", "waiting")
        ),
    ),
    ("peps_jax.execution.program",),
    ("peps_jax.execution.batches",),
    ("peps_jax.execution",),
    ("peps_jax.command_line",),
    ("peps_jax.sweep",),
    ("peps_jax.reproduce.store",),
    ("peps_jax.reproduce.summary", "peps_jax.reproduce.ways"),
    ("peps_jax.reproduce.plan", "peps_jax.reproduce.driving"),
    ("peps_jax.reproduce",),
    ("peps_jax.human_study",),
)
LAYER_OF = {room: layer for layer, rooms in enumerate(LAYERS) for room in rooms}
STRANGERS = {
    f"peps_jax.learning.{name}" for name in ("classifier", "dynamics", "sac", "surrogate")
}  # know nothing of one another
FRONT = (
    "peps_jax"  # its __init__ shows what users need, of whatever layer: commands may import it, what they use may not
)
COMMAND = "peps_jax.sweep"  # the lowest of them


def layer_of(module: str) -> int | None:
    """The row of a module, or of the nearest room that it lies in; None if neither has one."""
    if module == FRONT:
        return LAYER_OF[COMMAND]
    parts = module.split(".")
    rooms = (".".join(parts[:length]) for length in range(len(parts), 1, -1))
    rest = f"{module.rpartition('.')[0]}.*"
    return next((LAYER_OF[room] for room in (*rooms, module, rest) if room in LAYER_OF), None)


def source_files(root: Path) -> dict[str, Path]:
    """Files by module name: `peps_envs` lies under envs/, `peps_jax` at the root."""
    modules = {}
    for base, package in ((root / "envs", "peps_envs"), (root, "peps_jax")):
        for path in sorted((base / package).rglob("*.py")):
            parts = path.relative_to(base).with_suffix("").parts
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


def imported(path: Path, module: str, modules: dict[str, Path]) -> set[str]:
    """The project's modules that `path` imports, anywhere in it: `from peps_jax import train` means peps_jax.train."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                source = ".".join([*above, *filter(None, [node.module])])
            names = {f"{source}.{alias.name}" for alias in node.names}
            found |= {name if name in modules else source for name in names}
    return {name for name in found if name.split(".")[0] in ("peps_envs", "peps_jax")}


def violations(root: Path) -> list[str]:
    """One line for each module without a layer and each arrow that runs upwards."""
    modules = source_files(root)
    lines = []
    for module, path in modules.items():
        if module == FRONT:
            continue
        if layer_of(module) is None:
            lines.append(f"{module} has no layer: give it a place in LAYERS of tests/project/test_layers.py")
            continue
        for target in sorted(imported(path, module, modules) - {module}):
            layer = layer_of(target)
            if layer is not None and layer > layer_of(module):
                lines.append(f"{module} imports {target}, which is above it")
            elif {module, target} <= STRANGERS:
                lines.append(f"{module} imports {target}: what is learned apart knows nothing of one another")
    return lines


def plant(root: Path, file: str, text: str) -> None:
    """A copy of the source tree in which every file is empty, but `file` holds `text`."""
    for path in source_files(ROOT).values():
        empty = root / path.relative_to(ROOT)
        empty.parent.mkdir(parents=True, exist_ok=True)
        empty.touch()
    (root / file).write_text(text, encoding="utf-8")


def test_no_arrow_runs_upwards():
    assert len(source_files(ROOT)) > 20
    assert not violations(ROOT)


@pytest.mark.parametrize(
    ("file", "line", "complaint"),
    [
        (
            "envs/peps_envs/navigation/density.py",
            "import peps_jax.config",
            "imports peps_jax.config, which is above it",
        ),
        (
            "envs/peps_envs/environment.py",
            "from peps_envs.registry import make",
            "imports peps_envs.registry, which is above it",
        ),
        (
            "envs/peps_envs/navigation/density.py",
            "from .. import registry",
            "imports peps_envs.registry, which is above it",
        ),
        ("peps_jax/train.py", "from peps_jax import evaluate", "imports peps_jax.evaluate, which is above it"),
        ("peps_jax/train.py", "def late():\n    from .sweep import run", "imports peps_jax.sweep, which is above it"),
        (
            "peps_jax/preferences/synthetic_human.py",
            "from ..methods.peps import PEPS",
            "imports peps_jax.methods.peps, which is above it",
        ),
        (
            "peps_jax/preferences/synthetic_human.py",
            "from peps_jax import Config",
            "imports peps_jax, which is above it",
        ),
        (
            "peps_jax/preferences/data.py",
            "from peps_jax.learning.surrogate import SurrogateState",
            "imports peps_jax.learning.surrogate, which is above it",
        ),
        (
            "peps_jax/preferences/queries.py",
            "from peps_jax.learning import networks",
            "imports peps_jax.learning.networks, which is above it",
        ),
        ("peps_jax/settings.py", "from peps_jax.round import Round", "imports peps_jax.round, which is above it"),
        ("peps_jax/settings.py", "from .preferences import data", "imports peps_jax.preferences.data, which is above"),
        ("peps_jax/config.py", "from peps_jax import settings", "imports peps_jax.settings, which is above it"),
        ("peps_jax/round.py", "import peps_jax.learning.sac", "imports peps_jax.learning.sac, which is above it"),
        ("peps_jax/trajectory.py", "from peps_jax.config import Problem", "imports peps_jax.config, which is above it"),
        ("peps_jax/storage/files.py", "from peps_jax import config", "imports peps_jax.config, which is above it"),
        ("peps_jax/learning/sac.py", "from peps_jax.learning import dynamics", "nothing of one another"),
        ("peps_jax/gadgets.py", "", "peps_jax.gadgets has no layer"),
    ],
)
def test_a_planted_import_is_caught(tmp_path, file, line, complaint):
    plant(tmp_path, file, line)
    (found,) = violations(tmp_path)
    assert complaint in found


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("peps_jax/train.py", "from peps_jax import rollout, methods"),
        (
            "peps_jax/preferences/synthetic_human.py",
            "from peps_jax.settings import Settings\nfrom peps_jax.config import Config\nimport peps_envs",
        ),
        (
            "peps_jax/learning/surrogate.py",
            "from peps_jax.preferences.data import PreferenceSet\nfrom peps_jax.settings import SurrogateSettings",
        ),
        ("peps_jax/preferences/data.py", "from peps_jax.storage import files\nfrom peps_jax import trajectory"),
        ("peps_jax/round.py", "from peps_jax.settings import ScheduleSettings"),
        ("peps_jax/sweep/command.py", "from peps_jax import Config, evaluate\nimport numpy"),
        ("peps_jax/__init__.py", "from peps_jax.sweep import main"),
    ],
)
def test_an_arrow_downwards_is_not(tmp_path, file, line):
    plant(tmp_path, file, line)
    assert not violations(tmp_path)


def test_modules_are_named_for_what_they_are_about():
    nameless = {"utils", "util", "helpers", "helper", "misc", "common"}
    named = {part for module in source_files(ROOT) for part in module.split(".")}
    folders = ("benchmarks", "benchmarks/peers", "tests")  # what the benchmark installs has names of its own
    named |= {path.stem for folder in folders for path in (ROOT / folder).glob("*.py")}
    assert not named & nameless


def test_importing_the_library_imports_no_other_ecosystem_and_not_matplotlib():
    others = {"brax", "mujoco", "gymnax", "gymnasium", "matplotlib"}
    program = f"import sys, peps_envs, peps_jax; print(*({others} & set(sys.modules)))"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, encoding="utf-8", check=True).stdout
    assert not printed.split()


@pytest.mark.parametrize("command", ["sweep", "reproduce"])
def test_a_command_has_a_device_for_every_core(command):
    """Importing it makes no array: JAX would meet its devices before they are as many as the cores."""
    program = f"""
import os
os.sched_getaffinity = lambda process: range(3)
import peps_jax.{command} as command, peps_jax.command_line, jax
if hasattr(command, "__path__"):
    import peps_jax.{command}.__main__
peps_jax.command_line.use_every_core()
print(jax.device_count())
"""
    environment = {**os.environ, "XLA_FLAGS": ""}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, encoding="utf-8", check=True, env=environment
    )
    assert done.stdout.split() == ["3"]
