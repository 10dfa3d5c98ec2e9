"""What the brain learns from, against a naive replay, hand arithmetic and a tiny solved MDP."""

import hashlib
import io
import pickle
import resource
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dqn import (
    DEAD,
    DQN,
    FAR,
    GOAL,
    LIVE,
    TRUNCATED,
    Batch,
    QNetwork,
    Replay,
    greedy,
    linear_schedule,
    load,
    mirror,
    save,
    td_target,
    write_whole,
)

SETTINGS = SimpleNamespace(
    device="cpu", gamma=0.9, n=1, batch=16, mirror=False, double=True, goal_value=0.0,
    precision="float32", optimizer="adam", lr=5e-4, optimizer_eps=1e-4, max_grad_norm=10.0,
    target_every=25, far_value=0.0,
)  # fmt: skip


# -------------------------------------------------- the replay


def play(rows: int, lanes: int, seed: int) -> list[list[tuple]]:
    """Random episodes: a log per lane of (frame number, action, reward, end)."""
    rng, frame_number = np.random.default_rng(seed), 0
    logs = [[] for _ in range(lanes)]
    for _ in range(rows):
        for log in logs:
            end = rng.choice([LIVE, DEAD, GOAL, TRUNCATED], p=[0.85, 0.05, 0.05, 0.05])
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
        s2 = [np.stack([picture(30_000 + f)] * 4) for f, *_ in row]
        replay.add(s, np.array([x[1] for x in row]), [x[2] for x in row], s2, [x[3] for x in row])
    return replay


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
            assert got.discount[0] == pytest.approx(gamma)
            assert got.end[0] == end
            assert s2 is None or number(got.s2)[0].tolist() == s2


def test_samples_are_drawn_from_all_complete_windows_and_no_others() -> None:
    rows, kept, n = 137, 60, 5
    replay = fill(play(rows, 1, seed=0), kept)
    batch = replay.sample(20_000, n, 0.9, np.random.default_rng(0))
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
    tensors = [torch.tensor([x]) for x in (r, discount, end, choose, value)]
    return td_target(*tensors, {DEAD: 0.0, GOAL: 100.0, FAR: 40.0}).item()


def test_the_target_by_hand() -> None:
    q = [1.0, 3.0, 2.0]
    assert target(0.5, 0.9, LIVE, q, q) == pytest.approx(0.5 + 0.9 * 3)  # ordinary
    assert target(-10.0, 0.9, DEAD, q, q) == -10.0  # crashed
    assert target(0.5, 0.9, GOAL, q, q) == pytest.approx(0.5 + 0.9 * 100)  # arrived
    assert target(-10.0, 0.9, FAR, q, q) == pytest.approx(-10 + 0.9 * 40)  # left by the far edge
    assert target(0.5, 0.9, TRUNCATED, q, q) == pytest.approx(
        0.5 + 0.9 * 3
    )  # out of time, not dead


def test_double_dqn_values_with_one_network_what_the_other_chose() -> None:
    online, frozen = [0.0, 5.0, 1.0], [9.0, 2.0, 4.0]
    assert target(1.0, 0.5, LIVE, frozen, frozen) == 1 + 0.5 * 9  # plain: the maximum flatters
    assert target(1.0, 0.5, LIVE, online, frozen) == 1 + 0.5 * 2  # double


# -------------------------------------------------- the mirror


def test_mirroring_flips_frames_and_actions_of_the_chosen_only() -> None:
    rng = np.random.default_rng(0)
    s, s2 = rng.integers(256, size=(2, 6, 4, 84, 84), dtype=np.uint8)
    a, r = np.arange(6), np.zeros(6, np.float32)
    batch = Batch(s.copy(), a.copy(), r, s2.copy(), r, r)
    flip = np.array([True, False, True, False, False, True])
    flipped = mirror(batch, flip, 9)
    for i in range(6):
        assert (flipped.s[i] == (s[i, ..., ::-1] if flip[i] else s[i])).all()
        assert (flipped.s2[i] == (s2[i, ..., ::-1] if flip[i] else s2[i])).all()
    assert flipped.a.tolist() == [8, 1, 6, 3, 4, 3]


# -------------------------------------------------- the network and the agent


def test_the_network_is_natures() -> None:
    layers = [8 * 8 * 4 * 32 + 32, 4 * 4 * 32 * 64 + 64, 3 * 3 * 64 * 64 + 64]
    layers += [7 * 7 * 64 * 512 + 512, 512 * 9 + 9]
    assert sum(p.numel() for p in QNetwork(9).parameters()) == sum(layers) == 1_688_745


def test_equal_seeds_give_equal_networks_and_leave_torchs_own_generator_alone() -> None:
    before = torch.random.get_rng_state()
    one, two, other = (DQN(SETTINGS, 9, seed).q.state_dict() for seed in (1, 1, 10**40))
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


def test_the_target_network_is_copied_every_so_many_updates_and_not_between() -> None:
    agent, memory = DQN(SETTINGS, 2, seed=0), corridor(200)
    rng = np.random.default_rng(0)
    start = agent.q_target.head[2].bias.clone()
    for _ in range(SETTINGS.target_every - 1):
        agent.learn(memory, 1e-3, 1.0, 1.0, rng)
    assert (agent.q_target.head[2].bias == start).all()
    agent.learn(memory, 1e-3, 1.0, 1.0, rng)
    assert (agent.q_target.head[2].bias == agent.q.head[2].bias).all()


def corridor(steps: int) -> Replay:
    """Four cells in a row, left or right at random: the right end pays 1, the left end -1.

    A frame is dark but for a bright stripe where the drone is.
    """
    rng, memory, cell = np.random.default_rng(0), Replay(steps, 1), 1
    for _ in range(steps):
        a = int(rng.integers(2))
        after = cell + 2 * a - 1
        end = LIVE if 0 <= after <= 3 else DEAD
        r = float(after == 4) - float(after == -1)
        memory.add(stripe(cell)[None], np.array([a]), [r], [stripe(after)], [end])
        cell = after if end == LIVE else int(rng.integers(4))
    return memory


def stripe(cell: int) -> np.ndarray:
    """What cell looks like (4, 84, 84)."""
    s = np.zeros((4, 84, 84), np.uint8)
    s[..., 21 * cell : 21 * cell + 21] = 255
    return s


@pytest.mark.parametrize("n", [1, 3])
def test_the_agent_solves_a_tiny_mdp(n: int) -> None:
    settings = SimpleNamespace(**(vars(SETTINGS) | {"n": n}))
    agent, memory, rng = DQN(settings, 2, seed=0), corridor(1000), np.random.default_rng(1)
    for update in range(300):
        agent.learn(memory, linear_schedule(update, 5e-4, 1e-5, 300), 1.0, 1.0, rng)
    states = np.stack([stripe(cell) for cell in range(4)])
    assert greedy(agent.q, states).tolist() == [1, 1, 1, 1]
    if n == 1:  # longer windows of a random walk are off-policy, so their values are lower
        best = agent.q(torch.from_numpy(states)).max(1).values.detach().numpy()
        assert best == pytest.approx([0.9**3, 0.9**2, 0.9, 1.0], abs=0.1)


@pytest.mark.parametrize(("delta", "learnt"), [(1.0, 0.0), (1000.0, -10.0)])
def test_clipped_errors_learn_the_median_and_squared_ones_the_mean(
    delta: float, learnt: float
) -> None:
    agent, memory, rng = DQN(SETTINGS, 2, seed=0), Replay(1000, 1), np.random.default_rng(0)
    for step in range(1000):  # one step an episode, and one in ten of them ends badly
        memory.add(stripe(1)[None], np.zeros(1), [-100.0 * (step % 10 == 0)], [stripe(1)], [DEAD])
    for update in range(150):
        agent.learn(memory, linear_schedule(update, 2e-3, 1e-5, 150), delta, 1.0, rng)
    q = agent.q(torch.from_numpy(stripe(1))[None])[0, 0].item()
    assert q == pytest.approx(learnt, abs=1.5)


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
    for length in (0, 1, 31, 32, 33, len(whole) // 2, len(whole) - 32, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="digest is wrong"):
            load(path, "weights")
    path.write_bytes(whole)
    with pytest.raises(ValueError, match="holds weights, needed: checkpoint"):
        load(path, "checkpoint")
    for content in (b"", b"text", b"PK\x03\x04 a broken archive"):
        path.write_bytes(digest(content))
        with pytest.raises(ValueError, match=r"cannot be read|digest is wrong"):
            load(path, "weights")
    with pytest.raises(ValueError, match="cannot be read"):
        load(tmp_path / "missing.pt", "weights")
    with pytest.raises(ValueError, match="cannot be read"):
        load(tmp_path, "weights")


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
    write_whole(path, b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # no file may grow beyond
    try:
        with pytest.raises(OSError, match="too large"):
            write_whole(path, bytes(20_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["w.pt"]
