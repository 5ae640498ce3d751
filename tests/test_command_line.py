"""What the command lines share: text for whatever terminal there is, devices, waiting, complaints of one line, exit codes."""

import ast
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from peps_jax import command_line

ROOT = Path(__file__).parents[1]
TINY = [
    *("--env", "nav-d1", "--method", "sac", "--seeds", "1", "--total-steps", "160", "--episodes", "4"),
    *("--num-envs", "4", "--rollout-length", "10", "--warmup-steps", "40", "--batch-size", "16"),
    *("--updates-per-step", "0.1", "--hidden-sizes", "8", "--model-hidden-sizes", "8", "--ensemble-size", "3"),
]


def run(module: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """`python -m module`, with these variables changed."""
    words = [sys.executable, "-m", module, *arguments]
    return subprocess.run(words, capture_output=True, env=os.environ | environment, cwd=ROOT, timeout=300, check=False)


# --- text -----------------------------------------------------------------------------------------------------------------

ASCII = {
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
}  # nothing but ASCII, in files' names and in print


def text_without_encoding(path: Path) -> list[str]:
    """One line for each call in a source that reads or writes text as the locale would have it."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        given = {keyword.arg: keyword.value for keyword in node.keywords}
        modes = [one.value for one in (*node.args[:2], given.get("mode")) if isinstance(one, ast.Constant)]
        modes = [mode for mode in modes if isinstance(mode, str) and mode and set(mode) <= set("rwxabt+")]
        opened = isinstance(node.func, ast.Name) and name == "open"
        default = "r" if opened else "w+b"  # what `open` does without a mode, and what `tempfile` does
        text = (
            name in ("read_text", "write_text")
            or (
                (opened or name in ("NamedTemporaryFile", "TemporaryFile", "fdopen"))
                and "b" not in "".join(modes or [default])
            )
            or (name == "open" and modes and "b" not in "".join(modes))
            or bool({"text", "universal_newlines"} & given.keys())
        )
        if text and not {"encoding", None} & given.keys():  # None: **options
            lines.append(f"{path}:{node.lineno} {name} without an encoding")
    return lines


def sources() -> list[Path]:
    return [path for folder in ("peps_jax", "envs", "benchmarks", "tests") for path in (ROOT / folder).rglob("*.py")]


def test_every_text_file_has_an_encoding():
    checked = [path for path in sources() if ".peers" not in path.parts]
    assert len(checked) > 100
    assert not [line for path in checked for line in text_without_encoding(path)]


@pytest.mark.parametrize(
    "line",
    [
        "path.read_text()",
        "path.write_text('')",
        "open(path)",
        "open(path, 'w', newline='')",
        "path.open('w')",
        "tempfile.TemporaryFile('w+')",
        "subprocess.run(words, text=True)",
        "subprocess.Popen(words, universal_newlines=True)",
    ],
)
def test_text_without_an_encoding_is_found(line, tmp_path):
    source = tmp_path / "source.py"
    source.write_text(line, encoding="utf-8")
    assert len(text_without_encoding(source)) == 1
    source.write_text(line.replace(")", ", encoding='utf-8')").replace("(, ", "("), encoding="utf-8")
    assert not text_without_encoding(source)


@pytest.mark.parametrize("line", ["open(path, 'rb')", "tempfile.TemporaryFile()", "path.read_bytes()", "store.open()"])
def test_bytes_need_none(line, tmp_path):
    source = tmp_path / "source.py"
    source.write_text(line, encoding="utf-8")
    assert not text_without_encoding(source)


def test_what_cannot_be_shown_is_replaced(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", None)
    command_line.print_whatever_can_be_shown()
    print("1.0 ± 0.5 – λ 水, in gr\udcc3\udcb6n")
    out.flush()
    assert out.buffer.getvalue() == "1.0 +- 0.5 - lambda ?, in grön\n".encode()


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep's folder, made with UTF-8; where compiled programs are kept; and the sweep's output."""
    folder = tmp_path_factory.mktemp("utf-8")
    kept = str(folder / "kept")
    done = run("peps_jax.sweep", *TINY, "--checkpoint-every", "0", "--out", folder / "größe", PEPS_JAX_CACHE=kept)
    assert done.returncode == 0, done.stderr
    return folder / "größe", kept, done.stdout.decode("utf-8")


@pytest.mark.parametrize("environment", [ASCII, {"PYTHONIOENCODING": "ascii"}], ids=["locale", "terminal"])
def test_a_sweep_needs_no_utf_8(environment, swept, tmp_path):
    folder, kept, printed = swept
    assert "±" in printed
    arguments = [*TINY, "--checkpoint-every", "0", "--out", tmp_path / "größe"]
    done = run("peps_jax.sweep", *arguments, PEPS_JAX_CACHE=kept, **environment)
    assert done.returncode == 0, done.stderr
    assert b"+-" in done.stdout
    assert not [byte for byte in done.stdout.replace(os.fsencode(tmp_path / "größe"), b"") if byte > 127]
    names = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    assert sorted(path.relative_to(tmp_path / "größe") for path in (tmp_path / "größe").rglob("*")) == names
    for name in ("results.csv", "cells/nav-d1-sac-seed0.msgpack"):
        assert (tmp_path / "größe" / name).read_bytes() == (folder / name).read_bytes()
    assert "größe" in _command(tmp_path / "größe")


def _command(folder: Path) -> str:
    """The command that a folder's manifest tells."""
    return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["command"]
