"""The pages with the server that there is: both phases to their end, and all that may come between."""

import os
import signal
import socket
import subprocess
import sys
from contextlib import closing
from unittest import mock

import pytest
import study_cases
from study_cases import Client, invite, make_study, served

from browser.fake import VIEW, clicking, clip
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Stimulus
from peps_jax.storage import files

expect = pytest.importorskip("playwright.sync_api", reason="Playwright isn't installed").expect

PAIRS = 6
LANES = (0, 400)  # of the car in the first clip of a pair and in the second


def drawn(number, sides=2):
    """A pair, or with one side a scene, that says which it is and can be drawn."""
    drawings = tuple(files.json_bytes(clip(LANES[side]) | {"number": number}).decode() for side in range(sides))
    return Stimulus(files.digest(f"{number} {sides}".encode()), b"arrays", drawings)


@pytest.fixture
def folder(tmp_path):
    """A study of six pairs for each, one of which is a check and one a repeat, and of three scenes."""
    numbers = dict(participants=10, pairs=PAIRS, repeats=1 / PAIRS, checks=1, shared=0.0, scenes=3)
    with mock.patch.object(study_cases, "stimulus", drawn):
        made = make_study(tmp_path / "study", pool=80, agents=("peps", "sac"), **numbers)
    with closing(Database(made.database)) as database:
        database.note("view", VIEW)
        database.note("test_view", VIEW)
    return made


@pytest.fixture
def shown(context):
    """Every pair and scene that the server showed, in its order."""
    found = []

    def note(response):
        if response.url.endswith(("/api/pair", "/api/scene")) and response.ok and "place" in (told := response.json()):
            found.append(told)

    context.on("response", note)
    return found


def ready(page):
    page.wait_for_selector(".hint:has-text('Now choose'):visible")


def gone(page, number):
    """Waits until so many are answered."""
    page.wait_for_selector(f"#progress-text:has-text(' {number + 1} of '), [data-page=done]:not([hidden])")


def second(pair):
    """The side on which the second clip of a pair is shown."""
    return "left" if pair["left"]["shapes"][0]["at"][1] == LANES[1] else "right"


def start(page, click):
    """Through the pages before the pairs or scenes."""
    click("#agree")
    page.wait_for_selector("#check-on[aria-disabled=false]")
    click("#check-on")
    click("#instructions-on")
    page.wait_for_selector("#begin:visible, #practice-mark:visible")
    if page.locator("#practice-mark").is_visible():
        for following in ("2 of 2", None):
            ready(page)
            click("#equal")
            page.wait_for_selector(f"#progress-text:has-text('{following}')" if following else "#begin:visible")
    click("#begin")


@pytest.mark.parametrize("by", ["keys", "buttons"])
def test_the_training_phase(page, folder, shown, by):
    """Who always takes the second clip, whatever side it is on, is written down so."""
    with served(folder) as serving:
        page.goto(f"{serving.address}/#{invite(folder)[0]}")
        click = clicking(page, by)
        start(page, click)
        page.wait_for_selector("#importance-on:visible")
        page.keyboard.type("1354")
        click("#importance-on")
        for place in range(1, PAIRS + 1):
            ready(page)
            side = second(shown[-1])
            if by == "keys":
                page.keyboard.press(f"Arrow{side.title()}")
            else:
                page.click(f"#{side}")
            gone(page, place)
        assert page.locator("#code").text_content().strip()
        assert page.context.cookies() == []
    assert [pair["place"] for pair in shown] == list(range(PAIRS))
    sides = [second(pair) for pair in shown]
    assert sides.count("left") == PAIRS / 2, "exactly half are swapped"
    with closing(Database(folder.database)) as database:
        told = database.answers()
        assert len(told) == PAIRS - 2, "the check and the repeat aren't among them"
        assert {one.preferred for one in told} == {0.0}
        assert database.repeat_consistency() == 1.0
        assert database.overview()["left_share"] == 0.5


@pytest.mark.parametrize("by", ["keys", "buttons"])
def test_the_testing_phase(page, folder, shown, by):
    with served(folder) as serving:
        page.goto(f"{serving.address}/#{invite(folder, phase='testing')[0]}")
        start(page, clicking(page, by))
        for place, rating in enumerate((1, 10, 5, 9, 2, 7), 1):
            ready(page)
            if by == "keys":
                page.keyboard.press(str(rating % 10))
            else:
                page.locator("#ratings button").nth(rating - 1).click()
            gone(page, place)
        assert page.locator("#code").text_content().strip()
    with closing(Database(folder.database)) as database:
        assert sorted(row["rating"] for row in database.tables()["ratings"]) == [1, 2, 5, 7, 9, 10]
    assert not any("peps" in str(scene) for scene in shown), "nobody is told whose scene it is"


def test_reload_back_and_a_second_tab_show_the_same_pair(context, page, folder, shown, complaints):
    with served(folder) as serving:
        token = invite(folder)[0]
        Client(serving.address, token).begin()
        page.goto(f"{serving.address}/#{token}")
        ready(page)
        page.keyboard.press("ArrowDown")
        gone(page, 1)
        page.reload()
        ready(page)
        page.goto("about:blank")
        page.go_back()
        ready(page)
        other = context.new_page()
        other.goto(page.url)
        ready(other)
        first, *again = shown[1:]
        assert len(again) == 3
        assert all(pair == first for pair in again), "one pair, on its sides"
        page.keyboard.press("ArrowLeft")
        gone(page, 2)
        other.keyboard.press("ArrowRight")
        gone(other, 2)
        complaints[:] = [text for text in complaints if "409" not in text]
    with closing(Database(folder.database)) as database:
        assert [row["choice"] for row in database.tables()["answers"]] == ["equal", "left"]


def test_ten_browsers_side_by_side(browser, folder, complaints):
    with served(folder) as serving:
        tokens = invite(folder, 10)
        contexts = [browser.new_context(viewport={"width": 640, "height": 480}) for _ in tokens]
        pages = []
        for context, token in zip(contexts, tokens, strict=True):
            complaints.watch(context)
            Client(serving.address, token).begin()
            pages.append(context.new_page())
            pages[-1].goto(f"{serving.address}/#{token}")
        for place in range(1, PAIRS + 1):
            for page in pages:
                ready(page)
                page.keyboard.press("ArrowRight")
            for page in pages:
                gone(page, place)
        for context in contexts:
            context.close()
    with closing(Database(folder.database)) as database:
        assert database.check_integrity() == []
        rows = database.tables()["answers"]
    assert len(rows) == 10 * PAIRS
    assert {row["choice"] for row in rows} == {"right"}


def test_the_researcher_sees_answers_as_they_come(context, page, folder):
    with served(folder) as serving:
        token = invite(folder)[0]
        Client(serving.address, token).begin()
        desk = context.new_page()
        desk.goto(serving.researcher_link)
        expect(desk.locator("#answers")).to_have_text("0")
        page.goto(f"{serving.address}/#{token}")
        ready(page)
        page.keyboard.press("ArrowLeft")
        gone(page, 1)
        expect(desk.locator("#answers")).to_have_text("1")
        expect(desk.locator("#people tr")).to_contain_text([f"1 of {PAIRS}"])


@pytest.fixture
def starting(folder):
    """Starts the server as a process, always on one port; what is still there in the end is killed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []

    def start():
        command = [
            sys.executable,
            "-m",
            "peps_jax.human_study",
            "serve",
            "--out",
            str(folder.path),
            "--port",
            str(port),
        ]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ | {"JAX_PLATFORMS": "cpu"}))
        processes[-1].stdout.readline()  # it says where it is when it is there
        return processes[-1]

    start.address = f"http://127.0.0.1:{port}"
    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.slow
def test_a_server_that_is_killed_before_every_second_answer(page, folder, shown, starting, complaints):
    page.set_default_timeout(40_000)
    server = starting()
    token = invite(folder)[0]
    client = Client(starting.address, token)
    client.begin()
    client.close()
    page.goto(f"{starting.address}/#{token}")
    for place in range(1, PAIRS + 1):
        ready(page)
        if place % 2 == 0:
            server.send_signal(signal.SIGKILL)
            server.wait()
            page.keyboard.press(f"Arrow{second(shown[-1]).title()}")
            page.wait_for_selector("#trouble:has-text('Your answer is kept')")
            server = starting()
            if place == 4:
                page.reload()
        else:
            page.keyboard.press(f"Arrow{second(shown[-1]).title()}")
        gone(page, place)
    complaints[:] = [text for text in complaints if "net::ERR_" not in text]
    assert [pair["place"] for pair in shown] == list(range(PAIRS)), "nothing is asked twice"
    with closing(Database(folder.database)) as database:
        assert database.check_integrity() == []
        assert {one.preferred for one in database.answers()} == {0.0}
        assert len(database.tables()["answers"]) == PAIRS
