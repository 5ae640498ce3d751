"""The study's file of settings and texts."""

import pytest

from peps_jax.human_study import settings
from peps_jax.human_study.settings import Folder


def content(**numbers):
    return settings.template("highway-dry", "highway-rain", True, **numbers)


def test_a_new_file_says_what_it_was_made_of():
    made = settings.read(content(pairs=40, seed=7))
    assert (made.env, made.test_env, made.pairs, made.seed, made.checks) == ("highway-dry", "highway-rain", 40, 7, 5)
    assert [one.name for one in made.importance] == ["speed", "distance", "relative_speed", "lane"]
    assert made.texts.consent == settings.CONSENT
    assert not made.codes


def test_elsewhere_there_are_neither_collisions_nor_the_papers_four():
    made = settings.read(settings.template("nav-d4", "nav-d4", False, ("agent", "firm sand", "goal", "ice")))
    assert "Green is where it should go, blue is ice, yellow is sand." in made.texts.instructions_training
    assert made.checks == 0
    assert made.importance == ()


def test_texts_with_quotes_and_signs_come_back():
    text = content().replace("Thank you for taking part.", r"Say \"thanks\" \\ <b>λ</b> 'x'")
    assert settings.read(text).texts.thanks == ("Say \"thanks\" \\ <b>λ</b> 'x'",)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("pairs = 200", "pairs = 201", "pairs 201 is odd: give an even number"),
        ("pairs = 200", "pairs = 1", "pairs 1 is out of range: give a whole number from 2 to 10000"),
        ("pairs = 200", "pairs = 20.0", "pairs 20.0 is out of range: give a whole number"),
        ("pairs = 200", 'pairs = "many"', "pairs 'many' is out of range"),
        ("pairs = 200", "pairs = true", "pairs True is out of range"),
        ("pairs = 200", "pairs = 4", "pairs 4 has no room for 5 checks and the repeats"),
        ("repeats = 0.1", "repeats = nan", "repeats nan is out of range: give a number from 0.0 to 0.5"),
        ("pairs = 200", "paris = 200", "'paris' is unknown: known are"),
        ("pairs = 200", "pairs 200", "is no TOML"),
        ('title = "', 'title = 3 # "', "title 3 is no line of text"),
        ("[texts]", "[texsts]", r"\[texts\] is missing"),
        ("thanks = [", "thakns = [", "'thakns' is unknown"),
        ('name = "speed"', 'name = "lane"', "importance has a name twice"),
        ('name = "speed"', 'nmae = "speed"', "importance .* isn't right: give each a name and a text"),
        ('# training = "C1A2B3C4"', "training = 3", "code of training 3 is no line of text"),
        ('# training = "C1A2B3C4"', 'trainings = "x"', "'trainings' is unknown"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_told_in_one_line(old, new, complaint):
    text = content()
    assert old in text
    with pytest.raises(ValueError, match=complaint) as told:
        settings.read(text.replace(old, new, 1))
    assert "\n" not in str(told.value)


def test_every_number_of_the_file_has_a_comment():
    lines = content().splitlines()
    for field in settings.NUMBERS:
        (line,) = [line for line in lines if line.startswith(f"{field.name} = ")]
        assert field.metadata["text"] in line


def test_a_folder_without_a_study_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no study: make one first"):
        Folder(tmp_path).check()
    (tmp_path / settings.FILE).write_text("x", encoding="utf-8")
    with pytest.raises(ValueError, match="holds a study already"):
        Folder(tmp_path).check_free()
