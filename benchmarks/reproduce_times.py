"""What each result of a `peps_jax.reproduce` folder took, from the seconds that its parts were made in.

    python benchmarks/reproduce_times.py results/reproduce

Writes benchmarks/results/reproduce_times.md. Seconds are a training's share of its batch: compilation and pictures come on top. The
driving study keeps none, and has no row.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from peps_jax import Config
from peps_jax.reproduce.__main__ import RESULTS
from peps_jax.reproduce.plan import Need, Plan, Training
from peps_jax.reproduce.store import HEAD, KEPT
from peps_jax.storage import files
from peps_jax.storage.tables import markdown

OUT = Path(__file__).parent / "results" / "reproduce_times.md"


def seconds_of(folder: Path, needs: Iterable[Need]) -> dict[str, float] | None:
    """Of each part, by its name: the median of its method's, so that what else the machine did meanwhile counts little.

    None if one isn't there, or keeps no seconds.
    """
    by_kind: dict[str, dict[str, float]] = {}
    for need in needs:
        path = folder / KEPT / f"{need.name}.npz"
        if not path.exists():
            return None
        with np.load(path) as arrays:
            if "seconds" not in arrays:
                return None
            kind = need.config.method if isinstance(need, Training) else "planner"
            by_kind.setdefault(kind, {})[need.name] = float(arrays["seconds"])
    return {name: float(np.median(list(alike.values()))) for alike in by_kind.values() for name in alike}


def table(folder: Path) -> str:
    """A row for each result that is complete in the folder, in the order of the command's help."""
    head = json.loads((folder / HEAD).read_text(encoding="utf-8"))
    plan, before, rows = Plan(Config(), head["seeds"], head["settings"]["episodes"]), set(), []
    for name, result in RESULTS.items():
        parts = seconds_of(folder, result.needs(plan))
        if parts is None:
            continue
        new = {part: seconds for part, seconds in parts.items() if part not in before}
        before |= set(parts)
        minutes = (f"{sum(some.values()) / 60:.0f}" for some in (parts, new))
        rows.append([f"`{name}`", str(len(parts)), *minutes])
    shown = markdown(["result", "trainings and plans", "minutes by itself", "after those above"], rows)
    return f"{shown}\nWith `--seeds {head['seeds']}` on {len(head['devices'])} cores; each method's compilation comes on top.\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of `python -m peps_jax.reproduce --out`")
    folder = parser.parse_args().folder
    if not (folder / HEAD).is_file():
        parser.error(f"folder {str(folder)!r} holds no reproduction ({HEAD})")
    text = table(folder)
    files.write_whole(OUT, text.encode())
    print(text)


if __name__ == "__main__":
    main()
