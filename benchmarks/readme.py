"""Writes measured and generated tables into the README and the pages under docs/, so that no figure there is typed by hand.

    make readme

A table stands between `<!-- begin FILE -->` and `<!-- end -->`, where FILE is what a measuring command wrote; the pictures that
it shows lie beside it. `<!-- begin headline FILE -->` is the README's short table of FILE, a table1.csv, and
`<!-- begin settings -->` lists the fields of `Config`.
"""

from __future__ import annotations

import csv
import dataclasses
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from peps_jax import Config
from peps_jax.command_line import shown
from peps_jax.storage.tables import markdown

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MARKED = re.compile(r"<!-- begin (?:(\w+)(?: (\S+/\S+))?|(\S+/\S+)) -->\n.*?<!-- end -->", flags=re.DOTALL)

SHOWN = (("peps", "PEPS"), ("sac", "SAC"), ("drlhp", "DRLHP"))  # methods of the short table
SCORES = ("return", "explicability")
BEST = "planner, peps"  # knows the models, and plans for Eq. (6)


def embedded(text: str, page: Path) -> str:
    """`text` of `page` with every marked place holding what belongs there."""

    def replace(match: re.Match) -> str:
        kind, argument, file = match.groups()
        content = GENERATED[kind](argument) if kind else measured(file, page)
        marker = match[0].partition("\n")[0]
        return f"{marker}\n{content.strip()}\n<!-- end -->"

    return MARKED.sub(replace, text)


def measured(file: str, page: Path) -> str:
    """The content of `file`, with the pictures beside it named as `page` sees them."""
    folder = Path(os.path.relpath((ROOT / file).parent, page.parent)).as_posix()
    return re.sub(r"\]\((?=[^)/]+\.(?:png|gif)\))", f"]({folder}/", (ROOT / file).read_text(encoding="utf-8"))


def published(file: str) -> dict[tuple[str, str], dict[str, str]]:
    """The lines of `file`, a table1.csv, by domain and method."""
    with open(ROOT / file, encoding="utf-8", newline="") as table_:
        return {(row["domain"], row["method"]): row for row in csv.DictReader(table_)}


def headline(file: str) -> str:
    """How many seeds of PEPS, SAC and DRLHP arrive in each domain, scores with intervals, and the planner's explicability."""
    rows = published(file)
    domains = [domain for domain, method in rows if method == BEST]

    def estimate(domain: str, method: str, score: str) -> str:
        value, low, high = (float(rows[domain, method][f"{score}{end}"]) for end in ("", "_low", "_high"))
        return f"{value:.1f} [{low:.1f}, {high:.1f}]"

    arrived = lambda domain: " / ".join(rows[domain, method]["arrived"] for method, _ in SHOWN)
    scores = (f"{score}, {title}" for score in SCORES for _, title in SHOWN)
    number = rows[domains[0], SHOWN[0][0]]["trained"]
    head = [
        "domain",
        f"arrive, of {number}: {' / '.join(title for _, title in SHOWN)}",
        *scores,
        "explicability, planner",
    ]
    body = [
        [
            domain.removeprefix("nav-").upper(),
            arrived(domain),
            *(estimate(domain, method, score) for score in SCORES for method, _ in SHOWN),
            f"{float(rows[domain, BEST]['explicability_mean']):.1f}",
        ]
        for domain in domains
    ]
    return markdown(head, body)


def settings(_: str | None) -> str:
    """The fields of `Config` by their groups: flag, default and meaning."""
    groups: dict[str, list[Sequence[str]]] = {}
    for field in dataclasses.fields(Config):
        default = "" if field.default is None else f"`{shown(field.default)}`"
        kind = "traced" if field.metadata.get("pytree_node", True) else "static"
        row = (f"`{field.name}`", default, kind, field.metadata["help"].replace("|", "\\|"))
        groups.setdefault(field.metadata["group"], []).append(row)
    head = ("field", "default", "kind", "what it is")
    title = lambda name: name.upper() if name == "sac" else name.capitalize()
    return "\n\n".join(f"### {title(name)}\n\n{markdown(head, rows).strip()}" for name, rows in groups.items())


GENERATED: dict[str, Callable[[str | None], str]] = {"headline": headline, "settings": settings}


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(embedded(page.read_text(encoding="utf-8"), page), encoding="utf-8")
