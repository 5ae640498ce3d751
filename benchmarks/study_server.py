"""Whether the study's server loses answers when it is killed, and how fast it is; writes benchmarks/results/study_server.json.

    python benchmarks/study_server.py

First, clients answer pairs while the server is killed (SIGKILL) at random moments and begun anew. A client repeats a request
that wasn't acknowledged, and asks now and then for its pair once more. In the end every acknowledged answer has to be in the
database as it was given, once, and no pair may have been shown on other sides or asked twice. Then as many clients answer at a
steady rate, and what each answer takes is measured, beside what the disk alone takes to be sure of 4 kB.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import pathlib
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from typing import Any

from peps_jax.human_study import settings, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Stimulus
from peps_jax.human_study.settings import Folder
from peps_jax.storage import files

FILE = pathlib.Path(__file__).parent / "results" / "study_server.json"
CHOICES = ("left", "right", "equal", "unclear")
CLIP, ARRAYS = 550, 9_000  # bytes, of a clip and of a pair's arrays as a drive has them
AGAIN = 0.1  # share of the answers before which a client asks for its pair once more
PAUSE = 0.3  # s, longest of a client between two answers
ATTEMPTS, RETRY = 600, 0.1  # of a request, and s between them
BEGINNING = 60.0  # s until a server has to answer


def make_study(path: pathlib.Path, people: int, pairs: int) -> tuple[Folder, list[str]]:
    """A study with as many pairs as `people` with `pairs` each need, whose clips mean nothing; and the people's tokens."""
    folder, chance = Folder(path), random.Random(0)
    path.mkdir()
    text = settings.template("highway-dry", "highway-rain", True, pairs=pairs, participants=people, checks=0)
    folder.file.write_text(text, encoding="utf-8")
    tokens.make_key(folder.key)
    database = Database.create(folder.database)
    made = folder.settings()
    database.note("made", {name: getattr(made, name) for name in settings.FIXED})
    ask = [stimulus(place, chance) for place in range(people * pairs)]
    database.add_queries("ask", ask, [3 if place % 10 == 0 else 1 for place in range(len(ask))])
    own = [tokens.new() for _ in range(people)]
    database.invite("training", list(map(tokens.digest, own)))
    database.close()
    return folder, own


def stimulus(place: int, chance: random.Random) -> Stimulus:
    sides = tuple(json.dumps({"clip": f"{place} {side}", "at": "A" * CLIP}) for side in range(2))
    arrays = chance.randbytes(ARRAYS)
    return Stimulus(files.digest(arrays), arrays, sides)


class Server:
    """A server in a process of its own, which can be killed and begun anew at the same port."""

    def __init__(self, folder: Folder):
        self._folder, self.port = folder, free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self.kills = 0

    def begin(self) -> None:
        command = [sys.executable, "-m", "peps_jax.human_study", "serve", "--out", str(self._folder.path)]
        self._process = subprocess.Popen([*command, "--port", str(self.port)], stdout=subprocess.DEVNULL)
        until = time.monotonic() + BEGINNING
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > until:
                    raise RuntimeError("the server doesn't begin") from None
                time.sleep(0.02)

    def kill(self) -> None:
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()
        self.kills += 1

    def end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Client:
    """One participant's browser."""

    def __init__(self, port: int, token: str, number: int):
        self._port, self._token, self._chance = port, token, random.Random(number)
        self._connection: http.client.HTTPConnection | None = None
        self.acknowledged: dict[int, dict[str, Any]] = {}  # by place
        self.shown: dict[int, Any] = {}
        self.wrong: list[str] = []
        self.repeated = 0  # requests

    def request(self, method: str, path: str, body: Any = None) -> Any:
        """The reply, after as many attempts as it takes."""
        content = None if body is None else json.dumps(body)
        headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
        for _ in range(ATTEMPTS):
            try:
                if self._connection is None:
                    self._connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30)
                self._connection.request(method, path, content, headers)
                response = self._connection.getresponse()
                reply = json.loads(response.read())
                if response.status != 200:
                    raise RuntimeError(f"{method} {path}: {response.status} {reply}")
                return reply
            except (OSError, http.client.HTTPException, json.JSONDecodeError):
                self.close()
                self.repeated += 1
                time.sleep(RETRY)
        raise RuntimeError(f"{method} {path}: no reply in {ATTEMPTS} attempts")

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def begin(self) -> None:
        state = self.request("POST", "/api/consent", {"agreed": True, "platform": {}})
        for page in ("check", "instructions"):
            state = self.request("POST", "/api/proceed", {"page": page})
        answers = {one["name"]: 3 for one in state["importance"]}
        self.request("POST", "/api/importance", {"answers": answers, "request": str(uuid.uuid4())})

    def look(self) -> int:
        """Asks for the pair; the place. It has to be what was there before."""
        pair = self.request("GET", "/api/pair")
        place = pair["place"]
        before = self.shown.setdefault(place, pair)
        if before != pair:
            self.wrong.append(f"place {place} was shown differently")
        if place in self.acknowledged:
            self.wrong.append(f"place {place} was asked again")
        return place

    def answer(self, place: int) -> float:
        """Answers at random; s that it took."""
        body = {
            "place": place, "choice": self._chance.choice(CHOICES), "frames": {"left": 30, "right": 30},
            "reaction_ms": self._chance.randrange(5000), "watched_ms": self._chance.randrange(9000), "hidden_ms": 0,
            "replays": 0, "request": str(uuid.uuid4()),
        }  # fmt: skip
        began = time.perf_counter()
        self.request("POST", "/api/answer", body)
        took = time.perf_counter() - began
        self.acknowledged[place] = body
        return took

    def answer_all(self, number: int) -> None:
        try:
            self.begin()
            for _ in range(number):
                place = self.look()
                if self._chance.random() < AGAIN:
                    self.look()
                time.sleep(self._chance.uniform(0, PAUSE))
                self.answer(place)
        except RuntimeError as error:
            self.wrong.append(str(error))
        self.close()


def kill_and_answer(folder: pathlib.Path, people: int, pairs: int, kills: int, seed: int) -> dict[str, Any]:
    """Clients answer while the server is killed at random moments."""
    study, own = make_study(folder, people, pairs)
    server, chance = Server(study), random.Random(seed)
    clients = [Client(server.port, token, number) for number, token in enumerate(own)]
    threads = [threading.Thread(target=client.answer_all, args=[pairs]) for client in clients]
    done = lambda: sum(len(client.acknowledged) for client in clients)
    moments = sorted(chance.sample(range(people * pairs - people), kills))
    server.begin()
    began = time.monotonic()
    try:
        for thread in threads:
            thread.start()
        for moment in moments:
            while done() < moment and any(thread.is_alive() for thread in threads):
                time.sleep(0.001)
            time.sleep(chance.uniform(0, 0.05))
            server.kill()
            server.begin()
        for thread in threads:
            thread.join()
    finally:
        server.end()
    seconds = time.monotonic() - began
    found = verdict(study, clients)
    return {
        "clients": people, "answers": done(), "kills": server.kills, "seconds": round(seconds, 1),
        "requests_repeated": sum(client.repeated for client in clients), **found,
    }  # fmt: skip


def verdict(study: Folder, clients: list[Client]) -> dict[str, Any]:
    """What became of the acknowledged answers."""
    database = Database(study.database)
    rows = database.tables()["answers"]
    integrity = database.check_integrity()
    database.close()
    kept: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for row in rows:
        kept.setdefault((row["participant"], row["place"]), []).append(row)
    told = ("choice", "reaction_ms", "watched_ms")
    lost = changed = 0
    for number, client in enumerate(clients, 1):
        for place, body in client.acknowledged.items():
            found = kept.get((number, place), [])
            lost += not found
            changed += any(row[name] != body[name] for row in found for name in told)
    seen = [
        (row["participant"], row["query"]) for row in rows if row["kind"] != "repeat"
    ]  # nobody sees a pair twice, but for its repeat
    return {
        "lost": lost,
        "changed": changed,
        "doubled": sum(len(found) - 1 for found in kept.values()),
        "not_acknowledged_but_kept": len(kept) - sum(len(client.acknowledged) for client in clients),
        "asked_twice": len(seen) - len(set(seen)),
        "wrong": [line for client in clients for line in client.wrong],
        "integrity": integrity or ["ok"],
    }


def measure(folder: pathlib.Path, people: int, pairs: int, rate: float) -> dict[str, Any]:
    """What an answer takes while `people` answer at `rate` a second together."""
    study, own = make_study(folder, people, pairs)
    server = Server(study)
    clients = [Client(server.port, token, number) for number, token in enumerate(own)]
    took: list[list[float]] = [[] for _ in clients]
    disk: list[float] = []
    server.begin()
    try:
        for client in clients:
            client.begin()
        start = time.monotonic() + 1

        def work(which: int) -> None:
            client = clients[which]
            place = client.look()
            for turn in range(pairs):
                time.sleep(max(0.0, start + (turn + which / people) * people / rate - time.monotonic()))
                took[which].append(client.answer(place))
                if turn < pairs - 1:
                    place = client.look()
            client.close()

        threads = [threading.Thread(target=work, args=[which]) for which in range(people)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            disk.append(synced(folder / "disk"))
            time.sleep(0.5)
        seconds = time.monotonic() - start
    finally:
        server.end()
    every = sorted(1000 * one for row in took for one in row)
    at = lambda values, share: round(values[min(len(values) - 1, int(share * len(values)))], 2)
    return {
        "clients": people, "answers": len(every), "a_second": round(len(every) / seconds, 1),
        "ms": {"p50": at(every, 0.5), "p90": at(every, 0.9), "p99": at(every, 0.99), "most": round(every[-1], 2)},
        "disk_ms": {"p50": at(sorted(disk), 0.5), "most": round(max(disk), 2)},
        "load": [round(one, 2) for one in os.getloadavg()], "cores": os.cpu_count(),
        "wrong": [line for client in clients for line in client.wrong],
    }  # fmt: skip


def synced(path: pathlib.Path) -> float:
    """Milliseconds until 4 kB are on the disk."""
    began = time.perf_counter()
    with path.open("wb") as file:
        file.write(b"0" * 4096)
        file.flush()
        os.fsync(file.fileno())
    return 1000 * (time.perf_counter() - began)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--clients", type=int, default=50, help="at once [50]")
    parser.add_argument("--answers", type=int, default=60, help="of each, an even number [60]")
    parser.add_argument("--kills", type=int, default=30, help="of the server [30]")
    parser.add_argument("--rate", type=float, default=40.0, help="answers a second where their time is measured [40]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    parser.add_argument("--out", type=pathlib.Path, default=FILE, help=f"file [{FILE}]")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        killed = kill_and_answer(pathlib.Path(folder) / "killed", given.clients, given.answers, given.kills, given.seed)
        print(json.dumps(killed, indent=1), flush=True)
        measured = measure(pathlib.Path(folder) / "measured", given.clients, given.answers, given.rate)
        print(json.dumps(measured, indent=1), flush=True)
    files.write_whole(given.out, files.json_bytes({"killed": killed, "measured": measured}))
    right = not any(killed[name] for name in ("lost", "changed", "doubled", "asked_twice", "wrong"))
    return 0 if right and killed["integrity"] == ["ok"] and not measured["wrong"] else 1


if __name__ == "__main__":
    sys.exit(main())
