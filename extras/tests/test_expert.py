"""The planner against a loop of single steps, the loss by hand, interrupted trainings."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

import deepflight
import dqn
from deepflight import Config, Run
from env import Drone, VecForest, World, fly, reward
from extras.lessons import expert, run
from extras.lessons.expert import ExpertBatch, ExpertConfig, ExpertReplay, plan, scan

WORLD = World()
CLEARING = replace(WORLD, grid=(0, 0))  # no trunks
ARRIVAL = Config(forward_reward=0.0, goal_bonus=125.0, far_bonus=0.0)
# A training small enough to be done often: its replay wraps at step 160.
SMALL = dict(learning_starts=80, replay_size=160, update_every=16, batch_size=8, target_every=64)


def placed(world: World, *pose: float, seed: int = 0) -> Drone:
    """A drone at this pose."""
    drone = Drone(world)
    drone.reset(seed)
    drone.pose = pose
    return drone


# -------------------------------------------------- the laser and the planner


def test_the_nearest_beam_agrees_with_d_obs() -> None:
    drone, rng = Drone(WORLD), np.random.default_rng(0)
    for seed in range(10):
        drone.reset(seed)
        while not drone.outcome:
            assert scan(drone)[1].min() == pytest.approx(drone.d_obs, abs=0.05)
            drone.step(int(rng.integers(9)))


def test_the_scan_starts_straight_ahead_and_goes_counter_clockwise() -> None:
    drone = placed(WORLD, 0.0, 0.0, 0.0)
    drone.trunks = np.array([[0.0, 5.0]])
    bearings, distance = scan(drone)
    assert bearings[distance.argmin()] == pytest.approx(math.pi / 2)
    assert distance.min() == pytest.approx(4.5)
    assert distance[0] == 20.0


def one_after_another(scanned: Sequence, pose: Sequence, w: World, c: Config) -> list[float]:
    """What `plan` should say."""
    surface = [(d * math.cos(b), d * math.sin(b)) for b, d in zip(*scanned, strict=True)]
    surface = [p for p, d in zip(surface, scanned[1], strict=True) if d < w.laser_range]
    rates = [w.yaw_rate * (2 * a / (w.num_actions - 1) - 1) for a in range(w.num_actions)]
    steps = [max(round(seconds / w.dt), 1) for seconds in (0.6, 1.6)]
    values = [[] for _ in rates]
    for first, then in product(range(w.num_actions), repeat=2):
        (x, y, heading), ahead, left, turned, value = pose, 0.0, 0.0, 0.0, 0.0
        for k, rate in enumerate([rates[first]] * steps[0] + [rates[then]] * steps[1]):
            turned += rate * w.dt
            ahead += w.speed * w.dt * math.cos(turned)
            left += w.speed * w.dt * math.sin(turned)
            px = x + ahead * math.cos(heading) - left * math.sin(heading)
            py = y + ahead * math.sin(heading) + left * math.cos(heading)
            d_obs = min([math.dist((ahead, left), point) for point in surface] + [w.laser_range])
            d_goal, crash = math.dist((px, py), (w.length, 0)), d_obs < w.d_crash + 0.1
            goal = not crash and d_goal < w.goal_radius
            far = not crash and not goal and px > w.length
            out = not goal and (px < -w.back or abs(py) > w.width / 2)
            lost = crash or far or out
            value += c.gamma**k * reward("crash" if lost else "", d_obs, d_goal, w)
            value += c.gamma**k * c.forward_reward * w.speed * w.dt * math.cos(heading + turned)
            if lost or goal:
                break
        ends = []
        for bearing, metres, bonus in (
            (math.atan2(-py, w.length - px), d_goal, c.goal_bonus),
            (0.0, w.length - px, c.far_bonus),
        ):
            turn = abs(math.remainder(bearing - heading - turned, math.tau))
            ends.append(bonus * c.gamma ** ((turn / w.yaw_rate + metres / w.speed) / w.dt))
        more = c.goal_bonus if goal else c.far_bonus if far else 0 if lost else max(ends)
        values[first].append(value + c.gamma ** (k + 1) * more)
    return [max(some) for some in values]


@pytest.mark.parametrize("seed", range(15))
def test_the_planner_adds_up_the_rewards_to_come_in_any_world(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(expert, "BEAMS", 60)
    rng = np.random.default_rng(seed)
    world = World(
        length=rng.uniform(8, 60), width=rng.uniform(8, 40), back=rng.uniform(0, 3),
        speed=rng.uniform(2, 7), dt=rng.uniform(0.05, 0.15), yaw_rate=rng.uniform(0.3, 1.5),
        num_actions=int(rng.integers(2, 6)), laser_range=rng.uniform(3, 15), d_crash=0.6, d_neg=2.5,
        r_safe=rng.uniform(0, 1), r_precrash=-rng.uniform(1, 9), r_crash=-rng.uniform(5, 50),
        goal_radius=rng.uniform(0.5, 4), grid=(3, 3), first=(7.5, -6.0),
    )  # fmt: skip
    for _ in range(5):
        x, y = rng.random(2) * (world.length, world.width) - (0, world.width / 2)
        drone, (goal, far) = placed(world, x, y, rng.uniform(-4, 4)), rng.uniform(0, 200, 2)
        c = Config(gamma=rng.uniform(0.8, 0.999), forward_reward=rng.uniform(0, 3),
                   goal_bonus=goal, far_bonus=far)  # fmt: skip
        where = scan(drone), drone.pose, world, c
        assert plan(*scan(drone), *where[1:]) == pytest.approx(one_after_another(*where))


def test_the_header_s_number_and_the_turn_to_the_goal() -> None:
    drone = placed(CLEARING, 0.0, 0.0, 0.0)
    assert plan(*scan(drone), drone.pose, CLEARING, ARRIVAL).max() == pytest.approx(26.7, abs=0.05)
    for heading, action in ((0.0, 4), (-2.0, 8), (2.0, 0)):
        drone = placed(CLEARING, 45.0, 0.0, heading)
        assert plan(*scan(drone), drone.pose, CLEARING, ARRIVAL).argmax() == action


def test_the_planner_turns_away_from_a_trunk_ahead() -> None:
    drone = placed(WORLD, 0.0, 0.0, 0.0)
    for left in (0.3, -0.3):
        drone.trunks = np.array([[6.0, left]])
        assert (plan(*scan(drone), drone.pose, WORLD, ARRIVAL).argmax() - 4) * left < 0


def test_the_candidates_reach_2_2_s_ahead_at_any_control_rate() -> None:
    for rate in (10, 30, 50):
        at, headings = expert.trajectories(World(dt=1 / rate))
        assert at.shape == headings.shape == (81, round(2.2 * rate))
        assert headings[0, -1] == pytest.approx(-0.7 * 2.2)
        assert at[40, -1] == pytest.approx(11.0)


def test_the_laser_pilot_arrives_and_never_crashes() -> None:
    first = deepflight.TEST_FIRST
    episodes = fly(expert.laser_pilot(0.99), range(first, first + 20), WORLD)
    assert not any(e["outcome"] == "crash" for e in episodes)
    assert sum(e["outcome"] == "goal" for e in episodes) >= 18
    assert sum(e["return"] for e in episodes) / 20 > 70


# -------------------------------------------------- settings


def test_the_recipe_differs_from_dqn_s_in_what_its_comment_says() -> None:
    own, base = asdict(ExpertConfig()), asdict(Config())
    assert {key: own[key] for key in own if own[key] != base.get(key)} == dict(
        learning_starts=500, epsilon_final=0.0, epsilon_decay=15_000, lr_final=0.0,
        forward_reward=1.0, far_bonus=115.0, bellman=False,
    )  # fmt: skip
    assert (ExpertConfig.pilot, ExpertConfig.validate_every) == ("imitation", 20_000)


# -------------------------------------------------- the loss and batches


def test_imitation_moves_advantages_to_those_of_the_scores_and_not_the_level() -> None:
    scores = torch.tensor([[3.0, 1.0, -500.0], [70.0, 70.0, 70.0]])
    q = torch.tensor([[10.0, 20.0, 60.0], [5.0, -5.0, 0.0]], requires_grad=True)
    optimizer, level = torch.optim.SGD([q], 0.5), q.mean(1).tolist()
    for _ in range(300):
        optimizer.zero_grad()
        expert.imitation_loss(q, scores, 10.0).backward()
        optimizer.step()
    assert q.mean(1).tolist() == pytest.approx(level, abs=1e-4)
    assert (q[0] - q[0, 0]).tolist() == pytest.approx([0, -2, -20], abs=1e-3)  # 20 at most
    assert (q[1] - q[1, 0]).tolist() == pytest.approx([0, 0, 0], abs=1e-3)


def filled(envs: VecForest) -> ExpertReplay:
    """30 rows, whose frames, actions and scores tell the row; 2 environments."""
    replay, none = ExpertReplay(80, envs), np.zeros(2, bool)
    for t in range(30):
        envs.scores = np.arange(18).reshape(2, 9) + 100 * t
        s = np.full((2, 4, 84, 84), t, np.uint8)
        s[..., 0] = 255  # the left column, which a reflection moves
        replay.add(s, np.full(2, t % 9), np.full(2, 40.0), s, none, none)
    return replay


def test_scores_come_back_with_their_observation_and_turn_round_with_it() -> None:
    rng = np.random.default_rng(0)
    b = filled(VecForest(WORLD, 2, [])).sample(200, 1, 0.9, rng)
    t = b.s[:, 3, 0, 40].long()  # (B,)
    assert (b.scores[:, 0] // 100 == t).all()
    assert {*(b.scores[:, 0] % 100).tolist()} == {0, 9}, "of both environments"
    twin = ExpertBatch(*(x.clone() for x in b))
    expert.mirror(twin, 9, rng)
    flipped = twin.s[:, 3, 0, 83] == 255  # (B,)
    assert 60 < flipped.sum() < 140
    for i in range(200):
        scores, a = (b.scores[i].flip(0), 8 - b.a[i]) if flipped[i] else (b.scores[i], b.a[i])
        assert torch.equal(twin.scores[i], scores)
        assert twin.a[i] == a


def td_loss_by_hand(agent: dqn.Agent, b: dqn.Batch) -> float:
    """The loss of dqn.learn where all errors are beyond huber_delta."""
    with torch.no_grad():
        q, q2, online = agent.q(b.s), agent.q_target(b.s2), agent.q(b.s2)
    errors = dqn.td_target(b, q2, online) - q.gather(1, b.a[:, None])[:, 0]  # (B,)
    assert (errors > 10).all(), "beyond huber_delta the loss is 10 * abs(error) - 50"
    return (10 * errors - 50).mean().item()


@pytest.mark.parametrize("bellman", [False, True])
def test_the_loss_is_that_of_imitation_and_with_bellman_of_td_targets_too(
    bellman: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dqn.DQNConfig, "bfloat16", False)
    rng = np.random.default_rng(0)
    b = filled(VecForest(WORLD, 2, [])).sample(32, 2, 0.9, rng)
    agent = dqn.Agent(c := ExpertConfig(bellman=bellman), 9, rng)
    with torch.no_grad():
        expected = expert.imitation_loss(agent.q(b.s), b.scores, 10.0).item()
    expected += bellman * td_loss_by_hand(agent, b)
    expert.learn(agent, b, c)
    assert agent.loss == pytest.approx(expected, rel=1e-4)


# -------------------------------------------------- trainings


@pytest.fixture(autouse=True)
def little_to_fly(monkeypatch: pytest.MonkeyPatch) -> None:
    """A validation is two episodes."""
    monkeypatch.setattr(deepflight, "VALIDATION", range(10**9, 10**9 + 2))


def finish(c: Config, folder: Path, cuts: Sequence[int] = ()) -> Run:
    """A whole training, saved and resumed after each of these steps."""
    folder.mkdir()
    run = Run(c, folder)
    for cut in cuts:
        while run.envs.steps < cut:
            next(run.loop)
        run.save_checkpoint()
        keys = "config log validations actions seconds forests rng agent optimizer"
        run = Run(c, folder, deepflight.load(folder / "checkpoint.pt", *keys.split()))
    assert run.go() == 0
    return run


def assert_same_training(one: Run, other: Run) -> None:
    """Equal weights, optimizers, replays, random numbers and files."""
    for a, b in ((one.agent, other.agent), (one.agent.optimizer, other.agent.optimizer)):
        assert list(flat(a.state_dict())) == list(flat(b.state_dict()))
    for name in ("frames", "actions", "rewards", "ends", "scores"):
        if hasattr(one.replay, name):
            assert np.array_equal(getattr(one.replay, name), getattr(other.replay, name)), name
    assert one.rng.bit_generator.state == other.rng.bit_generator.state
    best = ((run.folder / "best.pt").read_bytes() for run in (one, other))
    assert len({*best}) == 1


def flat(x: object) -> object:
    """The numbers in nested dictionaries and lists, a tensor as its bytes."""
    for value in x.values() if isinstance(x, dict) else x:
        if isinstance(value, torch.Tensor):
            yield value.numpy().tobytes()
        elif isinstance(value, dict | list):
            yield from flat(value)
        else:
            yield value


def test_an_imitation_of_disparity_interrupted_is_uninterrupted(tmp_path: Path) -> None:
    c = ExpertConfig(**SMALL, steps=240, camera="disparity", bellman=True)
    whole = finish(c, tmp_path / "whole")
    cut = finish(c, tmp_path / "cut", cuts=(8, 168, 208))
    assert_same_training(whole, cut)
    assert whole.replay.scores.any(2).all()
    assert (whole.replay.frames[:, :, 0] == 0).mean() > 0.5, "the sky has no disparity"


def test_where_q_would_explore_the_expert_flies(tmp_path: Path) -> None:
    c = ExpertConfig(**SMALL, steps=160, epsilon_final=1.0)
    run = finish(c, tmp_path / "run")
    for drone in run.envs.drones[:2]:
        assert len(drone.actions) == 160 // 8
        alone = VecForest(WORLD, 1, [drone.seed])
        alone.reset_done()
        for a in drone.actions:
            assert expert.expert_scores(alone, c)[0].argmax() == a
            alone.step([a])


def test_eval_prints_the_laser_pilot_beside_the_shipped_network(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = Path(deepflight.__file__).parent / "weights/imitation.pt"
    words = ["eval", "--weights", str(shipped), "--episodes", "2", "--out", str(tmp_path)]
    monkeypatch.setattr(deepflight, "save_film", lambda *film: None)
    assert run(ExpertConfig, words) == 0
    head = capsys.readouterr().out.splitlines()[2].split()
    assert head == ["random", "straight", "laser", "imitation"]
