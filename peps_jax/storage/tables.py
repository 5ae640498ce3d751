"""Tables as CSV, as Markdown, and in LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def csv_bytes(records: Sequence[Mapping[str, Any]]) -> bytes:
    """`records` as CSV; a column for every name that any of them has."""
    columns = list(dict.fromkeys(name for line in records for name in line))  # environments may differ in their events
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return buffer.getvalue().encode()


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    shown = lambda row: "| " + " | ".join(row) + " |"
    return "\n".join([shown(head), "|" + "---|" * len(head), *map(shown, rows)]) + "\n"


def latex(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in LaTeX, for the package booktabs; a rule wherever the first column changes."""
    shown = lambda row: " & ".join(map(_escaped, row)) + r" \\"
    lines = [rf"\begin{{tabular}}{{ll{'r' * (len(head) - 2)}}}", r"\toprule", shown(head), r"\midrule"]
    for place, row in enumerate(rows):
        if place and row[0] != rows[place - 1][0]:
            lines.append(r"\midrule")
        lines.append(shown(row))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _escaped(text: str) -> str:
    written = {"%": r"\%", "_": r"\_", "±": r"$\pm$", "–": "--", "r̂": r"$\hat r$", "λ": r"$\lambda$"}
    for sign, command in written.items():
        text = text.replace(sign, command)
    return text
