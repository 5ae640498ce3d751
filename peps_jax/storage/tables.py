"""Tables as CSV and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any


def csv_bytes(records: Sequence[Mapping[str, Any]]) -> bytes:
    """`records` as CSV; a column for every name that any of them has."""
    columns = list(dict.fromkeys(name for line in records for name in line))  # worlds may differ in their events
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return buffer.getvalue().encode()


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    shown = lambda cells: "| " + " | ".join(cells) + " |"
    return "\n".join([shown(head), "|" + "---|" * len(head), *map(shown, rows)]) + "\n"
