"""What the command lines share: text for whatever terminal there is, devices, waiting, complaints of one line, exit codes."""

import ast
import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from peps_jax import command_line
from peps_jax.execution import batches, checkpoints, machine, waiting
from peps_jax.execution.progress import Display
from peps_jax.storage import files

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


PROCESSES = ("run", "Popen", "call", "check_call", "check_output")


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
            or (name in PROCESSES and bool({"text", "universal_newlines"} & given.keys()))
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


@pytest.mark.parametrize("arguments", [["--help"], ["--env", "nowhere"]])
def test_who_prints_for_nobody_ends_quietly(arguments):
    """`peps-sweep --help | head -1`: no stack, and no complaint of Python's as it ends."""
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, "-m", "peps_jax.sweep", *arguments]
    done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT, check=False, timeout=300)
    os.close(writer)
    assert done.returncode == (0 if arguments == ["--help"] else 2)
    assert done.stderr.count(b"\n") == (0 if arguments == ["--help"] else 1)


def test_work_that_prints_for_nobody_is_kept(monkeypatch, capfd):
    class Prints:
        name, makes_checkpoints, told = "", False, []

        def run(self, stop):
            raise BrokenPipeError

        def kept(self):
            self.told.append("kept")

        writing = staticmethod(contextlib.nullcontext)

        def close(self):
            self.told.append("closed")

    monkeypatch.setattr(command_line, "_print_no_more", lambda: None)
    monkeypatch.setattr(command_line, "use_every_core", lambda: None)
    assert command_line.Command("command", list, lambda flags: Prints()).carry_out([]) == 141
    assert Prints.told == ["kept", "closed"]
    assert capfd.readouterr() == ("", "")


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
    for name in ("results.csv", "runs/nav-d1-sac-seed0.msgpack"):
        assert (tmp_path / "größe" / name).read_bytes() == (folder / name).read_bytes()
    assert "größe" in _command(tmp_path / "größe")


# --- devices and waiting --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", ["peps_jax.sweep", "peps_jax.reproduce"])
def test_an_accelerator_that_is_not_there_is_one_line(module, tmp_path):
    nothing = {"JAX_PLATFORMS": "cuda", "CUDA_VISIBLE_DEVICES": ""}
    done = run(module, "--out", tmp_path / "out", **nothing)
    error = done.stderr.decode("utf-8")
    assert done.returncode == 2
    assert error.startswith(f"python -m {module}: error: JAX found no cuda device on ")
    assert error.count("\n") == 1
    assert "JAX_PLATFORMS is 'cuda'" in error
    assert not (tmp_path / "out").exists()
    assert run(module, "--help", **nothing).returncode == 0


def test_a_driver_that_does_not_answer_is_said(monkeypatch, capsys):
    answer = threading.Event()
    monkeypatch.setattr(machine.jax, "devices", answer.wait)
    monkeypatch.setattr(machine, "WAIT", 0.3)
    monkeypatch.setattr(waiting, "EVERY", 0.2)
    with pytest.raises(ValueError, match=r"JAX found no cpu device on .* in 0 s \(no answer\)"):
        machine.meet_devices()
    assert capsys.readouterr().err.startswith("waiting for JAX to find its devices on ")
    answer.set()


BROKEN = """
import os
def initialize():
    os.write(2, b"I0000 00:00:17 stub.cc:31] Could not find drivers\\n")
    raise RuntimeError("Unable to load CUDA. Is it installed?")
"""


@pytest.mark.parametrize(("platforms", "code"), [("cuda", 2), ("", 0)])
def test_a_broken_plugin_is_one_line_unless_the_processor_will_do(platforms, code, tmp_path):
    plugin = tmp_path / "jax_plugins" / "broken"
    plugin.mkdir(parents=True)
    (plugin / "__init__.py").write_text(BROKEN, encoding="utf-8")
    program = "from peps_jax.execution import machine; machine.meet_devices()"
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"JAX_PLATFORMS": platforms, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, cwd=ROOT, env=environment, check=False)
    error = done.stderr.decode("utf-8")
    assert "Unable to load CUDA. Is it installed?" in error
    if code:
        assert error.splitlines()[-1].startswith("ValueError: JAX found no cuda device on ")
        assert "stub.cc" not in error
    else:
        assert done.returncode == 0
        assert "stub.cc" in error


def test_reminders_come_as_long_as_it_lasts(monkeypatch, capsys):
    monkeypatch.setattr(waiting, "EVERY", 0.2)
    with waiting.Reminder("thinking") as reminder:
        time.sleep(0.5)
        reminder.about(lambda: "doing")
        time.sleep(0.3)
    time.sleep(0.3)
    assert capsys.readouterr().err.splitlines() == ["thinking, 0 s so far", "thinking, 0 s so far", "doing, 0 s so far"]


def test_what_is_soon_done_has_no_reminder(capsys):
    with waiting.Reminder("thinking"):
        pass
    assert capsys.readouterr().err == ""


def test_long_compilation_rounds_and_evaluation_say_so(tiny, monkeypatch, capsys):
    monkeypatch.setattr(waiting, "EVERY", 0.2)
    batch = batches.Batch((0,), 1, ())
    curves = {name: np.zeros((1, 2)) for name in ("episodes", "return_", "explicability")}
    with Display([tiny], [batch]) as display:
        display.compiling(batch)
        time.sleep(0.3)
        display.start(batch)
        display.advanced(batch, 2, curves, None)
        time.sleep(0.3)
        display.advanced(batch, 4, curves, None)
        time.sleep(0.3)
    said = [line for line in capsys.readouterr().err.splitlines() if "so far" in line]
    assert said == [
        "compiling peps, 1 run, 0 s so far",
        "training peps, 1 run: 2 rounds are done, the next ones take, 0 s so far",
        "evaluating peps, 1 run, 0 s so far",
    ]


def _command(folder: Path) -> str:
    """The command that a folder's manifest tells."""
    return json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["command"]


# --- from call to exit code -----------------------------------------------------------------------------------------------


class Errand:
    """Work that a test gives."""

    name, makes_checkpoints = "process 3", False

    def __init__(self, act, makes_checkpoints: bool = False):
        self._act, self.makes_checkpoints = act, makes_checkpoints
        self.told: list[str] = []

    def run(self, stop: threading.Event) -> int:
        return self._act(stop)

    def kept(self) -> str:
        self.told.append("kept")
        return "2 of 3 are kept"

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def close(self) -> None:
        self.told.append("closed")


def carry_out(errand: Errand) -> int:
    return command_line.Command("a command", list, lambda flags: errand).carry_out([])


def raising(error: BaseException):
    """Work that ends with that."""

    def act(stop: threading.Event) -> int:
        raise error

    return act


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (KeyboardInterrupt(), 130, "\nprocess 3 stopped: 2 of 3 are kept\n"),
        (command_line.StoppedError(), 143, "\nprocess 3 stopped: 2 of 3 are kept\n"),
        (files.NotWrittenError("no room"), 2, "a command: error: no room; 2 of 3 are kept\n"),
        (checkpoints.IncompatibleError("another\nversion"), 2, "a command: error: another version; 2 of 3 are kept\n"),
        (files.OwnershipLostError("lost"), 2, "a command: error: lost\n"),
    ],
)
def test_what_ends_work_is_one_line_and_a_code(error, code, said, capsys):
    errand = Errand(raising(error))
    assert carry_out(errand) == code
    assert capsys.readouterr().err == said
    assert errand.told[-1] == "closed"


def test_a_fault_in_the_code_keeps_its_stack(capsys):
    errand = Errand(raising(ValueError("a fault")))
    with pytest.raises(ValueError, match="a fault"):
        carry_out(errand)
    assert capsys.readouterr().err == "failed: 2 of 3 are kept\n"
    assert errand.told == ["kept", "closed"]


def test_sigterm_interrupts_work_that_makes_no_checkpoint(capsys):
    def act(stop: threading.Event) -> int:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)
        raise AssertionError("went on")

    before = signal.getsignal(signal.SIGTERM)
    assert carry_out(Errand(act)) == 143
    assert signal.getsignal(signal.SIGTERM) is before


def test_sigterm_waits_for_a_checkpoint():
    def act(stop: threading.Event) -> int:
        assert not stop.is_set()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(10)
        return 7

    assert carry_out(Errand(act, makes_checkpoints=True)) == 7


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ValueError("seeds 0 is\n too few"), 2, "a command: error: seeds 0 is too few\n"),
        (files.NotWrittenError("no permission"), 2, "a command: error: no permission\n"),
        (KeyboardInterrupt(), 130, "\nstopped before anything was begun\n"),
        (command_line.StoppedError(), 143, "\nstopped before anything was begun\n"),
    ],
)
def test_what_ends_the_preparation_is_one_line_and_a_code(error, code, said, capsys):
    assert command_line.Command("a command", list, raising(error)).carry_out([]) == code
    assert capsys.readouterr().err == said


SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]


@pytest.mark.parametrize(
    ("script", "module"), [("peps-sweep", "peps_jax.sweep"), ("peps-reproduce", "peps_jax.reproduce")]
)
def test_help_names_the_command_that_was_called(script, module):
    place, _, function = SCRIPTS[script].partition(":")
    program = (
        f"import sys; sys.argv = ['/somewhere/bin/{script}', '--help']; from {place} import {function} as main; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=os.environ, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    text = done.stdout.decode("utf-8")
    assert text.startswith(f"usage: {script} [")
    assert f"python -m {module}" not in text
    called = run(module, "--help").stdout.decode("utf-8")
    assert called.startswith(f"usage: python -m {module} [")
    assert called.replace(f"python -m {module}", script) == text
