"""A server that is killed loses nothing; benchmarks/study_server.py does this at length."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "study_server.py"


@pytest.mark.slow
def test_no_acknowledged_answer_is_lost(tmp_path):
    out = tmp_path / "measured.json"
    command = [sys.executable, str(BENCHMARK), "--clients", "6", "--answers", "8", "--kills", "2", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stdout + done.stderr
    killed = json.loads(out.read_text(encoding="utf-8"))["killed"]
    assert (killed["answers"], killed["kills"]) == (48, 2)
    assert [killed[name] for name in ("lost", "changed", "doubled", "asked_twice", "wrong")] == [0, 0, 0, 0, []]
    assert killed["integrity"] == ["ok"]
