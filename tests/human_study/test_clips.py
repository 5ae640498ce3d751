"""Clips for the browser: few bytes, whole numbers, and refusals in one line."""

import json

import numpy as np
import pytest
from clip_cases import Parade, drive, parade, walk
from conftest import Line, LineParams

import peps_envs
from peps_jax.drawing.panels import ROLES
from peps_jax.human_study import clips


def size(value) -> int:
    """Bytes over the wire."""
    return len(json.dumps(value, separators=(",", ":")))


@pytest.mark.parametrize(("name", "states"), [("highway-rain", drive), ("nav-d4", walk), ("nav-d3", walk)])
def test_a_pair_of_clips_is_small(name, states):
    task = peps_envs.make(name)
    steps = task.environment.horizon // (1 if name.startswith("highway") else 2)
    sides = [states(task, steps, seed=seed) for seed in (1, 2)]
    pair = [clips.encode(task.environment, task.params, *side, np.ones(steps, bool)) for side in sides]
    assert size(pair) < 2_000
    assert size(clips.view(task.environment, task.params)) < 2_000


def test_a_view_has_scales_colours_and_what_stands_still():
    task = peps_envs.make("nav-d4")
    told = json.loads(json.dumps(clips.view(task.environment, task.params)))
    assert (told["grid"], told["step_seconds"]) == (0.01, clips.STEP)
    assert (told["width"], told["height"]) == pytest.approx((6.24, 6.24))
    assert told["colours"] == ROLES
    assert [shape["colour"] for shape in told["shapes"]][-1] == "agent"
    highway = peps_envs.make("highway-dry")
    assert clips.view(highway.environment, highway.params)["step_seconds"] == 1.0


def test_a_clip_names_what_the_view_has_and_tells_what_moves():
    task = peps_envs.make("nav-d4")
    steps = 10
    told = clips.encode(task.environment, task.params, *walk(task, steps), np.arange(steps) < 4)
    ground, agent = told["shapes"]
    assert told["steps"] == 4
    assert ground == [0, len(clips.view(task.environment, task.params)["shapes"]) - 2]
    assert agent["colour"] == "agent"
    assert all(isinstance(track, str) for track in agent["at"][:2])
    assert told["extent"] == [-12, 612, -12, 612]


def test_the_roads_lines_are_told_once():
    task = peps_envs.make("highway-dry")
    told = clips.encode(task.environment, task.params, *drive(task, 6), np.ones(6, bool))
    new = [shape for shape in told["shapes"] if isinstance(shape, dict)]
    assert [shape["colour"] for shape in new if shape.get("along")] == ["edge line"] * 2
    (dashes,) = [shape for shape in new if shape["colour"] == "lane line"]
    assert dashes["repeats"][1:] == [1200, 0]
    cars = [shape for shape in new if shape["kind"] == "rectangle"]
    assert [car["colour"] for car in cars] == [[[0, "agent"], [6, "wreck"]], [[0, "other"], [6, "wreck"]]]


@pytest.mark.parametrize(("numbers", "text"), [([0], "A"), ([1, -1, 15, -16], "CBef"), ([16, -17, 1000], "gBhBw+B")])
def test_numbers_are_written_in_letters(numbers, text):
    assert clips.written(numbers) == text


def test_what_comes_and_goes_says_when():
    told = clips.encode(Parade(), None, *parade(3), np.ones(3, bool))
    named = {str(shape["colour"]): shape for shape in told["shapes"] if isinstance(shape, dict)}
    assert named["ink"]["from"] == 1
    assert named["ink"]["text"] == [[0, "step 1"], [1, "step 2"], [2, "step 3"]]
    assert named["other"]["moments"] == 2
    assert named["agent"]["at"] == ["AofofA", 0, 300]


def test_what_makes_no_clip_is_refused_in_one_line():
    task = peps_envs.make("nav-d1")
    with pytest.raises(ValueError, match=r"^mask goes on nowhere: a clip needs a step$"):
        clips.encode(task.environment, task.params, *walk(task, 3), np.zeros(3, bool))
    with pytest.raises(ValueError, match=r"^Line has no scene: give it one"):
        clips.view(Line(), LineParams())
