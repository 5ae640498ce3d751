"""A server that has every state at hand: it answers in the test's own process, without a network."""

from __future__ import annotations

import json
import mimetypes
from collections.abc import Callable
from importlib import resources
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, ConsoleMessage, Page, Route

PAGES = resources.files("peps_jax.human_study") / "pages"
ORIGIN = "http://study.test"
POLICY = "default-src 'self'; img-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'none'"
STEPS = 4  # of a clip, 50 ms each

VIEW = {
    "grid": 0.01, "turn": 0.001, "width": 80.0, "height": 8.8, "y_down": True, "background": "road",
    "step_seconds": 0.05, "shapes": [], "colours": {
        "ink": "#2b2b2b", "road": "#d9d9d6", "edge line": "#8a8a8a", "lane line": "#ffffff", "agent": "#2f9e78",
        "other": "#1c6dd0", "wreck": "#c2255c",
    },
}  # fmt: skip


def clip(y: int, steps: int = STEPS) -> dict[str, Any]:
    """A car at `y` that stands on a road."""
    car = {"kind": "rectangle", "at": [1000, y, 500, 200, 0], "colour": "agent", "outline": "ink"}
    return {"steps": steps, "extent": [-1000, 7000, -240, 640], "shapes": [car]}


class Complaints(list):
    """What pages write to their consoles as errors or warnings, and what they throw."""

    def watch(self, context: BrowserContext) -> None:
        context.on("console", self._console)
        context.on("weberror", lambda error: self.append(str(error.error)))

    def _console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.append(message.text)


class Fake:
    """Answers like the server. `requests` has what was asked: (method, path, body)."""

    def __init__(self, **state: Any):
        texts = {
            "consent": ["You are invited.", "Taking part is voluntary."],
            "instructions": ["You will see pairs of clips."],
            "thanks": ["That helps."],
        }
        importance = [
            {"name": "speed", "text": "The car drives fast."},
            {"name": "lane", "text": "It stays in its lane."},
        ]
        self.state = {
            "phase": "training", "page": "pairs", "title": "What machines do", "texts": texts, "importance": importance,
            "progress": {"done": 0, "total": 3}, "code": None, "seconds_to_wait": None,
        } | state  # fmt: skip
        self.pairs = 3
        self.steps = STEPS
        self.requests: list[tuple[str, str, Any]] = []
        self.answers: dict[int, dict[str, Any]] = {}  # by place, from 0 on
        self.lost = 0  # so many posts reach nobody
        self.unheard = 0  # so many posts arrive, and what is answered is lost
        self.refusal: tuple[int, str] | None = None
        self.researcher: dict[str, Any] = {}
        self.picture = b""

    def serve(self, context: BrowserContext) -> None:
        context.route(f"{ORIGIN}/**", self._route)

    def open(self, page: Page, token: str = "token", query: str = "") -> None:
        self.serve(page.context)
        page.goto(f"{ORIGIN}/{query}#{token}")

    def posted(self, path: str) -> list[Any]:
        return [body for method, asked, body in self.requests if method == "POST" and asked == path]

    def _route(self, route: Route) -> None:
        path = urlsplit(route.request.url).path
        if not path.startswith("/api/"):
            self._file(
                route, {"/": "index.html", "/researcher": "researcher.html"}.get(path, path.removeprefix("/static/"))
            )
            return
        body = route.request.post_data_json if route.request.method == "POST" else None
        assert route.request.headers["authorization"].startswith("Bearer ")
        if body is not None and self.lost:
            self.lost -= 1
            route.abort("connectionrefused")
            return
        self.requests.append((route.request.method, path, body))
        status, reply = (self.refusal[0], {"error": self.refusal[1]}) if self.refusal else self.reply(path, body)
        if body is not None and self.unheard:
            self.unheard -= 1
            route.abort("connectionreset")
        elif isinstance(reply, bytes):
            route.fulfill(status=status, body=reply, content_type="image/png")
        else:
            route.fulfill(status=status, body=json.dumps(reply), content_type="application/json")

    def _file(self, route: Route, name: str) -> None:
        file = PAGES / name
        if not file.is_file():
            route.fulfill(status=404, body="")
            return
        kind = mimetypes.guess_type(name)[0]
        headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
        route.fulfill(body=file.read_bytes(), content_type=kind, headers=headers)

    def reply(self, path: str, body: Any) -> tuple[int, Any]:
        """Status and content."""
        match path.removeprefix("/api/"):
            case "state":
                return 200, self.state
            case "consent":
                self.state["page"] = "check" if body["agreed"] else "done"
                return 200, self.state
            case "proceed":
                order = ["check", "instructions", "ratings" if self.state["phase"] == "testing" else "importance"]
                self.state["page"] = order[order.index(body["page"]) + 1]
                return 200, self.state
            case "importance":
                self.state["page"] = "pairs"
                return 200, self.state
            case "practice":
                return 200, {"pairs": [{"left": clip(0), "right": clip(400)}] * 2}
            case "view":
                return 200, VIEW
            case "pair" | "scene" as what:
                place = len(self.answers)
                if place == self.pairs:
                    return 200, {"done": True}
                sides = {"left": clip(0, self.steps), "right": clip(400, self.steps)}
                shown = sides if what == "pair" else {"clip": clip(0, self.steps)}
                return 200, {"place": place, "total": self.pairs} | shown
            case "answer" | "rating":
                return self._answered(body)
            case "researcher":
                return 200, self.researcher
            case "researcher/picture":
                return 200, self.picture
            case "researcher/close_round":
                self.researcher["round"]["state"] = "closed"
                return 200, {"ok": True}
        return 404, {"error": f"nothing is at {path}"}

    def _answered(self, body: Any) -> tuple[int, Any]:
        before = self.answers.setdefault(body["place"], body)
        if before["request"] != body["request"]:
            return 409, {"error": "answered before"}
        if len(self.answers) == self.pairs:
            self.state |= {"page": "done", "code": "C1A2B3C4"}
        return 200, {"ok": True, "state": self.state}


def hide(page: Page, hidden: bool) -> None:
    """Has the page think that its tab is hidden, or that it is seen again."""
    page.evaluate(
        """hidden => {
            Object.defineProperty(document, "visibilityState", {value: hidden ? "hidden" : "visible", configurable: true});
            document.dispatchEvent(new Event("visibilitychange"));
        }""",
        hidden,
    )


def clicking(page: Page, by: str) -> Callable[[str], None]:
    """How buttons are used: with "keys" alone, or with the mouse."""

    def enter(button: str) -> None:
        page.wait_for_selector(f"{button}:visible")  # a press alone doesn't wait
        page.press(button, "Enter")

    return enter if by == "keys" else page.click
