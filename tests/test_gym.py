"""The environment for learned policies: bayesrace/gym.py and docs/gym.md."""

import importlib
import re
import sys
import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import bayesrace as br
from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gym import ENV_ID, OBSERVED, RaceEnv
from bayesrace.operation.analysis.laps import time_laps
from tests.conftest import Circuit
from tests.programs import ROOT

EXAMPLES = re.findall(
    r"^```python\n(.*?)^```$", (ROOT / "docs" / "gym.md").read_text(), re.DOTALL | re.MULTILINE
)
COAST = (0.0, 0.0)
FULL = (1.0, 0.0)


@pytest.fixture
def env(circuit: Circuit) -> RaceEnv:
    return RaceEnv("orca", circuit.track)


def followed(env: RaceEnv, swing: float = 0.3, mps: float = 1.2) -> list[dict[str, Any]]:
    """Infos of an episode driven along a line that swings about the centreline."""
    observation, info = env.reset()
    infos = [info]
    while not info["end"]:
        wanted = swing * np.sin(2 * np.pi * info["s_m"] / env.track.length_m)
        bend = np.arctan(observation[10] * env.car.wheelbase_m)
        delta = bend - 0.12 * (observation[4] - wanted) - 0.4 * observation[5]
        action = (mps - observation[0], (delta - observation[3]) / 0.1)
        observation, _, _, _, info = env.step(action)
        infos.append(info)
    return infos


def column(infos: list[dict[str, Any]], name: str) -> Floats:
    return np.array([info[name] for info in infos])


@pytest.mark.parametrize("start", ["line", "random"])
def test_gymnasium_finds_no_fault(start: str) -> None:
    made = gymnasium.make(ENV_ID, car="orca", track="harbour", start=start, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
    made.close()


def test_many_environments_at_once(circuit: Circuit) -> None:
    some = gymnasium.make_vec(
        ENV_ID, num_envs=3, vectorization_mode="sync", car="orca", track=circuit.track,
        start="random", laps=0, max_time_s=0.2,
    )  # fmt: skip
    observations, _ = some.reset(seed=1)
    assert observations.shape == (3, len(OBSERVED) + 12)
    for _ in range(25):  # beyond the end of an episode
        _, rewards, _, _, infos = some.step(np.zeros((3, 2)))
    assert rewards.shape == (3,)
    assert infos["state"].shape == (3, 7)
    some.close()


def test_rewards_add_up_to_the_way_along_the_centreline(circuit: Circuit) -> None:
    env = RaceEnv("orca", circuit.track, laps=0, max_time_s=1.0, off_track="continue")
    _, info = env.reset()
    total, terminated = 0.0, False
    while not info["end"]:
        _, reward, terminated, truncated, info = env.step(FULL)
        total += reward
    assert total == pytest.approx(info["progress_m"])
    assert info["progress_m"] == pytest.approx(info["s_m"])  # it began at the line
    assert terminated is not truncated


def test_a_car_is_where_the_track_says_it_is(circuit: Circuit) -> None:
    infos = followed(RaceEnv("orca", circuit.track))
    projected = circuit.track.project_path(column(infos, "state")[:, :2])
    np.testing.assert_allclose(column(infos, "s_m"), projected.s_m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        column(infos, "off_track_m"), projected.off_track_m, rtol=0, atol=1e-9
    )


def test_laps_are_those_of_the_projects_own_rule(circuit: Circuit) -> None:
    env = RaceEnv("orca", circuit.track, laps=2)
    infos = followed(env)
    assert infos[-1]["end"] == "laps"
    laps = time_laps(
        circuit.track, column(infos, "time_s"), column(infos, "state")[:, :2],
        column(infos, "s_m"),
    )  # fmt: skip
    assert infos[-1]["lap_times_s"] == pytest.approx(laps.times_s, rel=0, abs=1e-12)
    assert len(laps.times_s) == 2
    assert infos[-1]["progress_m"] == pytest.approx(2 * circuit.track.length_m, abs=0.05)


def test_the_observation_is_relative_to_the_track(circuit: Circuit) -> None:
    track, s_m, n_m = circuit.track, 2.0, -0.08
    env = RaceEnv("orca", track, ahead_m=[0.0, 0.5, 6.0])
    x, y = track.position(s_m) + n_m * track.normal(s_m)
    x0 = (x, y, float(track.heading(s_m)) + 0.1 + 4 * np.pi, 1.5, -0.1, 2.0, 0.2)
    observation, info = env.reset(options={"x0": x0})
    right_m, left_m = (float(one) for one in track.widths(s_m))
    expected = [1.5, -0.1, 2.0, 0.2, n_m / right_m, 0.1, right_m, left_m]
    expected += track.curvature(s_m + env.ahead_m).tolist()
    np.testing.assert_allclose(observation, expected, rtol=2e-3, atol=1e-5)
    np.testing.assert_array_equal(info["state"], x0)


def test_what_is_beyond_the_bounds_is_clipped(circuit: Circuit) -> None:
    env = RaceEnv("orca", circuit.track)
    x, y, psi = circuit.track.start_pose()
    observation, _ = env.reset(options={"x0": (x, y, psi, 1.0, 0.0, 200.0, 0.0)})
    assert observation[2] == env._high[2]
    assert env.observation_space.contains(observation)


def test_an_action_is_what_the_actuators_can(env: RaceEnv) -> None:
    car = env.car
    env.reset()
    _, _, _, _, info = env.step((1.0, 0.5))
    np.testing.assert_allclose(info["u_applied"], [car.d_max, car.delta_rate_max_radps / 2])
    _, _, _, _, clipped = env.step((9.0, -9.0))
    np.testing.assert_allclose(clipped["u_applied"], [car.d_max, -car.delta_rate_max_radps])
    for u in ((car.d_max, 0.1), (car.d_min, -0.2), COAST):
        np.testing.assert_allclose(tuple(env._input(env.action_for(u))), u, rtol=1e-15)


def test_a_seed_settles_the_start(circuit: Circuit) -> None:
    env = RaceEnv("orca", circuit.track, start="random")
    states = [env.reset(seed=seed)[1]["state"] for seed in (5, 6, 5)]
    np.testing.assert_array_equal(states[0], states[2])
    assert not np.array_equal(states[0], states[1])
    places = [env.reset()[1]["s_m"] for _ in range(20)]
    assert np.ptp(places) > circuit.track.length_m / 2


def test_leaving_the_track_ends_an_episode_or_costs(circuit: Circuit) -> None:
    width_m = float(np.max(circuit.track.width_left_m + circuit.track.width_right_m))
    ended: dict[str, dict[str, Any]] = {}
    for off_track in ("end", "continue"):
        env = RaceEnv(
            "orca", circuit.track, off_track=off_track, off_track_penalty=2.0,
        )  # fmt: skip
        _, info = env.reset()
        total, off, terminated = 0.0, 0, False
        while not info["end"]:
            _, reward, terminated, _, info = env.step(FULL)
            total, off = total + reward, off + (info["off_track_m"] > 0)
        assert terminated
        assert total == pytest.approx(info["progress_m"] - 2.0 * off)
        ended[off_track] = info
    assert ended["end"]["end"] == ended["continue"]["end"] == "off_track"
    assert 0 < ended["end"]["off_track_m"] < 0.1
    assert ended["continue"]["off_track_m"] > width_m


def test_a_piece_of_the_track_that_is_left_out_counts_nothing() -> None:
    """Between two pieces of a track a car comes from one to the other."""
    track = br.Track.load("harbour")
    env = RaceEnv("orca", track, off_track="continue", laps=0, max_time_s=5.0)
    s_m = np.linspace(0, track.length_m, 400)
    points, across = track.position(s_m), s_m[:, None] - s_m
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    apart[np.abs((across + track.length_m / 2) % track.length_m - track.length_m / 2) < 4] = 9.0
    i, j = np.unravel_index(np.argmin(apart), apart.shape)
    there, back = points[i], points[j]
    psi = float(np.arctan2(*(back - there)[::-1]))
    _, info = env.reset(options={"x0": (*there, psi, 2.0, 0.0, 0.0, 0.0)})
    reward = 0.0
    while not info["end"]:
        _, reward, terminated, _, info = env.step((0.3, 0.0))
    assert info["end"] == "short_cut"
    assert reward == 0
    assert terminated


def test_an_episode_that_is_over_wants_a_reset(env: RaceEnv) -> None:
    with pytest.raises(InputError, match=r"call reset\(\)"):
        env.step(COAST)
    slow = RaceEnv("orca", env.track, max_time_s=0.04)
    slow.reset()
    assert slow.step(COAST)[2:4] == (False, False)
    assert slow.step(COAST)[2:4] == (False, True)
    with pytest.raises(InputError, match=r"call reset\(\)"):
        slow.step(COAST)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"laps": -1}, ("laps = -1", "from 1 on")),
        ({"laps": 0}, ("laps = 0", "max_time_s")),
        ({"max_time_s": 0.0}, ("max_time_s = 0.0", "more than 0")),
        ({"off_track": "crash"}, ("off_track = 'crash'", "end, continue")),
        ({"off_track_penalty": -1.0}, ("off_track_penalty = -1", "0 or more")),
        ({"start": "pit"}, ("start = 'pit'", "line, random")),
        ({"ahead_m": []}, ("ahead_m = []", "distances")),
        ({"ahead_m": [-1.0]}, ("ahead_m = [-1.0]", "0 or more")),
        ({"render_mode": "human"}, ("render_mode = 'human'", "rgb_array")),
        ({"car": "orcas"}, ("orcas",)),
        ({"track": "harbor"}, ("harbor",)),
    ],
)
def test_what_no_episode_can_be_made_of_is_named(
    arguments: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as raised:
        RaceEnv(**{"car": "orca", "track": "harbour"} | arguments)
    assert all(word in str(raised.value) for word in words), raised.value


def test_bad_starts_and_actions_are_named(env: RaceEnv) -> None:
    for options, words in (
        ({"pose": 1}, "pose"),
        ({"x0": (1, 2)}, "expected"),
        ({"x0": (0.0, 0.0, 0, 0, 0, 0, 0)}, "off the track"),
    ):
        with pytest.raises(InputError, match=words):
            env.reset(options=options)
    env.reset()
    for action, words in (((1.0,), "expected"), ((np.nan, 0.0), "finite")):
        with pytest.raises(InputError, match=words):
            env.step(action)


def test_without_gymnasium_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "bayesrace.gym")
    with pytest.raises(InputError, match=r"gymnasium.*bayesrace\[gym\]"):
        importlib.import_module("bayesrace.gym")


def test_a_picture_shows_the_car(circuit: Circuit) -> None:
    env = RaceEnv("orca", circuit.track, render_mode="rgb_array")
    env.reset()
    before = env.render()
    for _ in range(20):
        env.step(FULL)
    after = env.render()
    assert before is not None
    assert after is not None
    assert before.dtype == np.uint8
    assert before.shape == after.shape
    assert max(before.shape) == 640
    changed = np.any(before != after, axis=2).mean()
    assert 0 < changed < 0.05
    assert RaceEnv("orca", circuit.track).render() is None


def test_the_controller_drives_the_same_laps_as_in_the_closed_loop() -> None:
    """As the page shows it."""
    names = executed(EXAMPLES[2])
    assert len(names["run"].laps) == 1
    assert names["info"]["lap_times_s"] == pytest.approx(names["run"].laps, rel=0, abs=1e-9)


def executed(example: str, **names: Any) -> dict[str, Any]:
    """The names that an example of the page leaves."""
    exec(example, names)  # noqa: S102
    return names


@pytest.mark.parametrize("index", [0, 1])
def test_the_examples_run(index: int) -> None:
    executed(EXAMPLES[index])


class FakeGym:
    """What the F1TENTH gym shows of itself, by our equations: speed and steering controllers,
    late steering, wrapped heading, and no lateral velocity."""

    def __init__(self, timestep: float, wall_s: float = 1e9) -> None:
        car = br.Car.load("f1tenth")
        self._car = br.Simulator(car, br.Track.load("workshop"), step_s=timestep)
        self._wall_s = wall_s
        self.unwrapped = self
        self.sim = SimpleNamespace(agents=[SimpleNamespace(state=np.zeros(7))])

    def reset(self, poses: Floats) -> tuple[Any, ...]:
        assert poses.shape == (1, 3)
        self._car.reset((*poses[0], 0.0, 0.0, 0.0, 0.0))
        self._asked = [0.0, 0.0]
        return self.step(np.zeros((1, 2)))

    def step(self, action: Floats) -> tuple[Any, ...]:
        steer, speed = action[0].tolist()
        self._asked.append(steer)
        state = self._car.state
        missing = self._asked.pop(0) - state.delta
        rate = 3.2 * np.sign(missing) if abs(missing) > 1e-4 else 0.0
        more = speed - float(np.hypot(state.vx, state.vy))
        state = self._car.step((more * (4.755 if more > 0 else 19.02), rate))
        self.sim.agents[0].state[6] = np.arctan2(state.vy, state.vx)
        seen = {
            "poses_x": [state.x], "poses_y": [state.y], "poses_theta": [state.psi % (2 * np.pi)],
            "linear_vels_x": [float(np.hypot(state.vx, state.vy))], "linear_vels_y": [0.0],
            "ang_vels_z": [state.omega],
            "collisions": np.array([float(self._car.time_s > self._wall_s)]),
        }  # fmt: skip
        return seen, self._car.step_s, False, {}


def test_the_f1tenth_gym_drives_as_the_car(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter of the page, with the gym's interface and rules in place of the gym."""
    asked: dict[str, Any] = {}

    def make(name: str, **arguments: Any) -> FakeGym:
        asked.update(arguments, name=name)
        return FakeGym(arguments["timestep"])

    monkeypatch.setitem(sys.modules, "gym", SimpleNamespace(make=make))
    adapter = executed(EXAMPLES[3])["F1tenthGym"]
    names = executed(EXAMPLES[4].replace("Spielberg_map.yaml", "workshop"), F1tenthGym=adapter)
    assert asked["name"] == "f110_gym:f110-v0"
    run = names["run"]
    assert run.laps == pytest.approx((7.305,), abs=0.01)
    assert run.off_track == 0
    assert not run.driven.fallbacks
    with pytest.raises(RuntimeError, match="wall"):
        br.drive(names["controller"], adapter(FakeGym(0.01, wall_s=0.5), 0.01), laps=1)
