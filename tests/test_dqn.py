"""What the brain learns from, against a naive replay, hand arithmetic and a tiny solved MDP."""

import hashlib
import io
import os
import pickle
import resource
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

import deepflight
from deepflight import RunConfig, draw, train
from dqn import (
    LIVE,
    TERMINAL,
    TRUNCATED,
    Agent,
    Batch,
    DQNConfig,
    QNetwork,
    Replay,
    RMSprop,
    check_like,
    check_output,
    greedy,
    linear_schedule,
    load,
    load_weights,
    lock_folder,
    margin_loss,
    mirror,
    save,
    save_weights,
    td_target,
    teacher_loss,
    whole_file,
)
from env import World

PLAIN = RunConfig(threads=1, forward_reward=0.0, goal_value=0.0, far_value=0.0)


# -------------------------------------------------- the replay


def play(rows: int, lanes: int, seed: int) -> list[list[tuple]]:
    """Random episodes: a log per lane of (frame number, action, reward, end)."""
    rng, frame_number = np.random.default_rng(seed), 0
    logs = [[] for _ in range(lanes)]
    for _ in range(rows):
        for log in logs:
            end = rng.choice([LIVE, TERMINAL, TRUNCATED], p=[0.85, 0.1, 0.05])
            frame_number += 1
            log.append((frame_number, int(rng.integers(9)), float(rng.normal()), int(end)))
    return logs


def picture(number: int) -> np.ndarray:
    """A frame (84, 84) that shows its number in its first two pixels."""
    frame = np.zeros((84, 84), np.uint8)
    frame[0, :2] = divmod(number, 256)
    return frame


def number(frames: np.ndarray) -> np.ndarray:
    """The numbers (B, 4) of the frames (B, 4, 84, 84)."""
    return frames[:, :, 0, 0].astype(int) * 256 + frames[:, :, 0, 1]


def fill(logs: list[list[tuple]], capacity: int) -> Replay:
    """A replay that has seen the logs."""
    replay = Replay(capacity, len(logs))
    for row in zip(*logs, strict=True):
        s = np.stack([np.stack([picture(f)] * 4) for f, *_ in row])  # only the newest frame counts
        s2 = np.stack([np.stack([picture(30_000 + f)] * 4) for f, *_ in row])
        a, r, end = (np.array(column) for column in list(zip(*row, strict=True))[1:])
        replay.add(s, a, r, s2, end == TERMINAL, end == TRUNCATED)
    return replay


def one_flight(rewards: Sequence[float], end: int) -> Replay:
    """A flight after three empty rows, and after it three rows of another that pays much."""
    ends = [TERMINAL] * 3 + [LIVE] * (len(rewards) - 1) + [end] + [LIVE] * 3
    paid = [0.0] * 3 + [*rewards] + [1000.0] * 3
    return fill([[(t + 1, 0, r, e) for t, (r, e) in enumerate(zip(paid, ends, strict=True))]], 20)


def window(replay: Replay, row: int, n: int, gamma: float) -> Batch:
    """One transition of the first lane."""
    return replay.window(np.array([row]), np.array([0]), n, gamma)


def naive(log: list[tuple], t: int, n: int, gamma: float) -> tuple:
    """The n-step transition of one lane from its whole history, written out step by step."""
    start = max([i + 1 for i in range(t) if log[i][3] != LIVE], default=0)
    s = [log[max(i, start)][0] for i in range(t - 3, t + 1)]
    r, k = 0.0, 0
    while True:
        r += gamma**k * log[t + k][2]
        end = log[t + k][3]
        k += 1
        if end != LIVE or k == n:
            break
    if end == TRUNCATED:
        last = [log[max(i, start)][0] for i in range(t + k - 3, t + k)]
        s2 = [*last, 30_000 + log[t + k - 1][0]]
    else:
        s2 = [log[max(i, start)][0] for i in range(t + k - 3, t + k + 1)] if end == LIVE else None
    return s, log[t][1], r, s2, gamma**k, end


@pytest.mark.parametrize("n", [1, 3, 5])
@pytest.mark.parametrize("rows", [40, 137])  # before and after the write position wraps
def test_stacks_and_windows_are_those_of_the_whole_history(n: int, rows: int) -> None:
    lanes, kept = 3, 60
    logs = play(rows, lanes, seed=n)
    replay = fill(logs, capacity=kept * lanes)
    oldest = max(rows - kept, 0) + 3
    for lane in range(lanes):
        for t in range(oldest, rows - n):
            got = replay.window(np.array([t % kept]), np.array([lane]), n, 0.9)
            s, a, r, s2, gamma, end = naive(logs[lane], t, n, 0.9)
            assert number(got.s)[0].tolist() == s
            assert got.a[0] == a
            assert got.r[0] == pytest.approx(r, abs=1e-5)
            assert got.gamma_n[0] == pytest.approx(gamma)
            assert got.end[0] == end
            assert s2 is None or number(got.s2)[0].tolist() == s2


def test_samples_are_drawn_from_all_complete_windows_and_no_others() -> None:
    rows, kept, n = 137, 60, 5
    replay = fill(play(rows, 1, seed=0), kept)
    batch = replay.sample(2_000, n, 0.9, np.random.default_rng(0))
    drawn = set(number(batch.s)[:, 3])  # frame t carries the number t + 1
    assert drawn == set(range(rows - kept + 3 + 1, rows - n + 1))


def test_the_last_frame_of_a_cut_episode_goes_when_its_row_is_overwritten() -> None:
    logs = play(500, 2, seed=1)
    replay = fill(logs, capacity=50)
    cuts = {
        ((475 + i) % 25, lane)
        for i in range(25)
        for lane in (0, 1)
        if logs[lane][475 + i][3] == TRUNCATED
    }
    assert set(replay.last_frames) == cuts


def test_a_transition_costs_at_most_7200_bytes() -> None:
    replay = Replay(8_000, 8)
    arrays = (replay.frames, replay.actions, replay.rewards, replay.ends)
    assert sum(x.nbytes for x in arrays) / 8_000 <= 7_200
    logs = [[(1, 0, 0.0, TRUNCATED if t % 1000 == 999 else LIVE) for t in range(2000)]]
    frames = fill(logs, capacity=2000).last_frames.values()
    assert len(frames) == 2
    assert all(x.base is None and x.nbytes == 7056 for x in frames)  # no view of a whole stack


# -------------------------------------------------- the target


def target(r: float, discount: float, end: int, choose: list[float], value: list[float]) -> float:
    """td_target of one transition, on plain numbers."""
    r, discount, end, value, choose = (torch.tensor([x]) for x in (r, discount, end, value, choose))
    return td_target(r, discount, end, value, choose).item()


def label(replay: Replay, row: int, n: int, gamma: float, best: float) -> float:
    """The label of the transition at this row, where the best value of every state is `best`."""
    batch, q2 = window(replay, row, n, gamma), torch.tensor([[best - 1, best, best - 2]])
    r, discount, end = map(torch.from_numpy, (batch.r, batch.gamma_n, batch.end))
    return td_target(r, discount, end, q2, q2).item()


def test_the_target_of_the_files_own_example_is_10_4() -> None:
    q = [9.0, 10.0, -3.0]
    assert target(0.5, 0.99, LIVE, q, q) == pytest.approx(10.4)
    assert target(0.5, 0.99, TRUNCATED, q, q) == pytest.approx(10.4)  # out of time, not dead
    assert target(0.5, 0.99, TERMINAL, q, q) == 0.5
    assert target(-10.0, 0.99, TERMINAL, q, q) == -10.0  # crashed


def test_the_return_of_the_files_own_example_is_minus_7_81() -> None:
    replay = one_flight([1.0, 1.0, -10.0], TERMINAL)
    batch = window(replay, 3, 3, 0.99)
    assert batch.r[0] == pytest.approx(-7.81, abs=0.005)
    assert batch.end[0] == TERMINAL
    assert label(replay, 3, 3, 0.99, best=50.0) == pytest.approx(-7.81, abs=0.005)


def test_the_label_of_three_rewards_by_hand() -> None:
    for end, after in ((LIVE, 8.0), (TRUNCATED, 8.0), (TERMINAL, 0.0)):
        replay = one_flight([4.0, 2.0, -6.0], end)
        three = 4 + 0.5 * 2 + 0.25 * -6  # 3.5
        assert window(replay, 3, 3, 0.5).r[0] == three
        assert window(replay, 3, 3, 0.5).gamma_n[0] == 0.125
        assert label(replay, 3, 3, 0.5, best=8.0) == three + 0.125 * after
        assert label(replay, 4, 2, 0.5, best=8.0) == 2 + 0.5 * -6 + 0.25 * after
        assert label(replay, 5, 1, 0.5, best=8.0) == -6 + 0.5 * after
        if end != LIVE:  # nothing of the next flight is in the label
            assert label(replay, 3, 6, 0.5, best=8.0) == three + 0.125 * after


def test_a_value_paid_at_the_end_is_the_bootstrap_of_a_state_of_that_value() -> None:
    gamma, worth = 0.99, 125.0
    for n in (1, 2, 3, 5):
        for length in range(1, n + 1):  # the flight ends within the window
            rewards = np.linspace(-1.0, 1.25, length)
            paid = one_flight([*rewards[:-1], rewards[-1] + gamma * worth], TERMINAL)
            goes_on = one_flight(rewards, LIVE)  # and its next state is worth that much
            expected = label(goes_on, 3, length, gamma, best=worth)
            assert label(paid, 3, n, gamma, best=-77.0) == pytest.approx(expected, rel=1e-6)


def test_double_dqn_values_with_one_network_what_the_other_chose() -> None:
    online, frozen = [0.0, 5.0, 1.0], [9.0, 2.0, 4.0]
    assert target(1.0, 0.5, LIVE, frozen, frozen) == 1 + 0.5 * 9  # plain: the maximum flatters
    assert target(1.0, 0.5, LIVE, online, frozen) == 1 + 0.5 * 2  # double


# -------------------------------------------------- the mirror


def test_mirroring_reflects_whole_transitions_and_half_of_them() -> None:
    rng = np.random.default_rng(0)
    s, s2 = rng.integers(256, size=(2, 64, 4, 84, 84), dtype=np.uint8)
    a, r, discount = np.arange(64) % 9, rng.normal(size=64), rng.random(64)
    end = rng.integers(3, size=64)
    scores, shown = rng.normal(size=(64, 9)), rng.random(64) < 0.5
    copies = s.copy(), a.copy(), r.copy(), s2.copy(), discount, end, scores.copy(), shown
    batch = mirror(Batch(*copies), 9, rng)
    flipped = np.array([(x == y[..., ::-1]).all() for x, y in zip(batch.s, s, strict=True)])
    assert 20 <= flipped.sum() <= 44  # three standard deviations
    turned = flipped[:, None, None, None]
    assert (batch.s == np.where(turned, s[..., ::-1], s)).all()
    assert (batch.s2 == np.where(turned, s2[..., ::-1], s2)).all()
    assert (
        batch.a == np.where(flipped, 8 - a, a)
    ).all()  # the sharpest left for the sharpest right
    assert (batch.r == r).all()
    assert (batch.gamma_n == discount).all()
    assert (batch.end == end).all()
    assert (batch.scores == np.where(flipped[:, None], scores[:, ::-1], scores)).all()
    assert (batch.shown == shown).all()


def test_other_draws_reflect_other_transitions() -> None:
    pictures, zeros, none = np.zeros((64, 4, 84, 84), np.uint8), np.zeros(64), np.zeros((64, 0))
    rng, drawn = np.random.default_rng(0), set()
    for _ in range(5):
        a = np.zeros(64, int)
        batch = Batch(pictures, a, zeros, pictures, zeros, zeros, none, zeros)
        drawn.add(tuple(mirror(batch, 9, rng).a))
    assert len(drawn) == 5


# -------------------------------------------------- what others say


def test_the_margin_loss_is_how_far_the_shown_action_is_from_the_best_by_the_margin() -> None:
    rng = np.random.default_rng(0)
    q, a = rng.normal(0, 5, (500, 9)), rng.integers(9, size=500)
    missed = []
    for values, shown in zip(q, a, strict=True):
        others = max(x for i, x in enumerate(values) if i != shown)
        missed.append(max(others + 3.0 - values[shown], 0))
    loss = margin_loss(torch.from_numpy(q), torch.from_numpy(a), 3.0)
    assert loss.numpy() == pytest.approx(missed)
    assert 0 < np.count_nonzero(missed) < 500


def test_a_teacher_moves_differences_of_values_to_those_of_its_scores_and_not_their_level() -> None:
    scores = torch.tensor([[3.0, 1.0, -500.0], [70.0, 70.0, 70.0]])
    q = torch.tensor([[10.0, 20.0, 60.0], [5.0, -5.0, 0.0]], requires_grad=True)
    optimizer, level = torch.optim.SGD([q], 5.0), q.mean(1).tolist()
    for _ in range(300):
        optimizer.zero_grad()
        teacher_loss(q, scores).backward()
        optimizer.step()
    assert q.mean(1).tolist() == pytest.approx(level, abs=1e-4)
    assert (q[0] - q[0, 0]).tolist() == pytest.approx([0, -2, -20], abs=1e-3)  # 20 at most
    assert (q[1] - q[1, 0]).tolist() == pytest.approx([0, 0, 0], abs=1e-3)


def test_what_the_teacher_said_comes_back_with_its_state() -> None:
    replay, rng = Replay(40, 2, 9), np.random.default_rng(0)
    scores, nothing = rng.normal(size=(30, 2, 9)).astype(np.float32), np.zeros(2, bool)
    for t in range(30):
        s = np.stack([np.stack([picture(1 + t)] * 4)] * 2)
        replay.add(s, np.zeros(2), np.zeros(2), s, nothing, nothing, scores[t])
    batch = replay.sample(200, 5, 0.9, rng)
    told = scores[number(batch.s)[:, 3] - 1]  # (B, 2, 9) of both lanes
    assert (batch.scores[:, None] == told).all(2).any(1).all()
    assert not batch.shown.any()


def test_a_share_of_each_batch_is_demonstrated_and_at_first_all_of_it() -> None:
    own, lesson = Replay(40, 1), Replay(40, 1, shown=True)
    for replay, value in ((own, 1.0), (lesson, 2.0)):
        for _ in range(30):
            state, none = np.zeros((1, 4, 84, 84), np.uint8), np.zeros(1, bool)
            replay.add(state, np.zeros(1), np.full(1, value), state, none, none)
    c, rng = DQNConfig(n_steps=1, demo_share=0.25), np.random.default_rng(0)
    for batch, shown in (
        (draw(own, None, c, rng), 0),
        (draw(own, lesson, c, rng), 8),
        (draw(lesson, None, c, rng), 32),
    ):
        assert len(batch.r) == 32
        assert batch.shown.sum() == (batch.r == 2).sum() == shown
        assert (batch.shown == (batch.r == 2)).all()


# -------------------------------------------------- the network and the agent


def test_the_network_is_natures() -> None:
    layers = [8 * 8 * 4 * 32 + 32, 4 * 4 * 32 * 64 + 64, 3 * 3 * 64 * 64 + 64]
    layers += [7 * 7 * 64 * 512 + 512, 512 * 9 + 9]
    assert sum(p.numel() for p in QNetwork(9).parameters()) == sum(layers) == 1_688_745


def test_equal_seeds_give_equal_networks_and_leave_torchs_own_generator_alone() -> None:
    before = torch.random.get_rng_state()
    one, two, other = (Agent(DQNConfig(), 9, n).q.state_dict() for n in (1, 1, 10**40))
    assert (torch.random.get_rng_state() == before).all()
    assert all((one[key] == two[key]).all() for key in one)
    assert any((one[key] != other[key]).any() for key in one)


def test_bfloat16_moves_values_by_a_twentieth_of_their_spread_at_most() -> None:
    torch.manual_seed(0)
    q, s = QNetwork(9), torch.randint(256, (16, 4, 84, 84), dtype=torch.uint8)
    with torch.no_grad():
        exact, fast = q(s), q(s, bfloat16=True)
    assert fast.dtype == torch.float32
    assert (fast - exact).abs().mean() < 0.05 * exact.std()


def test_three_updates_of_mnihs_rmsprop_by_hand() -> None:
    w = torch.zeros(1, requires_grad=True)
    optimizer, places = RMSprop([w], lr=0.1), []
    for g in (2.0, -1.0, 3.0):
        w.grad = torch.tensor([g])
        optimizer.step()
        places.append(w.item())
    # running means of g: 0.1, 0.045, 0.19275, and of g^2: 0.2, 0.24, 0.678
    variances = 0.2 - 0.1**2, 0.24 - 0.045**2, 0.678 - 0.19275**2
    steps = [-0.1 * g / v**0.5 for g, v in zip((2, -1, 3), variances, strict=True)]
    assert places == pytest.approx(np.cumsum(steps).tolist(), rel=1e-4)


def test_mnihs_epsilon_stands_inside_the_root_and_belongs_to_a_sum_of_32() -> None:
    w = torch.zeros(1, requires_grad=True)
    w.grad = torch.tensor([1e-5])  # so small that its variance counts for nothing
    RMSprop([w], lr=1.0).step()
    of_the_sum = 32 * 1e-5 / 0.01**0.5
    assert w.item() == pytest.approx(-of_the_sum, rel=1e-3)


def test_an_agent_begins_with_equal_networks_and_no_mean() -> None:
    agent = Agent(DQNConfig(), 9, seed=0)
    assert same(agent.q, agent.q_target)
    assert agent.mean.n_averaged == agent.updates == 0
    assert len({id(p) for p in agent.parameters()}) == 3 * 10  # of which nobody shares any


def same(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    """Whether two networks have equal weights, to the last bit."""
    return all(map(torch.equal, one.parameters(), two.parameters()))


@pytest.mark.parametrize("adam", [True, False])
def test_an_agent_that_is_saved_and_loaded_goes_on_as_if_nothing_had_been(
    adam: bool, tmp_path: Path
) -> None:
    c = DQNConfig(adam=adam, lr=1e-3)
    one, two = Agent(c, 9, seed=0), Agent(c, 9, seed=1)
    for _ in range(3):
        descend(one, -3.0, 1.0)
        one.mean.update_parameters(one.q)
    save(tmp_path / "a.pt", "agent", {"agent": one.state_dict()})
    two.load_state_dict(load(tmp_path / "a.pt", "agent")["agent"])
    assert two.updates == 3
    for agent in (one, two):  # with the optimizer's moments lost, these would go elsewhere
        descend(agent, -3.0, 1.0)
        agent.mean.update_parameters(agent.q)
    assert same(one, two)
    assert not same(one.q, one.q_target)
    assert two.mean.n_averaged == 4


def descend(agent: Agent, y: torch.Tensor | float, delta: float) -> None:
    """One gradient step of all values of one state towards y."""
    q = agent.q(torch.from_numpy(stripe(1))[None])
    agent.optimizer.zero_grad()
    F.smooth_l1_loss(q, torch.as_tensor(y).expand_as(q), beta=delta).backward()
    agent.optimizer.step()
    agent.updates += 1


@pytest.mark.parametrize(("delta", "learnt"), [(1.0, 0.0), (1000.0, -10.0)])
def test_clipped_errors_learn_the_median_and_squared_ones_the_mean(
    delta: float, learnt: float
) -> None:
    agent, state = Agent(DQNConfig(), 10, seed=0), torch.from_numpy(stripe(1))[None]
    for update in range(150):  # every action crashes every tenth time
        agent.optimizer.param_groups[0]["lr"] = linear_schedule(update, 2e-3, 1e-5, 150)
        descend(agent, -100.0 * (torch.arange(10) == update % 10), delta)
    q = agent.q(state).mean().item()
    assert q == pytest.approx(learnt, abs=1.5)


# -------------------------------------------------- the training, in a world of four cells


class Walker:
    """Four cells in a row, 0 goes left, 1 right: the right end pays 1, the left end -1.

    A picture is dark but for a bright stripe where the walker is.
    """

    def __init__(self) -> None:
        self.outcome = "not reset"

    def reset(self, seed: int) -> None:
        """Begin in the cell that the seed names."""
        self.seed, self.cell, self.actions, self.outcome, self.total = seed, seed % 4, "", "", 0.0

    def step(self, action: int) -> float:
        """Walk one cell; returns the reward."""
        self.cell += 2 * action - 1
        self.actions += str(action)
        self.outcome = {-1: "left", 4: "goal"}.get(self.cell, "")
        r = {-1: -1.0, 4: 1.0}.get(self.cell, 0.0)
        self.total += r
        return r

    def flight(self) -> dict:
        """What came of the walk, in the words of ForestEnv.flight."""
        walked = {"seed": self.seed, "actions": self.actions, "outcome": self.outcome, "edge": ""}
        return walked | {"steps": len(self.actions), "progress": 0.0, "return": self.total}


class Corridor:
    """Walkers side by side, as Fleet has drones."""

    def __init__(self, world: World, lanes: int) -> None:
        self.world, self.envs = world, [Walker() for _ in range(lanes)]

    @property
    def landed(self) -> list[int]:
        """The lanes of the walkers that have arrived, at either end."""
        return [lane for lane, walker in enumerate(self.envs) if walker.outcome]

    @property
    def observations(self) -> np.ndarray:
        """What the walkers see (L, 4, 84, 84)."""
        return np.stack([stripe(walker.cell) for walker in self.envs])

    def reset(self, lanes: Sequence[int], seeds: Iterable[int]) -> None:
        """Begin a walk in these lanes."""
        for lane, seed in zip(lanes, seeds, strict=True):
            self.envs[lane].reset(int(seed))

    def step(self, actions: Iterable[int]) -> tuple:
        """Observations, rewards, terminated, truncated and infos of all walkers."""
        r = [walker.step(int(a)) for walker, a in zip(self.envs, actions, strict=True)]
        terminated = np.array([walker.outcome != "" for walker in self.envs])
        infos = [{"forward": 0.0, "outcome": walker.outcome, "edge": ""} for walker in self.envs]
        return self.observations, np.array(r), terminated, np.zeros_like(terminated), infos

    def record(self, steps: int) -> list[list[tuple[int, str]]]:
        """No walk is flown again."""
        return [[] for _ in self.envs]


def stripe(cell: int) -> np.ndarray:
    """What cell looks like (4, 84, 84), and all dark beyond the ends."""
    s = np.zeros((4, 84, 84), np.uint8)
    s[..., max(21 * cell, 0) : max(21 * cell + 21, 0)] = 255
    return s


@pytest.fixture(autouse=True)
def alone() -> None:
    """One thread, because another may wait for a busy core."""
    torch.set_num_threads(1)


SHORT = partial(World, actions=2, max_steps=5)  # of the test flights and the random ones
WALK = DQNConfig(
    steps=1200, num_envs=4, gamma=0.9, replay_size=1600, learning_starts=200, update_every=4,
    batch_size=16, target_every=25, epsilon_final=1.0, lr=5e-4, lr_decay=0.02, n_steps=1,
    mirror=False, huber=1.0, average=0.0, bfloat16=False,
)  # fmt: skip


@pytest.fixture
def corridor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `train` walk the corridor."""
    monkeypatch.setattr(deepflight, "Fleet", Corridor)
    monkeypatch.setattr(deepflight, "World", SHORT)


@pytest.mark.parametrize(("n_steps", "steps"), [(1, 1600), (3, 1000)])
@pytest.mark.usefixtures("corridor")
def test_a_training_solves_a_tiny_mdp(n_steps: int, steps: int, tmp_path: Path) -> None:
    assert train(replace(WALK, n_steps=n_steps, steps=steps), PLAIN, tmp_path) == 0
    q = load_weights(tmp_path / "best.pt", 2, beacon=False, camera="grey")
    states = np.stack([stripe(x) for x in range(4)])
    assert greedy(q, states).tolist() == [1, 1, 1, 1]
    if n_steps == 1:  # longer windows of a random walk are off-policy, so their values are lower
        best = q(torch.from_numpy(states)).max(1).values.detach().numpy()
        assert best == pytest.approx([0.9**3, 0.9**2, 0.9, 1.0], abs=0.1)


def strides(c: DQNConfig, folder: Path) -> list[tuple[float, torch.Tensor]]:
    """Train; returns the learning rate of each update and Q's last layer after it."""
    taken = []

    def note(optimizer: torch.optim.Optimizer, *_: object) -> None:
        group = optimizer.param_groups[0]
        taken.append((group["lr"], group["params"][-2].detach().clone()))

    hook = register_optimizer_step_post_hook(note)
    try:
        assert train(c, PLAIN, folder) == 0
    finally:
        hook.remove()
    return taken[1:]  # the first is Agent's own, by a gradient of 0


@pytest.mark.usefixtures("corridor")
def test_the_target_network_is_an_old_copy_and_in_the_end_the_mean_of_the_weights_flies(
    tmp_path: Path,
) -> None:
    c = replace(WALK, steps=480, learning_starts=240, batch_size=4, average=0.25, lr=1e-3)
    rates, newest = zip(*strides(replace(c, lr_decay=0.5), tmp_path), strict=True)
    assert rates == pytest.approx([1e-3 * (1 - 0.5 * step / 480) for step in range(240, 481, 4)])
    agent = Agent(c, 2, seed=1)
    agent.load_state_dict(load(tmp_path / "checkpoint.pt", "checkpoint")["agent"])
    assert agent.updates == 61
    assert torch.equal(agent.q.head[2].weight, newest[-1])
    assert torch.equal(agent.q_target.head[2].weight, newest[49])  # of update 50, not 25 or 61
    assert agent.mean.n_averaged == 30  # at step 364, 368, ... 480
    mean = torch.stack(newest[-30:]).mean(0)
    assert torch.allclose(agent.mean.module.head[2].weight, mean, rtol=0, atol=1e-6)
    assert not torch.allclose(newest[-1], mean, rtol=0, atol=1e-4)
    best = load_weights(tmp_path / "best.pt", 2, beacon=False, camera="grey").state_dict()
    for name, value in agent.mean.module.state_dict().items():
        assert torch.equal(best[name], value.half().float())


@pytest.mark.usefixtures("corridor")
def test_where_the_copy_falls_on_the_last_update_both_networks_are_equal(tmp_path: Path) -> None:
    c = replace(WALK, steps=96, learning_starts=60, batch_size=4, target_every=5)  # 10 updates
    train(c, PLAIN, tmp_path)
    agent = Agent(c, 2, seed=1)
    agent.load_state_dict(load(tmp_path / "checkpoint.pt", "checkpoint")["agent"])
    assert agent.updates == 10
    assert same(agent.q, agent.q_target)
    assert same(
        load_weights(tmp_path / "best.pt", 2, beacon=False, camera="grey"), agent.q.half().float()
    )  # no mean: Q flies


def test_one_crash_in_ten_flights_moves_q_by_its_share_if_delta_is_as_large() -> None:
    y = torch.tensor([-10.0] + 9 * [0.0])  # one label is a crash
    q = torch.tensor([-1 / 9, -1.0], requires_grad=True)
    for value, delta in zip(q, (1.0, 10.0), strict=True):
        # 9 * q + 1 = 0 with Mnih's delta of 1; the mean of the labels with ours
        torch.nn.functional.smooth_l1_loss(value.expand(10), y, beta=delta).backward()
    assert q.grad.tolist() == pytest.approx([0, 0], abs=1e-7)  # where the loss is least


@pytest.mark.usefixtures("corridor")
def test_a_training_clips_errors_at_huber(tmp_path: Path) -> None:
    def first_gradient(delta: float) -> torch.Tensor:
        seen = []
        hook = register_optimizer_step_pre_hook(
            lambda optimizer, *_: seen.append(optimizer.param_groups[0]["params"][-1].grad.clone())
        )
        c = replace(WALK, steps=60, learning_starts=59, batch_size=4, huber=delta)
        try:
            assert train(c, PLAIN, tmp_path / str(delta)) == 0
        finally:
            hook.remove()
        return seen[1]  # the first is Agent's own, by a gradient of 0

    wide = first_gradient(1000.0)  # no error is as large, so the slope is e / delta
    assert wide.any()
    assert torch.allclose(10 * wide, first_gradient(100.0), rtol=1e-3, atol=0)
    lines = 4 * first_gradient(1e-3)  # every error is larger: 4 slopes of 1, a mean over 4
    assert torch.allclose(lines, lines.round(), atol=1e-6)


# -------------------------------------------------- files that are whole, or not there


class Payload:
    """A pickle that makes a file when it is loaded, as a malicious one would."""

    def __init__(self, trap: Path) -> None:
        self.trap = trap

    def __reduce__(self) -> tuple:
        return Path.touch, (self.trap,)


def digest(data: bytes) -> bytes:
    """What save writes behind the data: an attacker knows it too."""
    return data + hashlib.sha256(data).digest()


def weights_file(folder: Path) -> Path:
    """A small file of tensors and numbers."""
    save(folder / "w.pt", "weights", {"x": torch.arange(500.0), "step": 2**70})
    return folder / "w.pt"


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    path = weights_file(tmp_path)
    content = load(path, "weights")
    assert torch.equal(content["x"], torch.arange(500.0))
    assert content["step"] == 2**70
    assert [p.name for p in tmp_path.iterdir()] == ["w.pt"], "nothing is left beside it"
    plain = torch.load(path, weights_only=True)
    assert torch.equal(plain["x"], content["x"]), "torch itself reads it: the digest stands behind"


def test_weights_are_halved_and_fit_their_own_world_and_actions_only(tmp_path: Path) -> None:
    q, path = Agent(DQNConfig(), 9, seed=0).q, tmp_path / "w.pt"
    save_weights(path, q, beacon=True)
    assert path.stat().st_size < 3.5e6
    for name, value in load_weights(path, 9, beacon=True).state_dict().items():
        assert torch.equal(value, q.state_dict()[name].half().float())
    with pytest.raises(ValueError, match=r"trained with \{'beacon': True\}, here is"):
        load_weights(path, 9, beacon=False)
    with pytest.raises(ValueError, match=r"network: head.2.weight is a tensor of shape"):
        load_weights(path, 5, beacon=True)


@pytest.mark.parametrize(
    ("found", "named"),
    [
        ({"n": 1, "x": 0.5, "t": torch.zeros(2), "all": [("a", 1)]}, None),
        ({"n": 0, "x": -0.5, "t": torch.ones(2), "all": []}, None),
        ({"n": 1, "x": 0.5, "t": torch.zeros(2), "all": [("a", 1)] * 9}, None),
        ({"n": 1, "x": 0.5, "t": torch.zeros(2)}, "file holds other things than n, x, t, all"),
        ({"n": True, "x": 0.5, "t": torch.zeros(2), "all": []}, "file: n is of type bool"),
        ({"n": -1, "x": 0.5, "t": torch.zeros(2), "all": []}, "file: n is a number below 0"),
        (
            {"n": 1, "x": float("nan"), "t": torch.zeros(2), "all": []},
            "file: x holds a number that is not",
        ),
        ({"n": 1, "x": 0.5, "t": torch.zeros(3), "all": []}, "file: t is a tensor of shape"),
        ({"n": 1, "x": 0.5, "t": torch.zeros(2).half(), "all": []}, "file: t is a tensor of dtype"),
        ({"n": 1, "x": 0.5, "t": torch.zeros(2).to_sparse(), "all": []}, "tensor of layout"),
        (
            {"n": 1, "x": 0.5, "t": torch.full((2,), torch.inf), "all": []},
            "file: t holds a number that is not",
        ),
        ({"n": 1, "x": 0.5, "t": torch.zeros(2), "all": [("a", 1), ("a",)]}, "file: all: 1 holds"),
        (
            {"n": 1, "x": 0.5, "t": torch.zeros(2), "all": [("a", "1")]},
            "file: all: 0: 1 is of type",
        ),
    ],
)
def test_what_a_file_holds_is_like_what_we_would_write_or_named(found: dict, named: str) -> None:
    like = {"n": 7, "x": 1.5, "t": torch.ones(2), "all": [("", 0)]}
    if named is None:
        check_like(found, like, "file")
        return
    with pytest.raises(ValueError, match=named):
        check_like(found, like, "file")


def test_a_folder_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    with (
        lock_folder(tmp_path),
        pytest.raises(ValueError, match="another training's"),
        lock_folder(tmp_path),
    ):
        pass
    with lock_folder(tmp_path):
        assert not list(tmp_path.iterdir()), "the lock is no file"


def test_a_file_is_written_where_the_name_is_free_or_our_own_and_nowhere_else(
    tmp_path: Path,
) -> None:
    ours, theirs, link, loop = (tmp_path / name for name in ("ours", "theirs", "link", "loop"))
    ours.write_text('{"program": "Deep Flight"}')
    theirs.write_text("my diary on Deep Flight")
    link.symlink_to(theirs)
    loop.symlink_to(loop)
    os.mkfifo(tmp_path / "pipe")
    before = sorted(tmp_path.rglob("*"))
    for path in (ours, tmp_path / "new", tmp_path / "a/b/new"):
        check_output(path, b'{"program": "Deep Flight"')
    for path in (theirs, link, loop, tmp_path / "pipe", tmp_path, Path("/dev/null")):
        with pytest.raises(ValueError, match="this program did not write it"):
            check_output(path, b'{"program": "Deep Flight"')
    long = "x" * 300
    for path in (theirs / "new", tmp_path / "new" / long / "new", Path("/proc/new")):
        with pytest.raises(ValueError, match="cannot be read or written"):
            check_output(path, b'{"program": "Deep Flight"')
    assert sorted(tmp_path.rglob("*")) == before


def test_a_link_is_followed_to_its_target_and_stays_a_link(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    link.symlink_to(target)
    with whole_file(link) as file:
        file.write(b"new")
        assert not target.exists()
    assert link.is_symlink() and target.read_bytes() == b"new"


def test_a_file_with_any_byte_changed_is_refused(tmp_path: Path) -> None:
    path = weights_file(tmp_path)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(len(whole), size=300):
        broken = bytearray(whole)
        broken[place] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        with pytest.raises(ValueError, match="digest is wrong"):
            load(path, "weights")


def test_a_file_cut_short_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = weights_file(tmp_path)
    whole = path.read_bytes()
    for length in (1, 31, 32, 33, len(whole) // 2, len(whole) - 32, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="digest is wrong"):
            load(path, "weights")
    path.write_bytes(whole)
    with pytest.raises(ValueError, match="holds something else than checkpoint"):
        load(path, "checkpoint")
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="is no file of weights"):
        load(path, "weights")
    for content in (b"", b"text", b"PK\x03\x04 a broken archive"):
        path.write_bytes(digest(content))
        with pytest.raises(ValueError, match=r"cannot be read|digest is wrong"):
            load(path, "weights")
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(2**31)
    for path in (tmp_path / "missing.pt", tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(ValueError, match="is no file of weights"):
            load(path, "weights")
    with pytest.raises(ValueError, match="is no file of weights"):
        load(tmp_path / "huge", "weights")


def test_an_archive_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    archive, path = io.BytesIO(), tmp_path / "w.pt"
    with ZipFile(archive, "w", ZIP_DEFLATED) as file, file.open("a/data.pkl", "w") as part:
        for _ in range(1100):
            part.write(bytes(2**20))
    path.write_bytes(digest(archive.getvalue()))
    assert path.stat().st_size < 2e6
    with pytest.raises(ValueError, match="holds something else"):
        load(path, "weights")


def test_a_malicious_pickle_is_refused_and_its_payload_not_run(tmp_path: Path) -> None:
    path, trap = tmp_path / "w.pt", tmp_path / "trap"
    pickle.loads(pickle.dumps(Payload(trap)))
    assert trap.exists(), "the payload works where pickle is trusted"
    trap.unlink()
    archive = io.BytesIO()
    torch.save({"kind": "weights", "x": Payload(trap)}, archive)
    bare = pickle.dumps({"kind": "weights", "x": Payload(trap)})
    for data in (bare, archive.getvalue(), digest(bare), digest(archive.getvalue())):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"cannot be read|digest is wrong") as refused:
            load(path, "weights")
        assert "\n" not in str(refused.value)
        assert not trap.exists()


def test_when_the_disk_is_full_the_old_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "w.pt"
    path.write_bytes(b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # no file may grow beyond
    try:
        with pytest.raises(OSError, match="too large"), whole_file(path) as file:
            file.write(bytes(20_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["w.pt"]
