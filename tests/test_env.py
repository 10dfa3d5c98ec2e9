"""The rules of the forest: rewards at every knee, geometry, laser, outcomes, flights reflown."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from env import (
    Fleet,
    ForestEnv,
    World,
    fly,
    fly_random,
    laser_pilot,
    measure,
    plan,
    plant,
    random_pilot,
    refly,
    reward,
    straight_pilot,
    ways,
)
from render import CAMERAS

WORLD = World()
CLEARING = replace(WORLD, rows=0)  # no trunks


def flown(env: ForestEnv, actions: Sequence[int], seed: int = 0) -> tuple:
    """Reset and fly; returns what the last step returned."""
    env.reset(seed=seed)
    for action in actions:
        result = env.step(action)
    return result


@pytest.mark.parametrize(
    ("d_obs", "d_goal", "expected"),
    [
        (20.0, 90.0, 0.25),  # far from trunks, no way made
        (2.0001, 90.0, 0.25),  # just safe
        (2.0, 90.0, 0.0),  # r_neg
        (1.375, 90.0, -2.5),  # halfway
        (0.75, 90.0, -5.0),  # r_precrash
        (20.0, 45.0, 0.75),  # half the way made
        (20.0, 0.0, 1.25),  # at the goal
        (20.0, 99.0, 0.15),  # behind the start the way counts against
        (1.375, 45.0, -2.0),
    ],
)
def test_the_live_reward_at_every_knee_of_the_papers_formula(
    d_obs: float, d_goal: float, expected: float
) -> None:
    assert reward("", d_obs, d_goal, WORLD) == pytest.approx(expected)


def test_crashing_and_leaving_cost_ten_and_nothing_else() -> None:
    assert reward("crash", 0.7, 10.0, WORLD) == reward("left", 20.0, 0.0, WORLD) == -10.0


def test_arrival_and_the_time_limit_pay_the_live_reward() -> None:
    for outcome in ("goal", "time"):
        assert reward(outcome, 5.0, 3.0, WORLD) == reward("", 5.0, 3.0, WORLD)


def test_every_forest_is_150_trunks_within_the_jitter_of_the_grid() -> None:
    grid = np.array([(7.5 + 6 * i, -22 + 5 * j) for i in range(15) for j in range(10)])
    for seed in range(200):
        offset = plant(seed, WORLD) - grid
        assert offset.shape == (150, 2)
        assert (np.abs(offset) <= [1.0, 2.5]).all()
    assert np.abs(offset[:, 1]).max() > 1.5  # the jitter is that of the axis, not of the other


def test_a_forest_is_its_seed_and_nothing_else() -> None:
    assert (plant(3 * 10**9, WORLD) == plant(3 * 10**9, WORLD)).all()
    assert (plant(1, WORLD) != plant(2, WORLD)).all()


def test_the_jitter_is_uniform() -> None:
    x = np.concatenate(
        [plant(s, WORLD)[:, 0] - np.repeat(7.5 + 6 * np.arange(15), 10) for s in range(100)]
    )
    assert x.mean() == pytest.approx(0, abs=0.02)
    assert x.var() == pytest.approx(1 / 3, abs=0.01)


def test_the_scans_minimum_agrees_with_d_obs() -> None:
    env, rng = ForestEnv(blind=True), np.random.default_rng(0)
    for seed in range(30):
        env.reset(seed=seed)
        while not env.outcome:
            _, distance = env.scan()
            assert distance.min() == pytest.approx(env.d_obs, abs=0.05)
            env.step(int(rng.integers(9)))


def test_the_scan_starts_dead_ahead_and_goes_counter_clockwise() -> None:
    env = ForestEnv(blind=True)
    env.reset(seed=0)
    env.trunks = np.array([[0.0, 5.0]])
    bearings, distance = env.scan()
    assert bearings[distance.argmin()] == pytest.approx(math.pi / 2)
    assert distance.min() == pytest.approx(4.5)
    assert distance[0] == 20.0


def test_going_straight_makes_half_a_metre_a_step() -> None:
    *_, info = flown(ForestEnv(CLEARING), [4] * 10)
    assert info["pose"] == pytest.approx((5.0, 0.0, 0.0))
    assert info["d_goal"] == pytest.approx(85.0)
    assert info["d_obs"] == 20.0


@pytest.mark.parametrize("action", range(9))
def test_each_action_turns_at_its_yaw_rate_and_then_flies(action: int) -> None:
    rate = 0.7 * (action - 4) / 4  # 0 is right, 8 is left
    *_, info = flown(ForestEnv(CLEARING), [action] * 7)
    headings = rate * 0.1 * np.arange(1, 8)
    expected = (0.5 * np.cos(headings).sum(), 0.5 * np.sin(headings).sum(), 0.7 * rate)
    assert info["pose"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("actions", "outcome", "edge"),
    [
        ([4] * 175, "goal", ""),
        ([8] * 22 + [4] * 50, "left", "side"),
        ([8] * 45 + [4] * 60, "left", "back"),
        ([8] * 4 + [4] * 30 + [0] * 4 + [4] * 160, "left", "far"),
        ([4] * 40 + [8] * 960, "time", ""),
    ],
)
def test_each_flight_has_its_outcome_and_its_edge(
    actions: list[int], outcome: str, edge: str
) -> None:
    env = ForestEnv(CLEARING, blind=True)
    env.reset(seed=0)
    left = iter(actions)
    while not env.outcome:
        _, r, terminated, truncated, info = env.step(next(left))
    assert (info["outcome"], info["edge"]) == (outcome, edge)
    assert truncated == (outcome == "time")
    assert terminated != truncated
    assert (r == -10.0) == (outcome == "left")


def test_a_flight_into_a_trunk_is_a_crash() -> None:
    env = ForestEnv(blind=True)
    for seed in range(20):
        *_, (_, r, terminated, truncated, info) = refly(seed, straight_to_the_end(env, seed), WORLD)
        assert terminated
        assert not truncated
        assert info["outcome"] == "crash"
        assert r == -10.0
        x, y, _ = info["pose"]
        assert np.hypot(*(plant(seed, WORLD) - (x, y)).T).min() - 0.5 < 0.75


def straight_to_the_end(env: ForestEnv, seed: int) -> list[int]:
    """As many straight steps as the flight lasts."""
    env.reset(seed=seed)
    while not env.outcome:
        env.step(4)
    return env.actions


def test_a_flight_is_its_seed_and_its_actions() -> None:
    rng = np.random.default_rng(3)
    env = ForestEnv(replace(WORLD, beacon=True))
    for seed in (0, 5, 2 * 10**9, 10**40):
        observation, _ = env.reset(seed=seed)
        frames, rewards = [observation], [0.0]
        while not env.outcome:
            observation, r, *_ = env.step(int(rng.integers(2, 7)))
            frames.append(observation)
            rewards.append(r)
        again = list(refly(seed, env.flight()["actions"], env.world))
        assert all((a == b[0]).all() for a, b in zip(frames, again, strict=True))
        assert rewards == [step[1] for step in again]
        assert again[-1][-1]["progress"] == env.flight()["progress"]


def test_forward_is_the_way_gained_along_x_and_adds_up_to_x() -> None:
    env, rng = ForestEnv(CLEARING, blind=True), np.random.default_rng(1)
    env.reset(seed=0)
    x = gained = 0.0
    while not env.outcome:  # it flies ahead, and back as well
        *_, info = env.step(int(rng.integers(5, 9)))
        gained += info["forward"]
        assert info["forward"] == pytest.approx(info["pose"][0] - x)
        x = info["pose"][0]
        assert gained == pytest.approx(x)
        assert env.progress >= x
    _, info = env.reset(seed=1)
    assert (info["forward"], env.progress) == (0.0, 0.0)


def test_the_step_of_the_files_own_example_earns_minus_1_67() -> None:
    assert reward("", 1.5, 60.0, WORLD) == pytest.approx(-2 + 1 / 3)


def test_an_observation_is_the_last_four_frames_and_starts_as_one_frame_four_times() -> None:
    env = ForestEnv()
    first, _ = env.reset(seed=0)
    assert first.shape == (4, 84, 84)
    assert first.dtype == np.uint8
    assert (first == first[0]).all()
    second, *_ = env.step(4)
    third, *_ = env.step(4)
    assert (second[:3] == first[1:]).all()
    assert (third[:3] == second[1:]).all()
    assert (third[3] != third[2]).any()


def test_without_a_camera_only_the_frames_are_missing() -> None:
    seeing, blind = ForestEnv(), ForestEnv(blind=True)
    assert not flown(blind, [4, 5, 6])[0].any()
    assert flown(blind, [4, 5, 6])[1:] == flown(seeing, [4, 5, 6])[1:]


def test_step_returns_plain_python_numbers_as_gymnasium_asks() -> None:
    _, r, terminated, truncated, info = flown(ForestEnv(), [4])
    assert type(r) is float
    assert type(terminated) is type(truncated) is bool
    assert type(info["d_obs"]) is type(info["d_goal"]) is float


def test_without_a_seed_the_next_forest_is_the_next_number() -> None:
    env = ForestEnv(blind=True)
    env.reset(seed=41)
    env.reset()
    assert env.seed == 42


@pytest.mark.parametrize("four", [np.array(4), np.int64(4), np.uint8(4)])
def test_an_action_of_any_integer_type_means_what_the_int_means(four: object) -> None:
    assert flown(ForestEnv(blind=True), [four])[1:] == flown(ForestEnv(blind=True), [4])[1:]


def test_a_returned_observation_is_the_callers_own() -> None:
    spoilt, whole = ForestEnv(), ForestEnv()
    fleet = Fleet(WORLD, 1)
    fleet.reset([0], [0])
    for env, write in ((spoilt, True), (whole, False)):
        seen = [env.reset(seed=0)[0]]
        for a in (4, 5, 6):
            if write:
                seen[-1][:] = 7
            seen.append(env.step(a)[0])
    for a in (4, 5, 6):
        fleet.observations[:] = 7
        s2, *_ = fleet.step([a])
        last = s2.copy()
        s2[:] = 7
    assert (seen[-1] == whole.observation).all()
    assert (spoilt.observation == whole.observation).all()
    assert (last[0] == whole.observation).all()


def test_after_a_reset_that_fails_no_flight_is_in_the_air() -> None:
    env = ForestEnv(blind=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="seed is -1"):
        env.reset(seed=-1)
    with pytest.raises(ValueError, match="reset"):
        env.step(4)


@pytest.mark.parametrize("action", [-1, 9, 0.5, 4.0, None, "4", [4], math.nan, True, np.True_])
def test_an_impossible_action_is_named(action: object) -> None:
    env = ForestEnv(blind=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="allowed are whole numbers from 0 to 8"):
        env.step(action)


@pytest.mark.parametrize("seed", [-1, 0.5, "7", [1], True, 10**30 + 0.5])
def test_an_impossible_seed_is_named(seed: object) -> None:
    with pytest.raises(ValueError, match="allowed are whole numbers from 0"):
        ForestEnv(blind=True).reset(seed=seed)


def test_seeds_of_any_size_plant_a_forest() -> None:
    assert len(plant(10**30, WORLD)) == 150


def test_a_world_takes_numpys_numbers() -> None:
    assert World(rows=np.int64(10), speed=np.float32(4)) == World(rows=10, speed=4)


def test_a_flight_that_is_over_or_not_begun_cannot_go_on() -> None:
    env = ForestEnv(blind=True)
    with pytest.raises(ValueError, match="reset"):
        env.step(4)
    straight_to_the_end(env, 0)
    with pytest.raises(ValueError, match="reset"):
        env.step(4)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"speed": 13.0}, "speed"),  # 1.3 m a step, over a trunk's middle
        ({"dt": 0.3}, "dt"),
        ({"speed": 0.0}, "speed"),
        ({"speed": math.nan}, "speed"),
        ({"dt": math.inf}, "dt"),
        ({"trunk_radius": -0.5}, "trunk_radius"),
        ({"trunk_radius": 0.0}, "trunk_radius"),
        ({"first_x": 0.5, "first_y": -20.0}, "start"),  # a trunk at (0.5, 0)
        ({"first_x": 1.8, "first_y": -20.0, "jitter_x": 0.6}, "start"),  # or one that may be
        ({"width": 1.5}, "width"),  # no wider than the drone keeps away from bark
        ({"length": -90.0}, "length"),
        ({"rows": 1.5}, "rows"),
        ({"columns": -1}, "columns"),
        ({"actions": 1}, "actions"),
        ({"actions": 11}, "actions"),
        ({"jitter_y": -1.0}, "jitter_y"),
        ({"d_neg": 0.5}, "d_neg"),
        ({"laser_range": 0.5}, "laser_range"),
        ({"actions": 9.0}, "actions"),
        ({"speed": "fast"}, "speed"),
        ({"sky": 256}, "sky"),
        ({"max_steps": 0}, "max_steps"),
        ({"rows": True}, "rows"),
        ({"beacon": 1}, "beacon"),
        ({"yaw_rate": 0.0}, "yaw_rate"),
    ],
)
def test_an_impossible_world_is_refused_by_the_name_of_what_is_wrong(
    settings: dict, named: str
) -> None:
    with pytest.raises(ValueError, match=named):
        World(**settings)


# -------------------------------------------------- a fleet


def test_a_fleet_flies_as_its_drones_would_alone() -> None:
    world = replace(WORLD, beacon=True, max_steps=30)  # some crash, some run out of time
    fleet, rng, ends = Fleet(world, 5), np.random.default_rng(0), []
    alone = [ForestEnv(world) for _ in range(5)]
    for step in range(300):
        if step % 7 == 0:  # those that landed have waited
            seeds = rng.integers(10**9, size=len(fleet.landed))
            for lane, seed in zip(fleet.landed, seeds, strict=True):
                alone[lane].reset(seed=int(seed))
            fleet.reset(fleet.landed, seeds)
        flying = [env for env in alone if not env.outcome]
        waiting = [(lane, env.flight()) for lane, env in enumerate(fleet.envs) if env.outcome]
        assert fleet.landed == [lane for lane, _ in waiting]
        assert [env.seed for env in fleet.flying] == [env.seed for env in flying]
        assert (fleet.observations == np.stack([env.observation for env in flying])).all()
        actions = rng.integers(2, 7, size=len(flying))
        results = list(zip(*fleet.step(actions), strict=True))
        for env, a, (s2, r, terminated, truncated, info) in zip(
            flying, actions, results, strict=True
        ):
            lone_s2, *lone = env.step(a)
            assert (s2 == lone_s2).all()
            assert [r, terminated, truncated, info] == lone
            ends += [env.outcome] if env.outcome else []
        assert waiting == [(lane, fleet.envs[lane].flight()) for lane, _ in waiting]
    assert ends.count("crash") > 9
    assert ends.count("time") > 9


def test_the_record_holds_the_flights_of_the_last_steps_and_they_fly_again() -> None:
    fleet, rng, last = Fleet(WORLD, 3), np.random.default_rng(0), 60
    steps = [[] for _ in range(3)]  # of each lane: number of the flight, frame
    flights = [[] for _ in range(3)]  # of each lane: seed, digits
    for _ in range(250):
        landed = fleet.landed
        for lane, seed in zip(landed, seeds := rng.integers(10**9, size=len(landed)), strict=True):
            flights[lane].append((seed, ""))
        fleet.reset(landed, seeds)
        actions = rng.integers(2, 7, size=3)
        s2, *_ = fleet.step(actions)
        for lane, (a, frame) in enumerate(zip(actions, s2[:, -1], strict=True)):
            seed, digits = flights[lane][-1]
            flights[lane][-1] = (seed, f"{digits}{a}")
            steps[lane].append((len(flights[lane]) - 1, frame))
        oldest = [lane[-last:][0][0] for lane in steps]
        assert fleet.record(last) == [f[i:] for f, i in zip(flights, oldest, strict=True)]
    assert all(len(lane) > 5 for lane in flights)
    for lane, record in enumerate(fleet.record(last)):
        frames = [o[-1] for seed, digits in record for o, *_ in [*refly(seed, digits, WORLD)][1:]]
        assert len(frames) >= last
        assert (np.array(frames[-last:]) == [frame for _, frame in steps[lane][-last:]]).all()


def test_a_fleet_needs_an_action_for_each_drone_in_the_air() -> None:
    fleet = Fleet(WORLD, 2, blind=True)
    fleet.reset([0, 1], [0, 1])
    for actions in ([4], [4, 4, 4], [4, 9]):
        with pytest.raises(ValueError, match=r"zip|allowed are whole numbers from 0 to 8"):
            fleet.step(actions)


# -------------------------------------------------- pilots


GAMMA = 0.99


def best(env: ForestEnv) -> int:
    """What the planner takes where this drone is."""
    return int(plan(*env.scan(), env.pose, env.world, GAMMA, 0.0, 125.0, 0.0).argmax())


def read_forwards(
    scan: Sequence,
    pose: Sequence,
    w: World,
    gamma: float,
    forward: float,
    goal: float,
    far_end: float,
) -> list[float]:
    """What `plan` should say, one way and one step after another."""
    bark = [(d * math.cos(b), d * math.sin(b)) for b, d in zip(*scan, strict=True)]
    bark = [point for point, d in zip(bark, scan[1], strict=True) if d < w.laser_range]
    rates = [w.yaw_rate * (2 * a / (w.actions - 1) - 1) for a in range(w.actions)]
    steps = [max(round(seconds / w.dt), 1) for seconds in (0.6, 1.6)]
    worths = [[] for _ in rates]
    for first, then in product(range(w.actions), repeat=2):
        (x, y, heading), ahead, left, turned, worth = pose, 0.0, 0.0, 0.0, 0.0
        for k, rate in enumerate([rates[first]] * steps[0] + [rates[then]] * steps[1]):
            turned += rate * w.dt
            ahead += w.speed * w.dt * math.cos(turned)
            left += w.speed * w.dt * math.sin(turned)
            px = x + ahead * math.cos(heading) - left * math.sin(heading)
            py = y + ahead * math.sin(heading) + left * math.cos(heading)
            d_obs = min([math.dist((ahead, left), point) for point in bark] + [w.laser_range])
            d_goal, crash = math.dist((px, py), (w.length, 0)), d_obs < w.d_crash + 0.1
            arrived = not crash and d_goal < w.goal_radius
            far = not crash and not arrived and px > w.length
            out = not arrived and (px < -w.back or abs(py) > w.width / 2)
            lost = crash or far or out
            worth += gamma**k * reward("crash" if lost else "", d_obs, d_goal, w)
            worth += gamma**k * forward * w.speed * w.dt * math.cos(heading + turned)
            if lost or arrived:
                break
        ends = []
        for bearing, metres, value in (
            (math.atan2(-py, w.length - px), d_goal, goal),
            (0.0, w.length - px, far_end),
        ):
            turn = abs(math.remainder(bearing - heading - turned, math.tau))
            ends.append(value * gamma ** ((turn / w.yaw_rate + metres / w.speed) / w.dt))
        more = goal if arrived else far_end if far else 0 if lost else max(ends)
        worths[first].append(worth + gamma ** (k + 1) * more)
    return [max(some) for some in worths]


@pytest.mark.parametrize("seed", range(40))
def test_the_planner_adds_up_the_rewards_to_come_in_any_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = World(
        length=rng.uniform(8, 60), width=rng.uniform(8, 40), back=rng.uniform(0, 3),
        speed=rng.uniform(2, 7), dt=rng.uniform(0.05, 0.15), yaw_rate=rng.uniform(0.3, 1.5),
        actions=int(rng.integers(2, 6)), laser_range=rng.uniform(3, 15), d_crash=0.6, d_neg=2.5,
        r_safe=rng.uniform(0, 1), r_precrash=-rng.uniform(1, 9), r_crash=-rng.uniform(5, 50),
        goal_radius=rng.uniform(0.5, 4), beams=60, rows=3, columns=3, first_y=-6.0,
    )  # fmt: skip
    env, gamma = ForestEnv(world, blind=True), rng.uniform(0.8, 0.999)
    env.reset(seed=seed)
    for _ in range(5):
        x, y = rng.random(2) * (world.length, world.width) - (0, world.width / 2)
        env.pose = (x, y, rng.uniform(-4, 4))
        told = env.pose, world, gamma, *rng.uniform(0, 3, 1), *rng.uniform(0, 200, 2)
        assert plan(*env.scan(), *told) == pytest.approx(read_forwards(env.scan(), *told))


def test_in_the_open_the_planner_turns_to_the_goal() -> None:
    env = ForestEnv(CLEARING, blind=True)
    for heading, action in ((0.0, 4), (-2.0, 8), (2.0, 0)):
        env.reset(seed=0)
        env.pose = (45.0, 0.0, heading)
        assert best(env) == action


def test_the_planner_turns_away_from_a_trunk_ahead() -> None:
    env = ForestEnv(CLEARING, blind=True)
    env.reset(seed=0)
    for left in (0.3, -0.3):
        env.trunks = np.array([[6.0, left]])
        assert (best(env) - 4) * left < 0


def test_the_planner_sees_2_2_s_ahead_at_any_control_rate() -> None:
    for rate in (10, 30, 50):
        at, headings = ways(World(dt=1 / rate))
        assert at.shape == headings.shape == (81, round(2.2 * rate))
        assert headings[0, -1] == pytest.approx(-0.7 * 2.2)
        assert at[40, -1] == pytest.approx(11.0)


def test_the_laser_pilot_arrives_and_never_crashes() -> None:
    flights = fly(laser_pilot(GAMMA), range(2 * 10**9, 2 * 10**9 + 20), WORLD, blind=True)
    assert not any(f["outcome"] == "crash" for f in flights)
    assert sum(f["outcome"] == "goal" for f in flights) >= 18
    assert sum(f["return"] for f in flights) / 20 > 70


def test_the_random_pilot_draws_its_actions_uniformly() -> None:
    flights = fly_random([5, 6], WORLD, np.random.default_rng(0))
    assert len(flights) == 2000
    assert [f["seed"] for f in flights[:4]] == [5, 6, 5, 6]
    actions = "".join(f["actions"] for f in flights)
    shares = np.array([actions.count(str(a)) for a in range(9)]) / len(actions)
    assert shares == pytest.approx(1 / 9, abs=0.006)  # four standard errors of 40,000 draws


def test_the_straight_pilot_flies_along_the_middle_line() -> None:
    (flight,) = fly(straight_pilot, [0], CLEARING, blind=True)
    assert (flight["outcome"], flight["steps"]) == ("goal", 175)  # within 3 m of x = 90 m
    assert flight["actions"] == "4" * 175


def test_where_no_yaw_rate_is_straight_the_straight_pilot_takes_both_middle_ones_in_turn() -> None:
    (flight,) = fly(straight_pilot, [0], replace(CLEARING, actions=4), blind=True)
    assert (flight["outcome"], flight["actions"][:6]) == ("goal", "121212")


def test_flights_come_in_the_order_of_their_seeds_and_as_each_flies_alone() -> None:
    seeds = [*range(130, 0, -1), 7, 7]  # more than fly at once, and one forest thrice
    env, flights = ForestEnv(blind=True), fly(straight_pilot, seeds, WORLD, blind=True)
    assert [f["seed"] for f in flights] == seeds
    for seed, flight in zip(seeds, flights, strict=True):
        straight_to_the_end(env, seed)
        assert flight == env.flight()


def test_a_pilot_that_looks_flies_by_what_its_camera_sees() -> None:
    seen = []

    def pilot(fleet: Fleet) -> Sequence[int]:
        seen.append(fleet.observations)
        return random_pilot(np.random.default_rng(len(seen)))(fleet)

    (flight,) = fly(pilot, [3], WORLD)
    frames = [o for o, *_ in refly(3, flight["actions"], WORLD)]
    assert (np.concatenate(seen) == frames[:-1]).all()


def test_one_measure_a_flight_by_hand() -> None:
    flight = {"seed": 0, "actions": "444", "steps": 3, "progress": 1.5, "return": 2.0, "edge": ""}
    ended = [("goal", ""), ("left", "far"), ("left", "side"), ("crash", ""), ("time", "")]
    table = measure(
        [flight | {"outcome": o, "edge": e, "steps": i} for i, (o, e) in enumerate(ended)]
    )
    assert table["steps"].tolist() == [0, 1, 2, 3, 4]
    assert (table["progress"] == 1.5).all()
    assert (table["return"] == 2.0).all()
    assert table["crossed"].tolist() == [1, 1, 0, 0, 0]
    shares = {o: table[o].mean() for o in ("goal", "left", "crash", "time")}
    assert shares == {"goal": 0.2, "left": 0.4, "crash": 0.2, "time": 0.2}


# -------------------------------------------------- whatever the world, whatever the actions

# A training in this process takes subnormal numbers for nought: draw none.
floats = partial(st.floats, allow_subnormal=False)
WORLDS = st.builds(
    dict,
    length=floats(5, 120),
    width=floats(2, 60),
    rows=st.integers(0, 12),
    columns=st.integers(0, 8),
    first_x=floats(-5, 20),
    first_y=floats(-30, 5),
    spacing_x=floats(0.5, 10),
    spacing_y=floats(0.5, 10),
    jitter_x=floats(0, 3),
    jitter_y=floats(0, 3),
    trunk_radius=floats(0.05, 2),
    trunk_height=floats(0.1, 10),
    altitude=floats(0.1, 8),
    view=floats(1, 60),
    speed=floats(0.1, 10),
    yaw_rate=floats(0.01, 3),
    goal_radius=floats(0.1, 5),
    back=floats(0, 5),
    dt=floats(0.02, 0.5),
    d_crash=floats(0.1, 2),
    d_neg=floats(0.5, 4),
    laser_range=floats(1, 30),
    r_safe=floats(-1, 1),
    r_precrash=floats(-10, 0),
    r_crash=floats(-20, 0),
    max_steps=st.integers(1, 40),
    beacon=st.booleans(),
    camera=st.sampled_from(CAMERAS),
    near=floats(0.1, 10),
)


@given(WORLDS, st.integers(0, 2**70), st.lists(st.integers(0, 8), min_size=40, max_size=40))
def test_in_every_legal_world_a_flight_keeps_the_rules(
    settings: dict, seed: int, actions: list[int]
) -> None:
    try:
        env = ForestEnv(World(**settings))
    except ValueError:
        reject()
    keeps_the_rules(env, env.reset(seed=seed)[0], 0.0)
    for action in actions:
        if not env.outcome:
            observation, r, terminated, truncated, _ = env.step(action)
            assert truncated == (env.outcome == "time")
            assert terminated == (env.outcome in ("crash", "goal", "left"))
            keeps_the_rules(env, observation, r)


def keeps_the_rules(env: ForestEnv, observation: np.ndarray, r: float) -> None:
    """What the drone sees, earns and comes to agrees with where it is."""
    world, (x, y) = env.world, env.drone.position
    assert observation.shape == (4, 84, 84)
    assert observation.dtype == np.uint8
    assert all(map(math.isfinite, (r, x, y, env.drone.angle, env.d_obs, env.d_goal)))
    to_bark = [math.dist((x, y), trunk) - world.trunk_radius for trunk in env.trunks.tolist()]
    assert env.d_obs == pytest.approx(min([*to_bark, world.laser_range]), abs=1e-6)
    assert env.d_goal == pytest.approx(math.dist((x, y), (world.length, 0)))
    outside = x > world.length or x < -world.back or abs(y) > world.width / 2
    crash, arrived = env.d_obs < world.d_crash, env.d_goal < world.goal_radius
    late = len(env.actions) >= world.max_steps
    expected = "crash" if crash else "goal" if arrived else "left" if outside else late and "time"
    if env.actions:
        assert env.outcome == (expected or "")
        assert (env.edge != "") == (env.outcome == "left")
        r_goal = 1 - env.d_goal / world.length
        low, high = min(world.r_safe, world.r_precrash), max(world.r_safe, 0)
        live = low - 1e-9 <= r - r_goal <= high + 1e-9
        assert r == world.r_crash if env.outcome in ("crash", "left") else live
