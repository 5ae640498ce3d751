"""What the pages ask for, over HTTP: JSON under `/api/`, and the pages' files.

Who asks shows a token as `Authorization: Bearer`; it stands in the address's fragment, which browsers don't send. There are no
cookies, so another site can't act in somebody's name, and pages work inside a platform's frame. Where somebody is in the study
is known here alone: a page that is loaded anew asks `/api/state`.

    400  malformed     401  no token, or a wrong one     403  one of another phase, or for something else
    409  not now       413  too large                    429  too many wrong tokens
    503  nothing can be kept at present
"""

from __future__ import annotations

import json
import random
import re
import sqlite3
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from peps_jax.human_study import orders, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.assignments import PATIENCE
from peps_jax.human_study.database.records import (
    CHOICES,
    ConflictError,
    Link,
    Next,
    Participant,
    Place,
    Recruit,
    Wait,
    Watching,
)
from peps_jax.human_study.settings import FIXED, Folder

PAGES = Path(__file__).parent / "pages"
STATIC = re.compile(r"[a-z0-9_-]+\.(js|css|svg)")
MEDIA = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
LARGEST = 16_384  # bytes of a body
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
UUID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")
DAY = 86_400_000  # ms
MOST = 10**9
FIELDS, CHARACTERS = 30, 200  # of a browser's report, and of a text from outside


ORDER = ("consent", "check", "instructions", "importance", "pairs", "ratings", "done")  # of pages


class RefusedError(Exception):
    """A request isn't right; its status and one line."""

    def __init__(self, status: int, text: str):
        super().__init__(text)
        self.status = status


class Study:
    """What the server serves.

    Args:
      folder: of the study, which has been made.
    """

    def __init__(self, folder: Folder):
        folder.check()
        self.folder, self.settings, self.key = folder, folder.settings(), tokens.read_key(folder.key)
        self.database = Database(folder.database)
        try:
            self._check_unchanged()
        except ValueError:
            self.database.close()
            raise
        self.researcher = tokens.digest(tokens.derived(self.key, "researcher"))
        self.guesses = tokens.WrongGuesses()
        self.last_seen: dict[int, float] = {}  # by participant, time.monotonic()

    def _check_unchanged(self) -> None:
        made = self.database.noted("made")
        for field in FIXED:
            value = getattr(self.settings, field)
            if value != made[field]:
                name = self.folder.file.name
                raise ValueError(f"{name}: {field} {value!r} can't be changed: the study was made with {made[field]!r}")

    # --- where somebody is ------------------------------------------------------------------------------------------------------

    def state(self, who: Participant | Link) -> dict[str, Any]:
        """Where somebody is in the study: all that a page needs to know to go on."""
        page, outcome, code, progress, seconds = "consent", None, None, (0, 0), None
        if isinstance(who, Participant):
            who, waits = self._now(self.database.participant(who.number))
            page, outcome, code = who.page, who.outcome, who.code
            progress = self.database.progress(who.number)
            if waits:
                page, seconds = "wait", PATIENCE
            if outcome == "declined":
                page = "done"
        texts = self.settings.texts
        return {
            "phase": who.phase,
            "page": page,
            "outcome": outcome,
            "title": self.settings.title,
            "texts": {
                "consent": texts.consent,
                "instructions": texts.instructions_testing if who.phase == "testing" else texts.instructions_training,
                "thanks": texts.thanks,
            },
            "importance": [{"name": one.name, "text": one.text} for one in self.settings.importance],
            "progress": {"done": progress[0], "total": progress[1]},
            "code": code,
            "seconds_to_wait": seconds,
        }

    def _now(self, who: Participant) -> tuple[Participant, bool]:
        """The participant, whose end is noted if there is nothing more to show; and whether they wait for something."""
        if who.page == "importance" and "importance" not in self.pages(who.phase):  # it was taken out meanwhile
            self.database.turn(who.number, "importance", "pairs")
            who = self.database.participant(who.number)
        if who.page not in ("pairs", "ratings"):
            return who, False
        more = self.database.has_more(who.number)
        if more is not False:
            return who, more is None
        code = self.settings.codes.get(who.phase) or tokens.code(self.key, who.number)
        self.database.finish(who.number, who.page, code)
        return self.database.participant(who.number), False

    # --- beginning ----------------------------------------------------------------------------------------------------------------

    def consent(self, who: Participant | Link, agreed: bool, platform: Mapping[str, str]) -> dict[str, Any]:
        """Somebody agrees to take part, or doesn't: with that they begin, and not before."""
        if isinstance(who, Participant) and who.consented is not None and agreed:
            return self.state(who)
        if not agreed:
            if isinstance(who, Participant):
                self.database.decline(who.number)
                return self.state(who)
            return self.state(who) | {"page": "done", "outcome": "declined"}
        self._check_ready(who.phase)
        recruit = self._recruit(platform)
        own = {}
        if isinstance(who, Link):
            if recruit is None or recruit.platform != who.platform:
                raise RefusedError(400, "Open the link from the platform: its id of you is missing.")
            number = self.database.arrive(who, recruit, lambda number: tokens.digest(self._own_token(number)))
            own = {"token": self._own_token(number)}
        else:
            number = who.number
            if recruit is not None:
                self.database.recruit(number, recruit)
        self.begin(number, who.phase, "check")
        return self.state(self.database.participant(number)) | own

    def _own_token(self, number: int) -> str:
        return tokens.derived(self.key, f"participant {number}")

    def _check_ready(self, phase: str) -> None:
        if phase == "testing" and not self.database.scenes():
            raise ConflictError("There is nothing to rate yet: come back later.")

    def _recruit(self, given: Mapping[str, str]) -> Recruit | None:
        for name, platform in tokens.PLATFORMS.items():
            person, session = given.get(platform.person), given.get(platform.session)
            if session == tokens.PREVIEW:
                raise ConflictError("This is a preview: accept the task first.")
            if person:
                keyed = lambda text: tokens.identity(self.key, name, text)  # noqa: B023, used at once
                raw = json.dumps({key: given[key] for key in platform.names if key in given})
                return Recruit(name, keyed(person), keyed(f"{person}\0{session or ''}"), raw)
        return None

    def begin(self, number: int, phase: str, page: str) -> None:
        """A participant's order is laid down, and they are at `page`."""
        settings = self.settings
        seed = random.Random(f"participant {settings.seed} {number}").randrange(2**31)

        def order(before: int) -> list[Place]:
            if phase == "testing":
                shown = self.database.times_shown()
                return orders.of_scenes(seed, before, self.database.scenes(), settings.scenes, shown)
            if phase == "label":
                return orders.of_pairs(seed, settings.pairs)
            checks = self.database.query_numbers("check")[: settings.checks]
            return orders.of_pairs(seed, settings.pairs, settings.repeats, settings.shared, checks)

        self.database.begin(number, page, seed, order)

    # --- what comes after a page ------------------------------------------------------------------------------------------------

    def pages(self, phase: str) -> list[str]:
        """The pages of a phase, in their order."""
        left_out = {"importance", "pairs"} if phase == "testing" else {"ratings"}
        if phase == "label" or not self.settings.importance:
            left_out |= {"importance"}
        return [page for page in ORDER if page not in left_out]

    def after(self, phase: str, page: str) -> str:
        pages = self.pages(phase)
        return pages[pages.index(page) + 1]

    def proceed(self, who: Participant, page: str, report: Mapping[str, Any] | None) -> dict[str, Any]:
        """They are done with the browser check or the instructions."""
        if ORDER.index(who.page) < ORDER.index(page):
            raise ConflictError(f"The page {page} comes later: ask for the state.")
        self.database.turn(who.number, page, self.after(who.phase, page), report)
        return self.state(who)

    def importance(self, who: Participant, answers: Mapping[str, int], request: str) -> dict[str, Any]:
        self.database.rate_importance(who.number, answers, request, "importance", self.after(who.phase, "importance"))
        return self.state(who)

    # --- pairs and scenes ------------------------------------------------------------------------------------------------------

    def show(self, who: Participant) -> str:
        """What they see now, as JSON."""
        shown = self.database.next_shown(who.number, self.settings.lease)
        if shown is None:
            self._now(who)
            return '{"done": true}'
        if isinstance(shown, Wait):
            return json.dumps({"wait": shown.seconds})
        return self._shown(shown, self.database.progress(who.number)[1])

    @staticmethod
    def _shown(shown: Next, total: int) -> str:
        names = ("left", "right") if len(shown.drawings) == 2 else ("clip",)
        clips = ", ".join(f'"{name}": {drawing}' for name, drawing in zip(names, shown.drawings, strict=True))
        return f'{{"place": {shown.place}, "total": {total}, {clips}}}'

    def practice(self) -> str:
        """Two pairs that don't count, as JSON."""
        pairs = self.database.stimuli(self.database.query_numbers("practice")[:2])
        shown = ", ".join(f'{{"left": {pair.drawings[0]}, "right": {pair.drawings[1]}}}' for pair in pairs)
        return f'{{"pairs": [{shown}]}}'

    def view(self, phase: str) -> str:
        """What all clips of a phase share, as JSON."""
        return json.dumps(self.database.noted("test_view" if phase == "testing" else "view"))

    # --- the researcher -----------------------------------------------------------------------------------------------------------

    def overview(self) -> dict[str, Any]:
        """What the researcher's page shows."""
        seen, now = self.last_seen, time.monotonic()
        found = self.database.overview()
        for one in found["participants"]:
            if one["number"] in seen:
                one["last_seen_s"] = now - seen[one["number"]]
        picture = self.folder.picture
        version = picture.stat().st_mtime_ns if picture.is_file() else None
        found["picture"] = None if version is None else f"/api/researcher/picture?v={version}"
        found["routes"] = (
            json.loads(self.folder.routes.read_text(encoding="utf-8")) if self.folder.routes.is_file() else None
        )
        return found | {
            "title": self.settings.title,
            "live": self.database.live,
            "round_time": self.settings.round_time,
        }


# --- what a body has to be ----------------------------------------------------------------------------------------------------


def _record(value: Any, fields: Mapping[str, Callable[[Any], Any]], what: str = "body") -> dict[str, Any]:
    """An object with exactly these fields, each as its function reads it."""
    if not isinstance(value, dict):
        raise RefusedError(400, f"{what} is no object")
    for name in value:
        if name not in fields:
            raise RefusedError(400, f"{what} has an unknown field {name!r:.40}")
    read = {}
    for name, check in fields.items():
        if name not in value:
            raise RefusedError(400, f"{what} has no field {name!r}")
        try:
            read[name] = check(value[name])
        except ValueError as error:
            raise RefusedError(400, f"{name} {error}") from None
    return read


def _whole(low: int, high: int) -> Callable[[Any], int]:
    def read(value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ValueError(f"isn't a whole number from {low} to {high}")
        return value

    return read


def _milliseconds(value: Any) -> int:
    """A time as browsers measure it, in whole ms."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= DAY:
        raise ValueError(f"isn't a number of ms from 0 to {DAY}")
    return round(value)


def _one_of(*names: str) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if not isinstance(value, str) or value not in names:
            raise ValueError(f"isn't one of {', '.join(names)}")
        return value

    return read


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("isn't true or false")
    return value


def _request_id(value: Any) -> str:
    if not isinstance(value, str) or not UUID.fullmatch(value):
        raise ValueError("isn't a UUID")
    return value


def _sides(value: Any) -> tuple[int, int]:
    read = _record(value, {"left": _whole(0, MOST), "right": _whole(0, MOST)}, "frames")
    if not all(read.values()):
        raise ValueError("of a side are 0: it wasn't drawn, and can't be judged")
    return read["left"], read["right"]


def _frames(value: Any) -> int:
    if not _whole(0, MOST)(value):
        raise ValueError("are 0: the scene wasn't drawn, and can't be judged")
    return value


def _report(value: Any) -> dict[str, Any]:
    """What a page tells of the browser: a few numbers and short texts."""
    if not isinstance(value, dict) or len(value) > FIELDS:
        raise ValueError(f"isn't an object of at most {FIELDS} fields")
    for name, item in value.items():
        text = not isinstance(item, str) or len(item) <= CHARACTERS
        if len(name) > CHARACTERS or not isinstance(item, str | int | float | bool | None) or not text:
            raise ValueError(f"has fields that are no numbers or texts of at most {CHARACTERS} characters")
    return value


def _platform(value: Any) -> dict[str, str]:
    known = {name for platform in tokens.PLATFORMS.values() for name in platform.names}
    if not isinstance(value, dict) or not set(value) <= known:
        raise ValueError(f"has fields other than {', '.join(sorted(known))}")
    if not all(isinstance(text, str) and 0 < len(text) <= CHARACTERS for text in value.values()):
        raise ValueError(f"has a field that isn't a text of at most {CHARACTERS} characters")
    return value


_WATCHED = dict.fromkeys(("reaction_ms", "watched_ms", "hidden_ms"), _milliseconds) | {"replays": _whole(0, MOST)}
_ANSWER = {"place": _whole(0, MOST), "choice": _one_of(*CHOICES), "frames": _sides, "request": _request_id} | _WATCHED
_RATING = {"place": _whole(0, MOST), "rating": _whole(1, 10), "frames": _frames, "request": _request_id} | _WATCHED


def _watched(read: dict[str, Any]) -> dict[str, Any]:
    """What was read of an answer or a rating, with how it was watched as one."""
    watching = Watching(*(read.pop(name) for name in Watching._fields))
    return read | {"watching": watching}


async def _body(request: Request) -> Any:
    """A request's body, which has to be small JSON."""
    if request.headers.get("content-type", "").split(";")[0].strip() != "application/json":
        raise RefusedError(400, "the content type has to be application/json")
    length = request.headers.get("content-length", "0")
    if not length.isascii() or not length.isdigit() or int(length) > LARGEST:
        raise RefusedError(413, f"the body is larger than {LARGEST} bytes")
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > LARGEST:
            raise RefusedError(413, f"the body is larger than {LARGEST} bytes")
    try:
        value = json.loads(content, parse_constant=_no_number)
        json.dumps(value, ensure_ascii=False).encode()  # halves of characters are no text
        return value
    except (ValueError, RecursionError):
        raise RefusedError(400, "the body is no JSON") from None


def _no_number(text: str) -> Any:
    raise ValueError(text)


# --- the application ----------------------------------------------------------------------------------------------------------

Handler = Callable[[Request], Awaitable[Response]]


def application(study: Study) -> ASGIApp:
    """The pages and what they ask for.

    Handlers ask the database in the event loop's own thread: that takes a millisecond, and a few more until the disk is sure of
    an answer, and only one can write at a time anyway. Handing it to other threads took longer on a busy machine.
    """

    def holder(request: Request) -> Participant | Link | None:
        """Who asks: a participant, somebody with a link's token, or None, the researcher."""
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        digest = tokens.digest(token)
        address = request.client.host if request.client else ""
        if study.guesses.refuses(address, digest):
            raise RefusedError(429, "too many wrong tokens: wait a minute")
        if scheme.lower() == "bearer" and token:
            who = None if digest == study.researcher else study.database.holder(digest)
            if who is not None or digest == study.researcher:
                study.guesses.right(digest)
                if isinstance(who, Participant):
                    study.last_seen[who.number] = time.monotonic()
                return who
            study.guesses.wrong(address)
        raise RefusedError(401, "open the link that you were given: there is no right token in this one")

    def anybody(request: Request) -> Participant | Link:
        who = holder(request)
        if who is None:
            raise RefusedError(403, "this is the researcher's link: participants have their own")
        return who

    def participant(request: Request, *pages: str) -> Participant:
        """A participant in a phase that has one of `pages`."""
        who = anybody(request)
        if isinstance(who, Link):
            raise RefusedError(403, "agree to take part first")
        if not set(pages) & set(study.pages(who.phase)):
            raise RefusedError(403, f"this isn't part of the phase {who.phase}")
        if who.page == "consent":
            raise RefusedError(403, "agree to take part first")
        return who

    def researcher(request: Request) -> None:
        if holder(request) is not None:
            raise RefusedError(403, "this needs the researcher's link")

    async def state(request: Request) -> Response:
        return JSONResponse(study.state(anybody(request)))

    async def consent(request: Request) -> Response:
        who = anybody(request)
        read = _record(await _body(request), {"agreed": _boolean, "platform": _platform})
        return JSONResponse(study.consent(who, read["agreed"], read["platform"]))

    async def proceed(request: Request) -> Response:
        who = participant(request, "check")
        fields = {"page": _one_of("check", "instructions"), "report": _report}
        read = _record({"report": {}} | _object(await _body(request)), fields)
        return JSONResponse(study.proceed(who, read["page"], read["report"] or None))

    async def importance(request: Request) -> Response:
        who = participant(request, "importance")
        names = [one.name for one in study.settings.importance]
        scale = lambda value: _record(value, dict.fromkeys(names, _whole(1, 5)), "answers")
        read = _record(await _body(request), {"answers": scale, "request": _request_id})
        return JSONResponse(study.importance(who, read["answers"], read["request"]))

    async def practice(request: Request) -> Response:
        participant(request, "pairs")
        return _json(study.practice())

    async def view(request: Request) -> Response:
        who = anybody(request)
        return _json(study.view(who.phase))

    def shows(page: str) -> Handler:
        async def show(request: Request) -> Response:
            who = participant(request, page)
            if who.page == "done":
                return _json('{"done": true}')
            if who.page != page:
                raise RefusedError(409, f"first comes the page {who.page}")
            return _json(study.show(who))

        return show

    async def answer(request: Request) -> Response:
        who = participant(request, "pairs")
        read = _record(await _body(request), _ANSWER)
        study.database.answer(who.number, **_watched(read))
        return JSONResponse({"ok": True, "state": study.state(who)})

    async def rating(request: Request) -> Response:
        who = participant(request, "ratings")
        read = _record(await _body(request), _RATING)
        study.database.rate(who.number, **_watched(read))
        return JSONResponse({"ok": True, "state": study.state(who)})

    async def overview(request: Request) -> Response:
        researcher(request)
        return JSONResponse(study.overview())

    async def picture(request: Request) -> Response:
        researcher(request)
        try:
            content = study.folder.picture.read_bytes()
        except FileNotFoundError:
            raise RefusedError(404, "there is no picture yet") from None
        return Response(content, media_type="image/png")

    async def close_round(request: Request) -> Response:
        researcher(request)
        read = _record(await _body(request), {"round": _whole(0, MOST)})
        try:
            why = study.database.close_round(read["round"])
        except ValueError as error:
            raise RefusedError(409, str(error)) from None
        return JSONResponse({"ok": True, "why": why})

    def page(name: str) -> Handler:
        async def serve(request: Request) -> Response:
            return FileResponse(PAGES / name, media_type="text/html; charset=utf-8")

        return serve

    async def static(request: Request) -> Response:
        name = request.path_params["name"]
        if not STATIC.fullmatch(name) or not (PAGES / name).is_file():
            raise RefusedError(404, "there is no such file")
        return FileResponse(PAGES / name, media_type=MEDIA[(PAGES / name).suffix])

    def get(path: str, handler: Handler) -> Route:
        return Route(path, handler, methods=["GET"])

    def post(path: str, handler: Handler) -> Route:
        return Route(path, handler, methods=["POST"])

    routes = [
        get("/api/state", state),
        post("/api/consent", consent),
        post("/api/proceed", proceed),
        get("/api/practice", practice),
        post("/api/importance", importance),
        get("/api/view", view),
        get("/api/pair", shows("pairs")),
        post("/api/answer", answer),
        get("/api/scene", shows("ratings")),
        post("/api/rating", rating),
        get("/api/researcher", overview),
        get("/api/researcher/picture", picture),
        post("/api/researcher/close_round", close_round),
        get("/", page("index.html")),
        get("/researcher", page("researcher.html")),
        get("/static/{name}", static),
    ]
    errors = {
        RefusedError: _refused,
        ConflictError: _conflict,
        HTTPException: _misdirected,
        sqlite3.OperationalError: _busy,
    }
    return _with_headers(Starlette(routes=routes, exception_handlers=errors))


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RefusedError(400, "body is no object")
    return value


def _json(content: str) -> Response:
    return Response(content, media_type="application/json")


async def _refused(request: Request, error: RefusedError) -> Response:
    return JSONResponse({"error": str(error)}, error.status)


async def _conflict(request: Request, error: ConflictError) -> Response:
    return JSONResponse({"error": str(error)}, 409)


async def _misdirected(request: Request, error: HTTPException) -> Response:
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _busy(request: Request, error: sqlite3.OperationalError) -> Response:
    """The disk is full, or another process writes for very long: nothing is acknowledged, and the page asks again."""
    print(f"database: {error}", file=sys.stderr, flush=True)
    return JSONResponse({"error": "the server can't keep anything at present: try again"}, 503)


def _with_headers(app: ASGIApp) -> ASGIApp:
    """Every response, an error's too, forbids what pages don't need."""
    added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]

    async def respond(scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *added]
            await send(message)

        await app(scope, receive, send_with if scope["type"] == "http" else send)

    return respond
