"""The study's command line."""

import csv
import json
import re
import signal
import sqlite3
import subprocess
import sys

import pytest
from commands import exit_code
from study_cases import Client, answer_to, make_study, rating_of, served

from peps_jax.human_study import commands, tokens
from peps_jax.human_study.settings import Folder

PERSON, SESSION = "5f0c1b2d3e4f5a6b7c8d9e0f", "60a1b2c3d4e5f6a7b8c9d0e1"


@pytest.fixture
def run(capsys):
    """Runs a command; its exit code and what it printed, on stdout and stderr."""

    def run(*arguments):
        code = exit_code(commands.main, *arguments)
        printed = capsys.readouterr()
        return code, printed.out, printed.err

    return run


@pytest.fixture
def folder(tmp_path):
    return make_study(tmp_path / "study", pool=60, pairs=20, agents=("peps", "sac"), scenes=2)


def test_all_commands_are_shown(run):
    code, printed, _ = run("--help")
    assert code == 0
    assert all(f"  {name}" in printed for name in commands.ACTIONS)
    assert run()[:2] == (code, printed)
    for name in commands.ACTIONS:
        assert run(name, "--help")[0] == 0


def test_without_the_extra_it_says_what_to_install():
    program = (
        "import sys; sys.modules['uvicorn'] = None; from peps_jax.human_study.__main__ import main; sys.exit(main([]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, encoding="utf-8")
    assert done.returncode == 2
    assert done.stderr.endswith("error: uvicorn isn't installed: pip install 'peps-jax[study]'\n")


@pytest.mark.slow
def test_a_study_is_made_and_edited(run, tmp_path):
    out = tmp_path / "study"
    code, printed, _ = run("make", "--env", "nav-d4", "--out", out, "--participants", 1, "--pairs", 4, "--repeats", 0)
    assert code == 0
    assert "invite 1 --phase training" in printed
    assert sorted(path.name for path in out.iterdir()) == ["key", "study.sqlite", "study.toml"]
    settings = Folder(out).settings()
    assert (settings.env, settings.test_env, settings.pairs, settings.checks) == ("nav-d4", "nav-d4", 4, 0)
    code, printed, _ = run("invite", 1, "--out", out)
    (token,) = re.findall("#(.*)", printed)
    with served(Folder(out)) as serving:
        client = Client(serving.address, token)
        assert client.begin()["page"] == "pairs"
        assert set(client.get("/api/view")) >= {"width", "height"}
        assert len(client.get("/api/practice")["pairs"]) == 2
        for place in range(4):
            assert client.get("/api/pair")["left"]["steps"] >= 3
            reply = client.post("/api/answer", answer_to(place))
    assert reply["state"]["page"] == "done"
    assert run("make", "--env", "nav-d4", "--out", out)[0] == 2
    code, printed, _ = run("status", "--out", out)
    assert code == 0
    assert "4 of 4" in printed


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["mkae"], "command 'mkae' is unknown: did you mean 'make'?"),
        (["--pairs", "4"], "flag '--pairs' is unknown"),
        (["make", "--env", "nav-d9"], "env 'nav-d9' is unknown: did you mean 'nav-d"),
        (["make", "--env", "nav-d4", "--pairs", "3"], "pairs 3 is odd"),
        (["make", "--env", "nav-d4", "--pairs", "many"], "'many' is not a whole number, such as 200"),
        (["make", "--env", "nav-d4", "--pears", "4"], "flag '--pears' is unknown: did you mean --pairs?"),
        (["invite", "3"], "holds no study: make one first"),
        (["serve"], "holds no study: make one first"),
        (["status"], "holds no study: make one first"),
        (["export"], "holds no study: make one first"),
        (["erase"], "holds no study: make one first"),
    ],
)
def test_bad_input_is_told_in_one_line(run, tmp_path, arguments, complaint):
    out = ["--out", tmp_path / "nothing"]
    code, printed, told = run(*arguments, *out)
    assert code == 2
    assert not printed
    assert complaint in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["invite"], "invite takes a number of links, or --platform"),
        (["invite", 3, "--platform", "prolific"], "invite takes a number of links, or --platform"),
        (["invite", 0], "number 0 is out of range: choose 1 to 1000"),
        (["invite", "many"], "'many' is not a whole number"),
        (["invite", 3, "--phase", "test"], "phase 'test' is unknown: did you mean 'testing'?"),
        (["invite", "--platform", "prolofic"], "platform 'prolofic' is unknown: did you mean 'prolific'?"),
        (["serve", "--port", 99999], "port 99999 of '127.0.0.1' can't be used"),
        (["serve", "--host", "no.such.host.invalid"], "of 'no.such.host.invalid' can't be used"),
    ],
)
def test_bad_flags_of_a_study_are_told_in_one_line(run, folder, arguments, complaint):
    code, _, told = run(*arguments, "--out", folder.path)
    assert code == 2
    assert complaint in told
    assert told.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_server_is_stopped_in_a_line_and_begun_anew(folder, sign, code):
    command = [sys.executable, "-m", "peps_jax.human_study", "serve", "--port", "0", "--out", str(folder.path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8") as process:
        link = process.stdout.readline().removeprefix("researcher: ").strip()
        address, token = link.split("/researcher#")
        assert address.startswith("http://127.0.0.1:")
        client = Client(address, token)
        assert client.get("/api/researcher")["answers"] == 0
        client.close()
        process.send_signal(sign)
        _, told = process.communicate(timeout=30)
    assert process.returncode == code
    assert told.strip() == "stopped: every answer is kept; the same command goes on"


def test_a_port_that_is_taken_is_told(run, folder):
    with served(folder) as serving:
        port = serving.address.rsplit(":", 1)[1]
        code, _, told = run("serve", "--port", port, "--out", folder.path)
    assert code == 2
    assert f"port {port} of '127.0.0.1' can't be used: Address already in use; choose another --port" in told


def test_raters_are_not_invited_before_there_are_scenes(run, tmp_path):
    made = make_study(tmp_path / "study")
    code, _, told = run("invite", 3, "--phase", "testing", "--out", made.path)
    assert code == 2
    assert "phase 'testing' has nothing to rate: train agents first" in told


def test_links_have_a_token_each(run, folder):
    code, printed, _ = run("invite", 15, "--out", folder.path)
    assert code == 0
    assert len(set(printed.splitlines())) == 15
    assert all(re.fullmatch(r"http://127\.0\.0\.1:8200/#[\w-]{32}", line) for line in printed.splitlines())
    content = b"".join(path.read_bytes() for path in folder.path.iterdir())
    assert not any(line.split("#")[1].encode() in content for line in printed.splitlines())


def test_a_platforms_link_is_one_for_all(run, folder):
    first = run("invite", "--platform", "prolific", "--out", folder.path)
    assert first == run("invite", "--platform", "prolific", "--out", folder.path)
    assert "?PROLIFIC_PID={{%PROLIFIC_PID%}}&STUDY_ID={{%STUDY_ID%}}&SESSION_ID={{%SESSION_ID%}}#" in first[1]


@pytest.fixture
def finished(folder, run):
    """A study in which somebody has compared and somebody has rated, both sent by a platform."""
    invite = lambda phase: run("invite", "--platform", "prolific", "--phase", phase, "--out", folder.path)[1]
    links = {phase: invite(phase) for phase in ("training", "testing")}
    with served(folder) as serving:
        for number, (phase, link) in enumerate(links.items()):
            client = Client(serving.address, link.strip().split("#")[1])
            client.begin({"PROLIFIC_PID": f"{PERSON}{number}", "SESSION_ID": SESSION, "STUDY_ID": "study"})
            client.request("POST", "/api/proceed", {"page": "check", "report": {"agent": "Mozilla/5.0"}})
            for place in range(20 if phase == "training" else 4):
                if phase == "training":
                    client.get("/api/pair")
                    client.post("/api/answer", answer_to(place, ("left", "right", "equal")[place % 3]))
                else:
                    client.get("/api/scene")
                    client.post("/api/rating", rating_of(place, place + 1))
    return folder


def test_an_export_holds_no_personal_data(run, finished):
    payments = run("status", "--payments", "--out", finished.path)[1]
    rows = list(csv.DictReader(payments.splitlines()))
    assert [row["PROLIFIC_PID"] for row in rows] == [f"{PERSON}0", f"{PERSON}1"]
    codes = [row["code"] for row in rows]
    code, _, _ = run("export", "--out", finished.path)
    assert code == 0
    exported = {path.name: path.read_text(encoding="utf-8") for path in (finished.path / "export").iterdir()}
    names = {"participants", "queries", "scenes", "answers", "ratings", "importance", "rounds"}
    assert set(exported) == {f"{name}.csv" for name in names} | {"study.json"}
    key = tokens.read_key(finished.key)
    secrets = [
        PERSON,
        SESSION,
        "127.0.0.1",
        "Mozilla",
        "PROLIFIC",
        *codes,
        tokens.identity(key, "prolific", f"{PERSON}0"),
    ]
    for content in exported.values():
        assert not any(secret in content for secret in secrets)
    told = json.loads(exported["study.json"])
    assert {name: len(rows) for name, rows in told.items()} == {
        "participants": 2, "queries": 67, "scenes": 8, "answers": 20, "ratings": 4, "importance": 4, "rounds": 0,
    }  # fmt: skip
    answers = list(csv.DictReader(exported["answers.csv"].splitlines()))
    assert [row["choice"] for row in answers] == [row["choice"] for row in told["answers"]]
    assert {row["agent"] for row in told["ratings"]} == {"peps", "sac"}
    assert all(row["seconds"] >= 0 for row in told["answers"])


def test_erase_removes_the_platforms_ids_for_good(run, finished):
    everything = lambda: b"".join(path.read_bytes() for path in finished.path.glob("study.sqlite*"))
    assert PERSON.encode() in everything()
    assert run("erase", "--out", finished.path)[1].startswith("2 platform ids removed")
    assert PERSON.encode() not in everything()
    assert SESSION.encode() not in everything()
    rows = list(csv.DictReader(run("status", "--payments", "--out", finished.path)[1].splitlines()))
    assert [row["PROLIFIC_PID"] for row in rows] == ["", ""]
    assert all(row["code"] for row in rows)


def test_status_tells_of_a_damaged_database(run, finished):
    connection = sqlite3.connect(finished.database)
    connection.execute("DELETE FROM answer")
    connection.commit()
    connection.close()
    code, _, told = run("status", "--out", finished.path)
    assert code == 1
    assert told.startswith("damaged: ")
