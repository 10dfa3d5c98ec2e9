"""dqn.py: the brain. Deep Q-learning with experience replay [Mnih15], which knows of no forest.

    frames (4, 84, 84) -> conv 32 8x8/4 -> conv 64 4x4/2 -> conv 64 3x3/1 -> 512 -> Q(s, .) (9,)

Algorithm 1 of [Mnih15], "Human-level control through deep reinforcement learning", Nature 518;
the code below and the training loop in deepflight.py carry these numbers.

     1  initialize replay memory D to capacity N
     2  initialize action-value function Q with random weights theta
     3  initialize target action-value function Q^ with weights theta- = theta
     4  for episode = 1, M do
     5      initialize sequence s_1 = {x_1} and preprocessed sequence phi_1 = phi(s_1)
     6      for t = 1, T do
     7          with probability epsilon select a random action a_t
     8          otherwise select a_t = argmax_a Q(phi(s_t), a; theta)
     9          execute action a_t in emulator and observe reward r_t and image x_{t+1}
    10          set s_{t+1} = s_t, a_t, x_{t+1} and preprocess phi_{t+1} = phi(s_{t+1})
    11          store transition (phi_t, a_t, r_t, phi_{t+1}) in D
    12          sample random minibatch of transitions (phi_j, a_j, r_j, phi_{j+1}) from D
    13          set y_j = r_j if the episode terminates at step j+1,
                    r_j + gamma * max_a' Q^(phi_{j+1}, a'; theta-) otherwise
    14          perform a gradient descent step on (y_j - Q(phi_j, a_j; theta))^2 w.r.t. theta
    15          every C steps reset Q^ = Q
    16      end for
    17  end for

Legend: s, a state and action; r the sum of the next n discounted rewards (n = 1: the reward), with
what deepflight.py pays for metres ahead; s2 the state after them; gamma the discount of a step,
discount that of s2: gamma to the number of rewards in r; end how these ended; y the target;
B batch, T rows and L lanes of the replay.
At the end, the two functions that write and read files of tensors so that none is ever half there.
Not in this file: prioritized replay, distributional values, noisy layers.
"""

import hashlib
import io
import os
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor, nn

# How a transition ended: not at all; cut short by a time limit, after which the world would have
# gone on; or in a terminal state: a dead one, the goal, or beyond the far edge.
LIVE, TRUNCATED, DEAD, GOAL, FAR = range(5)


class QNetwork(nn.Module):
    """The Nature network [Mnih15, Methods]; its output is linear, for values may be negative."""

    def __init__(self, actions: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            *(nn.Conv2d(4, 32, 8, 4), nn.ReLU()),  # (B, 32, 20, 20)
            *(nn.Conv2d(32, 64, 4, 2), nn.ReLU()),  # (B, 64, 9, 9)
            *(nn.Conv2d(64, 64, 3, 1), nn.ReLU()),  # (B, 64, 7, 7)
            nn.Flatten(),  # (B, 3136)
        )
        self.head = nn.Sequential(nn.Linear(3136, 512), nn.ReLU(), nn.Linear(512, actions))

    def forward(self, s: Tensor, bfloat16: bool = False) -> Tensor:
        """Q(s, .) (B, actions) float32 of s (B, 4, 84, 84) uint8.

        bfloat16 speeds up the convolutions where the processor has it. The last layers stay
        float32: between 64 and 128 bfloat16 moves in steps of 0.5 and the actions would tie.
        """
        with torch.autocast(s.device.type, torch.bfloat16, enabled=bfloat16):
            seen = self.conv(s.float() / 255)  # (B, 3136)
        return self.head(seen.float())  # (B, actions)


@torch.no_grad()
def greedy(q: QNetwork, s: np.ndarray) -> np.ndarray:
    """The actions (B,) of highest value in the states s (B, 4, 84, 84) uint8 (line 8)."""
    return q(torch.from_numpy(s).to(q.head[0].weight.device)).argmax(1).cpu().numpy()


class Batch(NamedTuple):
    """B transitions drawn from the replay."""

    s: np.ndarray  # (B, 4, 84, 84) uint8
    a: np.ndarray  # (B,) int64
    r: np.ndarray  # (B,) float32, the window's discounted rewards
    s2: np.ndarray  # (B, 4, 84, 84) uint8, meaningless after DEAD, GOAL and FAR
    discount: np.ndarray  # (B,) float32, gamma to the number of rewards in r
    end: np.ndarray  # (B,) uint8


class Replay:
    """The last N transitions of L environments that step together (line 1).

    Each frame is kept once, 7,056 bytes, and a state is put together from four of them when it is
    drawn; keeping s and s2 whole would cost eight times as much. Row t, lane l holds the newest
    frame of s_t in environment l, the action taken there, its reward and how the transition ended.

        lane 0   x x x|x x x x x x x x           | an episode's end: no stack and no
        lane 1   x x x x x x x|x x x x             n-step window reaches across it,
                             ^ write position      nor across the write position
    """

    def __init__(self, capacity: int, lanes: int) -> None:
        shape = (capacity // lanes, lanes)
        self.frames = np.empty((*shape, 84, 84), np.uint8)  # (T, L, 84, 84)
        self.actions = np.zeros(shape, np.uint8)  # (T, L)
        self.rewards = np.zeros(shape, np.float32)  # (T, L)
        self.ends = np.zeros(shape, np.uint8)  # (T, L)
        self.last_frames: dict[tuple[int, int], np.ndarray] = {}  # of s2, for TRUNCATED alone
        self.rows, self.lanes = shape
        self.added = 0  # rows ever written

    def add(self, s: np.ndarray, a: np.ndarray, r: np.ndarray, s2: list, end: list) -> None:
        """Write one transition a lane (line 11): s, s2 (L, 4, 84, 84), a, r, end (L,)."""
        row = self.added % self.rows
        self.frames[row], self.actions[row] = s[:, -1], a
        self.rewards[row], self.ends[row] = r, end
        for lane in range(self.lanes):
            self.last_frames.pop((row, lane), None)
            if end[lane] == TRUNCATED:
                self.last_frames[row, lane] = s2[lane][-1].copy()
        self.added += 1

    def sample(self, size: int, n: int, gamma: float, rng: Generator) -> Batch:
        """Draw transitions uniformly (line 12) from all but the oldest three rows, which may have
        lost the frames before them, and the newest n, which wait for the rewards after them."""
        oldest = max(self.added - self.rows, 0) + 3
        row = rng.integers(oldest, self.added - n, size) % self.rows  # (B,)
        lane = rng.integers(self.lanes, size=size)  # (B,)
        return self.window(row, lane, n, gamma)

    def window(self, row: np.ndarray, lane: np.ndarray, n: int, gamma: float) -> Batch:
        """The n-step transitions that start at row (B,), lane (B,)."""
        last, r, power = row, self.rewards[row, lane], np.ones(len(row), np.float32)  # (B,)
        for _ in range(n - 1):
            live = self.ends[last, lane] == LIVE  # (B,)
            last = np.where(live, (last + 1) % self.rows, last)
            power = np.where(live, power * np.float32(gamma), power)
            r = r + live * power * self.rewards[last, lane]  # (B,)
        end = self.ends[last, lane]  # (B,)
        s2 = self.stack(np.where(end == LIVE, (last + 1) % self.rows, last), lane)  # (B, 4, 84, 84)
        for i in np.flatnonzero(end == TRUNCATED):
            s2[i] = [*s2[i, 1:], self.last_frames[last[i], lane[i]]]
        a = self.actions[row, lane].astype(np.int64)  # (B,)
        return Batch(self.stack(row, lane), a, r, s2, power * np.float32(gamma), end)

    def stack(self, row: np.ndarray, lane: np.ndarray) -> np.ndarray:
        """The states (B, 4, 84, 84) at row (B,), lane (B,); an episode's first frame repeats."""
        rows = [row]
        for _ in range(3):
            before = (rows[0] - 1) % self.rows  # (B,)
            rows.insert(0, np.where(self.ends[before, lane] == LIVE, before, rows[0]))
        return self.frames[np.stack(rows, 1), lane[:, None]]


def mirror(batch: Batch, flip: np.ndarray, actions: int) -> Batch:
    """Reflect the chosen transitions, flip (B,) bool: frames left to right, a -> actions - 1 - a.

    Flight, reward and camera are symmetric, so the reflection is another true transition for free;
    only the forest's grid is not quite, being 0.5 m off centre.
    """
    for frames in (batch.s, batch.s2):
        frames[flip] = frames[flip, ..., ::-1]
    batch.a[flip] = actions - 1 - batch.a[flip]
    return batch


def td_target(
    r: Tensor, discount: Tensor, end: Tensor, choose: Tensor, value: Tensor, worth: dict[int, float]
) -> Tensor:
    """The Bellman target y (B,) of line 13: r + gamma * max_a Q^(s2, a), until the episode ends.

    r, discount, end (B,). choose and value (B, actions) are action values at s2: those that choose
    a2 and those that say what it is worth. DQN takes both from Q^; Double DQN lets Q choose, for
    the maximum of noisy values flatters them [van Hasselt 2016]. worth says what each kind of
    terminal state counts for; only those stop the bootstrap, for a time limit ends nothing.
    """
    a2 = choose.argmax(1, keepdim=True)  # (B, 1)
    v2 = value.gather(1, a2)[:, 0]  # (B,)
    for terminal, v in worth.items():
        v2 = torch.where(end == terminal, v, v2)
    return r + discount * v2


def linear_schedule(step: int, first: float, final: float, steps: int) -> float:
    """The schedule of epsilon and the learning rate: from first to final in steps, then constant.

    >>> [linear_schedule(t, 1.0, 0.1, 100) for t in (0, 50, 100, 1000)]
    [1.0, 0.55, 0.1, 0.1]
    """
    return final + (first - final) * max(1 - step / steps, 0)


class DQN(nn.Module):
    """Q, Q^ and the optimiser. settings: the learner's fields of deepflight.Config."""

    def __init__(self, settings: Any, actions: int, seed: int) -> None:
        super().__init__()
        self.settings, self.actions, self.updates = settings, actions, 0
        # Channels last in memory spares float32 a fifth of its time, and bfloat16 nothing.
        layout = torch.channels_last if settings.precision == "float32" else torch.contiguous_format
        with torch.random.fork_rng():  # torch draws initial weights from its global generator:
            torch.manual_seed(seed % 2**64)  # lend it our seed and put its own state back
            self.q = QNetwork(actions).to(settings.device, memory_format=layout)  # line 2
            self.q_target = QNetwork(actions).to(settings.device, memory_format=layout)
        self.q_target.load_state_dict(self.q.state_dict())  # line 3
        self.optimizer = make_optimizer(self.q.parameters(), settings)
        self.worth = {DEAD: 0.0, GOAL: settings.goal_value, FAR: settings.far_value}

    def learn(self, memory: Replay, lr: float, delta: float, share: float, rng: Generator) -> None:
        """One gradient step on a batch from memory (lines 12 to 15).

        delta: of Huber's loss, a parabola up to there and straight beyond. 1 is Mnih's clipping of
        errors; it is quick, but where values are in the hundreds it learns the median of what may
        come, and a rare crash does not move a median. A large delta learns the mean.
        share: 1 resets Q^ = Q every C steps; less moves Q^ that share of the way to Q now. About
        1/k in the k-th update makes Q^ a running mean, which lies still where Q does not.
        """
        c = self.settings
        batch = memory.sample(c.batch, c.n, c.gamma, rng)  # line 12
        batch = mirror(batch, rng.random(c.batch) < c.mirror / 2, self.actions)
        # In the shapes of Batch:
        s, a, r, s2, discount, end = (torch.from_numpy(x).to(c.device) for x in batch)
        fast = c.precision == "bfloat16"
        with torch.no_grad():
            value = self.q_target(s2, fast)  # (B, actions)
            choose = self.q(s2, fast) if c.double else value  # (B, actions)
            y = td_target(r, discount, end, choose, value, self.worth)  # (B,) line 13
        q = self.q(s, fast).gather(1, a[:, None])[:, 0]  # (B,)
        # Huber's loss over delta (line 14), so that no error pulls harder than 1.
        loss = nn.functional.smooth_l1_loss(q, y, beta=delta)
        self.optimizer.param_groups[0]["lr"] = lr
        self.optimizer.zero_grad()
        loss.backward()
        if c.max_grad_norm:
            nn.utils.clip_grad_norm_(self.q.parameters(), c.max_grad_norm)
        self.optimizer.step()
        self.updates += 1
        if share < 1 or self.updates % c.target_every == 0:
            for old, new in zip(self.q_target.parameters(), self.q.parameters(), strict=True):
                old.data.lerp_(new.data, share)  # line 15


def make_optimizer(theta: Any, c: Any) -> torch.optim.Optimizer:
    """Adam, or [Mnih15]'s RMSProp with alpha 0.95, for the weights theta."""
    if c.optimizer == "adam":
        return torch.optim.Adam(theta, c.lr, eps=c.optimizer_eps, fused=True)
    return torch.optim.RMSprop(theta, c.lr, 0.95, c.optimizer_eps, momentum=0.95, centered=True)


# -------------------------------------------------- files that are whole, or not there


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that the old one or the new one is there, whole, whenever the power fails."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if part.read_bytes() != data:
            raise OSError(f"{part} does not read as it was written")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def save(path: Path, kind: str, content: dict) -> None:
    """Write tensors and plain values with torch.save, and behind them their SHA-256."""
    buffer = io.BytesIO()
    torch.save({"kind": kind} | content, buffer)
    write_whole(path, buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())


def load(path: Path, kind: str) -> dict:
    """Read what save wrote, or raise ValueError; no code from the file is ever run.

    The digest comes first, for torch.load takes flipped bits for numbers; PK begins every archive
    of torch.save.
    """
    try:
        data = path.read_bytes()
        if data[:2] != b"PK" or hashlib.sha256(data[:-32]).digest() != data[-32:]:
            raise ValueError(f"{path} is damaged, or no file of Deep Flight: its digest is wrong")
        content = torch.load(io.BytesIO(data[:-32]), weights_only=True)
        if content["kind"] != kind:
            raise ValueError(f"{path} holds {content['kind']}, needed: {kind}")
        return content
    except (OSError, EOFError, LookupError, RuntimeError, TypeError, UnpicklingError) as error:
        raise ValueError(f"{path} cannot be read: {error}".partition("\n")[0]) from None
