"""dqn.py: the brain. Deep Q-learning (DQN), the algorithm of [Mnih15].

The words, for this drone
    state s       what the drone knows: its last four pictures. One shows where the trunks are, and
                  four show how they move
    action a      one of nine yaw rates, chosen ten times a second
    reward r      one number a step, good or bad
    transition    one step of experience: state s, action a, reward r, next state s2
    return        all rewards to come, added up; a reward k steps away counts gamma^k times. (Tables
                  and logs add up a flight's rewards without gamma.)
    gamma         the discount, 0.99. It makes soon worth more than late, and keeps the sum of
                  endless rewards finite. Three rewards 1, 1, -10 and then the end: the return is
                  1 + 0.99 * 1 + 0.99^2 * -10 = 1 + 0.99 - 9.80 = -7.81

Q(s, a) is the expected return of a drone that takes action a in state s, and the best action in
every later state. "Expected" means the average over all that the drone cannot know, such as the
trunks behind the next one. A drone that knows Q can fly: it takes the action whose Q is greatest.
(`train` learns Q, as this file says. `train --teacher`, which made the shipped pilot, copies a
planner. It uses the network and the replay below, and none of the labels.)

A neural network learns Q. It is a function with 1.7 million adjustable numbers, its weights. Four
pictures go in. Nine numbers come out, one for each action. It learns from examples, each an input
with a label: the number that should have come out. Nobody has the labels. But the return from s is
r plus gamma times the return from s2, and the drone that takes the best action in s2 may expect the
greatest Q of s2. So every transition makes a label y for Q(s, a):

    y = r + gamma * max over a2 of Q(s2, a2)
    y = r    if the world ended the flight: a crash, arrival, leaving the forest

In numbers: r = 0.5, and the greatest of the nine values Q(s2, .) is 10. Then y = 0.5 + 0.99 * 10 =
10.4. If Q(s, a) is 8, its error is 2.4. A gradient step changes every weight a little, in the
direction that makes the error smaller. With one weight w and one input x = 4, Q is w * x, and w = 2
makes it 8. Half the error's square is 2.88. If w grew by a little d, Q would grow by 4 * d, and
2.88 would fall by 2.4 * 4 * d = 9.6 * d: the gradient is -9.6. The step is the learning rate, say
0.01, times 9.6. Now w is 2.096, and Q is 8.38. The label is called the TD target (for temporal
difference), and the equation is Bellman's.

How can a network learn from labels that it makes itself? Each label holds one true reward, and
where a crash ends a flight the whole label is true. Take a flight of three steps with rewards 0.5,
0.5 and -10. To keep it small, let there be one action only, so that the max is its Q. Let all Q be
0 at first, and let every update go all the way to its label:

                  Q of step 1   step 2   step 3   (each row from the row above it)
    after update 1    0.5         0.5     -10     the crash is known
    after update 2    1.0        -9.4     -10     0.5 + 0.99 * -10 = -9.4
    after update 3   -8.8        -9.4     -10     0.5 + 0.99 * -9.4 = -8.8: all three are true

The truth moves backwards through the flight. Three things can go wrong. DQN has an answer to each:

  * Pictures that follow each other look alike. A network that learns from them in that order
    forgets the rest. So a **replay** memory keeps the transitions, and each update learns from a
    few of them, drawn at random.
  * Each update of Q moves the labels too, so the network chases its own tail. So the labels come
    from a **target network** Q^: a copy of Q that is renewed only now and then.
  * A drone that always does what seems best never finds out what is better. So it **explores**:
    with probability epsilon it takes a random action, at first always, later rarely.

Algorithm 1 of [Mnih15], "Human-level control through deep reinforcement learning", Nature 518. The
code carries these numbers. `train` in deepflight.py and what it calls have all of them.

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

In our words: an episode is a flight, the emulator is env.py, x is a picture, phi_t is the stack of
four pictures that we call s, and theta are the weights.

What is in the network? **Layers**, one after another. Each number that comes out of a layer is a
weighted sum of numbers that go in, plus a constant, its bias. With inputs 2 and -1, weights 3 and
4, and bias 1, that is 3 * 2 + 4 * -1 + 1 = 3. In a linear layer every output has a weight for each
input: 3,136 inputs and 512 outputs make 1.6 of our 1.7 million weights. Two such layers would be no
better than one, because a sum of sums is a sum. So between layers stands ReLU, which turns negative
numbers into 0. A convolution is a layer for pictures. Its outputs see only a small square each, and
all of them use the same few weights, called a filter. Let a filter of two pixels have the weights
-1 and 1, and let it slide along the row 5 5 9 9. Out come 0 4 0: it has found the edge. A filter of
8x8 pixels that moves on by 4 pixels at a time has (84 - 8) / 4 + 1 = 20 places in a row of 84.

PyTorch in short. The loss is one number that says how wrong a batch of outputs is, such as half
the mean of (y - Q)^2. Its gradient says for every weight which way the loss grows, and how fast.
    q(s)               calls QNetwork.forward; a tensor is an array that remembers how it was made,
                       so that the chain rule can lead back to every weight
    torch.no_grad()    do not remember; so a label is a constant, and only Q(s, a) is moved
    optimizer.zero_grad()   forget the last gradient
    loss.backward()    compute the gradient, and leave it with the weights
    optimizer.step()   move the weights a little against the gradient
    smooth_l1_loss(q, y, beta=10)   the mean over the batch. With e = q - y, it is e^2 / 20 up to an
                       error of 10, and abs(e) - 5 beyond: a square that goes on as a straight line
    values.gather(1, a[:, None])[:, 0]      in NumPy: values[arange(len(a)), a]
    nn.Module          a function that owns weights; state_dict() gives them all, by name
    nn.Sequential(f, g)     g(f(x))
    nn.Conv2d(4, 32, 8, 4)  a convolution: 4 pictures in, 32 out, 8x8 pixels, strides of 4
    nn.Linear(3136, 512)    a linear layer; nn.Flatten puts pictures into one row for it
    x.sqrt_()          a name with _ at its end changes x itself

A mark like [+double] means: not in the textbook. `double` is then a setting, and its text says how
to switch it off. ([+demos] is a flag of `train`, without which it is off.) One update in four steps
is Mnih's too, although Algorithm 1 has one a step. [Mnih15] limits line 14, and we count that as
textbook: up to an error of 1 the loss is half the error's square, and beyond it a straight line. So
a large error changes the weights no more than an error of 1. (Our limit is 10 [+huber].) [Mnih15]
also cuts rewards to [-1, 1]. We do not, because a crash would then count no more than being near a
trunk.

Legend
    s, a      state and action
    r         reward; in a batch the discounted sum of n_steps rewards [+n_steps]
    s2        the state after r
    gamma_n   the discount of s2: gamma to the number of rewards in r
    end       how a transition ended: LIVE, TRUNCATED or TERMINAL
    y         the label, or TD target
    Q, Q^     the network that learns, and the target network
    B         transitions in a batch
    A         actions
    L         drones that fly side by side; each has a lane of the replay
    T         rows of the replay

Not in this file: the forest, prioritized replay, distributional values, noisy layers.

Sources
    [Mnih15]             Human-level control through deep reinforcement learning, Nature 518
    [van Hasselt 2016]   Deep reinforcement learning with double Q-learning, AAAI
    [Hester 2018]        Deep Q-learning from demonstrations, AAAI
"""

import fcntl
import hashlib
import io
import os
import re
import secrets
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zipfile import ZipFile

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

# How a transition ended (env.py tells more):
# LIVE       not at all
# TRUNCATED  by the clock alone, so more rewards would have followed
# TERMINAL   in the world itself, so no more rewards can follow
LIVE, TRUNCATED, TERMINAL = range(3)


def setting(value: Any, text: str, low: Any, high: Any = 1e9) -> Any:
    """One field of the settings: its default, a text with unit and source, and what is allowed:
    from low to high, or one of two words."""
    return field(default=value, metadata={"help": text, "legal": (low, high)})


@dataclass(frozen=True)
class DQNConfig:
    """The algorithm's settings. [+] is not in the textbook; its text says what switches it off."""

    steps: int = setting(200_000, "control steps in all", 1)
    gamma: float = setting(0.99, "discount per step [DF II-A]", 0, 1)
    replay_size: int = setting(200_000, "transitions remembered, 7.1 kB each", 1, 1e7)
    learning_starts: int = setting(5_000, "control steps before the first update", 1)
    update_every: int = setting(4, "control steps per update [Mnih15]", 1)
    batch_size: int = setting(32, "transitions per update [Mnih15]", 1, 10_000)
    target_every: int = setting(500, "updates between copies of Q to the target network", 1)
    epsilon_final: float = setting(0.05, "share of random actions in the end; it starts at 1", 0, 1)
    epsilon_decay: int = setting(40_000, "control steps until epsilon is at its final value", 1)
    lr: float = setting(2.5e-4, "learning rate [Mnih15]", 0, 1)
    adam: bool = setting(True, "[+] Adam; --no-adam: Mnih's RMSprop", 0, 1)
    num_envs: int = setting(8, "[+] drones that fly side by side; 1: off", 1, 1000)
    double: bool = setting(True, "[+] Double DQN [van Hasselt 2016]; --no-double: off", 0, 1)
    n_steps: int = setting(5, "[+] true rewards in a label; 1: off", 1, 100)
    mirror: bool = setting(True, "[+] reflect half of every batch; --no-mirror: off", 0, 1)
    huber: float = setting(10.0, "[+] delta: larger errors pull no harder; 1: Mnih's", 1e-3, 1e6)
    lr_decay: float = setting(0.1, "[+] share of lr left in the end; 1: off", 0, 1)
    average: float = setting(0.1, "[+] last share of the steps, averaged to fly; 0: off", 0, 0.5)
    teacher: bool = setting(
        False, "[+] a planner says what actions are worth; off by default", 0, 1
    )
    bellman: bool = setting(True, "TD targets; --no-bellman: from the teacher alone", 0, 1)
    demo_updates: int = setting(2_000, "updates on --demos alone, before all others", 1)
    demo_share: float = setting(0.0, "share of --demos in every later batch; 0: none", 0, 1)
    margin: float = setting(5.0, "by which a demonstrated action must be the best", 0, 1e3)
    bfloat16: bool = setting(True, "[+] quick convolutions if the CPU has it; --no-bfloat16", 0, 1)


# -------------------------------------------------- DQN


class QNetwork(nn.Module):
    """The network of [Mnih15, Methods].

    pictures (4, 84, 84) -> conv 32 8x8/4 -> conv 64 4x4/2 -> conv 64 3x3/1 -> 512 -> Q(s, .) (A,)

    conv 32 8x8/4: 32 filters of 8x8 pixels, through all four pictures, slide over them in strides
    of 4. Each gives a large number where it finds its pattern. The last layer has no ReLU, because
    values may be negative.
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

        [+bfloat16] Numbers of half as many bits make the convolutions quicker. The last layers stay
        float32: values near 100 are common here, bfloat16 has only steps of 0.5 there, and actions
        would tie.
        """
        grey = s.to(torch.bfloat16 if bfloat16 else torch.float32).div_(255)  # (B, 4, 84, 84) 0..1
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            seen = self.conv(grey)  # (B, 3136)
        return self.head(seen.float())  # (B, A)


@torch.no_grad()
def greedy(q: QNetwork, s: ndarray) -> ndarray:
    """The actions (B,) of greatest value in the states s (B, 4, 84, 84) uint8 (line 8). A pilot
    that always takes these is called greedy."""
    return q(torch.from_numpy(s)).argmax(1).numpy()


def td_target(r: Tensor, gamma_n: Tensor, end: Tensor, q2: Tensor, q2_online: Tensor) -> Tensor:
    """The label y (B,) of line 13: r + gamma * max_a2 Q^(s2, a2), or r where the world ended.

    r, gamma_n, end (B,). Only TERMINAL stops the sum: a time limit ends the flight, but not the
    world. q2 (B, A): Q^(s2, .), which says what an action is worth. q2_online (B, A): the values by
    which a2 is chosen. With [+double] they are Q(s2, .); in the textbook they are q2 too.

    [+double] Let two actions both be worth 0 in truth, and let Q^ err by +1 and -1. A max picks
    whatever error points upwards: it is 1, too high. Let Q choose a2 instead. If its errors had
    nothing to do with those of Q^, it would hit +1 and -1 equally often: 0 on average, which is
    right. (They have something to do with each other, so it helps in part.)
    """
    a2 = q2_online.argmax(1, keepdim=True)  # (B, 1)
    v2 = q2.gather(1, a2)[:, 0]  # (B,) the q2 of a2; if q2_online is q2, the max
    return r + gamma_n * torch.where(end == TERMINAL, 0.0, v2)


def margin_loss(q: Tensor, a: Tensor, margin: float) -> Tensor:
    """[+demos] The large-margin loss of [Hester 2018], (B,). Somebody took action a (B,), so its Q
    should be the greatest, by the margin at least: 0 where it is, else by how much that is missed.
    q (B, A).

    >>> q = torch.tensor([[1.0, 9.0, 0.0]])
    >>> [margin_loss(q, torch.tensor([a]), 5.0).item() for a in (0, 1)]
    [13.0, 0.0]
    """
    others = 1 - nn.functional.one_hot(a, q.shape[1])  # (B, A)
    return (q + margin * others).amax(1) - q.gather(1, a[:, None])[:, 0]


def teacher_loss(q: Tensor, scores: Tensor) -> Tensor:
    """[+teacher] How far q (B, A) is from a teacher's scores (B, A), after each state's mean has
    been taken from both. So the teacher says by how much an action is better than another, and not
    how good the state is. An action that is 20 worse than the best or more counts as 20 worse.
    """
    scores = (scores - scores.amax(1, keepdim=True)).clamp(-20)  # (B, A) 0 for the best
    q, scores = (x - x.mean(1, keepdim=True) for x in (q, scores))  # (B, A), (B, A)
    return nn.functional.smooth_l1_loss(q, scores, beta=10.0)


def linear_schedule(step: int, first: float, final: float, steps: int) -> float:
    """The schedule of epsilon and the learning rate: from first to final in steps, then constant.

    >>> [linear_schedule(t, 1.0, 0.1, 100) for t in (0, 50, 100, 1000)]
    [1.0, 0.55, 0.1, 0.1]
    """
    return final + (first - final) * max(1 - step / steps, 0)


class Batch(NamedTuple):
    """B transitions drawn from the replay."""

    s: ndarray  # (B, 4, 84, 84) uint8
    a: ndarray  # (B,) int64
    r: ndarray  # (B,) float32
    s2: ndarray  # (B, 4, 84, 84) uint8, meaningless after TERMINAL
    gamma_n: ndarray  # (B,) float32
    end: ndarray  # (B,) uint8
    scores: ndarray  # (B, A) float32, what a teacher said; (B, 0) without one
    shown: ndarray  # (B,) bool, whether a was demonstrated


class Replay:
    """The last transitions of L drones that fly side by side (line 1).

    Each picture is kept once, 7,056 bytes, and a state is put together from four of them when it is
    drawn. To keep s and s2 whole would cost eight times as much. Row t, lane l holds the newest
    picture of s_t of drone l, the action taken there, its reward and how it ended. The rows are a
    ring: when the last one is written, the first is written again.

        lane 0   x x x|x x x x x x x x     |: a flight's end
        lane 1   x x x x x|x x x x x x     W: the row that is written next
                           W

    A state's four pictures and a label's n rewards never reach across a flight's end, nor across W.
    The s2 of a transition is the state of the next row. After a crash no s2 is needed. After the
    time limit it is needed and no row holds it, so `last_frames` keeps its newest picture. An
    example with one lane:

        row        0    1    2    3    4    5
        picture    A    B    C    D    E    F
        reward     1    1   -10   0    0    2      the flight of rows 0 to 2 ends in a crash

        stack of row 3: D D D D    of row 5: D D E F
        window of row 1, n = 2: r = 1 + gamma * -10, and it ends there
        window of row 3, n = 2: r = 0 + gamma * 0, and s2 is the stack of row 5
    """

    def __init__(self, capacity: int, lanes: int, told: int = 0, shown: bool = False) -> None:
        """told: how many numbers a teacher says of a state. shown: are these demonstrations?"""
        shape = (capacity // lanes, lanes)
        try:
            self.frames = np.empty((*shape, 84, 84), np.uint8)  # (T, L, 84, 84)
        except MemoryError:
            raise ValueError(f"replay_size is {capacity:,}: too many for this memory") from None
        self.actions = np.zeros(shape, np.uint8)  # (T, L)
        self.rewards = np.zeros(shape, np.float32)  # (T, L)
        self.ends = np.zeros(shape, np.uint8)  # (T, L)
        self.scores, self.shown = np.zeros((*shape, told), np.float32), shown  # (T, L, A or 0)
        self.last_frames: dict[tuple[int, int], ndarray] = {}  # (row, lane) -> (84, 84)
        self.rows, self.lanes = shape
        self.added = 0  # rows ever written

    def add(
        self, s: ndarray, a: ndarray, r: ndarray, s2: ndarray,
        terminated: ndarray, truncated: ndarray, scores: ndarray | float = 0.0,
    ) -> None:  # fmt: skip
        """Write one transition per lane (line 11): s, s2 (L, 4, 84, 84), scores (L, A), all others
        (L,)."""
        row = self.added % self.rows
        self.scores[row] = scores
        self.frames[row], self.actions[row], self.rewards[row] = s[:, -1], a, r
        self.ends[row] = np.where(terminated, TERMINAL, np.where(truncated, TRUNCATED, LIVE))
        for lane in range(self.lanes):
            self.last_frames.pop((row, lane), None)
            if self.ends[row, lane] == TRUNCATED:
                self.last_frames[row, lane] = s2[lane, -1].copy()
        self.added += 1

    def sample(self, size: int, n: int, gamma: float, rng: Generator) -> Batch:
        """Draw transitions uniformly (line 12).

        Not the oldest three rows: the rows before them, which their stacks look at, are overwritten
        or were never written. Not the newest n rows: they need rows that are not written yet.
        """
        oldest = max(self.added - self.rows, 0) + 3
        row = rng.integers(oldest, self.added - n, size) % self.rows  # (B,)
        lane = rng.integers(self.lanes, size=size)  # (B,)
        return self.window(row, lane, n, gamma)

    def window(self, row: ndarray, lane: ndarray, n: int, gamma: float) -> Batch:
        """The transitions that start at row (B,), lane (B,), each over n steps.

        [+n_steps] With n = 2 the label of Q(s_0, a_0) is r_0 + gamma * r_1 + gamma * gamma * (the
        greatest Q^ in s_2): two true rewards, then the estimate. So the truth moves n states
        backwards with each update, and not one. The price: r_1 followed from the action that was
        taken in s_1. If that was not the best one, the label is too low. We accept that, because it
        learns sooner. A window stops at the end of a flight.
        """
        # In the class's example, row 1, n = 3: k = 0 gives r = 1. k = 1 adds 0.99 * -10, and there
        # the flight ends. So k = 2 adds nothing, and gamma_n stays 0.99^2.
        r, gamma_n = np.zeros(len(row), np.float32), np.ones(len(row), np.float32)  # (B,), (B,)
        last, live = row, np.ones(len(row), bool)  # (B,), (B,) newest row in r; is more to come?
        for k in range(n):
            now = (row + k) % self.rows  # (B,)
            r = r + live * gamma_n * self.rewards[now, lane]  # (B,)
            gamma_n = np.where(live, gamma_n * np.float32(gamma), gamma_n)  # (B,)
            last = np.where(live, now, last)  # (B,)
            live = live & (self.ends[now, lane] == LIVE)  # (B,)
        end = self.ends[last, lane]  # (B,)
        # s2 is the state of the row after the last one, if the flight goes on there.
        after = np.where(end == LIVE, (last + 1) % self.rows, last)  # (B,)
        s2 = self.stack(after, lane)  # (B, 4, 84, 84)
        for i in np.flatnonzero(end == TRUNCATED):  # s2 is the last row's state: add a picture
            s2[i] = [*s2[i, 1:], self.last_frames[last[i], lane[i]]]
        a = self.actions[row, lane].astype(np.int64)  # (B,)
        scores, shown = self.scores[row, lane], np.full(len(row), self.shown)  # (B, A), (B,)
        return Batch(self.stack(row, lane), a, r, s2, gamma_n, end, scores, shown)

    def stack(self, row: ndarray, lane: ndarray) -> ndarray:
        """The states (B, 4, 84, 84) at row (B,), lane (B,); a flight's first picture repeats."""
        rows = [row]
        for _ in range(3):
            before = (rows[0] - 1) % self.rows  # (B,)
            same_flight = self.ends[before, lane] == LIVE  # (B,) else repeat the first picture
            rows.insert(0, np.where(same_flight, before, rows[0]))
        return self.frames[np.stack(rows, 1), lane[:, None]]


class Agent(nn.Module):
    """All that learning changes: Q, Q^, the optimizer, and the mean of Q's last weights."""

    def __init__(self, c: DQNConfig, actions: int, seed: int) -> None:
        super().__init__()
        self.updates, self.loss, self.bfloat16 = 0, torch.zeros(()), c.bfloat16 and HAS_BFLOAT16
        layout = torch.channels_last  # the order in memory in which convolutions are quickest
        with torch.random.fork_rng():  # torch draws the first weights from its own generator:
            torch.manual_seed(seed % 2**64)  # lend it our seed, then put its state back
            self.q = QNetwork(actions).to(memory_format=layout)  # line 2
            self.q_target = QNetwork(actions).to(memory_format=layout)
        self.q_target.load_state_dict(self.q.state_dict())  # line 3
        self.mean = AveragedModel(self.q)  # [+average] the mean of Q's weights over its updates
        self.optimizer = make_optimizer(self.q.parameters(), c)

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint needs besides weights; PyTorch's state_dict calls this."""
        return {"means": self.optimizer.state_dict()["state"], "updates": self.updates}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take it up again; PyTorch's load_state_dict calls this."""
        for i, means in enumerate(self.optimizer.state.values()):
            for name, tensor in means.items():
                tensor.copy_(state["means"][i][name])
        self.updates = state["updates"]


# -------------------------------------------------- mirror images, optimizers


def mirror(batch: Batch, actions: int, rng: Generator) -> Batch:
    """[+mirror] Reflect half of the transitions: pictures left to right, a -> A - 1 - a.

    Flight, reward and camera are symmetric, so the reflection is one more true transition, for
    free. Only the forest's grid is not quite symmetric: it stands 0.5 m off centre.
    """
    flip = rng.random(len(batch.a)) < 0.5  # (B,)
    for frames in (batch.s, batch.s2):
        frames[flip] = frames[flip, ..., ::-1]
    batch.a[flip] = actions - 1 - batch.a[flip]
    batch.scores[flip] = batch.scores[flip, ::-1]
    return batch


class RMSprop(torch.optim.Optimizer):
    """[Mnih15]'s optimizer. A weight's gradient g moves it by -lr * g / sqrt(variance + epsilon).

    The variance is the running mean of g^2, less the square of the running mean of g. Mnih's table
    has a "gradient momentum" of 0.95 and a "squared gradient momentum" of 0.95. Both are decay
    factors of these means. PyTorch's own RMSprop with momentum 0.95 is another algorithm: there,
    each move goes on with 0.95 of the last one. Mnih's epsilon (not that of exploring) is 0.01 for
    a gradient that is the sum over a batch of 32. Ours is the mean, so our epsilon is 0.01 / 32^2.
    """

    def __init__(self, theta: Any, lr: float) -> None:
        super().__init__(theta, {"lr": lr})
        for w in self.param_groups[0]["params"]:
            self.state[w] = {"mean": torch.zeros_like(w), "mean_square": torch.zeros_like(w)}

    @torch.no_grad()
    def step(self) -> None:
        """Move every weight once."""
        for w, means in self.state.items():
            mean, mean_square = means.values()
            mean.lerp_(w.grad, 0.05)
            mean_square.lerp_(w.grad.square(), 0.05)
            deviation = (mean_square - mean.square()).add_(0.01 / 32**2).sqrt_()
            w.addcdiv_(w.grad, deviation, value=-self.param_groups[0]["lr"])


def make_optimizer(theta: Iterable[Tensor], c: DQNConfig) -> torch.optim.Optimizer:
    """[+adam] Adam keeps two running means for each weight: m of its gradient g, and v of g^2. A
    running mean goes a small part of the way to each number that comes: m = 0.9 * m + 0.1 * g.
    The weight moves by -lr * m / sqrt(v). So all weights move about equally fast, whether
    their gradients are large or small. Without it: the RMSprop of [Mnih15]. theta: the weights."""
    theta = list(theta)
    if not c.adam:
        return RMSprop(theta, c.lr)
    adam = torch.optim.Adam(theta, c.lr, eps=1.5e-4, fused=True)
    # Adam makes its running means at its first step. Make them here, by a step with a gradient of
    # 0, which moves no weight. So every checkpoint holds the same tensors. Then set Adam's count of
    # steps back to 0.
    for w in theta:
        w.grad = torch.zeros_like(w)
    adam.step()
    for means in adam.state.values():
        means["step"].zero_()
    return adam


# Where the processor has no bfloat16 of its own, float32 is quicker.
HAS_BFLOAT16 = bool(torch.cpu.get_capabilities().get("avx512_bf16"))
# A training goes on only where these are the same, because its numbers would differ elsewhere.
MACHINE = {"torch": str(torch.__version__), "bfloat16": HAS_BFLOAT16}


# -------------------------------------------------- files: skip this on a first reading

LARGEST = 2**30  # bytes of a file that is read; a checkpoint has 34 MB


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write. It stands under its name when it is whole, and till then the old one does.

    Links are followed to their target, folders made. Raises OSError where that is impossible.
    """
    target = Path(os.path.realpath(path))
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    made = [folder for folder in target.parents if not folder.exists()]
    with ExitStack() as at_last:  # whatever happens, even a signal in the midst of this
        for take_away in (*(folder.rmdir for folder in reversed(made)), part.unlink):
            at_last.callback(attempt, take_away)
        target.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, target)


def attempt(take_away: Callable[[], None]) -> None:
    """Take a file or folder away. A file that has its name by now, or a full folder, stays."""
    with suppress(OSError):
        take_away()


def check_output(path: Path, mark: bytes) -> None:
    """Raise ValueError unless a file can be written there, and the name is free or that of a file
    whose first 1,000 bytes match this pattern: then we wrote it, and may replace it."""
    try:
        target = Path(os.path.realpath(path))
        if os.path.lexists(target) and not re.match(mark, head(target), re.DOTALL):
            raise ValueError(f"{path} exists, and this program did not write it: move it away")
        with suppress(EOFError), whole_file(path):
            raise EOFError  # a rehearsal: nothing of it stays
    except (OSError, RecursionError) as error:  # Recursion: too many folders in one another
        why = getattr(error, "strerror", "too deep")
        raise ValueError(f"{path} cannot be read or written: {why}") from None


def head(path: Path) -> bytes:
    """The first 1,000 bytes of a regular file; none of anything else."""
    if not path.is_file() or not path.stat().st_size:  # /proc has files of size 0 that block
        return b""
    with path.open("rb") as file:
        return file.read(1000)


def save(path: Path, kind: str, content: dict) -> None:
    """Write tensors and plain values with torch.save, and behind them their SHA-256."""
    buffer = io.BytesIO()
    torch.save({"kind": kind} | content, buffer)
    with whole_file(path) as file:
        file.write(buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())


def load(path: Path, kind: str) -> dict:
    """Read what save wrote, or raise ValueError; no code from the file is ever run.

    The digest comes first, because torch.load takes flipped bits for numbers. A file that was made
    on purpose can have the right one. So `check_like` has to look at what this returns.
    """
    if not os.path.isfile(path) or not 0 < os.path.getsize(path) <= LARGEST:
        raise ValueError(f"{path} is no file of {kind}, such as train writes to runs/001")
    try:
        archive, digest = (data := path.read_bytes())[:-32], data[-32:]
        whole, content = hashlib.sha256(archive).digest() == digest, None
        if whole and sum(x.file_size for x in ZipFile(io.BytesIO(archive)).infolist()) <= LARGEST:
            with warnings.catch_warnings(action="ignore"):  # torch's, of what it will not load
                content = torch.load(io.BytesIO(archive), weights_only=True)
    except Exception as error:  # such an archive can fail in torch.load in any way
        why = getattr(error, "strerror", None) or type(error).__name__
        raise ValueError(f"{path} cannot be read: {why}") from None
    if not whole:
        raise ValueError(f"{path} is damaged, or no file of Deep Flight: its digest is wrong")
    if type(content) is not dict or content.pop("kind", None) != kind:
        raise ValueError(f"{path} holds something else than {kind}")
    return content


def check_like(found: Any, like: Any, where: object) -> None:
    """Raise ValueError unless what a file holds is built like what we would write: the same types,
    keys, shapes and dtypes, finite numbers, and whole numbers from 0. A list may hold any number of
    things, all like the first one of `like`."""
    if type(found) is not type(like):
        raise ValueError(f"{where} is of type {type(found).__name__}, not {type(like).__name__}")
    if isinstance(like, list):
        like = like[:1] * len(found)
    if isinstance(like, list | tuple):
        found, like = dict(enumerate(found)), dict(enumerate(like))
    if isinstance(like, dict):
        if found.keys() != like.keys():
            raise ValueError(f"{where} holds other things than {', '.join(map(str, like))}")
        for key in like:
            check_like(found[key], like[key], f"{where}: {key}")
    elif isinstance(like, Tensor):
        for trait in ("is_nested", "dtype", "layout", "device", "shape"):
            if (a := getattr(found, trait)) != (b := getattr(like, trait)):
                raise ValueError(f"{where} is a tensor of {trait} {a}, not {b}")
    if isinstance(like, Tensor | float) and not torch.isfinite(torch.as_tensor(found)).all():
        raise ValueError(f"{where} holds a number that is not finite")
    if isinstance(like, int) and not 0 <= found < 2**128:
        raise ValueError(f"{where} is a number below 0 or beyond 2^128")
    if isinstance(like, str) and not found.isascii():
        raise ValueError(f"{where} is no text of ours")


def pack(q: QNetwork, world: dict[str, Any]) -> dict[str, Any]:
    """What a weights file holds: a network in half precision, and what world it was trained in."""
    return {"network": {name: value.half() for name, value in q.state_dict().items()}} | world


def save_weights(path: Path, q: QNetwork, **world: Any) -> None:
    """Write a weights file, 3.4 MB. Raises FloatingPointError if a weight is no finite number."""
    content = pack(q, world)
    if not all(value.isfinite().all() for value in content["network"].values()):
        raise FloatingPointError(f"{path} is not written: some weights are no finite numbers")
    save(path, "weights", content)


def load_weights(path: Path, actions: int, **world: Any) -> QNetwork:
    """Read what save_weights wrote, in that same world. Raises ValueError."""
    saved, q = load(path, "weights"), QNetwork(actions)
    check_like(saved, pack(q, world), path)
    if other := {key: saved[key] for key in world if saved[key] != world[key]}:
        raise ValueError(f"{path} was trained with {other}, here is {world}")
    q.load_state_dict(saved["network"])
    return q


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Keep other processes out as long as this one is inside, however it ends."""
    try:
        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise ValueError(f"{folder} is another training's, which still runs") from None
    except OSError as error:
        raise ValueError(f"{folder} cannot be opened: {error.strerror}") from None
    try:
        yield
    finally:
        os.close(handle)
