"""What is kept of a study."""

import json
import random
import sqlite3
from collections import Counter

import pytest
from study_cases import WATCHED, stimuli, stimulus

from peps_jax.human_study import orders, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import ConflictError, Link, Place, Recruit, Wait

FRAMES = (30, 30)
LEASE = 120.0


class Clock:
    """Seconds, which tests move."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def database(tmp_path, clock):
    made = Database.create(tmp_path / "study.sqlite", clock)
    yield made
    made.close()


def people(database, number, order, phase="training"):
    """Participants who have begun, each with `order(number)`."""
    made = database.invite(phase, [f"{phase} token {place}" for place in range(number)])
    for one in made:
        database.begin(one, "pairs", one, lambda before, one=one: order(one))
    return made


def asks(number):
    return lambda seed: [Place("ask", swapped=place % 2 == 1) for place in range(number)]


def shown(database, participant):
    """Which pair somebody is shown now, and whether its first segment is on the right."""
    now = database.next_shown(participant, LEASE)
    left, right = map(json.loads, now.drawings)
    assert left["clip"] == right["clip"]
    return now.place, left["clip"], left["side"] == 1


def say(database, participant, choice="left", request=None):
    place, clip, _ = shown(database, participant)
    database.answer(participant, place, choice, FRAMES, WATCHED, request or f"{participant} {place}")
    return clip


def test_a_pair_stays_the_same_until_it_is_answered(database):
    database.add_queries("ask", stimuli(30))
    (one,) = people(database, 1, asks(10))
    first = shown(database, one)
    assert [shown(database, one) for _ in range(5)] == [first] * 5
    say(database, one)
    assert shown(database, one)[0] == 1


def test_nobody_sees_a_pair_twice(database):
    database.add_queries("ask", stimuli(12))
    for one in people(database, 3, asks(12)):
        assert len({say(database, one) for _ in range(12)}) == 12


def test_the_least_answered_pairs_come_first(database):
    database.add_queries("ask", stimuli(10))
    seen = Counter(say(database, one) for one in people(database, 4, asks(5)) for _ in range(5))
    assert set(seen.values()) == {2}


def test_a_leased_pair_is_nobody_elses_for_a_while(database, clock):
    database.add_queries("ask", stimuli(2))
    first, second, third = people(database, 3, asks(2))
    pairs = {shown(database, first)[1], shown(database, second)[1]}
    assert len(pairs) == 2
    say(database, second)
    assert shown(database, third)[1] in pairs  # all are taken: better a pair twice than nothing
    clock.now += LEASE + 1
    open_pair = shown(database, first)[1]
    assert shown(database, first)[1] == open_pair


def test_orders_differ_between_participants(database):
    database.add_queries("ask", stimuli(40), [40] * 40)
    seen = [[say(database, one) for _ in range(8)] for one in people(database, 3, asks(8))]
    assert len(set(map(tuple, seen))) == 3


def test_shared_pairs_are_seen_by_three(database):
    single, shared = orders.pool(6, 18, 0.2)
    database.add_queries("ask", stimuli(single + shared), [1] * single + [3] * shared)
    made = people(database, 6, lambda seed: orders.of_pairs(seed, 20, 0.1, 0.2))
    chance = random.Random(0)
    seen = Counter()
    left = dict.fromkeys(made, 20)
    while left:
        one = chance.choice(sorted(left))
        row = database.next_shown(one, LEASE)
        seen[json.loads(row.drawings[0])["clip"]] += 1
        say(database, one)
        left[one] -= 1
        left = {key: value for key, value in left.items() if value}
    assert not database.check_integrity()
    counts = Counter(Counter(said.query for said in database.answers()).values())
    assert counts[3] >= shared - 2
    assert counts[1] >= 0.9 * single


def test_answers_are_unswapped(database):
    database.add_queries("ask", stimuli(8))
    (one,) = people(database, 1, asks(8))
    for place in range(8):
        _, _, swapped = shown(database, one)
        assert swapped == (place % 2 == 1)
        say(database, one, ("left", "left", "right", "right", "equal", "equal", "unclear", "unclear")[place])
    by_place = database.tables()["answers"]
    assert [row["preferred"] for row in by_place] == [1, 0, 0, 1, 0.5, 0.5, None, None]
    assert sorted(said.preferred for said in database.answers() if said.preferred is not None) == [
        0.0, 0.0, 0.5, 0.5, 1.0, 1.0,
    ]  # fmt: skip


def test_repeats_are_compared_and_not_counted_twice(database):
    database.add_queries("ask", stimuli(2))
    order = [Place("ask"), Place("ask"), Place("repeat", True, repeats=0), Place("repeat", True, repeats=1)]
    (one,) = people(database, 1, lambda seed: order)
    clips = [say(database, one, choice) for choice in ("left", "left", "right", "left")]
    assert clips[:2] == clips[2:]
    assert len(database.answers()) == 2
    assert database.repeat_consistency() == 0.5
    assert not database.check_integrity()


def test_checks_are_counted_apart(database):
    checks = database.add_queries("check", stimuli(2))
    (one, other) = people(
        database, 2, lambda seed: [Place("check", number=checks[0]), Place("check", True, number=checks[1])]
    )
    for choice in ("left", "right"):
        say(database, one, choice)
    for choice in ("right", "equal"):
        say(database, other, choice)
    assert database.checks_failed() == {one: 0, other: 1}
    assert not database.answers()


def test_the_same_request_again_changes_nothing(database):
    database.add_queries("ask", stimuli(4))
    (one,) = people(database, 1, asks(4))
    shown(database, one)
    for _ in range(3):
        database.answer(one, 0, "left", FRAMES, WATCHED, "request")
    assert len(database.answers()) == 1


@pytest.mark.parametrize(
    ("place", "choice", "request_id"),
    [
        (0, "right", "other"), (0, "left", "other"), (0, "right", "first"), (1, "left", "first"), (1, "left", "new"),
        (9, "left", "new"),
    ],
)  # fmt: skip
def test_another_answer_is_refused(database, place, choice, request_id):
    database.add_queries("ask", stimuli(4))
    (one,) = people(database, 1, asks(4))
    shown(database, one)
    database.answer(one, 0, "left", FRAMES, WATCHED, "first")
    before = database.tables()["answers"]
    with pytest.raises(ConflictError):
        database.answer(one, place, choice, FRAMES, WATCHED, request_id)
    assert database.tables()["answers"] == before


def test_an_answer_to_somebody_elses_pair_is_refused(database):
    database.add_queries("ask", stimuli(4))
    one, other = people(database, 2, asks(4))
    shown(database, one)
    with pytest.raises(ConflictError):
        database.answer(other, 0, "left", FRAMES, WATCHED, "request")


def test_who_has_seen_every_pair_is_done(database):
    database.add_queries("ask", stimuli(3))
    checks = database.add_queries("check", [stimulus(100)])
    order = [Place("ask")] * 3 + [Place("ask"), Place("repeat", True, repeats=3), Place("check", number=checks[0])]
    (one,) = people(database, 1, lambda seed: order)
    for _ in range(4):
        assert database.has_more(one) is True
        say(database, one)
    assert database.has_more(one) is False
    assert database.next_shown(one, LEASE) is None
    assert database.progress(one) == (4, 4)


def test_an_order_is_laid_down_once(database):
    database.add_queries("ask", stimuli(4))
    (one,) = people(database, 1, asks(4))
    database.begin(one, "pairs", 1, lambda before: [Place("ask")] * 9)
    assert database.progress(one) == (0, 4)


@pytest.mark.parametrize("seed", range(6))
def test_whatever_happens_every_rule_holds(tmp_path, clock, seed):
    """People look, answer, go away and come back in any order, and the process begins anew now and then."""
    path, chance = tmp_path / "study.sqlite", random.Random(seed)
    database = Database.create(path, clock)
    database.add_queries("ask", stimuli(50), [3 if place < 10 else 1 for place in range(50)])
    checks = database.add_queries("check", stimuli(2, first=100))
    order = lambda one: orders.of_pairs(one, 20, 0.1, 0.2, checks)
    everybody = people(database, 6, order)
    showing, answered = {}, Counter()
    while sum(answered.values()) < 120:
        one = chance.choice([one for one in everybody if answered[one] < 20])
        now = shown(database, one)
        assert showing.setdefault((one, now[0]), now) == now
        assert now[0] == answered[one]
        match chance.randrange(6):
            case 0:
                clock.now += chance.uniform(0, 2 * LEASE)
            case 1:
                database.close()
                database = Database(path, clock)
            case _:
                say(database, one, chance.choice(("left", "right", "equal", "unclear")))
                answered[one] += 1
    for one in everybody:
        mine = [now for (who, _), now in showing.items() if who == one]
        places = order(one)
        assert sum(swapped for _, _, swapped in mine) == 10
        assert all(swapped == places[place].swapped for place, _, swapped in mine)
        assert len({clip for _, clip, _ in mine}) == 20 - 2  # two come twice
        assert {clip for _, clip, _ in mine if clip >= 100} == {100, 101}
    assert not database.check_integrity()
    assert all(database.next_shown(one, LEASE) is None for one in everybody)
    database.close()


# --- platforms ----------------------------------------------------------------------------------------------------------------


def arrive(database, phase, person, session):
    keyed = lambda text: tokens.identity(b"key", "prolific", text)
    recruit = Recruit("prolific", keyed(person), keyed(session), json.dumps({"PROLIFIC_PID": person}))
    return database.arrive(Link(phase, "prolific"), recruit, lambda number: f"token {number}")


def test_who_comes_back_goes_on_and_nobody_takes_part_twice(database):
    first = arrive(database, "training", "a", "s")
    assert arrive(database, "training", "a", "s") == first
    assert arrive(database, "training", "b", "t") != first
    for phase, session in (("training", "another"), ("testing", "s"), ("testing", "another")):
        with pytest.raises(ConflictError, match="already"):
            arrive(database, phase, "a", session)
    (invited,) = database.invite("testing", ["token"])
    with pytest.raises(ConflictError, match="already"):
        database.recruit(invited, Recruit("prolific", tokens.identity(b"key", "prolific", "a"), "", "{}"))


def test_erased_ids_are_nowhere_in_the_files(database, tmp_path):
    people_ids = [f"person{number:020}" for number in range(50)]
    for one in people_ids:
        arrive(database, "training", one, one)
    assert database.payments() == []  # nobody has agreed yet
    files = [path.read_bytes() for path in tmp_path.iterdir()]
    assert any(people_ids[3].encode() in content for content in files)
    assert database.erase() == 50
    assert database.erase() == 0
    files = [path.read_bytes() for path in tmp_path.iterdir()]
    assert not any(b"person000" in content for content in files)
    with pytest.raises(ConflictError, match="already"):
        arrive(database, "testing", people_ids[0], "another")


# --- rounds -------------------------------------------------------------------------------------------------------------------


def test_a_round_closes_when_all_is_answered(database):
    (one,) = people(database, 1, asks(6))
    database.begin_live()
    assert isinstance(database.next_shown(one, LEASE), Wait)
    assert database.has_more(one) is None
    database.open_round(0, [10, 11, 12], stimuli(3))
    for done in range(3):
        assert database.round(0).answered == done
        assert database.settle_round(0, 0.0) is None
        say(database, one)
    assert database.settle_round(0, 600.0) == "all answered"
    assert database.settle_round(0, 600.0) == "all answered"
    assert {said.asked for said in database.answers(0)} == {10, 11, 12}
    assert isinstance(database.next_shown(one, LEASE), Wait)
    database.end_live()
    assert database.next_shown(one, LEASE) is None


def test_a_round_closes_with_most_of_it_after_its_time(database, clock):
    (one,) = people(database, 1, asks(10))
    database.begin_live()
    database.open_round(0, range(10), stimuli(10))
    for _ in range(7):
        say(database, one)
    clock.now += 601
    assert database.settle_round(0, 600.0) is None
    say(database, one)
    assert database.settle_round(0, 900.0) is None
    assert database.settle_round(0, 600.0) == "8 of 10 answered after 600 s"


def test_a_round_is_closed_by_hand_when_half_of_it_is_there(database):
    (one,) = people(database, 1, asks(10))
    database.begin_live()
    database.open_round(0, range(10), stimuli(10))
    for _ in range(4):
        say(database, one)
    assert database.waits_for(0) == "4 of 10 answered: less than half, so it waits"
    with pytest.raises(ConflictError, match="4 of 10 answers"):
        database.close_round(0)
    say(database, one)
    assert database.close_round(0) == "by hand, 5 of 10 answered"
    assert database.close_round(0) == "by hand, 5 of 10 answered"


def test_late_answers_are_kept_and_not_mixed_in(database):
    first, second = people(database, 2, asks(10))
    database.begin_live()
    database.open_round(0, range(2), stimuli(2))
    shown(database, first)
    say(database, second)
    database.close_round(0)
    before = database.answers_digest(0)
    assert database.round(0).answers_digest == before
    say(database, first)
    assert database.answers_digest(0) == before
    assert len(database.answers(0)) == 1
    (late,) = database.late_answers()
    assert (late.participant, late.late, late.round) == (first, True, 0)


def test_who_cannot_tell_doesnt_hold_up_a_round(database):
    (one,) = people(database, 1, asks(4))
    database.begin_live()
    database.open_round(0, [5], stimuli(1))
    say(database, one, "unclear")
    assert database.settle_round(0, 600.0) == "all answered"
    assert [said.preferred for said in database.answers(0)] == [None]


def test_a_training_that_begins_anew_gets_its_closed_rounds(database):
    (one,) = people(database, 1, asks(4))
    database.begin_live()
    database.open_round(0, [5], stimuli(1))
    say(database, one)
    database.settle_round(0, 0.0)
    again = database.open_round(0, [5], stimuli(1))
    assert again.why == "all answered"
    assert len(database.rounds()) == 1
    with pytest.raises(ValueError, match="round 0 was asked with other queries"):
        database.open_round(0, [5], stimuli(1, first=7))
    with pytest.raises(ValueError, match="round 0 was asked with other queries"):
        database.open_round(0, [6], stimuli(1))


def test_two_processes_see_one_anothers_rounds_and_answers(database, tmp_path, clock):
    other = Database(tmp_path / "study.sqlite", clock)
    (one,) = people(database, 1, asks(4))
    other.begin_live()
    other.open_round(0, [5], stimuli(1))
    say(database, one)
    assert other.settle_round(0, 0.0) == "all answered"
    assert database.round(0).why == "all answered"
    other.close()


# --- the file -----------------------------------------------------------------------------------------------------------------


def test_it_is_synced_at_every_commit(database):
    value = lambda name: database._connection.execute(f"PRAGMA {name}").fetchone()[0]
    assert value("journal_mode") == "wal"
    assert value("synchronous") == 2
    assert value("foreign_keys") == 1


def test_only_its_owner_may_read_it(database, tmp_path):
    database.add_queries("ask", stimuli(2))
    rights = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert rights["study.sqlite"] == rights["study.sqlite-wal"] == 0o600


def test_a_file_that_is_no_study_is_refused(tmp_path):
    with pytest.raises(ValueError, match="isn't there"):
        Database(tmp_path / "nothing")
    (tmp_path / "text").write_text("no database, and long enough to be read as one" * 50, encoding="utf-8")
    with pytest.raises(ValueError, match="can't be read"):
        Database(tmp_path / "text")
    sqlite3.connect(tmp_path / "other").close()
    (tmp_path / "empty").touch()
    with pytest.raises(ValueError, match="has format 0"):
        Database(tmp_path / "empty")
    Database.create(tmp_path / "study").close()
    with pytest.raises(ValueError, match="is there already"):
        Database.create(tmp_path / "study")


def test_a_miscount_is_noticed(database):
    database.add_queries("ask", stimuli(2))
    (one,) = people(database, 1, asks(2))
    say(database, one)
    assert database.check_integrity() == []
    database._connection.execute("DELETE FROM answer")
    assert database.check_integrity() == ["1 queries are miscounted", "1 assignments are marked wrongly"]
