"""dqn.py: all of DQN.

HEADER
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

# How a transition ended: not at all, by the clock alone, or in the world itself (see env.py).
LIVE, TRUNCATED, TERMINAL = range(3)
# [+bfloat16] Convolutions are quicker in it where the processor has it natively.
BFLOAT16 = bool(torch.cpu.get_capabilities().get("avx512_bf16"))


class InputError(ValueError):
    """Something that whoever started the program can mend."""


def setting(default: Any, text: str, *legal: Any) -> Any:
    """A field of a configuration: its default, what it is, and its least and greatest value."""
    return field(default=default, metadata={"help": text, "legal": legal})


@dataclass(frozen=True)
class DQNConfig:
    """The hyperparameters. [+] is not in the textbook; its text says what switches it off."""

    steps: int = setting(200_000, "control steps in all", 1, 10**9)
    gamma: float = setting(0.99, "discount of a step [DF II-A]", 0, 1)
    replay_size: int = setting(200_000, "transitions kept, 7.1 kB each", 1, 10**7)
    learning_starts: int = setting(5_000, "control steps before the first update", 1, 10**9)
    update_every: int = setting(4, "control steps per update [Mnih15]", 1, 10**4)
    batch_size: int = setting(32, "transitions per update [Mnih15]", 1, 10**4)
    target_every: int = setting(2_000, "control steps per target network sync", 1, 10**9)
    epsilon_final: float = setting(0.05, "share of random actions in the end; at first 1", 0, 1)
    epsilon_decay: int = setting(40_000, "control steps until epsilon_final", 1, 10**9)
    lr: float = setting(2.5e-4, "learning rate of Adam [Mnih15: of RMSprop]", 0, 1)
    num_envs: int = setting(8, "[+] environments side by side; 1: off", 1, 1000)
    double: bool = setting(True, "[+] Double DQN [van Hasselt 2016]; --no-double: off", 0, 1)
    n_steps: int = setting(5, "[+] true rewards in a target; 1: off", 1, 100)
    mirror: bool = setting(True, "[+] reflect half of every batch; --no-mirror: off", 0, 1)
    huber_delta: float = setting(10.0, "[+] larger errors pull no harder; 1: Mnih's", 1e-3, 1e6)
    lr_decay: float = setting(0.1, "[+] share of lr left in the end; 1: off", 0, 1)
    swa_fraction: float = setting(0.1, "[+] last share of steps, averaged to fly; 0: off", 0, 0.5)

    def __post_init__(self) -> None:
        for f in fields(self):
            legal, value = f.metadata["legal"], getattr(self, f.name)
            if f.type is not str and not legal[0] <= value <= legal[1]:
                raise InputError(f"{f.name} is {value}, allowed are {legal[0]:,g} to {legal[1]:,g}")
        # The least to draw from: three rows that complete a stack, n_steps that wait for rewards.
        least = self.num_envs * (self.n_steps + 4)
        if min(self.replay_size, self.learning_starts) < least:
            raise InputError(f"replay_size and learning_starts must be {least} or more")


class QNetwork(nn.Module):
    """The network of [Mnih15, Methods].

    observation (4, 84, 84) -> conv 32 8x8/4 -> conv 64 4x4/2 -> conv 64 3x3/1 -> 512 -> Q(s, .) (A,)
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

        [+bfloat16] The convolutions may use numbers of half as many bits. The last layers stay
        float32, because values near 100 are common here, where bfloat16 has steps of 0.5.
        """
        grey = s.to(torch.bfloat16 if bfloat16 else torch.float32).div_(255)  # (B, 4, 84, 84) 0..1
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            features = self.conv(grey)  # (B, 3136)
        return self.head(features.float())  # (B, A)


@torch.no_grad()
def greedy(q: QNetwork, s: ndarray) -> ndarray:
    """The actions (B,) of greatest value for the observations s (B, 4, 84, 84) uint8."""
    return q(torch.from_numpy(s)).argmax(1).numpy()


class Batch(NamedTuple):
    """B transitions drawn from the replay."""

    s: Tensor  # (B, 4, 84, 84) uint8
    a: Tensor  # (B,) int64
    r: Tensor  # (B,) float32, the discounted sum of n rewards
    s2: Tensor  # (B, 4, 84, 84) uint8, meaningless after TERMINAL
    gamma_n: Tensor  # (B,) float32, gamma to the number of rewards in r
    end: Tensor  # (B,) uint8


class Replay:
    """The last transitions of `num_envs` environments side by side (line 1)."""

    def __init__(self, capacity: int, num_envs: int) -> None:
        self.rows, self.num_envs = capacity // num_envs, num_envs  # T, L
        self.frames = np.empty((self.rows, num_envs, 84, 84), np.uint8)  # (T, L, 84, 84)
        self.actions = np.zeros((self.rows, num_envs), np.int64)  # (T, L)
        self.rewards = np.zeros((self.rows, num_envs), np.float32)  # (T, L)
        self.ends = np.zeros((self.rows, num_envs), np.uint8)  # (T, L)
        self.last_frames: dict[tuple[int, int], ndarray] = {}  # (row, env) -> (84, 84)
        self.added = 0  # rows ever written

    def add(
        self, s: ndarray, a: ndarray, r: ndarray, s2: ndarray,
        terminated: ndarray, truncated: ndarray,
    ) -> None:  # fmt: skip
        """Write one transition per environment (line 11): s, s2 (L, 4, 84, 84), all others (L,)."""
        row = self.added % self.rows
        self.frames[row], self.actions[row], self.rewards[row] = s[:, -1], a, r
        self.ends[row] = np.where(terminated, TERMINAL, np.where(truncated, TRUNCATED, LIVE))
        for env in range(self.num_envs):
            self.last_frames.pop((row, env), None)
            if truncated[env]:
                self.last_frames[row, env] = s2[env, -1].copy()
        self.added += 1

    def sample(self, size: int, n: int, gamma: float, rng: Generator) -> Batch:
        """Draw transitions uniformly (line 12).

        Not the oldest three rows, because the rows that complete their stacks are overwritten. Not
        the newest n rows, because their rewards and s2 are yet to come.
        """
        oldest = max(self.added - self.rows, 0) + 3
        row = rng.integers(oldest, self.added - n, size) % self.rows  # (B,)
        env = rng.integers(self.num_envs, size=size)  # (B,)
        return self.window(row, env, n, gamma)

    def window(self, row: ndarray, env: ndarray, n: int, gamma: float) -> Batch:
        """The transitions that start at row (B,), env (B,), each over n steps or to the episode's end."""
        rows, envs = (row[:, None] + np.arange(n)) % self.rows, env[:, None]  # (B, n), (B, 1)
        live = self.ends[rows, envs] == LIVE  # (B, n)
        reached = np.ones((len(row), n), np.float32)  # (B, n) 1 until the episode has ended, then 0
        reached[:, 1:] = np.cumprod(live[:, :-1], 1)
        discounts = np.float32(gamma) ** np.arange(n, dtype=np.float32)  # (n,)
        r = (reached * discounts * self.rewards[rows, envs]).sum(1)  # (B,)
        count = reached.sum(1).astype(int)  # (B,) rewards in r
        last = (row + count - 1) % self.rows  # (B,)
        end = self.ends[last, env]  # (B,)
        # s2 is the observation of the row after the last one, if the episode goes on there.
        s2 = self.stack(np.where(end == LIVE, (last + 1) % self.rows, last), env)  # (B, 4, 84, 84)
        for i in np.flatnonzero(end == TRUNCATED):
            s2[i] = [*s2[i, 1:], self.last_frames[last[i], env[i]]]
        s, a = self.stack(row, env), self.actions[row, env]  # (B, 4, 84, 84), (B,)
        gamma_n = np.float32(gamma) ** count.astype(np.float32)  # (B,)
        return Batch(*map(torch.from_numpy, (s, a, r, s2, gamma_n, end)))

    def stack(self, row: ndarray, env: ndarray) -> ndarray:
        """The observations (B, 4, 84, 84) at row (B,), env (B,); an episode's first frame repeats."""
        rows = [row]
        for _ in range(3):
            before = (rows[0] - 1) % self.rows  # (B,)
            same_episode = self.ends[before, env] == LIVE  # (B,)
            rows.insert(0, np.where(same_episode, before, rows[0]))
        return self.frames[np.stack(rows, 1), env[:, None]]  # (B, 4, 84, 84)


def mirror(b: Batch, actions: int, rng: Generator) -> Batch:
    """[+mirror] Reflect half of the transitions: frames left to right, a -> A - 1 - a."""
    flip = rng.random(len(b.a)) < 0.5  # (B,)
    for frames in (b.s.numpy(), b.s2.numpy()):  # the same memory, seen as an array
        frames[flip] = frames[flip, ..., ::-1]
    b.a[flip] = actions - 1 - b.a[flip]
    return b


def td_target(b: Batch, q2: Tensor, q2_online: Tensor) -> Tensor:
    """The TD target y (B,) of line 13: r + gamma * max_a2 Q^(s2, a2), or r where the world ended."""
    a2 = q2_online.argmax(1, keepdim=True)  # (B, 1)
    v2 = q2.gather(1, a2)[:, 0]  # (B,) the q2 of a2; if q2_online is q2, the max
    return b.r + b.gamma_n * torch.where(b.end == TERMINAL, 0.0, v2)


class Agent(nn.Module):
    """What learning changes: Q, the target network Q^, the optimizer, and the mean of Q's weights."""

    def __init__(self, c: DQNConfig, actions: int, rng: Generator) -> None:
        super().__init__()
        with torch.random.fork_rng():  # torch draws the first weights from a generator of its own
            torch.manual_seed(int(rng.integers(2**63)))
            self.q = QNetwork(actions).to(memory_format=torch.channels_last)  # 2
        self.q_target = copy.deepcopy(self.q)  # 3
        self.mean = AveragedModel(self.q)  # [+swa_fraction]
        eps = 1.5e-4 * c.huber_delta
        self.optimizer = torch.optim.Adam(self.q.parameters(), c.lr, eps=eps, fused=True)
        self.epsilon, self.loss = 1.0, 0.0


def learn(agent: Agent, b: Batch, c: DQNConfig) -> None:
    """Lines 13 and 14: move the weights once."""
    with torch.no_grad():
        q2 = agent.q_target(b.s2, BFLOAT16)  # (B, A)
        q2_online = agent.q(b.s2, BFLOAT16) if c.double else q2  # (B, A) [+double]
        y = td_target(b, q2, q2_online)  # 13 (B,)
    q_sa = agent.q(b.s, BFLOAT16).gather(1, b.a[:, None])[:, 0]  # (B,)
    loss = nn.functional.huber_loss(q_sa, y, delta=c.huber_delta)  # 14 [+huber_delta]
    agent.optimizer.zero_grad()
    loss.backward()
    agent.optimizer.step()
    agent.loss = loss.item()


def linear_schedule(step: int, first: float, final: float, steps: int) -> float:
    """From first to final in so many steps, then constant.

    >>> [linear_schedule(t, 1.0, 0.1, 100) for t in (0, 50, 100, 1000)]
    [1.0, 0.55, 0.1, 0.1]
    """
    return final + (first - final) * max(1 - step / steps, 0)


def due(every: int, step: int, num_envs: int) -> int:
    """How often something is due in a pass of all environments that is due every so many steps.

    >>> due(4, 16, 8), due(2_000, 16, 8)  # this pass made steps 9 to 16: 12 and 16 are due
    (2, 0)
    """
    return step // every - (step - num_envs) // every


def train(c: DQNConfig, envs: Any, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1 of [Mnih15]."""
    replay = Replay(c.replay_size, c.num_envs)  # 1
    agent = Agent(c, envs.num_actions, rng)  # 2, 3
    yield agent, replay
    for step in range(envs.steps + c.num_envs, c.steps + c.num_envs, c.num_envs):  # 4
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_decay, c.steps)  # [+lr_decay]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 5, 6 (L, 4, 84, 84)
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        a = np.where(
            explore, rng.integers(envs.num_actions, size=c.num_envs), greedy(agent.q, s)
        )  # 8
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        replay.add(s, a, shaped(r, drones), s2, terminated, truncated)  # 11
        for _ in range(due(c.update_every, step, c.num_envs) if step >= c.learning_starts else 0):
            batch = replay.sample(c.batch_size, c.n_steps, c.gamma, rng)  # 12
            learn(agent, mirror(batch, envs.num_actions, rng) if c.mirror else batch, c)  # 13, 14
            if step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.mean.update_parameters(agent.q)
        if due(c.target_every, step, c.num_envs):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15
        yield agent, replay
