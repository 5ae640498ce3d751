"""What environments say there is to see: plain shapes, in their own units, that JSON knows too."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams

import peps_envs
from peps_envs import highway
from peps_envs.highway.vehicle import LANE_WIDTH, LENGTH, WIDTH
from peps_envs.scene import Circle, Polyline, Rectangle, Scene, Text
from peps_jax.drawing.panels import ROLES


def seen(task, environment=None, **changes):
    """What there is to see at the start, with `changes` of the state."""
    environment = environment or task.environment
    state, _ = environment.reset(jax.random.key(0), task.params)
    return environment.scene(state.replace(**changes), task.params)


@pytest.mark.parametrize("name", ["nav-d1", "nav-d4", "highway-rain"])
def test_a_scene_is_plain_data_of_known_colours(name):
    scene = seen(peps_envs.make(name))
    told = json.loads(json.dumps(scene.as_dict()))
    assert told["extent"] == list(scene.extent)
    assert told["y_down"] is True
    assert [shape["kind"] for shape in told["shapes"]] == [shape.kind for shape in scene.shapes]
    colours = {shape[field] for shape in told["shapes"] for field in ("colour", "outline") if shape.get(field)}
    assert colours | {told["background"]} <= set(ROLES)


def test_every_kind_of_shape_says_what_it_is():
    shapes = (Rectangle(0, 1, 2, 3, "a"), Circle(0, 1, 2, "b"), Polyline(((0, 1), (2, 3)), "c"), Text(0, 1, "here"))
    told = Scene(shapes, (0, 1, 2, 3)).as_dict()["shapes"]
    assert [shape["kind"] for shape in told] == ["rectangle", "circle", "polyline", "text"]
    assert told[0] | {"x": 0, "width": 2, "angle": 0.0, "outline": None} == told[0]
    assert told[2]["points"] == ((0, 1), (2, 3))


def test_navigation_shows_its_ground_and_the_agent():
    task = peps_envs.make("nav-d3")
    scene = seen(task, position=jnp.array([2.0, 0.5]))
    *ground, agent = scene.shapes
    assert (agent.colour, agent.x, agent.y) == ("agent", 2.0, 0.5)
    assert [area.colour for area in ground] == ["floor", "ice", "sand", "pit", "goal", "wall"]
    goal = ground[4]
    np.testing.assert_allclose((goal.x, goal.y, goal.width, goal.height), (5.4, 5.4, 1.2, 1.2), rtol=1e-5)
    left, right, low, high = scene.extent
    assert left < 0 < 6 < right
    assert low < 0 < 6 < high
    assert "firm sand" in [area.colour for area in seen(peps_envs.make("nav-d4")).shapes]
    assert [area.colour for area in seen(peps_envs.make("nav-d1")).shapes] == ["floor", "pit", "goal", "agent"]


def test_the_road_goes_along_with_the_ego():
    task = peps_envs.make("highway-rain")
    environment = highway.Highway(traffic=1)
    state, _ = environment.reset(jax.random.key(0), task.params)
    vehicles = state.vehicles.replace(
        x=jnp.array([1000.0, 1030.0, 990.0]),
        heading=jnp.array([0.2, 0.0, 0.0]),
        crashed=jnp.array([False, True, False]),
    )
    scene = seen(task, environment, vehicles=vehicles)
    cars = [shape for shape in scene.shapes if isinstance(shape, Rectangle)]
    assert [car.colour for car in cars] == ["agent", "wreck", "other"]
    assert [car.x for car in cars] == [1000, 1030, 990]
    assert [car.y for car in cars] == [LANE_WIDTH, LANE_WIDTH, 0]
    assert cars[0].angle == pytest.approx(0.2)
    assert {(car.width, car.height) for car in cars} == {(LENGTH, WIDTH)}
    left, right, *_ = scene.extent
    assert (left, right) == (980, 1060)
    dashes = [shape for shape in scene.shapes if isinstance(shape, Polyline) and shape.colour == "lane line"]
    assert all(dash.points[0][0] % 12 == 0 for dash in dashes), "they stay where they are while the view moves"


def test_an_environment_may_have_no_picture():
    assert seen(peps_envs.Task(Line(), LineParams(), {})) is None
