"""Who may come in."""

import stat

import pytest

from peps_jax.human_study import tokens

KEY = bytes(range(32))


def test_tokens_differ_and_are_long():
    made = {tokens.new() for _ in range(100)}
    assert len(made) == 100
    assert min(map(len, made)) >= 32


def test_derived_tokens_differ_by_key_and_purpose():
    assert tokens.derived(KEY, "researcher") == tokens.derived(KEY, "researcher")
    made = {tokens.derived(KEY, "researcher"), tokens.derived(KEY, "label"), tokens.derived(b"x" * 32, "researcher")}
    assert len(made) == 3


def test_a_persons_hash_needs_the_key():
    assert tokens.identity(KEY, "prolific", "5f0") != tokens.identity(b"x" * 32, "prolific", "5f0")
    assert tokens.identity(KEY, "prolific", "5f0") != tokens.identity(KEY, "mturk", "5f0")
    assert "5f0" not in tokens.identity(KEY, "prolific", "5f0")


def test_only_the_owner_may_read_the_key(tmp_path):
    tokens.make_key(tmp_path / "key")
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
    assert len(tokens.read_key(tmp_path / "key")) == 32


@pytest.mark.parametrize("content", ["", "abc", "zz" * 32, "ab" * 31])
def test_a_damaged_key_is_refused(tmp_path, content):
    (tmp_path / "key").write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=r"key .* is damaged: it has to hold 64 hexadecimal digits"):
        tokens.read_key(tmp_path / "key")


def test_wrong_guesses_are_limited_for_a_while():
    now = [0.0]
    guesses = tokens.WrongGuesses(limit=3, window=60.0, clock=lambda: now[0])
    for _ in range(3):
        assert not guesses.refuses("a", "wrong")
        guesses.wrong("a")
    assert guesses.refuses("a", "wrong")
    assert not guesses.refuses("b", "wrong")
    now[0] = 61.0
    assert not guesses.refuses("a", "wrong")


def test_who_was_let_in_before_stays_in():
    guesses = tokens.WrongGuesses(limit=1)
    guesses.right("known")
    guesses.wrong("a")
    assert guesses.refuses("a", "other")
    assert not guesses.refuses("a", "known")
