"""The researcher's page: who is where, live; rounds, pictures, and what is refused."""

import io

import pytest

from browser.fake import ORIGIN

expect = pytest.importorskip("playwright.sync_api", reason="Playwright isn't installed").expect


def person(number, **changes):
    return {
        "number": number, "phase": "training", "page": "pairs", "outcome": None, "done": 3, "total": 12, "last_seen_s": 2.0,
        "checks_failed": 0,
    } | changes  # fmt: skip


@pytest.fixture
def desk(page, fake):
    from PIL import Image

    fake.researcher = {
        "title": "What machines do", "participants": [person(1), person(2, checks_failed=2, last_seen_s=None)], "answers": 6,
        "ratings": 0, "answers_per_minute": 4.0, "agreement": 0.75, "left_share": 0.5, "repeat_consistency": None, "routes": None,
        "round": {
            "number": 3, "asked": 10, "answered": 6, "open_s": 300.0, "state": "open", "says": "waits for 2 answers",
            "can_close": True,
        },
        "picture": "/api/researcher/picture?v=1",
    }  # fmt: skip
    buffer = io.BytesIO()
    Image.new("RGB", (40, 30), "#2f9e78").save(buffer, "png")
    fake.picture = buffer.getvalue()
    fake.serve(page.context)
    page.goto(f"{ORIGIN}/researcher#token")
    page.wait_for_selector("#all:visible")
    return page


def test_it_shows_how_the_study_stands(desk):
    for name, text in (
        ("answers", "6"),
        ("rate", "4"),
        ("agreement", "75 %"),
        ("left", "50 %"),
        ("repeats", "–"),
        ("checks", "2"),
    ):
        expect(desk.locator(f"#{name}")).to_have_text(text)
    expect(desk.locator("#checks-more")).to_have_text("by 1 person")
    first, second = desk.locator("#people tr").all()
    expect(first).to_contain_text("3 of 12")
    expect(first).to_contain_text("now")
    expect(second).to_contain_text("–")
    expect(desk.locator("#round-title")).to_have_text("Round 3, open")
    expect(desk.locator("#picture")).to_have_js_property("naturalWidth", 40)


def test_it_is_live(desk, fake):
    fake.researcher |= {"answers": 7, "participants": [person(1, page="done", done=12)]}
    expect(desk.locator("#answers")).to_have_text("7")
    expect(desk.locator("#people tr")).to_have_count(1)
    expect(desk.locator("#present-more")).to_have_text("1 of 1 done")


def test_a_round_is_closed_by_hand_after_asking(desk, fake):
    desk.click("#close")
    expect(desk.locator("#close-text")).to_contain_text("6 of 10")
    desk.click("#close-no")
    assert not fake.posted("/api/researcher/close_round")
    desk.click("#close")
    desk.click("#close-yes")
    expect(desk.locator("#round-title")).to_have_text("Round 3, closed")
    expect(desk.locator("#close")).to_be_hidden()
    assert fake.posted("/api/researcher/close_round") == [{"round": 3}]


def test_a_round_below_half_cant_be_closed(desk, fake):
    fake.researcher["round"] |= {"answered": 4, "can_close": False}
    expect(desk.locator("#close")).to_have_attribute("aria-disabled", "true")
    desk.locator("#close").click(force=True)
    expect(desk.locator("#close-sure")).to_be_hidden()


def test_a_wrong_link_says_so(page, fake, complaints):
    fake.refusal = (401, "there is no right token in this one")
    fake.serve(page.context)
    page.goto(f"{ORIGIN}/researcher#wrong")
    expect(page.locator("#refused")).to_have_text("there is no right token in this one")
    expect(page.locator("#all")).to_be_hidden()
    complaints[:] = [text for text in complaints if "401" not in text]


def test_names_from_outside_are_shown_as_text(desk, fake):
    fake.researcher |= {"title": "<b>bold</b>", "routes": {"note": "<i>note</i>", "route": []}}
    expect(desk.locator("#title")).to_have_text("<b>bold</b>")
    expect(desk.locator("#training-note")).to_have_text("<i>note</i>")
