"""The table that a sweep prints when it is done."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from peps_jax import methods
from peps_jax.sweep import results
from peps_jax.sweep.results import Row


def print_table(rows: Sequence[Row]) -> None:
    """A line for each environment, method and lambda: mean and standard deviation over the seeds that didn't fail."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for name in ("env", "method", "lambda"):
        table.add_column(name)
    records_of = {row.key.training: results.record(row) for row in rows}
    rates = list(dict.fromkeys(name for record in records_of.values() for name in record if name.endswith("_rate")))
    events = (name.removesuffix("_rate").replace("_", " ") for name in rates)
    for name in ("return", "explicability", *events, "seeds"):
        table.add_column(name, justify="right", no_wrap=True)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        lam = f"{row.key.lam:g}" if methods.get(row.key.method).uses_lam else "any"
        groups.setdefault((row.key.env, row.key.method, lam), []).append(row)
    for key, members in groups.items():
        trainings = {row.key.training: row for row in members}.values()
        records = [records_of[row.key.training] for row in trainings if not row.run.failed]
        failed = len(trainings) - len(records)
        seeds = f"{len(records)}" + (f", {failed} failed" if failed else "")
        figures = (_spread(records, name) for name in ("return_mean", "explicability_mean"))
        table.add_row(*key, *figures, *(_rate(records, name) for name in rates), seeds)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _spread(records: Sequence[dict[str, Any]], name: str) -> str:
    values = [record[name] for record in records]
    return f"{np.mean(values):.1f} ± {np.std(values):.1f}" if values else "–"


def _rate(records: Sequence[dict[str, Any]], name: str) -> str:
    values = [record[name] for record in records if name in record]
    return f"{100 * np.mean(values):.0f} %" if values else "–"
