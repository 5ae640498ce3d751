"""The study's folder, and the file with its settings and texts.

study.toml      settings and texts, to be edited
study.sqlite    participants, pairs, answers: everything that is known
key             for tokens and for the hashes of platforms' ids; only its owner may read it
picture.png     what a training shows the researcher, if there is one
routes.json     and the same as numbers
"""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from peps_jax.storage import files

FILE, DATABASE, KEY, PICTURE, ROUTES = "study.toml", "study.sqlite", "key", "picture.png", "routes.json"
PORT = 8200
LONGEST = 5_000  # characters of a text


@dataclasses.dataclass(frozen=True)
class Importance:
    """Something whose importance participants rate from 1 to 5."""

    name: str
    text: str


def _setting(default: Any, low: float, high: float, text: str) -> Any:
    return dataclasses.field(default=default, metadata={"low": low, "high": high, "text": text})


@dataclasses.dataclass(frozen=True)
class Texts:
    """What the pages say; each is a list of paragraphs."""

    consent: tuple[str, ...]
    instructions_training: tuple[str, ...]
    instructions_testing: tuple[str, ...]
    thanks: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Settings:
    """A study's settings and texts, as its file has them."""

    title: str
    env: str
    test_env: str
    address: str
    texts: Texts
    importance: tuple[Importance, ...] = ()
    codes: dict[str, str] = dataclasses.field(default_factory=dict)
    seed: int = _setting(0, 0, 2**31 - 1, "random seed of pairs and of every participant's order")
    participants: int = _setting(15, 1, 10_000, "who are expected in the training phase: so many pairs are made")
    pairs: int = _setting(200, 2, 10_000, "pairs of each, repeats and checks among them; an even number")
    repeats: float = _setting(0.1, 0.0, 0.5, "share of them that come again, swapped, for consistency")
    checks: int = _setting(5, 0, 50, "pairs of which one side is plainly wrong; who ever prefers it may be left out")
    shared: float = _setting(0.1, 0.0, 1.0, "share of the pairs that three people see, for agreement")
    scenes: int = _setting(3, 1, 100, "scenes of each agent that a rater sees")
    lease: float = _setting(120.0, 1.0, 86_400.0, "s for which a pair that was shown isn't given to others")
    round_time: float = _setting(600.0, 0.0, 1e9, "s after which a round closes with 80 % of its answers")


NUMBERS = tuple(field for field in dataclasses.fields(Settings) if field.metadata)
FIXED = ("env", "test_env", "seed")  # by what `make` has put into the database


@dataclasses.dataclass(frozen=True)
class Folder:
    """Where things are in a study's folder."""

    path: Path

    @property
    def file(self) -> Path:
        return self.path / FILE

    @property
    def database(self) -> Path:
        return self.path / DATABASE

    @property
    def key(self) -> Path:
        return self.path / KEY

    @property
    def picture(self) -> Path:
        return self.path / PICTURE

    @property
    def routes(self) -> Path:
        return self.path / ROUTES

    def check(self) -> None:
        """Raises ValueError, in one line, if there is no study."""
        if not self.file.is_file() or not self.database.is_file():
            raise ValueError(f"out {str(self.path)!r} holds no study: make one first, or name its folder")

    def check_free(self) -> None:
        """Raises ValueError, in one line, if no study can be made here."""
        files.check_writable(self.path)
        if any(path.exists() for path in (self.file, self.database, self.key)):
            raise ValueError(f"out {str(self.path)!r} holds a study already: choose another folder")

    def settings(self) -> Settings:
        """What its file says. Raises ValueError."""
        try:
            content = self.file.read_text(encoding="utf-8")
        except OSError as error:
            raise ValueError(f"settings {str(self.file)!r} can't be read: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise ValueError(f"settings {str(self.file)!r} aren't text in UTF-8") from None
        return read(content, self.file.name)


def read(content: str, name: str = FILE) -> Settings:
    """Settings from a file's content.

    Raises:
      ValueError: it is no TOML, a field is unknown or missing, or a value makes no sense; one line says which.
    """
    try:
        table = tomllib.loads(content)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{name} is no TOML: {error}") from None
    texts = dict(_table(table, "texts", name))
    importance = table.pop("importance", [])
    codes = _table(table, "codes", name, missing={})
    own = {field.name: field for field in dataclasses.fields(Settings)}
    _refuse_unknown(table, set(own) - {"texts", "importance", "codes"}, name)
    for field in ("title", "env", "test_env", "address"):
        _line(table.get(field), field, name)
    for field in NUMBERS:
        if field.name in table:
            table[field.name] = _number(table[field.name], field, name)
    known = [field.name for field in dataclasses.fields(Texts)]
    _refuse_unknown(texts, set(known), f"{name}, [texts]")
    paragraphs = {text: _paragraphs(texts.get(text), text, name) for text in known}
    made = Settings(
        **table, texts=Texts(**paragraphs), importance=_importance(importance, name), codes=_codes(codes, name)
    )
    if made.pairs % 2:
        raise ValueError(f"{name}: pairs {made.pairs} is odd: give an even number, for half of them are swapped")
    if round(made.pairs * made.repeats) * 2 + made.checks > made.pairs:
        raise ValueError(f"{name}: pairs {made.pairs} has no room for {made.checks} checks and the repeats: give more")
    return made


def _table(table: dict[str, Any], field: str, name: str, missing: Any = None) -> dict[str, Any]:
    value = table.pop(field, missing)
    if not isinstance(value, dict):
        raise ValueError(f"{name}: [{field}] is missing: make a study anew to see what belongs there")
    return value


def _refuse_unknown(table: dict[str, Any], known: set[str], name: str) -> None:
    for field in table:
        if field not in known:
            raise ValueError(f"{name}: {field!r} is unknown: known are {', '.join(sorted(known))}")


def _line(value: Any, field: str, name: str) -> None:
    if not isinstance(value, str) or not value.strip() or len(value) > 200 or "\n" in value:
        raise ValueError(f"{name}: {field} {value!r} is no line of text: give one of at most 200 characters")


def _number(value: Any, field: dataclasses.Field[Any], name: str) -> Any:
    low, high, whole = field.metadata["low"], field.metadata["high"], isinstance(field.default, int)
    kinds = int if whole else (int, float)
    if not isinstance(value, kinds) or isinstance(value, bool) or not math.isfinite(value) or not low <= value <= high:
        kind = "a whole number" if whole else "a number"
        raise ValueError(f"{name}: {field.name} {value!r} is out of range: give {kind} from {low} to {high}")
    return value if whole else float(value)


def _paragraphs(value: Any, field: str, name: str) -> tuple[str, ...]:
    right = isinstance(value, list) and value and all(isinstance(text, str) and len(text) <= LONGEST for text in value)
    if not right:
        raise ValueError(f"{name}: {field} {value!r:.60} is no list of paragraphs: give some, each in quotes")
    return tuple(value)


def _importance(value: Any, name: str) -> tuple[Importance, ...]:
    made = []
    for item in value if isinstance(value, list) else [value]:
        if not isinstance(item, dict) or set(item) != {"name", "text"}:
            raise ValueError(f"{name}: importance {item!r:.60} isn't right: give each a name and a text")
        for field in ("name", "text"):
            _line(item[field], f"importance {field}", name)
        made.append(Importance(**item))
    if len({item.name for item in made}) != len(made):
        raise ValueError(f"{name}: importance has a name twice: give each its own")
    return tuple(made)


def _codes(value: dict[str, Any], name: str) -> dict[str, str]:
    _refuse_unknown(value, {"training", "testing"}, f"{name}, [codes]")
    for phase, code in value.items():
        _line(code, f"code of {phase}", name)
    return value


# --- a new file -----------------------------------------------------------------------------------------------------------

CONSENT = (
    "You are invited to take part in a study on how people judge what machines do. It takes about half an hour.",
    "You will look at short clips and say what you think of them. There are no right or wrong answers.",
    "We keep your answers and how long they took. If a platform sent you, we also keep its id of you until you are paid; "
    "it is then removed. Answers are published without it.",
    "Taking part is voluntary. You may stop at any time by closing the page; what you have answered until then is kept.",
    "REPLACE THIS: who runs the study, whom to write to, what is paid, and which committee has approved it.",
)
DRIVING = (
    "You will see pairs of short scenes on a road with two lanes, seen from above. Watch the green car, and what it does "
    "when the car in front of it brakes.",
    "Say in which of the two scenes the green car drives more as you would expect of a good driver.",
)
ANYTHING = (
    "You will see pairs of short clips side by side. Something moves in each of them.",
    "Say in which of the two it does what you would rather expect of it.",
)
GROUND = {
    "goal": "green is where it should go",
    "ice": "blue is ice",
    "sand": "pale yellow is deep sand",
    "firm sand": "yellow is sand",
    "pit": "brown is a pit",
    "wall": "grey are walls",
}  # by the roles of what a scene shows
ANSWERING = (
    "Use the buttons or the keys: left or right for the side that you prefer, down if both are equal, up if you can't tell. "
    "You can answer once both clips have been shown, and may watch them again.",
)
RATING = (
    "You will see scenes one after the other. Rate each from 1, not at all what you would expect, to 10, exactly what you "
    "would expect.",
)
THANKS = ("Thank you for taking part.",)
DRIVING_IMPORTANCE = (
    Importance("speed", "The car drives fast."),
    Importance("distance", "The car keeps its distance to other cars."),
    Importance("relative_speed", "The car isn't much faster than the cars near it."),
    Importance("lane", "The car stays in its lane."),
)


def template(env: str, test_env: str, driving: bool, ground: Sequence[str] = (), **numbers: Any) -> str:
    """The file of a new study, with a comment at everything that can be changed.

    Args:
      env: whose pairs are compared in the training phase.
      test_env: whose scenes are rated in the testing phase.
      driving: whether both are roads.
      ground: roles of what there is to see in `env`; those that `GROUND` knows are explained.
      numbers: settings that aren't the defaults.
    """
    values = {field.name: numbers.get(field.name, field.default) for field in NUMBERS}
    if not driving and "checks" not in numbers:
        values["checks"] = 0
    about = DRIVING if driving else ANYTHING
    explained = [text for role, text in GROUND.items() if role in ground]
    if explained:
        legend = ", ".join(explained)
        about += (f"{legend[0].upper()}{legend[1:]}.",)
    texts = {
        "consent": CONSENT,
        "instructions_training": about + ANSWERING,
        "instructions_testing": RATING,
        "thanks": THANKS,
    }
    lines = [
        "# A study's settings and texts. Texts may be edited at any time: a server that is started anew shows them.",
        f"title = {_quoted('What machines do')}",
        f"address = {_quoted(f'http://127.0.0.1:{PORT}')}  # where participants reach the pages: links begin with it",
        f"env = {_quoted(env)}  # of the training phase; fixed, as test_env and seed are",
        f"test_env = {_quoted(test_env)}  # of the testing phase",
        "",
        *(f"{name} = {value}  # {_text_of(name)}" for name, value in values.items()),
        "",
        "# Completion codes that the platform expects. Without one, each participant is given a code of their own.",
        "[codes]",
        '# training = "C1A2B3C4"',
        '# testing = "C5D6E7F8"',
        "",
        "[texts]",
        *(line for name, text in texts.items() for line in (f"{name} = [", *_listed(text), "]")),
    ]
    if driving:
        lines += ["", "# What participants rate from 1 to 5, before they compare."]
        for item in DRIVING_IMPORTANCE:
            lines += ["[[importance]]", f"name = {_quoted(item.name)}", f"text = {_quoted(item.text)}"]
    return "\n".join(lines) + "\n"


def _text_of(name: str) -> str:
    return next(field.metadata["text"] for field in NUMBERS if field.name == name)


def _listed(texts: tuple[str, ...]) -> list[str]:
    return [f"  {_quoted(text)}," for text in texts]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a JSON string is a TOML string
