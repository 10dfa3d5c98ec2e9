"""DQN, against the whole history in plain lists, arithmetic by hand, and a tiny solved MDP."""

import inspect
import re
import resource
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray
from pytest import MonkeyPatch, approx

import dqn
import env
from dqn import LIVE, TERMINAL, TRUNCATED, Agent, Batch, DQNConfig, QNetwork, Replay, td_target


def play(rows: int, num_envs: int, seed: int) -> list[list[tuple]]:
    """Random episodes: of each environment a history of (frame number, action, reward, end)."""
    rng, size = np.random.default_rng(seed), (rows, num_envs)
    ends = rng.choice([LIVE, TERMINAL, TRUNCATED], size, p=[0.85, 0.1, 0.05])
    frames, actions = 1 + np.arange(rows * num_envs).reshape(size), rng.integers(9, size=size)
    columns = [x.T.tolist() for x in (frames, actions, rng.normal(size=size), ends)]
    return [[*zip(*lists, strict=True)] for lists in zip(*columns, strict=True)]


def read(s: torch.Tensor) -> list[list[int]]:
    return (s[:, :, 0, 0].int() * 256 + s[:, :, 0, 1]).tolist()  # what two pixels of a frame show


def fill(histories: list[list[tuple]], capacity: int) -> Replay:
    """A replay that has seen these histories. After frame t, s2 shows 30,000 + t."""
    replay, both = Replay(capacity, len(histories)), np.zeros((2, len(histories), 4, 84, 84))
    for row in zip(*histories, strict=True):
        frame, a, r, end = map(np.array, zip(*row, strict=True))
        both[..., 0, :2] = np.stack(np.divmod([frame, 30_000 + frame], 256), -1)[:, :, None]
        s, s2 = both.astype(np.uint8)
        replay.add(s, a, r, s2, end == TERMINAL, end == TRUNCATED)
    return replay


def naive(history: list[tuple], t: int, n: int, gamma: float) -> tuple:
    """The n-step transition that begins at time t, step by step."""
    start = max([i + 1 for i in range(t) if history[i][3] != LIVE], default=0)

    def stack(now: int) -> list[int]:
        return [history[max(i, start)][0] for i in range(now - 3, now + 1)]

    r = 0.0
    for k in range(n):
        frame, _, reward, end = history[t + k]
        r += gamma**k * reward
        if end != LIVE:
            break
    s2 = {LIVE: stack(t + k + 1), TERMINAL: None, TRUNCATED: [*stack(t + k)[1:], 30_000 + frame]}
    return stack(t), history[t][1], r, s2[end], gamma ** (k + 1), end


STATM = Path("/proc/self/statm")  # sizes in pages: of the whole process, then in memory


@pytest.mark.skipif(not STATM.exists(), reason="needs Linux")
def test_the_replay_takes_its_memory_at_once_and_not_hours_later() -> None:
    before = int(STATM.read_text().split()[1])
    replay = Replay(20_000, 8)
    taken = (int(STATM.read_text().split()[1]) - before) * resource.getpagesize()
    assert taken > 0.9 * replay.frames.nbytes


@pytest.mark.parametrize("n", [1, 3, 5])
@pytest.mark.parametrize("rows", [40, 137])  # before the ring wraps, and after
def test_stacks_and_windows_are_those_of_the_whole_history(n: int, rows: int) -> None:
    num_envs, kept = 3, 60
    histories = play(rows, num_envs, seed=n)
    replay = fill(histories, kept * num_envs)
    for i, t in product(range(num_envs), range(max(rows - kept, 0) + 3, rows - n)):
        got = replay.window(np.array([t % kept]), np.array([i]), n, 0.9)
        s, a, r, s2, gamma_n, end = naive(histories[i], t, n, 0.9)
        assert (read(got.s)[0], got.a, got.end) == (s, a, end)
        assert (got.r.item(), got.gamma_n.item()) == approx((r, gamma_n), abs=1e-5)
        assert s2 is None or read(got.s2)[0] == s2


def test_samples_are_drawn_from_all_complete_windows_and_no_others() -> None:
    rows, kept, n = 137, 60, 5
    batch = fill(play(rows, 1, 0), kept).sample(2_000, n, 0.9, np.random.default_rng(0))
    drawn = {number for *_, number in read(batch.s)}  # frame t shows t + 1
    assert drawn == {*range(rows - kept + 3 + 1, rows - n + 1)}


def target(r: float, gamma_n: float, end: int, q2: list[float], q2_online: list[float]) -> float:
    b = Batch(None, None, torch.tensor([r]), None, torch.tensor([gamma_n]), torch.tensor([end]))
    return td_target(b, torch.tensor([q2]), torch.tensor([q2_online])).item()


def test_td_targets_by_hand() -> None:
    q = [9.0, 10.0, -3.0]  # the file's own example
    targets = [target(0.5, 0.99, end, q, q) for end in (LIVE, TRUNCATED, TERMINAL)]
    assert targets == approx([10.4, 10.4, 0.5])  # where time is up, more would have followed
    # Three rewards 4, 2, -6 with a gamma of 0.5, and then a state that is worth 8.
    replay = fill([[(t, 0, r, LIVE) for t, r in enumerate([0.0, 4.0, 2.0, -6.0, 9.0, 9.0])]], 6)
    b, q2 = replay.window(np.array([1]), np.array([0]), 3, 0.5), torch.tensor([[8.0, 7.0]])
    assert td_target(b, q2, q2).item() == 4 + 0.5 * 2 + 0.25 * -6 + 0.125 * 8
    # Values are +1 or -1 where the truth is 0: their maximum is too high, Double's choice is not.
    assert target(1.0, 0.5, LIVE, [9.0, 2.0, 4.0], [0.0, 5.0, 1.0]) == 1 + 0.5 * 2
    noise = [list(x) for x in product([-1.0, 1.0], repeat=2)]
    plain = [target(0.0, 1.0, LIVE, q2, q2) for q2 in noise]
    double = [target(0.0, 1.0, LIVE, q2, online) for q2, online in product(noise, noise)]
    assert (np.mean(plain), np.mean(double)) == (0.5, 0.0)


def random_batch(size: int) -> Batch:
    """Transitions of noise, always the same, with rewards of about 3."""
    rng = np.random.default_rng(0)
    s, s2 = rng.integers(256, size=(2, size, 4, 84, 84), dtype=np.uint8)
    r, gamma_n = rng.normal(0, 3, (2, size)).astype(np.float32)
    parts = s, rng.integers(9, size=size), r, s2, gamma_n, rng.integers(3, size=size)
    return Batch(*map(torch.from_numpy, parts))


def test_mirror_reflects_about_half_of_the_transitions_and_a_second_time_restores_them() -> None:
    b, before = random_batch(64), random_batch(64)
    dqn.mirror(b, 9, np.random.default_rng(0))
    flip = (b.s == before.s.flip(-1)).all((1, 2, 3))
    assert 20 <= flip.sum() <= 44  # three standard deviations
    for new, old in ((b.s, before.s), (b.s2, before.s2)):
        assert torch.equal(new, torch.where(flip[:, None, None, None], old.flip(-1), old))
    assert torch.equal(b.a, torch.where(flip, 8 - before.a, before.a))
    dqn.mirror(b, 9, np.random.default_rng(0))  # the same half
    assert all(map(torch.equal, b, before))


def test_a_mirrored_transition_is_true_in_the_mirrored_forest(monkeypatch: MonkeyPatch) -> None:
    def fly(actions: Sequence[int]) -> list[tuple]:
        envs = env.VecForest(env.World(beacon=True), 1, [3])
        s, transitions = envs.reset_done(), []
        for a in actions:
            s2, r, *_ = envs.step([a])
            transitions.append((s, np.array([a]), r, s2))
            s = s2
        return transitions

    true, plant = fly([8, 8, 3, 2, 1, 6]), env.plant
    monkeypatch.setattr(env, "plant", lambda *forest: plant(*forest) * [1, -1])
    for (s, a, r, s2), (s_m, a_m, r_m, s2_m) in zip(true, fly([0, 0, 5, 6, 7, 2]), strict=True):
        eight = (torch.from_numpy(np.repeat(x, 8, 0)) for x in (s, a, r, s2, r, r))
        b = dqn.mirror(Batch(*eight), 9, np.random.default_rng(0))
        flip = (b.a != a.item()).numpy()
        assert 0 < flip.sum() < 8
        assert (b.a.numpy() == np.where(flip, a_m, a)).all() and (r == r_m).all()
        for got, one, other in ((b.s, s, s_m), (b.s2, s2, s2_m)):
            assert (got.numpy() == np.where(flip[:, None, None, None], other, one)).all()


def agent(c: DQNConfig, seed: int = 0) -> Agent:
    return Agent(c, 9, np.random.default_rng(seed))


def same(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    return all(map(torch.equal, one.parameters(), two.parameters()))


def test_the_network_is_mnihs_and_has_1_7_million_weights() -> None:
    layers = [8 * 8 * 4 * 32 + 32, 4 * 4 * 32 * 64 + 64, 3 * 3 * 64 * 64 + 64]
    layers += [7 * 7 * 64 * 512 + 512, 512 * 9 + 9]
    q, s = QNetwork(9), random_batch(2).s.float()
    assert sum(p.numel() for p in q.parameters()) == sum(layers) == 1_688_745
    shapes = [tuple((s := layer(s)).shape[1:]) for layer in q.conv]
    assert shapes == [(32, 20, 20)] * 2 + [(64, 9, 9)] * 2 + [(64, 7, 7)] * 2 + [(3136,)]
    assert q.head(s).shape == (2, 9)


def test_an_agent_is_a_function_of_its_seed_and_begins_with_two_equal_networks() -> None:
    before, one = torch.random.get_rng_state(), agent(DQNConfig())
    assert (torch.random.get_rng_state() == before).all()
    assert same(one, agent(DQNConfig())) and not same(one, agent(DQNConfig(), seed=1))
    assert same(one.q, one.q_target) and one.averaged.n_averaged == 0
    assert len({id(p) for p in one.parameters()}) == 3 * 10  # and the three share no weights


@pytest.mark.parametrize("double", [True, False])
def test_an_updates_loss_and_gradient_by_hand(double: bool, monkeypatch: MonkeyPatch) -> None:
    monkeypatch.setattr(DQNConfig, "bfloat16", False)
    c, b = DQNConfig(double=double, huber_delta=2.0), random_batch(16)
    one, loss, gradient, errors = agent(c), 0.0, np.zeros(9), []
    one.q_target.head[2].bias.data = torch.arange(9.0) % 5  # it would choose otherwise than Q
    with torch.no_grad():
        values = [x.tolist() for x in (one.q(b.s), one.q(b.s2), one.q_target(b.s2))]
    scalars = (x.tolist() for x in (b.a, b.r, b.gamma_n, b.end))
    for a, r, gamma_n, end, q, q2, frozen in zip(*scalars, *values, strict=True):
        v2 = frozen[np.argmax(q2 if double else frozen)]
        e = q[a] - (r if end == TERMINAL else r + gamma_n * v2)
        loss += (e * e / 2 if abs(e) < 2 else 2 * (abs(e) - 1)) / 16
        gradient[a] += np.clip(e, -2, 2) / 16
        errors.append(abs(e))
    assert min(errors) < 2 < max(errors)
    dqn.learn(one, b, c)
    assert one.loss == approx(loss, rel=1e-4)
    assert one.q.head[2].bias.grad.numpy() == approx(gradient, abs=1e-4)


def test_adams_eps_grows_with_huber_delta_so_that_clipped_errors_move_weights_alike() -> None:
    b, first, moved = random_batch(4), agent(DQNConfig()), []
    for delta in (1.0, 8.0):
        moved.append(agent(c := DQNConfig(huber_delta=delta)))
        assert moved[-1].optimizer.param_groups[0]["eps"] == 1.5e-4 * delta
        dqn.learn(moved[-1], b._replace(r=b.r.sign() * 1e4), c)  # every error is clipped
    for one, two, before in zip(*(x.q.parameters() for x in (*moved, first)), strict=True):
        assert torch.allclose(one, two, rtol=0, atol=1e-7) and not torch.equal(one, before)


class Corridor:
    """Walkers side by side on four cells: 0 goes left, 1 right, where beyond the right end is 1
    and beyond the left end -1. A frame is dark, with a bright stripe where the walker is."""

    frames = np.zeros((6, 4, 84, 84), np.uint8)  # the cells between both ends
    for cell in range(4):
        frames[1 + cell, :, :, 21 * cell : 21 * cell + 21] = 255
    num_actions, drones = 2, ()

    def __init__(self) -> None:
        self.rng, self.steps, self.cells = np.random.default_rng(1), 0, np.full(4, -1)

    def reset_done(self) -> ndarray:
        """Begin anywhere, where a walk has ended."""
        begun = self.rng.integers(4, size=4)
        self.cells = self.before = np.where(self.cells % 5 == 4, begun, self.cells)
        return self.frames[1 + self.cells]

    def step(self, actions: ndarray) -> tuple:
        """Walk one cell."""
        self.steps, self.taken, self.cells = self.steps + 4, actions, self.cells + 2 * actions - 1
        done, r = self.cells % 5 == 4, 1.0 * (self.cells == 4) - (self.cells == -1)
        return self.frames[1 + self.cells], r, done, np.zeros_like(done), []


WALK = DQNConfig(
    steps=800, num_envs=4, gamma=0.9, replay_size=800, learning_starts=100, batch_size=16,
    target_every=50, epsilon_final=1.0, lr=1e-3, lr_final=0.02, n_steps=1, mirror=False,
    huber_delta=1.0, swa_fraction=0.0,
)  # fmt: skip


def test_dqn_solves_a_tiny_mdp() -> None:
    torch.set_num_threads(1)
    envs = Corridor()
    *_, (one, _) = dqn.train(WALK, envs, np.random.default_rng(0), lambda r, *_: r)
    assert one.q.values(envs.frames[1:5], ()).argmax(1).tolist() == [1, 1, 1, 1]
    best = one.q.values(envs.frames[1:5], ()).max(1).tolist()
    assert best == approx([0.9**3, 0.9**2, 0.9, 1.0], abs=0.1)


def test_the_loop_acts_greedily_syncs_the_target_network_and_averages_the_last_share() -> None:
    c = replace(WALK, steps=160, learning_starts=80, batch_size=4, target_every=36, lr_final=0.5)
    c, envs = replace(c, epsilon_final=0.0, epsilon_decay=1, swa_fraction=0.25), Corridor()
    loop = dqn.train(c, envs, np.random.default_rng(0), lambda r, *_: r)
    one, replay = next(loop)
    synced = one.q.head[2].weight.detach().clone()
    choice, last = one.q.values(envs.frames[1:5], ()).argmax(1), []
    for step, _ in zip(range(4, 164, 4), loop, strict=True):
        assert (envs.taken == choice[envs.before]).all()
        assert (4 * replay.added, envs.steps, one.epsilon) == (step, step, 0.0)
        assert one.optimizer.param_groups[0]["lr"] == approx(1e-3 * (1 - 0.5 * step / 160))
        q, choice = (
            one.q.head[2].weight.detach().clone(),
            one.q.values(envs.frames[1:5], ()).argmax(1),
        )
        synced = q if step % 36 == 0 else synced
        assert torch.equal(one.q_target.head[2].weight, synced)
        last += [q] if step > 120 else []
    assert one.averaged.n_averaged == len(last) == 10
    assert torch.allclose(one.averaged.module.head[2].weight, torch.stack(last).mean(0), atol=1e-6)


def test_the_loop_carries_the_numbers_of_algorithm_1_in_order() -> None:
    comments = re.findall(r"# (\d+(?:, \d+)*)\b", inspect.getsource(dqn.train))
    assert [int(x) for line in comments for x in line.split(",")] == [*range(1, 16)]
