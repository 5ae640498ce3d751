"""The page about other ecosystems: each example runs by itself, where its ecosystem is installed, with a short training."""

import contextlib
import io
import re

import pytest
from test_readme import ROOT, shortened, text_of

BLOCKS = re.findall(r"```python\n(.*?)```", text_of(ROOT / "docs" / "bridges.md"), flags=re.DOTALL)
OURS = ("peps_envs", "peps_jax")
LONG = ("train(", "SAC(")


def ecosystems(block: str) -> set[str]:
    """Names of what has to be installed for it."""
    bridged = {"mujoco" if name == "mjx" else name for name in re.findall(r"bridges\.(?:to|from)_(\w+)", block)}
    return bridged | set(re.findall(r"^(?:from|import) (\w+)", block, flags=re.MULTILINE)) - set(OURS)


def name_of(block: str) -> str:
    return "-".join(sorted(ecosystems(block) - {"jax", "numpy"}))


@pytest.mark.filterwarnings("ignore:Brax System:UserWarning", "ignore:Accessing `:DeprecationWarning")
@pytest.mark.parametrize(
    "block",
    [pytest.param(block, marks=pytest.mark.long if any(word in block for word in LONG) else ()) for block in BLOCKS],
    ids=map(name_of, BLOCKS),
)
def test_an_example_runs(block, tmp_path, monkeypatch):
    import jax

    for ecosystem in ecosystems(block):
        pytest.importorskip(ecosystem)
    monkeypatch.chdir(tmp_path)
    code = shortened(block).replace("learning_starts=1_000", "learning_starts=100").replace("=4_000", "=200")
    with contextlib.redirect_stdout(io.StringIO()), jax.numpy_rank_promotion("allow"):
        exec(compile(code, "bridges.md", "exec"), {"__name__": "bridges"})


def test_a_bridge_takes_ten_lines():
    """Beside imports, and a model that one has."""
    for block in BLOCKS:
        code = re.sub(r'XML = """.*?"""\n', "", block, flags=re.DOTALL)
        lines = [line for line in code.splitlines() if line and not line.startswith(("import ", "from "))]
        assert len(lines) <= 10, block
