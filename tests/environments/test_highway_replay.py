"""highway-env's recorded scenarios replayed: the same arrays, or one line that says why not."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from peps_envs import highway
from peps_envs.highway import simulation, traffic, vehicle

RECORDINGS = {  # of highway-env 1.12.1: one behaviour at a time, dense random traffic, and headings of pi with ties of places
    f"{name}/{scenario}": (file, scenario)
    for name in ("parity", "traffic", "turned")
    for file in (np.load(Path(__file__).parents[1] / f"data/highway_{name}.npz"),)
    for scenario in file["scenarios"]
}
DRIFT = {"state": (3.6e-4, 6e-6, 3e-7, 5.5e-5)}  # of x, y, heading and speed in single precision


def replayed(name, dtype):
    file, scenario = RECORDINGS[name]
    with jax.enable_x64(dtype == np.float64):
        return highway.replay(json.loads(str(file[f"{scenario}/meta"])), file[f"{scenario}/actions"])


def recorded(name):
    file, scenario = RECORDINGS[name]
    prefix = f"{scenario}/"
    return {key.removeprefix(prefix): file[key] for key in file.files if key.startswith(prefix) and "meta" not in key}


# Parity


@pytest.mark.parametrize("name", RECORDINGS)
def test_replays_agree_with_highway_env_in_double_precision(name):
    found, expected = replayed(name, np.float64), recorded(name)
    assert set(found) == set(expected)
    for key, values in expected.items():
        assert found[key].shape == values.shape
        if key != "obs" and values.dtype == np.float64:
            assert found[key].dtype == np.float64
        np.testing.assert_allclose(found[key], values, rtol=0, atol=3e-7 if key == "obs" else 1e-9, err_msg=key)


@pytest.mark.parametrize("name", [name for name in RECORDINGS if name.startswith("parity")])
def test_replays_agree_with_highway_env_in_single_precision(name):
    found, expected = replayed(name, np.float32), recorded(name)
    assert found["state"].dtype == np.float32
    drift = np.abs(found["state"] - expected["state"]).max((0, 1))
    assert np.all(drift <= DRIFT["state"]), drift
    for key in ("crashed", "lane", "terminated"):
        np.testing.assert_array_equal(found[key], expected[key], key)
    for key in ("target", "timer", "obs", "reward", "impact"):
        np.testing.assert_allclose(found[key], expected[key], rtol=0, atol=1e-4, err_msg=key)


def test_a_slow_car_across_the_lane_steers_the_same_way_in_single_precision():
    """atan(2 tan(asin(1))) is -pi/2 in single precision: the steering's limit is where the formula has its pole."""
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            gains = simulation.highway_env().gains
            arguments = (jnp.asarray(value, dtype) for value in (2.0, 1.2, 0.5))
            slip = vehicle.steer(*arguments, jnp.int32(0), gains)
            assert vehicle.steering_angle(slip) == pytest.approx(-math.pi / 3, rel=1e-6)


@pytest.mark.parametrize(("hz", "steps"), [(5, 6), (10, 11), (15, 16), (20, 20), (30, 31), (60, 60)])
def test_drivers_wait_as_long_as_sums_in_double_precision_say(hz, steps):
    assert traffic.steps_until(0.0, 1 / hz) == steps
    assert traffic.steps_until(1.1, 1 / hz) == 0


def test_a_heading_of_pi_is_the_same_compiled_or_not():
    angles = np.array([-np.pi, np.pi, 3 * np.pi, -3 * np.pi, 3.14, 0.0, 1e-12, 4.0, -4.0])
    for kind in (np.float32, np.float64):
        with jax.enable_x64(kind == np.float64):
            given = jnp.asarray(angles, kind)
            found = vehicle.wrap(given)
            np.testing.assert_array_equal(jax.jit(vehicle.wrap)(given), found)
            assert found.dtype == kind
            assert np.all((found >= -kind(np.pi)) & (found < kind(np.pi)))
            np.testing.assert_array_equal(found[:2], [-kind(np.pi)] * 2)
            np.testing.assert_allclose(found[4:7], angles[4:7], rtol=1e-6)
            np.testing.assert_allclose(np.sin(found), np.sin(angles), atol=1e-6)


@pytest.mark.parametrize("speed", [46.0, -41.0])
def test_a_plain_car_that_is_too_fast_is_refused_and_a_braking_one_is_not(speed):
    """highway-env would repeat the command that first slowed it, 46, 45.4, 44.8, ... m/s, until it drives backwards."""
    meta = json.loads(str(RECORDINGS["parity/brake_idle"][0]["brake_idle/meta"]))
    fast = lambda kind: meta | {"vehicles": [meta["vehicles"][0], dict(kind=kind, x=200.0, lane=0, speed=speed)]}
    with pytest.raises(
        ValueError, match=rf"vehicle 1 is plain and drives at {speed} m/s: .* slowed to 40 m/s"
    ) as error:
        highway.replay(fast("plain"), [1])
    assert "\n" not in str(error.value)
    speeds = highway.replay(fast("brake"), [1])["state"][:, 1, 3]
    assert np.all(np.diff(np.abs(speeds)) < 0), "nearer to 40 m/s in every step"
    assert np.all(np.abs(speeds) >= 40)


def test_scenarios_are_checked():
    meta = json.loads(str(RECORDINGS["parity/brake_idle"][0]["brake_idle/meta"]))
    wrong = meta | {"vehicles": [meta["vehicles"][0], meta["vehicles"][1] | {"kind": "bicycle"}]}
    with pytest.raises(ValueError, match="vehicle kind 'bicycle' is unknown: known are ego, brake, idm, plain"):
        highway.replay(wrong, [1])
    with pytest.raises(ValueError, match="the first vehicle has to be the ego"):
        highway.replay(meta | {"vehicles": meta["vehicles"][::-1]}, [1])


UNDECIDED = json.loads((Path(__file__).parents[1] / "data/highway_undecided.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", UNDECIDED)
def test_a_scene_in_which_rounding_decides_is_refused_up_to_where_it_does(name):
    """highway-env 1.12.1 went one way here and this package another, after an agreement to 1e-12."""
    meta, actions = UNDECIDED[name]["meta"], UNDECIDED[name]["actions"]
    with pytest.raises(ValueError, match=r"vehicle \d is at [\d.]+ s where rounding decides") as error:
        highway.replay(meta, actions)
    assert "\n" not in str(error.value)
