"""dqn.py: the brain. Deep Q-learning [Mnih15], which knows no forest, from the first word on.

The words, for this drone:
  state s       what the drone knows: its last four pictures
  action a      one of nine yaw rates, chosen ten times a second
  reward r      one number a step, good or bad (env.py has the table)
  transition    one step of experience: state s, action a, reward r, next state s2
  return        the sum of the rewards to come. A reward k steps away counts gamma^k times as much
  discount      gamma = 0.99. Three rewards 1, 1, -10 and then the end: the return is
                1 + 0.99 * 1 + 0.99^2 * -10 = 1 + 0.99 - 9.80 = -7.81

Q(s, a) is the expected return of a flight that is in state s, takes action a, and takes the best
actions from then on. "Expected" means the average over all that the drone cannot know, such as the
trunks behind the next one. Who knows Q can fly: take the action whose Q is greatest. So a network
learns Q. Four pictures go in. Nine numbers come out, one for each action.

A network learns from pairs of an input and a label. Nobody has the labels, but every transition
makes one. The return from s is r plus gamma times the return from s2, so the label of Q(s, a) is

    y = r + gamma * max over a2 of Q(s2, a2)        (at the end of a flight: y = r)

In numbers: r = 0.5, and the best of the nine values of Q(s2, .) is 10. Then y is 0.5 + 0.99 * 10 =
10.4. If the network says Q(s, a) = 8, it is wrong by 2.4, and one gradient step moves it a little
towards 10.4. Such a label is called a TD target; the equation is Bellman's.

How can a network learn from labels that it makes itself? Because each label holds one true reward.
Where a flight ends, the whole label is true: -10 for a crash. Once that is learnt, the state one
step earlier gets a better label, then the state two steps earlier, and so on: the truth moves
backwards through the flight. Three things can go wrong, and DQN has an answer to each:

  * Pictures that follow each other look alike. A network that learns from them in that order
    forgets the rest. So the drone keeps its transitions in a **replay** memory, and each update
    learns from a few of them, drawn at random.
  * Each update moves the labels too, and the network may chase its own tail. So the labels come
    from a **target network** Q^, a copy of Q that is renewed only now and then.
  * A drone that always does what seems best never finds out what is better. So it **explores**:
    with probability epsilon it takes a random action, at first always, later rarely.

Algorithm 1 of [Mnih15], "Human-level control through deep reinforcement learning", Nature 518. The
code carries these numbers; `train` in deepflight.py has all of them, in order, on one screen.

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

A mark like [+double] means: not in the textbook. The name is the setting that switches it off.

Legend
    s, a      state and action
    r         reward; in a batch the discounted sum of the next n_steps rewards [+n_steps]
    s2        the state after r
    gamma     the discount of one step
    discount  that of s2: gamma to the number of rewards in r
    end       LIVE, TRUNCATED or TERMINAL
    y         the label, or TD target
    Q, Q^     the network that learns, and the target network
    B         transitions in a batch
    A         actions
    L         drones that fly side by side, one lane of the replay each
    T         rows of the replay

Not in this file: prioritized replay, distributional values, noisy layers.
"""

import hashlib
import io
import os
import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

# How a transition ended: not at all; by a time limit, so that the world would have gone on; or in
# the world itself, so that no reward can follow.
LIVE, TRUNCATED, TERMINAL = range(3)


def setting(value: Any, text: str, low: float, high: float = np.inf) -> Any:
    """One field of the settings: its default, a text with unit and source, and what is allowed."""
    return field(
        default=value, metadata={"help": f"{text} (default: {value})", "legal": (low, high)}
    )


@dataclass(frozen=True)
class DQNConfig:
    """The algorithm's settings. [+] is not in the textbook; its text says what switches it off."""

    steps: int = setting(300_000, "control steps in all", 1)
    gamma: float = setting(0.99, "discount of a step [DF II-A]", 0, 1)
    replay_size: int = setting(200_000, "transitions remembered, 7.1 kB each", 1)
    learning_starts: int = setting(5_000, "control steps before the first update", 1)
    update_every: int = setting(4, "control steps an update [Mnih15]", 1)
    batch_size: int = setting(32, "transitions an update [Mnih15]", 1, 10_000)
    target_every: int = setting(500, "updates between copies of Q to the target network", 1)
    epsilon_final: float = setting(0.05, "share of random actions in the end, at first 1", 0, 1)
    epsilon_decay: int = setting(40_000, "control steps until then", 1)
    lr: float = setting(2.5e-4, "learning rate [Mnih15]", 0, 1)
    adam: bool = setting(True, "[+] Adam; --no-adam: RMSprop", 0, 1)
    num_envs: int = setting(8, "[+] drones that fly side by side; 1: off", 1, 1000)
    double: bool = setting(True, "[+] Double DQN [van Hasselt 2016]; --no-double: off", 0, 1)
    n_steps: int = setting(5, "[+] rewards in a label before the bootstrap; 1: off", 1, 100)
    mirror: bool = setting(True, "[+] reflect half of every batch; --no-mirror: off", 0, 1)
    huber: float = setting(100.0, "[+] larger errors pull no harder; 1: Mnih's", 1e-3, 1e6)
    huber_after: int = setting(100_000, "[+] control steps with Mnih's 1 before that", 0)
    lr_decay: float = setting(0.1, "[+] share of lr left in the end; 1: off", 0, 1)
    max_grad_norm: float = setting(10.0, "[+] longer gradients are cut to this; 0: off", 0)
    average: float = setting(0.1, "[+] last share of the steps: the mean of Q flies; 0: off", 0, 1)
    bfloat16: bool = setting(True, "[+] quick convolutions if the CPU has it; --no-bfloat16", 0, 1)


# -------------------------------------------------- plain DQN


class QNetwork(nn.Module):
    """The Nature network [Mnih15, Methods]. Its output is linear, because values may be negative.

    frames (4, 84, 84) -> conv 32 8x8/4 -> conv 64 4x4/2 -> conv 64 3x3/1 -> 512 -> Q(s, .) (A,)
    """

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
        """Q(s, .) (B, A) float32 of s (B, 4, 84, 84) uint8.

        [+bfloat16] Half as many bits make the convolutions quicker. The last layers stay float32:
        between 64 and 128 bfloat16 moves in steps of 0.5, and the actions would tie.
        """
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            seen = self.conv(s.float() / 255)  # (B, 3136)
        return self.head(seen.float())  # (B, A)


@torch.no_grad()
def greedy(q: QNetwork, s: ndarray) -> ndarray:
    """The actions (B,) of greatest value in the states s (B, 4, 84, 84) uint8 (line 8)."""
    return q(torch.from_numpy(s)).argmax(1).numpy()


def td_target(r: Tensor, discount: Tensor, end: Tensor, q2: Tensor, q2_online: Tensor) -> Tensor:
    """The label y (B,) of line 13: r + gamma * max_a2 Q^(s2, a2), or r where the world ended.

    r, discount, end (B,). q2 (B, A): Q^(s2, .). q2_online (B, A): the values that choose a2.
    The textbook lets Q^ choose, so both are Q^. Only TERMINAL stops the sum: a time limit ends the
    flight, but not the world.
    """
    a2 = q2_online.argmax(1, keepdim=True)  # (B, 1)
    v2 = q2.gather(1, a2)[:, 0]  # (B,)
    return r + discount * torch.where(end == TERMINAL, 0.0, v2)


class Batch(NamedTuple):
    """B transitions drawn from the replay."""

    s: ndarray  # (B, 4, 84, 84) uint8
    a: ndarray  # (B,) int64
    r: ndarray  # (B,) float32
    s2: ndarray  # (B, 4, 84, 84) uint8, meaningless after TERMINAL
    discount: ndarray  # (B,) float32
    end: ndarray  # (B,) uint8


class Replay:
    """The last transitions of L environments that step together (line 1).

    Each picture is kept once, 7,056 bytes, and a state is put together from four of them when it is
    drawn. To keep s and s2 whole would cost eight times as much. Row t, lane l holds the newest
    picture of s_t in environment l, the action taken there, its reward and how it ended.

        lane 0   x x x|x x x x x x x x           | a flight's end: no stack and no
        lane 1   x x x x x x x|x x x x             n-step window reaches across it,
                             ^ write position      nor across the write position
    """

    def __init__(self, capacity: int, lanes: int) -> None:
        shape = (capacity // lanes, lanes)
        self.frames = np.empty((*shape, 84, 84), np.uint8)  # (T, L, 84, 84)
        self.actions = np.zeros(shape, np.uint8)  # (T, L)
        self.rewards = np.zeros(shape, np.float32)  # (T, L)
        self.ends = np.zeros(shape, np.uint8)  # (T, L)
        self.last_frames: dict[tuple[int, int], ndarray] = {}  # of s2, for TRUNCATED alone
        self.rows, self.lanes = shape
        self.added = 0  # rows ever written

    def add(self, s: ndarray, a: ndarray, r: ndarray, s2: ndarray, end: ndarray) -> None:
        """Write one transition a lane (line 11): s, s2 (L, 4, 84, 84), a, r, end (L,)."""
        row = self.added % self.rows
        self.frames[row], self.actions[row] = s[:, -1], a
        self.rewards[row], self.ends[row] = r, end
        for lane in range(self.lanes):
            self.last_frames.pop((row, lane), None)
            if end[lane] == TRUNCATED:
                self.last_frames[row, lane] = s2[lane, -1].copy()
        self.added += 1

    def sample(self, size: int, n: int, gamma: float, rng: Generator) -> Batch:
        """Draw transitions uniformly (line 12) from all but the oldest three rows, which may have
        lost the pictures before them, and the newest n, which wait for the rewards after them."""
        oldest = max(self.added - self.rows, 0) + 3
        row = rng.integers(oldest, self.added - n, size) % self.rows  # (B,)
        lane = rng.integers(self.lanes, size=size)  # (B,)
        return self.window(row, lane, n, gamma)

    def window(self, row: ndarray, lane: ndarray, n: int, gamma: float) -> Batch:
        """The transitions that start at row (B,), lane (B,), each over n steps.

        [+n_steps] The label of n steps is r_0 + gamma * r_1 + ... + gamma^n * max Q^(s_n, .). A
        crash is then felt n states earlier at once, and not one state an update.
        """
        last, r, power = row, self.rewards[row, lane], np.ones(len(row), np.float32)  # (B,)
        for _ in range(n - 1):
            live = self.ends[last, lane] == LIVE  # (B,)
            last = np.where(live, (last + 1) % self.rows, last)  # (B,)
            power = np.where(live, power * np.float32(gamma), power)  # (B,)
            r = r + live * power * self.rewards[last, lane]  # (B,)
        end = self.ends[last, lane]  # (B,)
        s2 = self.stack(np.where(end == LIVE, (last + 1) % self.rows, last), lane)  # (B, 4, 84, 84)
        for i in np.flatnonzero(end == TRUNCATED):
            s2[i] = [*s2[i, 1:], self.last_frames[last[i], lane[i]]]
        a = self.actions[row, lane].astype(np.int64)  # (B,)
        return Batch(self.stack(row, lane), a, r, s2, power * np.float32(gamma), end)

    def stack(self, row: ndarray, lane: ndarray) -> ndarray:
        """The states (B, 4, 84, 84) at row (B,), lane (B,); a flight's first picture repeats."""
        rows = [row]
        for _ in range(3):
            before = (rows[0] - 1) % self.rows  # (B,)
            rows.insert(0, np.where(self.ends[before, lane] == LIVE, before, rows[0]))
        return self.frames[np.stack(rows, 1), lane[:, None]]


# -------------------------------------------------- what is not in the textbook


def mirror(batch: Batch, actions: int, rng: Generator) -> Batch:
    """[+mirror] Reflect half of the transitions: pictures left to right, a -> A - 1 - a.

    Flight, reward and camera are symmetric, so the reflection is another true transition for free.
    Only the forest's grid is not quite: it stands 0.5 m off centre.
    """
    flip = rng.random(len(batch.a)) < 0.5  # (B,)
    for frames in (batch.s, batch.s2):
        frames[flip] = frames[flip, ..., ::-1]
    batch.a[flip] = actions - 1 - batch.a[flip]
    return batch


def linear_schedule(step: int, first: float, final: float, steps: int) -> float:
    """The schedule of epsilon and the learning rate: from first to final in steps, then constant.

    >>> [linear_schedule(t, 1.0, 0.1, 100) for t in (0, 50, 100, 1000)]
    [1.0, 0.55, 0.1, 0.1]
    """
    return final + (first - final) * max(1 - step / steps, 0)


class Agent(nn.Module):
    """All that learning changes: Q, Q^, the optimizer, and the mean of Q's last weights."""

    def __init__(self, c: DQNConfig, actions: int, seed: int) -> None:
        super().__init__()
        self.updates, self.loss, self.bfloat16 = 0, torch.zeros(()), c.bfloat16 and HAS_BFLOAT16
        layout = torch.channels_last  # in memory: it spares float32 a fifth of its time
        with torch.random.fork_rng():  # torch draws initial weights from its global generator:
            torch.manual_seed(seed % 2**64)  # lend it our seed and put its own state back
            self.q = QNetwork(actions).to(memory_format=layout)  # line 2
            self.q_target = QNetwork(actions).to(memory_format=layout)
        self.q_target.load_state_dict(self.q.state_dict())  # line 3
        self.mean = AveragedModel(self.q)
        self.optimizer = make_optimizer(self.q.parameters(), c)

    def get_extra_state(self) -> dict[str, Any]:
        """What state_dict holds besides weights."""
        return {"optimizer": self.optimizer.state_dict(), "updates": self.updates}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take it up again."""
        self.optimizer.load_state_dict(state["optimizer"])
        self.updates = state["updates"]


def make_optimizer(theta: Any, c: DQNConfig) -> torch.optim.Optimizer:
    """[+adam] Adam, or an RMSprop after [Mnih15], for the weights theta."""
    if c.adam:
        return torch.optim.Adam(theta, c.lr, eps=1.5e-4, fused=True)
    return torch.optim.RMSprop(theta, c.lr, 0.95, 0.01, momentum=0.95, centered=True)


# Where the processor has no bfloat16 of its own, float32 is quicker.
HAS_BFLOAT16 = bool(torch.cpu.get_capabilities().get("avx512_bf16"))
MACHINE = {"torch": str(torch.__version__), "bfloat16": HAS_BFLOAT16}  # on another, other bytes


# -------------------------------------------------- files that are whole, or not there: skip this


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that the old one or the new one is there, whole, whenever the power fails."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
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

    The digest comes first, because torch.load takes flipped bits for numbers. PK begins every
    archive of torch.save.
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


def save_weights(path: Path, q: QNetwork, **world: Any) -> None:
    """Write a network in half precision, 3.4 MB, and what world it was trained in."""
    half = {name: value.half() for name, value in q.state_dict().items()}
    if not all(value.isfinite().all() for value in half.values()):
        raise FloatingPointError(f"{path} is not written: some weights are no finite numbers")
    save(path, "weights", {"network": half} | world)


def load_weights(path: Path, actions: int, **world: Any) -> QNetwork:
    """Read what save_weights wrote, in that same world. Raises ValueError."""
    saved, q = load(path, "weights"), QNetwork(actions)
    shapes = [{k: tuple(v.shape) for k, v in x.items()} for x in (saved["network"], q.state_dict())]
    if shapes[0] != shapes[1]:
        raise ValueError(f"{path} holds another network: {shapes[0]}, needed: {shapes[1]}")
    if other := {key: saved[key] for key in world if saved[key] != world[key]}:
        raise ValueError(f"{path} was trained with {other}, here is {world}")
    q.load_state_dict(saved["network"])
    return q


def lock_folder(folder: Path) -> sqlite3.Connection:
    """Keep a second process out as long as what this returns is held, however it is let go.

    SQLite's lock is the one in the standard library that works everywhere and dies with its owner.
    """
    try:
        lock = sqlite3.connect(folder / "lock", timeout=0, isolation_level=None)
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        raise ValueError(f"{folder} is another training's, or cannot be held: {error}") from None
    return lock
