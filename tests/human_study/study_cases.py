"""Small studies for tests, whose clips are placeholders: nothing is computed."""

from __future__ import annotations

import contextlib
import http.client
import json
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from peps_jax.human_study import settings, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Stimulus, Watching
from peps_jax.human_study.server import Study
from peps_jax.human_study.serving import Serving
from peps_jax.human_study.settings import Folder
from peps_jax.storage import files

WATCHED = Watching(reaction_ms=900, watched_ms=2000, hidden_ms=0, replays=1)

CLIENTS: list[Client] = []  # whose connections are still open


def stimulus(number: int, sides: int = 2) -> Stimulus:
    """A pair, or with one side a scene, whose drawings say which it is."""
    drawings = tuple(json.dumps({"clip": number, "side": side}) for side in range(sides))
    return Stimulus(files.digest(f"{number} {sides}".encode()), b"arrays", drawings)


def stimuli(number: int, first: int = 0) -> list[Stimulus]:
    return [stimulus(first + place) for place in range(number)]


def make_study(path: Path, pool: int = 40, agents: tuple[str, ...] = (), **numbers: Any) -> Folder:
    """A study of the road, with a pool of pairs, five checks, two practice pairs, and four scenes of each of `agents`."""
    folder = Folder(path)
    path.mkdir(parents=True, exist_ok=True)
    folder.file.write_text(settings.template("highway-dry", "highway-rain", True, **numbers), encoding="utf-8")
    tokens.make_key(folder.key)
    database = Database.create(folder.database)
    made = folder.settings()
    database.note("made", {"env": made.env, "test_env": made.test_env, "seed": made.seed})
    database.note("view", {"of": "training"})
    database.note("test_view", {"of": "testing"})
    shared = round(pool * made.shared)
    database.add_queries("ask", stimuli(pool), [1] * (pool - shared) + [3] * shared)
    database.add_queries("check", stimuli(made.checks, 1_000_000))
    database.add_queries("practice", stimuli(2, 2_000_000))
    for which, agent in enumerate(agents):
        database.add_scenes(agent, [stimulus(3_000_000 + 10 * which + place, 1) for place in range(4)])
    database.close()
    return folder


def invite(folder: Folder, number: int = 1, phase: str = "training") -> list[str]:
    """Tokens of new participants."""
    made = [tokens.new() for _ in range(number)]
    database = Database(folder.database)
    database.invite(phase, list(map(tokens.digest, made)))
    database.close()
    return made


class Client:
    """Somebody's browser, without the page: requests with a token, over one connection."""

    def __init__(self, address: str, token: str | None):
        self._host, self.token = address.removeprefix("http://"), token
        self._connection: http.client.HTTPConnection | None = None
        CLIENTS.append(self)

    def request(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> tuple[int, Any]:
        """The status, and the reply's JSON, or its bytes if it is none."""
        if self._connection is None:
            self._connection = http.client.HTTPConnection(self._host, timeout=20)
        sent = {} if self.token is None else {"Authorization": f"Bearer {self.token}"}
        if body is not None:
            sent["Content-Type"] = "application/json"
        content = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        try:
            self._connection.request(method, path, content, sent | (headers or {}))
            response = self._connection.getresponse()
            reply = response.read()
        except (OSError, http.client.HTTPException):
            self.close()
            raise
        self.headers = dict(response.headers)
        with contextlib.suppress(ValueError):
            return response.status, json.loads(reply)
        return response.status, reply

    def get(self, path: str) -> Any:
        return self._right(*self.request("GET", path))

    def post(self, path: str, body: Any) -> Any:
        return self._right(*self.request("POST", path, body))

    @staticmethod
    def _right(status: int, reply: Any) -> Any:
        assert status == 200, (status, reply)
        return reply

    def begin(self, platform: dict[str, str] | None = None) -> dict[str, Any]:
        """Through all pages up to the pairs or scenes; returns the state."""
        state = self.post("/api/consent", {"agreed": True, "platform": platform or {}})
        self.token = state.get("token", self.token)
        for page in ("check", "instructions"):
            state = self.post("/api/proceed", {"page": page, "report": {"fps": 60}})
        if state["page"] == "importance":
            names = [one["name"] for one in state["importance"]]
            state = self.post("/api/importance", {"answers": dict.fromkeys(names, 4), "request": str(uuid.uuid4())})
        return state

    def answer(self, place: int, choice: str = "left", **changes: Any) -> tuple[int, Any]:
        return self.request("POST", "/api/answer", answer_to(place, choice) | changes)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def answer_to(place: int, choice: str = "left") -> dict[str, Any]:
    """What a page sends."""
    frames = {"left": 60, "right": 60}
    return {"place": place, "choice": choice, "frames": frames, "request": str(uuid.uuid4())} | WATCHED._asdict()


def rating_of(place: int, rating: int = 5) -> dict[str, Any]:
    return {"place": place, "rating": rating, "frames": 60, "request": str(uuid.uuid4())} | WATCHED._asdict()


@contextlib.contextmanager
def served(folder: Folder) -> Iterator[Serving]:
    """The study's pages, in a thread."""
    serving = Serving(Study(folder))
    try:
        with serving.in_background():
            yield serving
    finally:
        while CLIENTS:
            CLIENTS.pop().close()
        serving.close()
