"""What a measurement says: one table, sentences, and one picture."""

from __future__ import annotations

import pathlib
from typing import Any

from rounds import BY_MINIBATCH, PARTS

from peps_jax.drawing.panels import COLOURS, QUIET
from peps_jax.storage.tables import markdown
from peps_jax.train import VALUED_TOGETHER

Record = dict[str, Any]
AIMS = {  # of ratios within one run, and of seconds
    "roofline, 64": 0.85,
    "roofline, 256": 0.9,
    "fastest peer, 64": 1.0,
    "fastest peer, 256": 1.0,
    "PEPS of SAC": 0.7,
    "imitation": 20.0,
    "linear": 0.1,
    "warm start": 3.0,
}
AT_MOST = ("linear", "warm start")
ALSO_TRIED = (  # each was compared with what is taken, in one process or right after it
    "Tried without gain: XLA's wider vectors, its oneDNN and XNNPACK products, inexact floating-point functions, another "
    "scheduler, bfloat16, an ensemble's networks one after the other. With gain: the noise of a round's actions drawn at once, as "
    "its minibatches are."
)


def fastest_peer(rows: dict[str, Record]) -> tuple[str, float] | None:
    """Its name and rate, of those that are there."""
    rates = {name: row["rate"] for name, row in rows.items() if name != "peps_jax" and "rate" in row}
    return max(rates.items(), key=lambda item: item[1]) if rates else None


def spread_of_seeds(seconds: dict[str, float], devices: int) -> float:
    """How far a seed's cost strays from the mean over numbers of seeds, from one for each device on."""
    each = [taken / int(number) for number, taken in seconds.items() if int(number) >= devices]
    mean = sum(each) / len(each)
    return max(abs(cost / mean - 1) for cost in each)


def ratios(record: Record) -> dict[str, float | None]:
    """What `AIMS` are about, seconds of a warm start among it; None where there is no peer."""
    training, devices = record["training"], record["machine"]["devices"]
    made: dict[str, float | None] = {}
    for width, rows in training["sac"].items():
        peer = fastest_peer(rows)
        made[f"fastest peer, {width}"] = rows["peps_jax"]["rate"] / peer[1] if peer else None
        made[f"roofline, {width}"] = rows["peps_jax"]["rate"] / record["roofline"][width]["rate"]
    made["PEPS of SAC"] = training["peps"]["64"]["rate"] / training["sac"]["64"]["peps_jax"]["rate"]
    peer = fastest_peer(training["drlhp"])
    made["imitation"] = training["drlhp"]["peps_jax"]["rate"] / peer[1] if peer else None
    made["linear"] = spread_of_seeds(record["growth"]["seeds"], devices)
    made["warm start"] = record["growth"]["compilation"]["warm"]
    return made


# --- text -----------------------------------------------------------------------------------------------------------------


def text(record: Record) -> str:
    """The table, and what to know about it."""
    return "\n".join([_table(record), "![What was measured](speed.png)", "", *_sentences(record)]) + "\n"


def _table(record: Record) -> str:
    rows = []
    environments = record["environments"]
    for name, row in environments["rates"].items():
        rows.append(_row(f"environment {name}", "peps_jax", row))
        for title, other in environments["others"].items():
            if other["environment"] == name:
                rows.append(_row(f"environment {name}", title, other, row["rate"]))
    for width, libraries in record["training"]["sac"].items():
        roofline = record["roofline"][width]["rate"]
        rows += _library_rows(f"SAC, {width} units", libraries, roofline)
    rows += _library_rows("DRLHP, 64 units", record["training"]["drlhp"])
    for width, row in record["training"]["peps"].items():
        rows.append(_row(f"PEPS, {width} units", "peps_jax", row))
    head = ["measured", "program", "environment steps a second", "peps_jax is so many times as fast", "of the roofline"]
    return markdown([*head, "compilation, s"], rows)


def _library_rows(measured: str, libraries: dict[str, Record], roofline: float | None = None) -> list[list[str]]:
    """The fastest first."""
    rows = []
    for title, row in sorted(libraries.items(), key=lambda item: -item[1].get("rate", 0.0)):
        ours = None if title == "peps_jax" else libraries["peps_jax"]["rate"]
        rows.append(_row(measured, title, row, ours, roofline))
    return rows


def _row(
    measured: str, program: str, row: Record, ours: float | None = None, roofline: float | None = None
) -> list[str]:
    if "missing" in row:
        return [measured, program, f"not measured: {row['missing'].replace('|', ' ')}", "", "", ""]
    times = f"{ours / row['rate']:,.3g}" if ours else ""
    share = f"{row['rate'] / roofline:.0%}" if roofline else ""
    compilation = f"{row['compilation']:.1f}" if "compilation" in row else ""
    return [measured, program, f"{row['rate']:,.0f}", times, share, compilation]


def _sentences(record: Record) -> list[str]:
    training, machine = record["training"], record["machine"]
    return [
        f"{machine['processor']}, {machine['devices']} devices, {record['minutes']:.0f} minutes in all"
        + (", **much too short to mean anything**" if record["quick"] else "")
        + ". Rates are summed over all that ran at the same time, and compilation is apart.",
        "",
        *(f"* {line}" for line in (
            _aims(record), _environments(record), _equal_work(training), _layouts(training), *_rounds(record["rounds"]),
            _layers(record["layers"]), ALSO_TRIED, _roofline(record), *_growth(record),
        )),
    ]  # fmt: skip


def _aims(record: Record) -> str:
    said = {name: "not measured" if value is None else f"{value:.2f}" for name, value in ratios(record).items()}
    for name, value in ratios(record).items():
        if name in AIMS and value is not None and (value > AIMS[name] if name in AT_MOST else value < AIMS[name]):
            said[name] += " (missed)"
    return (
        f"Aims, as ratios in this run: 0.85 of the roofline at 64 units: {said['roofline, 64']}; 0.9 at 256: "
        f"{said['roofline, 256']}; ahead of the fastest peer, which has a process on each core if that is faster, at 64: "
        f"{said['fastest peer, 64']}, at 256: {said['fastest peer, 256']}; PEPS at 0.7 of SAC's rate: {said['PEPS of SAC']}; a "
        f"seed's cost the same within 0.1: {said['linear']}; a warm start within 3 s: {said['warm start']}."
    )


def _environments(record: Record) -> str:
    difference = record["environments"].get("difference")
    check = f"; 500 of its steps are the JAX environment's within {difference:.0e}" if difference is not None else ""
    return f"Environments: random actions, a new start after an episode. NumPy's D1 has nothing of the other domains{check}."


def _equal_work(training: Record) -> str:
    ways = [
        f"{title} {row['way']}" for title, row in training["sac"]["64"].items() if title != "peps_jax" and "rate" in row
    ]
    return (
        "SAC: D1, 16 environments, an update for every 4 steps, batches of 256, two layers, twin critics, Adam at 1e-3. Ours are "
        "2 trainings on each core. A peer has all cores, as one process or as a training on each, whichever is faster "
        f"(at 64: {', '.join(ways)}). Stable-Baselines3 and SBX step D1 in one NumPy array for all 16, Brax "
        "and rejax step the JAX environment; evaluations are left out. DRLHP: in 400 steps 30 answers, and "
        "20 gradient steps on 32 of them by each of five networks; imitation's teacher answers by r_A, which takes it less."
    )


def _layouts(training: Record) -> str:
    parts = []
    for width, layouts in training["layouts"].items():
        ours = training["sac"][width]["peps_jax"]["rate"]
        parts += [f"{name} {rate / ours:.0%} at {width}" for name, rate in layouts.items()]
    return f"Tried: runs one after the other on each core (taken); {', '.join(parts)} of its rate."


def _rounds(rounds: Record) -> list[str]:
    lines = []
    for name, seconds in rounds.items():
        whole, parts = seconds["whole"], {part: seconds[part] for part in PARTS if part in seconds}
        shares = ", ".join(f"{PARTS[part]} {taken / whole:.0%}" for part, taken in parts.items())
        method, width = name.split()
        lines.append(
            f"A round of {method.upper()} at {width} takes {1000 * whole:.0f} ms: {shares}. Parts were timed as programs of "
            f"their own; together they are {sum(parts.values()) / whole:.0%} of the whole."
        )
        if BY_MINIBATCH in seconds:
            lines.append(
                f"Tried: {PARTS['value']} of what is drawn from replay, {VALUED_TOGETHER} minibatches at a time, took "
                f"{seconds[BY_MINIBATCH] / seconds['value']:.1f} times as long as of all that is there (taken)."
            )
    return lines


def _layers(layers: Record) -> str:
    told = []
    for name, ways in layers.items():
        ours = ways[ways["taken"]]
        others = [
            f"in {way} {seconds / ours:.2f} times as long"
            for way, seconds in ways.items()
            if way not in ("taken", ways["taken"])
        ]
        told.append(f"{name} {1e6 * ours:.0f} µs in {ways['taken']} (taken), {', '.join(others)}")
    return (
        "Tried: how the arguments of a network's products lie. A step on its gradient, written out for rows and JAX's own for "
        f"columns, takes {'; '.join(told)}."
    )


def _roofline(record: Record) -> str:
    parts = []
    for width, roofline in record["roofline"].items():
        rate, rounds = record["training"]["sac"][width]["peps_jax"]["rate"], record["rounds"][f"sac {width}"]
        updates = min(rounds["improve"] / rounds["whole"], 1.0)  # timed apart, it may come out longer than the whole
        outside = 1 - updates
        share = rate / roofline["rate"]
        parts.append(
            f"at {width} an update is {roofline['multiply_adds'] / 1e6:.1f} million multiply-adds, which this machine makes at "
            f"{roofline['multiply_adds_per_second'] / 1e9:.0f} billion a second where it does nothing else; SAC reaches "
            f"{share:.0%} of that ({outside:.0%} of its time is outside the updates, {max(updates - share, 0):.0%} is in them but "
            "not in products)"
        )
    return f"Roofline: the products of an update's shapes alone, on as many devices at once; {'; '.join(parts)}."


def _growth(record: Record) -> list[str]:
    growth = record["growth"]
    lines = []
    seeds = growth["seeds"]
    each = ", ".join(f"{number}: {1000 * taken / int(number):.0f}" for number, taken in seeds.items())
    lines.append(f"Milliseconds a seed of a short PEPS training, by the number of seeds: {each}.")
    for kind in ("environments", "ensemble", "width"):
        each = ", ".join(f"{size}: {1e6 * taken:.0f}" for size, taken in growth[kind].items())
        lines.append(f"Microseconds an environment step of PEPS on one core, by {kind}: {each}.")
    compilation = growth["compilation"]
    lines.append(
        f"A sweep's compilation in a fresh process: {compilation['cold']:.1f} s; {compilation['warm']:.1f} s once its structure "
        "is known, for programs are kept (`peps_jax/execution/compilation_cache.py`)."
    )
    return lines


# --- picture --------------------------------------------------------------------------------------------------------------


def draw(record: Record, path: pathlib.Path) -> None:
    """Environments, SAC beside others and the roofline, PEPS's round, and cost as work grows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.0), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2)
    _draw_environments(panels[0, 0], record["environments"])
    _draw_sac(panels[0, 1], record)
    _draw_rounds(panels[1, 0], record["rounds"])
    _draw_growth(panels[1, 1], record["growth"])
    for panel in panels.flat:
        panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def _bars(panel: Any, names: list[str], rates: list[float | None], colours: list[str]) -> None:
    places = range(len(names))[::-1]
    least = min(filter(None, rates)) / 4
    panel.barh(places, [rate or least for rate in rates], color=colours)
    panel.set_yticks(places, names)
    panel.set_xscale("log")
    for place, rate in zip(places, rates, strict=True):
        label = "not measured" if rate is None else f"{rate:,.0f}"
        panel.annotate(label, (rate or least, place), (4, 0), textcoords="offset points", va="center", fontsize=8)
    panel.set_xlim(least, max(filter(None, rates)) * 6)


def _draw_environments(panel: Any, environments: Record) -> None:
    rows = [(f"{name}, peps_jax", row.get("rate"), COLOURS[0]) for name, row in environments["rates"].items()]
    rows += [(f"{row['environment']}, {name}", row.get("rate"), QUIET) for name, row in environments["others"].items()]
    _bars(panel, *map(list, zip(*rows, strict=True)))
    panel.set_title("Environments alone: steps a second on all cores")


def _draw_sac(panel: Any, record: Record) -> None:
    training, rows = record["training"], []
    for width, libraries in training["sac"].items():
        for name, row in sorted(libraries.items(), key=lambda item: -item[1].get("rate", 0.0)):
            rows.append((f"SAC {width}, {name}", row.get("rate"), COLOURS[0] if name == "peps_jax" else QUIET))
        rows.append((f"SAC {width}, products alone", record["roofline"][width]["rate"], COLOURS[1]))
    rows += [(f"PEPS {width}, peps_jax", row["rate"], COLOURS[4]) for width, row in training["peps"].items()]
    _bars(panel, *map(list, zip(*rows, strict=True)))
    panel.set_title("Training: steps a second on all cores")


def _draw_rounds(panel: Any, rounds: Record) -> None:
    shown = list(PARTS)
    for place, seconds in enumerate(reversed(rounds.values())):
        left = 0.0
        for part, colour in zip(shown, COLOURS, strict=True):
            share = seconds.get(part, 0.0) / seconds["whole"]
            panel.barh(place, share, left=left, color=colour, label=PARTS[part] if place == len(rounds) - 1 else None)
            left += share
    panel.axvline(1.0, color=QUIET, linewidth=1)
    panel.set_yticks(range(len(rounds)), [f"{name.upper()}" for name in reversed(rounds)])
    panel.set_xlabel("share of the whole round's time")
    panel.set_title("Where a round's time goes, each part on its own")
    panel.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.35, -0.16), frameon=False)


def _draw_growth(panel: Any, growth: Record) -> None:
    kinds = ("seeds", "environments", "ensemble", "width")
    for kind, colour in zip(kinds, COLOURS, strict=False):
        sizes = [int(size) for size in growth[kind]]
        # of all that is trained at once: seeds' own figures are of all seeds, environments' of one of them
        scale = {"environments": sizes}.get(kind, [1] * len(sizes))
        costs = [cost * factor for cost, factor in zip(growth[kind].values(), scale, strict=True)]
        panel.plot([size / sizes[0] for size in sizes], [cost / costs[0] for cost in costs], "o-", color=colour,
                   label=f"{kind} {sizes[0]} to {sizes[-1]}")  # fmt: skip
    largest = max(max(map(int, growth[kind])) / min(map(int, growth[kind])) for kind in kinds)
    panel.plot([1, largest], [1, largest], color=QUIET, linewidth=1, linestyle="--", label="in proportion")
    panel.set_xscale("log", base=2)
    panel.set_yscale("log", base=2)
    panel.set_xlabel("so many times the size")
    panel.set_ylabel("so many times the time")
    panel.set_title("What more of it costs PEPS")
    panel.legend(fontsize=8, frameon=False)
