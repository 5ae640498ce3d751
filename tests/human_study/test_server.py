"""What the pages ask for, over HTTP."""

import copy
import json
import re
import socket
import sqlite3
import threading
import uuid

import pytest
from study_cases import Client, answer_to, invite, make_study, rating_of, served, stimuli

from peps_jax.human_study import tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.server import HEADERS, LARGEST, Study
from peps_jax.human_study.serving import Serving

AGENTS = ("peps", "sac", "drlhp")
CHOICES = ("left", "right", "equal", "unclear")
PARTICIPANTS = [
    ("GET", "/api/state", None),
    ("POST", "/api/consent", {"agreed": True, "platform": {}}),
    ("POST", "/api/proceed", {"page": "check"}),
    ("GET", "/api/practice", None),
    ("POST", "/api/importance", {"answers": {}, "request": str(uuid.uuid4())}),
    ("GET", "/api/view", None),
    ("GET", "/api/pair", None),
    ("POST", "/api/answer", answer_to(0)),
    ("GET", "/api/scene", None),
    ("POST", "/api/rating", rating_of(0)),
]
RESEARCHERS = [
    ("GET", "/api/researcher", None),
    ("GET", "/api/researcher/picture", None),
    ("POST", "/api/researcher/close_round", {"round": 0}),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_study(tmp_path_factory.mktemp("studies") / "study", pool=400, pairs=20, agents=AGENTS, scenes=2)


@pytest.fixture(scope="module")
def serving(folder):
    with served(folder) as made:
        yield made


@pytest.fixture
def come(serving, folder):
    """A participant of a phase who has begun, or hasn't."""

    def come(phase="training", begun=True):
        client = Client(serving.address, *invite(folder, phase=phase))
        if begun:
            client.begin()
        return client

    yield come
    serving.study.guesses = tokens.WrongGuesses()  # wrong tokens of one test aren't another one's


@pytest.fixture
def researcher(serving):
    return Client(serving.address, tokens.derived(serving.study.key, "researcher"))


# --- from start to end ----------------------------------------------------------------------------------------------------------


def test_a_participant_from_start_to_end(serving, come):
    client = come(begun=False)
    assert client.get("/api/state")["page"] == "consent"
    assert client.begin()["page"] == "pairs"
    sides = []
    for place in range(20):
        pair = client.get("/api/pair")
        assert (pair["place"], pair["total"]) == (place, 20)
        assert client.get("/api/pair") == pair
        assert pair["left"]["clip"] == pair["right"]["clip"]
        sides.append(pair["left"]["side"])
        status, reply = client.answer(place, CHOICES[place % 4])
        assert status == 200
        assert reply["state"]["progress"] == {"done": place + 1, "total": 20}
    assert sum(sides) == 10
    state = reply["state"]
    assert (state["page"], state["outcome"]) == ("done", "finished")
    assert re.fullmatch("[A-Z2-7]{8}", state["code"])
    assert client.get("/api/state") == state
    assert client.get("/api/pair") == {"done": True}
    assert not serving.study.database.check_integrity()


def test_a_rater_from_start_to_end(come):
    client = come("testing", begun=False)
    assert client.begin()["page"] == "ratings"
    seen = []
    for place in range(6):
        scene = client.get("/api/scene")
        assert scene == client.get("/api/scene")
        assert set(scene) == {"place", "total", "clip"}
        seen.append(scene["clip"]["clip"])
        reply = client.post("/api/rating", rating_of(place, 1 + place))
    assert len(set(seen)) == 6
    assert reply["state"]["page"] == "done"


def test_nothing_that_participants_get_tells_an_agents_label(come):
    client = come("testing", begun=False)
    told = json.dumps(client.get("/api/state"))
    told += json.dumps(
        [client.begin(), client.get("/api/scene"), client.get("/api/view"), client.post("/api/rating", rating_of(0))]
    )
    assert not any(agent in told for agent in AGENTS)


def test_looking_begins_nothing(serving, come):
    client = come(begun=False)
    for path in ("/api/state", "/api/view", "/"):
        client.request("GET", path)
    assert client.get("/api/state")["progress"] == {"done": 0, "total": 0}
    assert client.request("GET", "/api/pair")[0] == 403


def test_who_declines_may_change_their_mind(come):
    client = come(begun=False)
    state = client.post("/api/consent", {"agreed": False, "platform": {}})
    assert (state["page"], state["outcome"], state["code"]) == ("done", "declined", None)
    assert client.get("/api/state") == state
    assert client.request("GET", "/api/pair")[0] == 403
    assert client.begin()["page"] == "pairs"
    status, reply = client.request("POST", "/api/consent", {"agreed": False, "platform": {}})
    assert (status, reply["error"]) == (409, "You have agreed already: to stop, close the page.")


def test_pages_come_in_their_order(come):
    client = come(begun=False)
    client.post("/api/consent", {"agreed": True, "platform": {}})
    assert client.request("POST", "/api/proceed", {"page": "instructions"})[0] == 409
    assert client.request("GET", "/api/pair")[0] == 409
    assert client.post("/api/proceed", {"page": "check", "report": {"fps": 59.9}})["page"] == "instructions"
    assert client.post("/api/proceed", {"page": "check"})["page"] == "instructions"  # a page that was left open
    ratings = {
        "answers": dict.fromkeys(("speed", "distance", "relative_speed", "lane"), 3),
        "request": str(uuid.uuid4()),
    }
    assert client.request("POST", "/api/importance", ratings)[0] == 409
    assert client.post("/api/proceed", {"page": "instructions"})["page"] == "importance"
    assert client.post("/api/importance", ratings)["page"] == "pairs"
    assert client.post("/api/importance", ratings)["page"] == "pairs"
    other = copy.deepcopy(ratings)
    other["answers"]["speed"] = 5
    assert client.request("POST", "/api/importance", other)[0] == 409
    assert client.request("POST", "/api/importance", other | {"request": str(uuid.uuid4())})[0] == 409
    assert client.get("/api/practice")["pairs"][0].keys() == {"left", "right"}


def test_importance_may_be_taken_out_meanwhile(tmp_path):
    folder = make_study(tmp_path / "study", pairs=20)
    (token,) = invite(folder)
    with served(folder) as serving:
        client = Client(serving.address, token)
        client.post("/api/consent", {"agreed": True, "platform": {}})
        client.post("/api/proceed", {"page": "check"})
        assert client.post("/api/proceed", {"page": "instructions"})["page"] == "importance"
    folder.file.write_text(folder.file.read_text(encoding="utf-8").split("[[importance]]")[0], encoding="utf-8")
    with served(folder) as serving:
        client = Client(serving.address, token)
        assert client.post("/api/proceed", {"page": "instructions"})["page"] == "pairs"
        assert client.get("/api/pair")["place"] == 0


# --- answers ------------------------------------------------------------------------------------------------------------------


def test_a_request_again_gets_the_same_reply_and_another_is_refused(come):
    client = come()
    client.get("/api/pair")
    body = answer_to(0)
    first = client.post("/api/answer", body)
    assert client.post("/api/answer", body) == first
    for change in ({"choice": "right"}, {"request": str(uuid.uuid4())}, {"place": 1}, {"reaction_ms": 1}):
        assert client.request("POST", "/api/answer", body | change)[0] == 409
    assert client.get("/api/state")["progress"]["done"] == 1


def test_five_clicks_at_once_store_one(serving, come):
    client = come()
    client.get("/api/pair")
    clicks = [Client(serving.address, client.token) for _ in range(5)]
    statuses = []
    threads = [threading.Thread(target=lambda one=one: statuses.append(one.answer(0)[0])) for one in clicks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200, 409, 409, 409, 409]
    assert client.get("/api/state")["progress"]["done"] == 1


@pytest.mark.parametrize("frames", [{"left": 0, "right": 9}, {"left": 9, "right": 0}])
def test_what_was_not_drawn_cannot_be_judged(come, frames):
    client = come()
    client.get("/api/pair")
    status, reply = client.answer(0, frames=frames)
    assert (status, reply["error"]) == (400, "frames of a side are 0: it wasn't drawn, and can't be judged")
    assert client.get("/api/state")["progress"]["done"] == 0


def test_two_tabs_are_shown_the_same(serving, come):
    client = come()
    other = Client(serving.address, client.token)
    assert client.get("/api/pair") == other.get("/api/pair")
    assert client.answer(0)[0] == 200
    assert other.answer(0)[0] == 409
    assert other.get("/api/pair")["place"] == 1


# --- who may do what ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("token", [None, "", "wrong", "x" * 5000, "' OR 1=1 --", "é"])
def test_without_a_right_token_nothing_is_told(serving, come, token):
    client = Client(serving.address, None)
    headers = {} if token is None else {"Authorization": f"Bearer {token}".encode("latin-1")}
    for method, path, body in PARTICIPANTS + RESEARCHERS:
        status, reply = client.request(method, path, body, headers)
        assert status == 401
        assert set(reply) == {"error"}


def test_a_token_in_other_places_is_none(serving, come):
    own = come(begun=False).token
    client = Client(serving.address, None)
    for path, headers in (
        (f"/api/state?token={own}", {}),
        ("/api/state", {"Cookie": f"token={own}"}),
        ("/api/state", {"Authorization": own}),
        ("/api/state", {"Authorization": f"Basic {own}"}),
        ("/api/state", {"Authorization": f"Bearer {tokens.digest(own)}"}),
    ):
        assert client.request("GET", path, headers=headers)[0] == 401


def test_participants_may_nothing_that_is_the_researchers(come):
    for client in (come(), come("testing"), come(begun=False)):
        for method, path, body in RESEARCHERS:
            assert client.request(method, path, body)[0] == 403


def test_the_researcher_takes_no_part(researcher):
    for method, path, body in PARTICIPANTS:
        assert researcher.request(method, path, body)[0] == 403


def test_a_token_of_the_other_phase_is_refused(come):
    trainer, rater = come(), come("testing")
    importance = {
        "answers": dict.fromkeys(("speed", "distance", "relative_speed", "lane"), 3),
        "request": str(uuid.uuid4()),
    }
    for method, path, body in (
        ("GET", "/api/pair", None),
        ("GET", "/api/practice", None),
        ("POST", "/api/answer", answer_to(0)),
        ("POST", "/api/importance", importance),
    ):
        assert rater.request(method, path, body)[0] == 403
    assert trainer.request("GET", "/api/scene")[0] == 403
    assert trainer.request("POST", "/api/rating", rating_of(0))[0] == 403
    assert trainer.get("/api/view") == {"of": "training"}
    assert rater.get("/api/view") == {"of": "testing"}


def test_a_token_acts_for_its_owner_alone(come):
    one, other = come(), come()
    one.get("/api/pair")
    body = answer_to(0)
    assert one.request("POST", "/api/answer", body)[0] == 200
    assert other.request("POST", "/api/answer", body)[0] == 409
    assert other.get("/api/state")["progress"]["done"] == 0


def test_wrong_guesses_are_limited(serving, come):
    known, fresh = come(), come(begun=False)
    guesser = Client(serving.address, "guess")
    for number in range(tokens.WRONG):
        guesser.token = f"guess {number}"
        assert guesser.request("GET", "/api/state")[0] == 401
    assert guesser.request("GET", "/api/state")[0] == 429
    assert fresh.request("GET", "/api/state")[0] == 429
    assert known.request("GET", "/api/state")[0] == 200


# --- bodies -------------------------------------------------------------------------------------------------------------------

UNKNOWN, MISSING = object(), object()
WRONG = [None, True, -1, 1.5, 10**30, "", "left; DROP TABLE answer", [], {}, ["left"], {"left": 1}]
FIELDS = [
    ("/api/answer", answer_to(0), "place"),
    ("/api/answer", answer_to(0), "choice"),
    ("/api/answer", answer_to(0), "frames"),
    ("/api/answer", answer_to(0), "request"),
    ("/api/answer", answer_to(0), "replays"),
    ("/api/answer", answer_to(0), "reaction_ms"),
    ("/api/answer", answer_to(0), "hidden_ms"),
]


@pytest.mark.parametrize(("path", "right", "field"), FIELDS)
def test_wrong_values_are_refused(come, path, right, field):
    client = come()
    client.get("/api/pair")
    for value in WRONG:
        if field.endswith("_ms") and value == 1.5:
            continue  # as browsers measure
        status, reply = client.request("POST", path, right | {field: value})
        assert status == 400, (field, value)
        assert "\n" not in reply["error"]
    without = {name: value for name, value in right.items() if name != field}
    assert client.request("POST", path, without)[0] == 400
    assert client.request("POST", path, right | {f"{field}2": 1})[0] == 400
    assert client.get("/api/state")["progress"]["done"] == 0


@pytest.mark.parametrize("rating", [0, 11, 5.5, "5", None, True, [5]])
def test_wrong_ratings_are_refused(come, rating):
    client = come("testing")
    client.get("/api/scene")
    assert client.request("POST", "/api/rating", rating_of(0) | {"rating": rating})[0] == 400
    assert client.request("POST", "/api/rating", rating_of(0) | {"frames": 0})[0] == 400


@pytest.mark.parametrize("body", [{}, [], {"round": "0"}, {"round": -1}, {"round": None}, {"round": 0, "why": "x"}])
def test_wrong_rounds_are_refused(researcher, body):
    assert researcher.request("POST", "/api/researcher/close_round", body)[0] == 400


@pytest.mark.parametrize(
    "body",
    [
        {}, [], 3, None, "x", {"agreed": True}, {"agreed": 1, "platform": {}}, {"agreed": True, "platform": []},
        {"agreed": True, "platform": {}, "phase": "label"}, {"agreed": True, "platform": {"PROLIFIC_PID": 3}},
        {"agreed": True, "platform": {"PROLIFIC_PID": ""}}, {"agreed": True, "platform": {"PROLIFIC_PID": "x" * 201}},
        {"agreed": True, "platform": {"pid": "x"}},
    ],
)  # fmt: skip
def test_wrong_consents_are_refused(come, body):
    client = come(begun=False)
    status, _ = client.request("POST", "/api/consent", b"null" if body is None else body)
    assert status == 400
    assert client.get("/api/state")["page"] == "consent"


@pytest.mark.parametrize(
    "report", [3, [], {"x": []}, {"x": {}}, {"x": "y" * 201}, {"x" * 201: 1}, {str(name): 1 for name in range(31)}]
)
def test_wrong_reports_are_refused(come, report):
    client = come(begun=False)
    client.post("/api/consent", {"agreed": True, "platform": {}})
    assert client.request("POST", "/api/proceed", {"page": "check", "report": report})[0] == 400


@pytest.mark.parametrize(
    "answers",
    [{}, [], {"speed": 3}, dict.fromkeys(("speed", "distance", "relative_speed", "lane", "other"), 3)]
    + [dict.fromkeys(("speed", "distance", "relative_speed", "lane"), value) for value in (0, 6, 2.5, "3", None, True)],
)
def test_wrong_importance_is_refused(come, answers):
    client = come()
    assert client.request("POST", "/api/importance", {"answers": answers, "request": str(uuid.uuid4())})[0] == 400


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b'{"agreed": NaN, "platform": {}}', b"[" * 9000])
def test_what_is_no_json_is_refused(come, content):
    assert come(begun=False).request("POST", "/api/consent", content)[0] == 400


def test_other_content_types_are_refused(come):
    body = b'{"agreed": true, "platform": {}}'
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        assert come(begun=False).request("POST", "/api/consent", body, {"Content-Type": kind})[0] == 400


def test_large_bodies_are_refused(serving, come):
    client = come(begun=False)
    assert client.request("POST", "/api/consent", b" " * (LARGEST + 1))[0] == 413
    client.close()
    host, port = serving.address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=20) as raw:
        head = (
            f"POST /api/consent HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.token}\r\n"
            "Content-Type: application/json\r\nTransfer-Encoding: chunked\r\nConnection: close\r\n\r\n"
        )
        raw.sendall(head.encode() + (b"2000\r\n" + b" " * 8192 + b"\r\n") * 3 + b"0\r\n\r\n")
        assert b" 413 " in raw.recv(4096)


@pytest.mark.parametrize(
    "text", ["'; DROP TABLE participant; --", "<script>alert(1)</script>", "\0", "ü\ud800", "%s{x}"]
)
def test_hostile_texts_do_no_harm(serving, come, researcher, text):
    client = come(begun=False)
    platform = {"PROLIFIC_PID": text + str(uuid.uuid4()), "SESSION_ID": text}
    status, _ = client.request("POST", "/api/consent", {"agreed": True, "platform": platform})
    assert status in (200, 400)
    client.request("POST", "/api/proceed", {"page": "check", "report": {text: text}})
    client.request("POST", "/api/proceed", {"page": text})
    client.request("POST", "/api/answer", answer_to(0) | {"choice": text, "request": text})
    assert researcher.get("/api/researcher")["participants"]
    assert not serving.study.database.check_integrity()


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py", "/static/..%2fserver.py", "/static/%2e%2e/server.py", "/static/", "/static/x.py", "/key",
        "/study.sqlite",
    ],
)  # fmt: skip
def test_only_the_pages_files_are_served(serving, path):
    assert Client(serving.address, None).request("GET", path)[0] == 404


def test_other_methods_are_refused(come):
    client = come()
    for method, path in (
        ("POST", "/api/pair"),
        ("GET", "/api/answer"),
        ("DELETE", "/api/state"),
        ("PUT", "/api/consent"),
    ):
        assert client.request(method, path)[0] == 405


def test_what_cannot_be_kept_is_not_acknowledged(serving, come, monkeypatch, capsys):
    client = come()
    client.get("/api/pair")

    def full(*values, **named):
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(serving.study.database, "answer", full)
    body = answer_to(0)
    assert client.request("POST", "/api/answer", body)[0] == 503
    monkeypatch.undo()
    assert client.get("/api/state")["progress"]["done"] == 0
    assert client.request("POST", "/api/answer", body)[0] == 200
    assert "disk is full" in capsys.readouterr().err


def test_every_error_is_a_line_of_json(come):
    client = come()
    for method, path in (("GET", "/api/nothing"), ("POST", "/api/state"), ("GET", "/static/nothing.js")):
        status, reply = client.request(method, path)
        assert status in (404, 405)
        assert set(reply) == {"error"}


def test_every_reply_forbids_what_pages_do_not_need(serving, come):
    client = come()
    for path in ("/", "/api/state", "/api/nothing", "/static/nothing.js", "/api/researcher"):
        client.request("GET", path)
        assert {name: client.headers[name.lower()] for name in HEADERS} == HEADERS
        assert "set-cookie" not in client.headers
        assert "server" not in client.headers
    assert "unsafe" not in HEADERS["Content-Security-Policy"]


def test_nobody_but_this_machine_is_listened_to(serving):
    assert serving.address.startswith("http://127.0.0.1:")
    assert serving._socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize(("behind", "statuses"), [(True, {401}), (False, {401, 429})])
def test_where_requests_come_from_is_believed_of_a_proxy_alone(folder, behind, statuses):
    serving = Serving(Study(folder), behind_proxy=behind)
    try:
        with serving.in_background():
            client = Client(serving.address, "wrong")
            found = {
                client.request("GET", "/api/state", headers={"X-Forwarded-For": f"10.0.0.{number}"})[0]
                for number in range(tokens.WRONG + 5)
            }
            client.close()
    finally:
        serving.close()
    assert found == statuses


def test_ids_are_erased_beside_a_running_server(platform_link, folder, serving):
    client = platform_link()
    client.begin(sent("erasable person", "session"))
    pair = client.get("/api/pair")
    database = Database(folder.database)
    assert database.erase() >= 1
    database.close()
    everything = b"".join(path.read_bytes() for path in folder.path.glob("study.sqlite*"))
    assert b"erasable" not in everything
    assert client.get("/api/pair") == pair


# --- platforms ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def platform_link(folder, serving):
    """Somebody who comes by the link of a platform."""

    def come(phase="training", platform="prolific"):
        token = tokens.derived(serving.study.key, f"{platform} {phase}")
        serving.study.database.add_link(tokens.digest(token), phase, platform)
        return Client(serving.address, token)

    return come


def sent(person, session):
    return {"PROLIFIC_PID": person, "SESSION_ID": session, "STUDY_ID": "study"}


def test_who_comes_from_a_platform_gets_a_token_of_their_own(platform_link):
    client = platform_link()
    assert client.get("/api/state")["page"] == "consent"
    link = client.token
    assert client.begin(sent("person 1", "session"))["page"] == "pairs"
    assert client.token != link
    pair = client.get("/api/pair")
    again = platform_link()
    again.post("/api/consent", {"agreed": True, "platform": sent("person 2", "session 2")})
    back = platform_link()
    state = back.post("/api/consent", {"agreed": True, "platform": sent("person 1", "session")})
    assert (state["page"], state["token"]) == ("pairs", client.token)
    back.token = state["token"]
    assert back.get("/api/pair") == pair


def test_nobody_takes_part_twice(platform_link):
    platform_link().begin(sent("person 3", "session"))
    for phase, session in (("training", "session 2"), ("testing", "session"), ("testing", "session 3")):
        status, reply = platform_link(phase).request(
            "POST", "/api/consent", {"agreed": True, "platform": sent("person 3", session)}
        )
        assert (status, reply["error"]) == (
            409,
            "You have taken part in this study already, and nobody may do so twice.",
        )


def test_without_the_platforms_id_nobody_comes_in_by_its_link(platform_link):
    for given in ({}, {"STUDY_ID": "x"}, {"workerId": "x", "assignmentId": "y"}):
        assert platform_link().request("POST", "/api/consent", {"agreed": True, "platform": given})[0] == 400
    assert platform_link().request("GET", "/api/pair")[0] == 403


def test_who_only_previews_does_not_begin(platform_link):
    given = {"workerId": "w", "assignmentId": tokens.PREVIEW, "hitId": "h"}
    client = platform_link(platform="mturk")
    assert client.request("POST", "/api/consent", {"agreed": True, "platform": given})[0] == 409
    assert client.begin(given | {"assignmentId": "a"})["page"] == "pairs"


def test_who_declines_by_a_platforms_link_leaves_nothing(platform_link, folder):
    database = Database(folder.database)
    before = len(database.participants())
    state = platform_link().post("/api/consent", {"agreed": False, "platform": sent("person 9", "session")})
    assert (state["page"], state["outcome"]) == ("done", "declined")
    assert len(database.participants()) == before
    database.close()


# --- the researcher -----------------------------------------------------------------------------------------------------------


def test_the_researcher_sees_who_is_where(come, researcher, folder):
    client = come()
    client.get("/api/pair")
    client.answer(0)
    found = researcher.get("/api/researcher")
    last = found["participants"][-1]
    assert (last["phase"], last["page"], last["done"], last["total"]) == ("training", "pairs", 1, 20)
    assert last["last_seen_s"] < 60
    assert found["answers"] >= 1
    assert found["picture"] is None
    folder.picture.write_bytes(b"picture")
    shown = researcher.get("/api/researcher")["picture"]
    assert researcher.request("GET", shown)[1] == b"picture"
    folder.picture.unlink()
    assert researcher.request("GET", shown)[0] == 404


def test_a_round_is_closed_by_hand(tmp_path):
    folder = make_study(tmp_path / "live", pairs=20, checks=0, repeats=0.0)
    with served(folder) as serving:
        database, client = serving.study.database, Client(serving.address, *invite(folder))
        researcher = Client(serving.address, tokens.derived(serving.study.key, "researcher"))
        database.begin_live()
        state = client.begin()
        assert (state["page"], state["seconds_to_wait"] > 0) == ("wait", True)
        assert client.get("/api/pair")["wait"] > 0
        database.open_round(0, range(4), stimuli(4))
        assert client.get("/api/state")["page"] == "pairs"
        close = lambda: researcher.request("POST", "/api/researcher/close_round", {"round": 0})
        assert close()[0] == 409
        for place in range(2):
            client.get("/api/pair")
            assert client.answer(place)[0] == 200
        shown = researcher.get("/api/researcher")["round"]
        assert {name: shown[name] for name in ("number", "asked", "answered", "state", "can_close")} == {
            "number": 0, "asked": 4, "answered": 2, "state": "open", "can_close": True,
        }  # fmt: skip
        assert close() == (200, {"ok": True, "why": "by hand, 2 of 4 answered"})
        assert researcher.request("POST", "/api/researcher/close_round", {"round": 9})[0] == 409
        database.end_live()
        assert client.get("/api/state")["page"] == "done"


def test_a_study_whose_environment_was_changed_is_refused(tmp_path):
    folder = make_study(tmp_path / "changed")
    folder.file.write_text(
        folder.file.read_text(encoding="utf-8").replace('env = "highway-dry"', 'env = "nav-d4"', 1), encoding="utf-8"
    )
    with pytest.raises(ValueError, match="env 'nav-d4' can't be changed: the study was made with 'highway-dry'"):
        Study(folder)
