"""The participants' page in every state, also in those that a real server hardly comes to."""

import itertools
import re

import pytest

from browser.fake import ORIGIN, STEPS, Fake, clicking, hide

expect = pytest.importorskip("playwright.sync_api", reason="Playwright isn't installed").expect

# what browsers write to the console of a connection or a refusal
LOST = re.compile("net::ERR_|Failed to load resource")
KEYS = {"left": "ArrowLeft", "right": "ArrowRight", "equal": "ArrowDown", "unclear": "ArrowUp"}


def shown(page, name):
    """Waits for a page of the study."""
    page.wait_for_selector(f"section[data-page={name}]:not([hidden])")


def seen(page):
    """Waits until what is shown may be answered."""
    page.wait_for_selector(
        "section:not([hidden]) button.choice[aria-disabled=false], #ratings:visible [aria-disabled=false]"
    )


def answered(page, number):
    """Waits until so many are answered."""
    page.wait_for_selector(f"#progress-text:visible:has-text('{number + 1} of'), [data-page=done]:not([hidden])")


def test_the_training_phase_from_start_to_end(page, fake):
    fake.state["page"] = "consent"
    fake.open(page)
    click = clicking(page, "keys")
    click("#agree")
    page.wait_for_selector("#check-on[aria-disabled=false]")
    click("#check-on")
    click("#instructions-on")
    for place in (1, 2):
        expect(page.locator("#practice-mark")).to_be_visible()
        seen(page)
        page.keyboard.press(KEYS["left"])
        page.wait_for_selector(f"#progress-text:visible:has-text('{place + 1} of'), #begin:visible")
    click("#begin")
    shown(page, "importance")
    page.keyboard.type("2")
    page.check("input[name=item-1][value='5']", force=True)
    click("#importance-on")
    for place, choice in enumerate(("right", "equal", "unclear"), 1):
        shown(page, "pairs")
        expect(page.locator("#practice-mark")).to_be_hidden()
        seen(page)
        page.keyboard.press(KEYS[choice])
        answered(page, place)
    expect(page.locator("#code")).to_have_text("C1A2B3C4")
    (check,) = [body for body in fake.posted("/api/proceed") if body["page"] == "check"]
    assert set(check["report"]) == {"frames_per_second", "width", "height", "pixel_ratio", "touch"}
    (importance,) = fake.posted("/api/importance")
    assert importance["answers"] == {"speed": 2, "lane": 5}
    assert [body["choice"] for body in fake.posted("/api/answer")] == ["right", "equal", "unclear"]
    assert page.url == f"{ORIGIN}/#token"
    assert page.context.cookies() == []


def test_ratings_from_start_to_end(page):
    fake = Fake(page="instructions", phase="testing")
    fake.open(page)
    page.click("#instructions-on")
    page.click("#begin")
    for place, rating in enumerate((1, 7, 10), 1):
        shown(page, "ratings")
        seen(page)
        page.get_by_role("button", name=str(rating)).filter(has_text=re.compile(f"^{rating}$")).click()
        answered(page, place)
    told = fake.posted("/api/rating")
    assert [body["rating"] for body in told] == [1, 7, 10]
    assert all(isinstance(body["frames"], int) and body["frames"] >= STEPS for body in told)


def test_an_answer_before_both_clips_were_drawn_is_ignored(page, fake):
    fake.steps = 30  # 1.5 s
    fake.open(page)
    page.wait_for_selector("#left:visible")
    for _ in range(5):
        page.keyboard.press("ArrowLeft")
        page.locator("#right").click(force=True)
    expect(page.locator("#pair-hint")).to_contain_text("First watch both clips")
    assert not fake.answers
    seen(page)
    assert not fake.answers
    page.keyboard.press("r")
    page.keyboard.press("ArrowLeft")
    answered(page, 1)
    told = fake.answers[0]
    assert told["choice"] == "left"
    assert told["replays"] == 1
    least = 30 * 50 / 50  # no frame moves a clip by more than 50 ms
    assert told["frames"]["left"] >= least
    assert told["frames"]["right"] >= least
    assert 1400 <= told["watched_ms"] <= told["reaction_ms"] + 50
    assert told["hidden_ms"] == 0


@pytest.mark.parametrize("clicks", [2, 5])
def test_many_clicks_store_one_answer(page, fake, clicks):
    fake.open(page)
    seen(page)
    page.locator("#left").click(click_count=clicks)
    answered(page, 1)
    seen(page)
    page.evaluate(
        "times => { for (let time = 0; time < times; time++) document.getElementById('right').click() }", clicks
    )
    answered(page, 2)
    seen(page)
    for _ in range(clicks):
        page.keyboard.press("ArrowDown")
    shown(page, "done")
    assert [(body["place"], body["choice"]) for body in fake.posted("/api/answer")] == [
        (0, "left"),
        (1, "right"),
        (2, "equal"),
    ]


def test_a_double_click_goes_one_page_on(page, fake):
    fake.state["page"] = "importance"
    fake.open(page)
    shown(page, "importance")
    page.keyboard.type("25")
    page.locator("#importance-on").click(click_count=5)
    seen(page)
    assert len(fake.posted("/api/importance")) == 1
    assert len([path for _, path, _ in fake.requests if path == "/api/pair"]) == 1


def test_a_held_key_answers_one_pair(page, fake):
    fake.open(page)
    seen(page)
    page.keyboard.down("ArrowLeft")
    answered(page, 1)
    seen(page)
    for _ in range(3):
        page.keyboard.down("ArrowLeft")
    page.wait_for_timeout(300)
    assert len(fake.answers) == 1


def test_what_is_lost_on_the_way_is_sent_again_under_the_same_id(page, fake, complaints):
    fake.open(page)
    seen(page)
    fake.lost, fake.unheard = 1, 1
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#trouble")).to_have_text("Connection lost. Your answer is kept, trying again …")
    answered(page, 1)
    expect(page.locator("#trouble")).to_be_hidden()
    first, second = fake.posted("/api/answer")
    assert first == second
    assert len(fake.answers) == 1
    seen(page)
    page.keyboard.press("ArrowRight")
    answered(page, 2)
    assert fake.answers[1]["request"] != first["request"]
    complaints[:] = [text for text in complaints if not LOST.search(text)]


def test_a_reload_sends_what_the_server_doesnt_have_yet(page, fake, complaints):
    fake.open(page)
    seen(page)
    fake.lost = 100
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("#trouble:visible")
    assert not fake.answers
    fake.lost = 0
    page.reload()
    page.wait_for_selector("#progress-text:has-text('2 of 3')")
    assert fake.answers[0]["choice"] == "left"
    assert page.evaluate("history.state") is None
    complaints[:] = [text for text in complaints if not LOST.search(text)]


def test_reload_and_the_back_button_come_back_to_the_same_pair(page, fake):
    fake.open(page)
    seen(page)
    page.keyboard.press("ArrowLeft")
    answered(page, 1)
    for again in (page.reload, lambda: (page.goto("about:blank"), page.go_back())):
        again()
        expect(page.locator("#progress-text")).to_have_text("Pair 2 of 3")
    seen(page)
    assert len(fake.posted("/api/answer")) == 1


def test_two_tabs_ask_nothing_twice(context, page, fake, complaints):
    fake.open(page)
    other = context.new_page()
    other.goto(page.url)
    for tab in (page, other):
        seen(tab)
    page.keyboard.press("ArrowLeft")
    answered(page, 1)
    fake.steps = 60  # for the notice to be there long enough
    other.keyboard.press("ArrowRight")  # refused: it was answered in the first tab

    assert fake.answers[0]["choice"] == "left"
    expect(other.locator("#progress-text")).to_have_text("Pair 2 of 3")
    expect(other.locator("#pair-hint")).to_contain_text("answered already")
    complaints[:] = [text for text in complaints if not LOST.search(text)]


def test_a_hidden_tab_watches_nothing(page, fake):
    fake.steps = 10  # 0.5 s
    fake.open(page)
    page.wait_for_selector("#left:visible")
    hide(page, True)
    page.wait_for_timeout(900)
    page.keyboard.press("ArrowLeft")
    assert page.locator("#left").get_attribute("aria-disabled") == "true"
    assert not fake.answers
    hide(page, False)
    seen(page)
    page.keyboard.press("ArrowLeft")
    answered(page, 1)
    told = fake.answers[0]
    assert told["hidden_ms"] >= 850
    assert told["watched_ms"] < told["reaction_ms"] - 500 or told["reaction_ms"] < 900


def test_who_waits_goes_on_alone(page, fake):
    fake.state |= {"page": "wait", "seconds_to_wait": 42.0}
    fake.open(page)
    shown(page, "wait")
    expect(page.locator("#wait-time")).to_have_text("About 42 seconds.")
    fake.state["page"] = "pairs"
    seen(page)


def test_who_waits_for_a_moment_sees_no_other_page(page, fake):
    told, waits = fake.reply, itertools.count()
    wait = lambda path: path == "/api/pair" and next(waits) == 1
    fake.reply = lambda path, body: (200, {"wait": 2.0}) if wait(path) else told(path, body)
    fake.open(page)
    seen(page)
    page.evaluate("""() => {
        const wait = document.querySelector("[data-page=wait]");
        const note = () => { if (!wait.hidden) document.title = "another page" };
        new MutationObserver(note).observe(wait, {attributes: true});
    }""")
    page.keyboard.press("ArrowLeft")
    answered(page, 1)
    assert next(waits) > 2
    assert page.title() != "another page"


def test_who_declines_is_asked_once_more(page, fake):
    fake.state["page"] = "consent"
    fake.open(page)
    page.click("#decline")
    page.click("#decline-no")
    expect(page.locator("#decline-sure")).to_be_hidden()
    page.click("#decline")
    fake.state["outcome"] = "declined"
    page.click("#decline-yes")
    shown(page, "declined")
    assert [body["agreed"] for body in fake.posted("/api/consent")] == [False]


def test_a_platforms_participant_is_given_a_token_of_their_own(page, fake):
    fake.state["page"] = "consent"
    told = fake.reply
    own = lambda path, body: (
        (200, fake.state | {"page": "pairs", "token": "own"}) if path == "/api/consent" else told(path, body)
    )
    fake.reply = own
    fake.open(page, query="?PROLIFIC_PID=p1&SESSION_ID=s1&STUDY_ID=&utm=x")
    page.click("#agree")
    shown(page, "pairs")
    assert fake.posted("/api/consent")[0]["platform"] == {"PROLIFIC_PID": "p1", "SESSION_ID": "s1"}
    assert page.url == f"{ORIGIN}/#own"


def test_a_preview_cant_be_answered(page, fake):
    fake.state["page"] = "consent"
    fake.open(page, query="?assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE")
    expect(page.locator("#consent-note")).to_contain_text("preview")
    expect(page.locator("#agree")).to_be_hidden()


def test_what_consent_is_refused_for_stands_there(page, fake, complaints):
    fake.state["page"] = "consent"
    fake.open(page)
    page.wait_for_selector("#agree:visible")
    fake.refusal = (409, "There is nothing to rate yet: come back later.")
    page.click("#agree")
    expect(page.locator("#consent-note")).to_have_text("There is nothing to rate yet: come back later.")
    complaints[:] = [text for text in complaints if not LOST.search(text)]


@pytest.mark.parametrize(
    ("status", "text"), [(401, "open the link again"), (403, "open the link again"), (429, "few minutes")]
)
def test_a_link_that_is_refused_says_what_to_do(page, fake, complaints, status, text):
    fake.refusal = (status, "a reason")
    fake.open(page)
    expect(page.locator("#refused-text")).to_contain_text(text)
    expect(page.locator("#refused-why")).to_have_text("a reason")
    complaints[:] = [text for text in complaints if not LOST.search(text)]


def test_an_address_without_a_token_asks_nothing(page, fake):
    fake.open(page, token="")
    expect(page.locator("#refused-text")).to_contain_text("incomplete")
    assert not fake.requests


def test_texts_are_shown_as_text(page, fake):
    evil = "<img src=x onerror=alert(1)><script>alert(2)</script>"
    fake.state |= {"title": evil, "page": "consent"}
    fake.state["texts"] = {name: [evil] for name in ("consent", "instructions", "thanks")}
    fake.state["importance"] = [{"name": "a", "text": evil}]
    fake.open(page)
    expect(page.locator("#consent-text")).to_have_text(evil)
    expect(page.locator("#title")).to_have_text(evil)
    for name, box in (("instructions", "#instructions-text"), ("importance", "#item-0"), ("done", "#thanks-text")):
        fake.state |= {"page": name, "code": evil}
        page.reload()
        expect(page.locator(box)).to_have_text(evil)
    expect(page.locator("#code")).to_have_text(evil)
    assert page.locator("img, main script").count() == 0


def test_the_code_can_be_copied_or_is_at_least_selected(page, fake):
    fake.state |= {"page": "done", "code": "C1A2B3C4"}
    fake.open(page)
    page.click("#copy")
    expect(page.locator("#copy")).to_contain_text("Ctrl+C")  # plain HTTP gives pages no clipboard
    assert page.evaluate("getSelection().toString()") == "C1A2B3C4"


@pytest.mark.parametrize("name", ["consent", "check", "instructions", "importance", "pairs", "ratings", "wait", "done"])
def test_everything_has_a_name_and_keys_reach_it(page, fake, name):
    fake.state |= {"page": name, "code": "C", "seconds_to_wait": 60}
    fake.open(page)
    shown(page, name)
    section = page.locator(f"section[data-page={name}]")
    assert section.locator("h1").evaluate("h1 => h1 === document.activeElement"), "a screen reader begins at the title"
    for canvas in section.locator("canvas:visible").all():
        assert canvas.get_attribute("role") == "img"
        assert canvas.get_attribute("aria-label")
    controls = section.locator("button:visible, input:visible")
    for control in controls.all():
        assert control.evaluate("one => one.ariaLabel || one.textContent.trim()")
    names = controls.evaluate_all("all => all.map((one) => one.name || one.id || one.textContent)")
    reached = []
    for _ in range(len(names)):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "document.activeElement.name || document.activeElement.id || document.activeElement.textContent"
            )
        )
    assert set(reached) >= set(names)
