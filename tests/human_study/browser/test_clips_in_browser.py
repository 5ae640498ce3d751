"""What a browser makes of clips: the scenes of the films, at any time between two moments."""

import numpy as np
import pytest
from clip_cases import Parade, drive, parade, walk

import peps_envs
from peps_jax.drawing import scenes
from peps_jax.human_study import clips
from peps_jax.preferences.data import Segments

STEPS = 6
TIMES = [0, 0.25, 1, 1.5, 2.999, 3, 4.2, 5.75, 6, 9]
READ = """async ([view, clip, times]) => {
    const { Clip } = await import("/static/clip.js");
    const read = new Clip(view, clip);
    return times.map((time) => read.sceneAt(time));
}"""
CASES = {
    "highway-rain": (peps_envs.make("highway-rain"), drive),
    "nav-d2": (peps_envs.make("nav-d2"), walk),
    "nav-d4": (peps_envs.make("nav-d4"), walk),
    "parade": (peps_envs.Task(Parade(), None, {}), lambda task, steps: parade(steps)),
}


def in_sight(shape, scene, slack=0.02):
    """Whether more of a shape than its edge is in view: what lies outside may be told or not."""
    left, right, low, high = scene["extent"]
    xs, ys = np.transpose(shape["points"]) if shape["kind"] == "polyline" else ([shape["x"]], [shape["y"]])
    across, down = (shape.get(side, 0) / 2 for side in ("width", "height"))
    beside = min(xs) - across > right - slack or max(xs) + across < left + slack
    return not (beside or min(ys) - down > high - slack or max(ys) + down < low + slack)


def look(shape):
    return {name: value for name, value in shape.items() if isinstance(value, str)}


def numbers(shape):
    return np.hstack(
        [np.ravel(shape[name]) for name in sorted(shape) if isinstance(shape[name], float | int | tuple | list)]
    )


@pytest.mark.parametrize("name", CASES)
def test_a_clip_shows_the_films_scenes(page, fake, name):
    """Everything in sight is there once, in its colours, within a thousandth of the road's width."""
    task, states = CASES[name]
    before, after = states(task, STEPS)
    mask = np.ones(STEPS, bool)
    told = clips.encode(task.environment, task.params, before, after, mask)
    segment = Segments(None, None, mask, None, before, after)
    film = scenes.scenes_of(task.environment, task.params, scenes.states_of(segment), TIMES)
    fake.open(page)
    read = page.evaluate(READ, [clips.view(task.environment, task.params), told, TIMES])
    left, right, low, high = film[0].extent
    error = 0.001 * min(right - left, high - low)
    for theirs, ours in zip([scene.as_dict() for scene in film], read, strict=True):
        np.testing.assert_allclose(ours["extent"], theirs["extent"], atol=error)
        assert (ours["y_down"], ours["background"]) == (theirs["y_down"], theirs["background"])
        wanted, found = ([shape for shape in scene["shapes"] if in_sight(shape, theirs)] for scene in (theirs, ours))
        assert len(found) == len(wanted)
        for shape in wanted:
            alike = [numbers(other) for other in found if look(other) == look(shape)]
            assert min(np.abs(other - numbers(shape)).max() for other in alike) < error
        over = [[look(shape) for shape in shapes if shape["kind"] != "polyline"] for shapes in (found, wanted)]
        assert over[0] == over[1], "they lie over one another in the same order"


DRAW = """async ([view, scene, width, height, places]) => {
    const { draw, fit } = await import("/static/drawing.js");
    const canvas = document.createElement("canvas");
    const room = fit(canvas, view, width, height);
    draw(canvas, scene, room, view.colours);
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const at = ([x, y]) => [...data.slice(4 * (y * canvas.width + x)).slice(0, 3)];
    return { size: [canvas.width, canvas.height], pixels: places.map(at) };
}"""
RED, BLUE, GREY = [255, 0, 0], [0, 0, 255], [128, 128, 128]


@pytest.mark.parametrize(
    ("box", "y_down", "size", "red", "blue"),
    [
        ((200, 60), True, (200, 50), (50, 10), (150, 40)),
        ((200, 60), False, (200, 50), (50, 40), (150, 10)),
        ((60, 200), True, (50, 200), (10, 150), (40, 50)),  # upright: x goes up, its right stays right
        ((60, 200), False, (50, 200), (40, 150), (10, 50)),
    ],
)
def test_a_scene_is_drawn_where_it_is(page, fake, box, y_down, size, red, blue):
    """A red square a quarter of the way along, a blue one at three quarters on the other side of a wide scene."""
    squares = [("red", 25.0, 5.0), ("#0000ff", 75.0, 20.0)]
    look = {"kind": "rectangle", "width": 6.0, "height": 6.0, "angle": 0.5, "outline": None}
    shapes = [look | {"colour": colour, "x": x, "y": y} for colour, x, y in squares]
    scene = {"extent": [0, 100, 0, 25], "y_down": y_down, "background": "road", "shapes": shapes}
    view = {"width": 100, "height": 25, "colours": {"road": "#808080"}}
    fake.open(page)
    drawn = page.evaluate(DRAW, [view, scene, *box, [red, blue, (size[0] // 2, size[1] // 2)]])
    assert tuple(drawn["size"]) == size
    assert drawn["pixels"] == [RED, BLUE, GREY]


SPEED = """async ([view, clips, frames]) => {
    const { Clip } = await import("/static/clip.js");
    const { draw, fit } = await import("/static/drawing.js");
    const stages = clips.map((clip) => {
        const canvas = document.createElement("canvas");
        return { canvas, room: fit(canvas, view, 640, 400), clip: new Clip(view, clip) };
    });
    const begin = performance.now();
    for (let frame = 0; frame < frames; frame++) {
        for (const { canvas, room, clip } of stages) draw(canvas, clip.sceneAt((clip.steps * frame) / frames), room, view.colours);
    }
    return (performance.now() - begin) / frames;
}"""


@pytest.mark.parametrize("name", ["highway-rain", "nav-d4"])
def test_a_browser_draws_a_pair_sixty_times_a_second(page, fake, name):
    task, states = CASES[name]
    encoded = clips.encode(task.environment, task.params, *states(task, STEPS), np.ones(STEPS, bool))
    fake.open(page)
    each = page.evaluate(SPEED, [clips.view(task.environment, task.params), [encoded, encoded], 300])
    assert each < 1000 / 60  # ms
