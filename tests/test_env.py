"""The world: rewards at every knee, geometry, outcomes, many drones at once, episodes reflown."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from pytest import approx

from env import Drone, VecForest, World, fly, plant, refly, reward, straight_pilot

WORLD = World()
CLEARING = replace(WORLD, grid=(0, 0))  # no trunks
OUT = ("crash", "far", "back", "side")


def flown(world: World, actions: Sequence[int], seed: int = 0) -> Drone:
    """A drone that has flown these actions, or as many of them as its episode lasts."""
    drone, left = Drone(world), iter(actions)
    drone.reset(seed)
    while not drone.outcome and (action := next(left, None)) is not None:
        drone.step(action)
    return drone


def begun(world: World, seeds: Sequence[int]) -> VecForest:
    envs = VecForest(world, len(seeds), seeds)
    envs.reset_done()
    return envs


def test_the_reward_at_every_knee_of_the_papers_formula() -> None:
    for d_obs, d_goal, expected in (
        (20.0, 90.0, 0.25),  # far from trunks, no way made
        (2.0001, 90.0, 0.25),  # just safe
        (2.0, 90.0, 0.0),  # r_near begins
        (1.375, 90.0, -2.5),  # halfway
        (0.75, 90.0, -5.0),  # r_precrash
        (20.0, 45.0, 0.75),  # half the way made
        (20.0, 0.0, 1.25),  # at the goal
        (20.0, 99.0, 0.15),  # behind the start
        (1.5, 60.0, -2 + 1 / 3),  # the file's own example
    ):
        assert [reward(o, d_obs, d_goal, WORLD) for o in ("", "goal", "time")] == approx(
            [expected] * 3
        )
        assert {reward(o, d_obs, d_goal, WORLD) for o in OUT} == {-10.0}


def test_a_forest_is_150_trunks_within_the_jitter_of_the_grid() -> None:
    grid = np.array([(7.5 + 6 * i, -22 + 5 * j) for i in range(15) for j in range(10)])
    offsets = np.array([plant(seed, WORLD) - grid for seed in range(200)])  # (200, 150, 2)
    assert (np.abs(offsets) <= [1.0, 2.5]).all()
    assert offsets.mean((0, 1)) == approx([0, 0], abs=0.03)
    assert offsets.var((0, 1)) == approx([1 / 3, 2.5**2 / 3], rel=0.02)  # it is uniform


def test_a_forest_is_a_function_of_its_seed_alone() -> None:
    assert (plant(3 * 10**9, WORLD) == plant(3 * 10**9, WORLD)).all()
    assert (plant(1, WORLD) != plant(2, WORLD)).all()


def test_each_action_flies_the_arc_of_its_yaw_rate() -> None:
    for action in range(9):
        turn, n = 0.1 * 0.7 * (action - 4) / 4, 22  # rad a step: 0 is right, 8 is left
        # The sum of 0.5 m in the directions turn, 2 * turn, ... n * turn, as a complex number.
        chord = math.sin(n * turn / 2) / math.sin(turn / 2) if turn else n
        at = 0.5 * chord * np.exp(1j * turn * (n + 1) / 2)
        assert flown(CLEARING, [action] * n).pose == approx((at.real, at.imag, n * turn), abs=1e-9)


def test_d_obs_is_the_distance_to_the_nearest_surface_and_below_0_75_m_a_crash() -> None:
    rng, seen = np.random.default_rng(0), []
    for seed in range(20):
        drone = flown(WORLD, [], seed)
        while not drone.outcome:
            before = drone.pose[0], drone.progress
            drone.step(int(rng.integers(2, 7)))
            assert drone.forward == drone.pose[0] - before[0]
            assert drone.progress == max(drone.pose[0], before[1])
            brute = np.linalg.norm(plant(seed, WORLD) - drone.pose[:2], axis=1).min() - 0.5
            assert drone.d_obs == approx(min(brute, 20.0), abs=1e-9)
            assert drone.d_goal == approx(math.dist(drone.pose[:2], (90, 0)))
            assert (drone.outcome == "crash") == (brute < 0.75)
            seen.append(brute)
    assert min(seen) < 0.75 < 2 < max(seen)


ENDS = {
    "crash": [4] * 175, "goal": [4] * 175, "side": [8] * 22 + [4] * 50,
    "back": [8] * 45 + [4] * 60, "time": [4] * 40 + [8] * 960,
    "far": [8] * 4 + [4] * 30 + [0] * 4 + [4] * 160,
}  # fmt: skip


@pytest.mark.parametrize("outcome", ENDS)
def test_each_outcome_is_reached_and_only_time_truncates(outcome: str) -> None:
    envs, actions = begun(WORLD if outcome == "crash" else CLEARING, [0]), iter(ENDS[outcome])
    while envs.active:
        _, (r,), (terminated,), (truncated,), (drone,) = envs.step([next(actions)])
        assert not (envs.active and (terminated or truncated))
    assert drone.outcome == outcome
    assert (terminated, truncated) == (outcome != "time", outcome == "time")
    assert (r == -10.0) == (outcome in OUT)
    (x, y, _), late = drone.pose, len(drone.actions) >= 1000
    facts = {"crash": drone.d_obs < 0.75, "goal": math.dist((x, y), (90, 0)) < 3, "time": late}
    facts |= {"far": x > 90, "back": x < -2, "side": abs(y) > 25}
    assert [name for name, fact in facts.items() if fact] == [outcome]


def test_an_observation_is_the_last_four_frames_and_at_first_one_frame_four_times() -> None:
    envs = VecForest(WORLD, 1, [0])
    first, (second, *_), (third, *_) = envs.reset_done(), envs.step([4]), envs.step([4])
    assert (first.shape, first.dtype) == ((1, 4, 84, 84), np.uint8)
    assert (first == first[:, :1]).all() and (third[:, 3] != third[:, 2]).any()
    assert (second[:, :3] == first[:, 1:]).all() and (third[:, :3] == second[:, 1:]).all()


@pytest.mark.parametrize("beacon", [False, True])
def test_drones_side_by_side_fly_as_each_would_alone(beacon: bool) -> None:
    world = replace(WORLD, beacon=beacon, max_steps=30)  # some crash, some run out of time
    rng, envs, alone = np.random.default_rng(0), VecForest(world, 5, range(60)), {}
    while len(s := envs.reset_done()):
        drones, actions = envs.active, rng.integers(2, 7, size=len(s))
        for drone, seen in zip(drones, s, strict=True):
            if not drone.actions:
                alone[drone.seed] = begun(world, [drone.seed])
            assert seen.tobytes() == alone[drone.seed].drones[0].observation.tobytes()
        *together, same = envs.step(actions)
        assert same == drones
        for i, (drone, a) in enumerate(zip(drones, actions, strict=True)):
            *lone, (other,) = alone[drone.seed].step([a])
            assert all((x[i] == y[0]).all() for x, y in zip(together, lone, strict=True))
            assert drone.episode() == other.episode()
    outcomes = [episode["outcome"] for episode in envs.episodes]
    assert len(alone) == 60 and min(outcomes.count("crash"), outcomes.count("time")) > 5


def test_where_no_seed_is_left_a_drone_stays_inactive() -> None:
    envs, passes = VecForest(WORLD, 3, iter([5, 6, 7, 8])), []
    while len(s := envs.reset_done()):
        passes.append(len(s))
        envs.step([4] * len(s))
    assert passes == sorted(passes, reverse=True) and {*passes} == {1, 2, 3}
    assert sorted(episode["seed"] for episode in envs.episodes) == [5, 6, 7, 8]
    assert envs.active == [] and [len(actions) for actions in envs.history] == passes
    assert envs.steps == sum(passes) == sum(episode["steps"] for episode in envs.episodes)


def test_an_episode_is_its_seed_and_its_actions() -> None:
    rng, world = np.random.default_rng(3), replace(WORLD, beacon=True)
    for seed in (0, 5, 4 * 10**9, 10**40):
        envs = VecForest(world, 1, [seed])
        steps = [(envs.reset_done()[0], envs.drones[0].pose)]
        while envs.active:
            steps.append((envs.step([int(rng.integers(2, 7))])[0][0], envs.drones[0].pose))
        (episode,) = envs.episodes
        assert episode["steps"] == len(episode["actions"]) == len(steps) - 1
        for (s, pose), drone in zip(steps, refly(episode, world), strict=True):
            assert (s == drone.observation).all() and pose == drone.pose
        assert drone.episode() == episode


def test_fly_returns_one_episode_a_seed_in_their_order() -> None:
    seeds = [*range(130, 0, -1), 7, 7]  # more than fly at once, and one forest three times
    episodes = fly(straight_pilot, seeds, WORLD)
    assert [episode["seed"] for episode in episodes] == sorted(seeds)
    for episode in episodes[:20]:
        assert episode == flown(WORLD, [4] * 200, episode["seed"]).episode()
    (episode,) = fly(straight_pilot, [0], CLEARING)
    assert (episode["outcome"], episode["actions"]) == ("goal", "4" * 175)  # to x = 87.5 m
