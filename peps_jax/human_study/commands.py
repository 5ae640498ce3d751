"""The command line.

    python -m peps_jax.human_study make --env highway-dry --test-env highway-rain --out results/study
    python -m peps_jax.human_study invite 15 --phase training --out results/study
    python -m peps_jax.human_study serve --out results/study

Bad input gets one line on stderr and exit code 2. Ctrl-C loses nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from peps_envs.registry import unknown_name
from peps_jax.command_line import Command, Parser, Work, called, number, options
from peps_jax.human_study import making, tokens, work_commands
from peps_jax.human_study.action import OUT, Action, Errand
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import ConflictError
from peps_jax.human_study.server import Study
from peps_jax.human_study.serving import LOOPBACK, Serving
from peps_jax.human_study.settings import NUMBERS, PORT, Folder
from peps_jax.storage import files
from peps_jax.storage.tables import csv_bytes

PROG = called("peps_jax.human_study", "peps-study")
MOST = 1000  # invitations at once
EXPORT = "export"
DESCRIPTION = "A study with people, and training that waits for their answers."


def _make_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", default="highway-dry", metavar="NAME", help="of the training phase [highway-dry]")
    parser.add_argument(
        "--test-env", default=None, metavar="NAME", help="of the testing phase [highway-rain, or --env]"
    )
    for field in NUMBERS:
        text = f"{field.metadata['text']} [{field.default}]".replace("%", "%%")
        flag = f"--{field.name.replace('_', '-')}"
        parser.add_argument(flag, default=None, dest=field.name, help=text, **options(field.default))


def _make(values: argparse.Namespace) -> Work:
    folder = Folder(Path(values.out))
    env = values.env
    test_env = values.test_env or ("highway-rain" if env == "highway-dry" else env)
    given = {field.name: getattr(values, field.name) for field in NUMBERS}
    numbers = {name: value for name, value in given.items() if value is not None}
    made = making.check(folder, env, test_env, numbers)

    def make() -> int:
        print(f"making pairs of {made.env} for {made.participants} participants", file=sys.stderr, flush=True)
        making.make(folder, env, test_env, numbers)
        print(f"in {folder.path}: {folder.file.name} (settings and texts: edit it), {folder.database.name}")
        print(f"go on with: {PROG} invite {made.participants} --phase training --out {folder.path}")
        return 0

    return Errand(make, kept=f"no study is in {folder.path}")


def _invite_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("number", nargs="?", type=number(int, 15), metavar="N", help="how many links")
    parser.add_argument("--phase", default="training", metavar="PHASE", help="training or testing [training]")
    parser.add_argument("--platform", default=None, metavar="NAME", help="one link for all: prolific or mturk")


def _invite(values: argparse.Namespace) -> Work:
    if values.phase not in ("training", "testing"):
        raise ValueError(unknown_name("phase", values.phase, ("training", "testing")))
    if values.platform is not None and values.platform not in tokens.PLATFORMS:
        raise ValueError(unknown_name("platform", values.platform, tokens.PLATFORMS))
    if (values.number is None) == (values.platform is None):
        raise ValueError("invite takes a number of links, or --platform for one link that all use")
    if values.number is not None and not 1 <= values.number <= MOST:
        raise ValueError(f"number {values.number} is out of range: choose 1 to {MOST}")
    folder, database = _opened(values)
    address, key = folder.settings().address.rstrip("/"), tokens.read_key(folder.key)
    if values.phase == "testing" and not database.scenes():
        raise ValueError("phase 'testing' has nothing to rate: train agents first")

    def invite() -> int:
        if values.platform is not None:
            token = tokens.derived(key, f"{values.platform} {values.phase}")
            database.add_link(tokens.digest(token), values.phase, values.platform)
            print(f"{address}/{tokens.PLATFORMS[values.platform].link}#{token}")
            return 0
        made = [tokens.new() for _ in range(values.number)]
        database.invite(values.phase, list(map(tokens.digest, made)))
        for token in made:
            print(f"{address}/#{token}")
        return 0

    return Errand(invite, close=database.close)


def _serve_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", default=PORT, help=f"where it listens [{PORT}]", **options(PORT))
    parser.add_argument("--host", default=LOOPBACK, metavar="HOST", help=f"for whom: 0.0.0.0 for all [{LOOPBACK}]")
    parser.add_argument("--behind-proxy", action="store_true", help="a proxy here says where requests come from")


def _serve(values: argparse.Namespace) -> Work:
    study = Study(Folder(Path(values.out)))
    try:
        serving = Serving(study, values.host, values.port, values.behind_proxy)
    except ValueError:
        study.database.close()
        raise

    def serve() -> int:
        print(f"researcher: {serving.researcher_link}", flush=True)
        print(f"participants: {serving.address}/ with the links that invite prints; Ctrl-C stops", flush=True)
        serving.run()
        return 0

    return Errand(serve, kept="every answer is kept; the same command goes on", close=serving.close)


def _status_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--payments", action="store_true", help="who is to be paid: platforms' ids and codes")


def _status(values: argparse.Namespace) -> Work:
    _, database = _opened(values)

    def status() -> int:
        if values.payments:
            sys.stdout.write(csv_bytes(_payments(database)).decode())
            return 0
        found = database.overview()
        shown = lambda share: "-" if share is None else f"{100 * share:.0f} %"
        for one in found["participants"]:
            failed = f", {one['checks_failed']} checks failed" if one["checks_failed"] else ""
            print(f"{one['number']:4} {one['phase']:9} {one['page']:12} {one['done']:4} of {one['total']}{failed}")
        print(
            f"{found['answers']} answers, {found['ratings']} ratings, {found['answers_per_minute']} in the last minute; agreement "
            f"{shown(found['agreement'])}, left {shown(found['left_share'])}, repeats alike {shown(found['repeat_consistency'])}"
        )
        if found["round"]:
            print(f"round {found['round']['number']}, {found['round']['state']}: {found['round']['says']}")
        wrong = database.check_integrity()
        for line in wrong:
            print(f"damaged: {line}", file=sys.stderr)
        return 1 if wrong else 0

    return Errand(status, close=database.close)


def _payments(database: Database) -> list[dict[str, Any]]:
    rows = []
    for row in database.payments():
        raw = row.pop("raw") or {}
        rows.append(row | {name: raw.get(name, "") for name in _platform_columns(row["platform"])})
    return rows


def _platform_columns(platform: str | None) -> tuple[str, ...]:
    return () if platform is None else tokens.PLATFORMS[platform].names


def _export_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--to", default=None, metavar="DIR", help=f"folder of the files [{EXPORT} in --out]")


def _export(values: argparse.Namespace) -> Work:
    folder, database = _opened(values)
    target = folder.path / EXPORT if values.to is None else Path(values.to)
    files.check_writable(target)

    def export() -> int:
        tables = database.tables()
        files.make_folder(target)
        for name, rows in tables.items():
            files.write_whole(target / f"{name}.csv", csv_bytes(rows))
        files.write_whole(target / "study.json", files.json_bytes(tables))
        print(f"in {target}: {', '.join(f'{name}.csv' for name in tables)}, study.json")
        return 0

    return Errand(export, close=database.close)


def _erase(values: argparse.Namespace) -> Work:
    _, database = _opened(values)

    def erase() -> int:
        try:
            erased = database.erase()
        except ConflictError as error:
            print(error, file=sys.stderr)
            return 1
        print(f"{erased} platform ids removed; their keyed hashes stay, so that nobody takes part twice")
        return 0

    return Errand(erase, close=database.close)


def _opened(values: argparse.Namespace) -> tuple[Folder, Database]:
    folder = Folder(Path(values.out))
    folder.check()
    return folder, Database(folder.database)


ACTIONS: dict[str, Action] = {
    "make": Action("a study's folder: settings and texts, pairs, database", _make_flags, _make),
    "invite": Action("links for participants", _invite_flags, _invite),
    "serve": Action("the pages", _serve_flags, _serve),
    "status": Action("who is where, agreement, whether the database is whole", _status_flags, _status),
    "export": Action("CSV and JSON without personal data", _export_flags, _export),
    "erase": Action("removes platforms' ids", lambda parser: None, _erase),
    **work_commands.ACTIONS,
}


def parser(name: str) -> Parser:
    """The parser of one command's flags."""
    action = ACTIONS[name]
    before = "N " if name == "invite" else ""
    made = Parser(f"{PROG} {name}", before, description=action.about[0].upper() + action.about[1:] + ".")
    made.add_argument("--out", default=OUT, metavar="DIR", help=f"the study's folder [{OUT}]")
    action.flags(made)
    return made


def overview() -> Parser:
    """What shows all commands."""
    texts = "\n".join(f"  {name:10} {action.about}" for name, action in ACTIONS.items())
    return Parser(PROG, "COMMAND ", description=DESCRIPTION, epilog=f"commands, each with --help:\n{texts}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    return Command(PROG, _read, lambda values: ACTIONS[values.command].prepare(values)).carry_out(arguments)


def _read(arguments: Sequence[str]) -> argparse.Namespace:
    name, *flags = given = arguments or ["--help"]
    if name not in ACTIONS:
        overview().parse(given if name.startswith("-") else [])
        overview().error(unknown_name("command", name, ACTIONS))
    if not ACTIONS[name].computes:
        jax.config.update("jax_platforms", "cpu")  # a training beside it may need the others
    values = parser(name).parse(flags)
    values.command = name
    return values
