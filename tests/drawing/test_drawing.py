"""Figures: one palette, scenes as matplotlib draws them, films, and what a sweep shows of each environment."""

import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LineParams, Point, untrained
from matplotlib.colors import to_hex

import peps_envs
from peps_envs.pictures import OUTLINE, picture
from peps_envs.scene import Circle, Polyline, Rectangle, Scene, Text
from peps_jax import evaluate, methods
from peps_jax.drawing import navigation_map, panels, scenes
from peps_jax.sweep import pictures, results

SHAPES = (
    Rectangle(2.0, 1.0, 2.0, 1.0, "agent", angle=np.pi / 2, outline="ink"),
    Circle(1.0, 1.0, 0.5, "#123456"),
    Polyline(((0.0, 0.0), (4.0, 2.0)), "lane line"),
    Text(3.0, 1.0, "here"),
)
SCENE = Scene(SHAPES, (0.0, 4.0, 0.0, 2.0), y_down=True, background="road")


# --- the palette ----------------------------------------------------------------------------------------------------------


def test_no_two_methods_share_a_colour_however_many_there_are(monkeypatch):
    own = [panels.colour_of(name) for name in methods.METHODS]
    more = {f"method {number}": None for number in range(60)}
    monkeypatch.setattr(methods, "METHODS", methods.METHODS | more)
    found = [panels.colour_of(name) for name in methods.METHODS]
    assert len(set(found)) == len(found)
    assert found[: len(own)] == own, "a method that is registered later changes no colour"


def test_the_first_dozen_colours_are_easily_told_apart():
    parts = np.array([[int(code[place : place + 2], 16) for place in (1, 3, 5)] for code in panels.colours(12)]) / 255
    assert min(np.linalg.norm(one - other) for one, other in itertools.combinations(parts, 2)) > 0.25


# --- scenes ---------------------------------------------------------------------------------------------------------------


def drawn(scene):
    figure, grid = panels.panels_of(1, 1, 2.0, 2.0)
    scenes.draw(grid[0, 0], scene)
    return figure, grid[0, 0]


def test_a_scene_is_drawn_as_it_is_described():
    _, axes = drawn(SCENE)
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 4), (2, 0)), "y downwards"
    assert to_hex(axes.get_facecolor()) == panels.ROLES["road"]
    box, disc = axes.patches
    assert [to_hex(patch.get_facecolor()) for patch in (box, disc)] == [panels.ROLES["agent"], "#123456"]
    corners = box.get_patch_transform().transform(box.get_path().vertices)
    np.testing.assert_allclose(corners.min(0), (1.5, 0.0), atol=1e-6)  # turned around its centre
    np.testing.assert_allclose(corners.max(0), (2.5, 2.0), atol=1e-6)
    assert (box.get_linewidth(), disc.get_linewidth()) == (OUTLINE, 0)
    (line,), (text,) = axes.lines, axes.texts
    np.testing.assert_array_equal(line.get_xydata(), [[0, 0], [4, 2]])
    assert text.get_text() == "here"
    order = [artist.get_zorder() for artist in (box, disc, line, text)]
    assert order == sorted(order)
    assert len(set(order)) == 4


def test_a_picture_is_the_view_and_nothing_around_it():
    shown = picture(Scene(SHAPES[1:2], SCENE.extent, y_down=True, background="road"), pixels=200)
    assert (shown.shape, shown.dtype) == ((100, 200, 3), np.uint8)
    colour = lambda x, y: "#" + "".join(f"{part:02x}" for part in shown[y, x])
    assert [colour(x, y) for x, y in ((0, 0), (199, 99), (120, 50))] == [panels.ROLES["road"]] * 3
    assert colour(50, 50) == "#123456"


def test_drawing_anew_replaces_what_was_there():
    _, axes = drawn(SCENE)
    scenes.draw(axes, Scene(SHAPES[:1], SCENE.extent))
    assert len(axes.patches) == 1
    assert not axes.lines
    assert axes.get_ylim() == (0, 2)


def test_between_two_states_real_numbers_are_interpolated_and_nothing_else():
    key = jax.random.key(0)
    before = {
        "place": np.float32([0, 1]),
        "never": np.float32(np.inf),
        "time": np.int32(3),
        "hit": np.bool_(False),
        "key": key,
    }
    after = before | {"place": np.float32([1, 3]), "time": np.int32(4), "hit": np.bool_(True)}
    found = scenes.between(before, after, 0.25)
    np.testing.assert_allclose(found["place"], [0.25, 1.5])
    assert (found["never"], found["time"], found["hit"]) == (np.inf, 3, False)
    assert found["key"] is key


class Shown(peps_envs.Environment):
    """Shows a point's place and time as a text."""

    reset = step = reward = perceive = perception_width = None

    def scene(self, state, params):
        return Scene((Text(0.0, 0.0, f"{float(state.place[0]):g} at {int(state.time)}"),), (0.0, 1.0, 0.0, 1.0))


def test_scenes_of_a_segment_end_where_it_ends():
    times = np.arange(5)
    states, after = (Point((2.0 * times + shift)[:, None], times + shift // 2) for shift in (0, 2))
    segment = types.SimpleNamespace(state=states, next_state=after, mask=np.array([1, 1, 1, 0, 0]))
    shown = scenes.scenes_of(Shown(), None, scenes.states_of(segment), (0, 1.5, 3, 4.5))
    assert [scene.shapes[0].text for scene in shown] == ["0 at 0", "3 at 1", "6 at 3", "6 at 3"]


def test_strips_have_a_column_for_each_clip_and_a_row_for_each_moment():
    figure = scenes.strips({"one": [SCENE, SCENE], "two": [SCENE, SCENE]}, ("begin", "end"), "a note")
    assert [axes.get_title() for axes in figure.axes] == ["one", "two", "", ""]
    assert [axes.get_ylabel() for axes in figure.axes] == ["begin", "", "end", ""]


def test_in_a_film_who_is_done_stands_still(tmp_path):
    from PIL import Image

    other = Scene(SHAPES[1:2], SCENE.extent)
    scenes.film({"long": [SCENE, other, SCENE], "short": [other]}, tmp_path / "film.gif", rate=4)
    with Image.open(tmp_path / "film.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (3, 250)
        shown = []
        for place in range(3):
            gif.seek(place)
            shown.append(np.asarray(gif.convert("RGB"), float))
    height = shown[0].shape[0] // 2
    assert np.abs(shown[0][:height] - shown[1][:height]).max() > 50
    assert np.abs(shown[0][height:] - shown[1][height:]).max() < 10


def test_a_ghost_is_only_of_what_is_elsewhere():
    box, _, *rest = SHAPES
    expected = Scene((box, Circle(1.4, 1.0, 0.5, "#123456"), *rest), SCENE.extent)
    *shown, ghost = scenes.with_ghost(SCENE, expected).shapes
    assert tuple(shown) == SHAPES
    assert ghost == Circle(1.4, 1.0, 0.5, f"#123456{scenes.CLEAR}", outline="ink")
    assert scenes.with_ghost(SCENE, SCENE) == SCENE
    line = Polyline(((0.0, 0.0), (1.0, 1.0)), "agent")
    drawn(scenes.with_ghost(SCENE, Scene((*SHAPES, line), SCENE.extent)))


def test_strips_across_have_a_row_for_each_clip():
    tall = Scene(SHAPES[1:2], (0.0, 2.0, 0.0, 2.0))
    figure = scenes.strips_across({"one": {"a": SCENE, "b": SCENE}, "two": {"c": tall, "d": tall}}, "a note")
    assert [axes.get_title("left") for axes in figure.axes] == ["one", "", "two", ""]
    assert [axes.get_xlabel() for axes in figure.axes] == ["a", "b", "c", "d"]
    figure.canvas.draw()
    one, two = (figure.axes[place].get_window_extent().height for place in (0, 2))
    assert two > 1.5 * one, "a row is as high as its scenes"


def test_a_small_film_in_columns(tmp_path):
    from PIL import Image

    moving = [Scene((Circle(x, 1.0, 0.5, "agent"),), SCENE.extent) for x in (1.0, 2.0, 3.0)]
    clips = dict.fromkeys(("one", "two", "three"), moving)
    scenes.film(clips, tmp_path / "whole.gif", rate=4, columns=2)
    scenes.small_film(clips, tmp_path / "small.gif", rate=4, columns=2)
    with Image.open(tmp_path / "whole.gif") as whole, Image.open(tmp_path / "small.gif") as small:
        assert small.n_frames == whole.n_frames == 3
        assert whole.width == 2 * 6 * 100, "two columns of six inches"
        assert small.height < whole.height, "without its margin"


# --- navigation's maps ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("heat", [False, True])
def test_a_map_is_navigations_scene_without_the_agent(heat):
    params = peps_envs.make("nav-d4").params
    _, grid = panels.panels_of(1, 1, 2.0, 2.0)
    navigation_map.draw_map(grid[0, 0], params, heat)
    filled = [to_hex(patch.get_facecolor()) for patch in grid[0, 0].patches if patch.get_fill()]
    roles = ["pit", "goal", "wall"] if heat else ["floor", "ice", "firm sand", "pit", "goal", "wall"]
    assert filled == [panels.ROLES[role] for role in roles]
    assert sorted(text.get_text() for text in grid[0, 0].texts) == (["goal", "ice", "pit", "sand"] if heat else [])


# --- what a sweep shows ---------------------------------------------------------------------------------------------------


def rows_of(config, name):
    """An untrained agent of `config` with what it does, as a sweep has them."""
    run = untrained(config)
    evaluation = jax.jit(evaluate, static_argnames="num_episodes")(run, num_episodes=2)
    run = run.replace(evaluation=jax.tree.map(np.asarray, evaluation))
    return [results.Row(results.Key(name, config.method, 1.0, 0, "any"), run)]


def test_an_environment_without_a_picture_shows_its_perceived_state_over_time(line):
    (row,) = rows = rows_of(
        line.replace(method="sac", params=LineParams(width=0.5), belief=LineParams(width=0.5)), "line"
    )
    (axes,) = pictures.routes(rows).axes
    assert (axes.get_title(), axes.get_ylabel()) == ("sac", "line")
    evaluation = row.run.evaluation
    assert len(axes.lines) == 2
    for shown, perceived, length in zip(axes.lines, evaluation.perceived, evaluation.length, strict=True):
        moved = (perceived[: int(length) + 1, 0] - perceived[0, 0]) / 0.5  # in perceptual widths
        np.testing.assert_allclose(shown.get_ydata(), moved, rtol=1e-5)


def test_an_environment_with_a_picture_shows_moments_of_an_episode(tiny):
    rows = rows_of(tiny.replace(env="highway-rain", method="sac"), "highway-rain")
    (axes,) = pictures.routes(rows).axes
    assert [inset.get_title("left") for inset in axes.child_axes][-1] in {f"step {step}" for step in range(1, 9)}
    assert len(axes.child_axes) == pictures.MOMENTS
    assert all(to_hex(inset.get_facecolor()) == panels.ROLES["road"] for inset in axes.child_axes)
    assert all(len(inset.patches) == 2 for inset in axes.child_axes), "two cars"


def test_navigation_shows_routes_on_its_map(tiny):
    (row,) = rows = rows_of(tiny.replace(method="sac"), "nav-d1")
    (axes,) = pictures.routes(rows, episodes=1).axes
    route, start = axes.lines
    length = int(row.run.evaluation.length[0])
    np.testing.assert_allclose(route.get_xydata(), row.run.evaluation.perceived[0, : length + 1])
    np.testing.assert_allclose(start.get_xydata(), [jnp.asarray(peps_envs.make("nav-d1").params.start)])
