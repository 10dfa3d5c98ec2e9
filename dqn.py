"""dqn.py: DQN, the deep Q-network of Mnih et al. 2015 [Mnih15]: network, replay, TD target, loop.

An agent gets an observation s (four frames), takes an action a (one of nine yaw rates), and gets a
reward r and the next observation s2. The **return** is the sum of all rewards to come, where one
that is k steps away counts gamma^k times. gamma is the discount, 0.99, so soon is worth more than
late. Three rewards 1, 1, -10 and then the end: 1 + 0.99 * 1 + 0.99^2 * -10 = -7.81.

**Q(s, a)** is the return to expect after action a in s, if the best action is taken in every later
step. An agent that knows Q can act: it takes the action with the highest Q. Here a neural network
learns Q. It is a function with 1.7 million adjustable numbers, its weights: four frames go in, nine
numbers come out. For each Q(s, a) it needs a target y. Nobody knows the true one. But the return
from s is r plus gamma times the return from s2, so every transition (s, a, r, s2) makes a target:

    y = r + gamma * max over a2 of Q(s2, a2)        or y = r, if the world ended the episode

In numbers: r = 0.5, and the greatest of the nine Q(s2, .) is 10. Then y = 0.5 + 0.99 * 10 = 10.4.
If Q(s, a) is 8, the error is 2.4, and all weights move a little, so that Q(s, a) grows. y is called
the TD target (temporal difference), and the equation is Bellman's. To make a target from another
estimate is called bootstrapping. It works because each target holds one true reward, and where a
crash ends an episode the whole target is true. Take three steps with rewards 0.5, 0.5 and -10, a
single possible action, and let all Q be 0 at first. Each update sets all three to their targets:

                     Q of step 1   step 2   step 3
    after update 1       0.5         0.5     -10
    after update 2       1.0        -9.4     -10     because 0.5 + 0.99 * -10 = -9.4
    after update 3      -8.8        -9.4     -10     because 0.5 + 0.99 * -9.4 = -8.8: all are true

The truth moves backwards. Three things can go wrong, and DQN has an answer to each:
  * Steps that follow each other are alike (correlated samples), and a network that learns from them
    in that order forgets the rest. So a **replay** buffer keeps transitions, and each update draws
    some at random. Flights of older, worse agents still serve, because y takes the best a2, not
    the one that was flown (Q-learning is off-policy).
  * Each update of Q would also move its own targets, in a chase without end. So they come from a
    **target network** Q^, a copy of Q that is synced only now and then.
  * An agent that always does what seems best never finds what is better. So it **explores**: with
    probability epsilon, at first 1 and later 0.05, its action is random (an exploration schedule).

DQN for one environment, without what is marked [+] below:

    s = the first observation of an episode
    for each step:
        a = a random action with probability epsilon, else the a of greatest Q(s, a)
        s2, r, end = step(a)
        put s, a, r, s2, end into the replay
        s = s2, or if the episode has ended the first observation of another one
        every 4 steps:
            b = 32 random transitions of the replay
            y = b.r if b.end is TERMINAL else b.r + gamma * max Q^(b.s2, .)
            loss = the mean of (y - Q(b.s, b.a))^2 / 2, linear beyond an error of 1
            move the weights of Q against the gradient of the loss (see `learn`)
        every 2,000 steps:
            Q^ = Q

Legend: A actions, B transitions in a batch, L environments side by side (E = L in training), T
rows of the replay. A pass is one control step of all environments. [+name] marks what [Mnih15] does
not have; the setting of that name switches it off. More differences are always on: Adam, bfloat16
where the processor knows it, rewards that are not clipped to -1 .. 1, and no skipped frames.
"""

import copy
from collections import namedtuple
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor, nn

# How a transition ended: not at all, by the time limit, or in the world itself (env.py tells more).
LIVE, TRUNCATED, TERMINAL = range(3)


class InputError(ValueError):
    """An error that the user can mend."""


def setting(default: Any, text: str, *legal: Any) -> Any:
    """A setting: its default, what it is, and its least and greatest value, or the legal words."""
    return field(default=default, metadata={"help": text, "legal": legal})


@dataclass(frozen=True)
class DQNConfig:
    """The hyperparameters. [+] is not in [Mnih15]; its text says what switches it off."""

    steps: int = setting(200_000, "control steps in all", 1, 10**9)
    gamma: float = setting(0.99, "discount of a step [DF II-A]", 0, 1)
    replay_size: int = setting(200_000, "transitions kept, 7.1 kB each", 1, 10**7)
    learning_starts: int = setting(5_000, "control steps before the first update", 1, 10**9)
    update_every: int = setting(4, "control steps per update [Mnih15]", 1, 10**4)
    batch_size: int = setting(32, "transitions per update [Mnih15]", 1, 10**4)
    target_every: int = setting(2_000, "control steps per target network sync (ours)", 1, 10**9)
    epsilon_final: float = setting(0.05, "share of random actions in the end; at first 1", 0, 1)
    epsilon_decay: int = setting(40_000, "control steps until epsilon_final", 1, 10**9)
    lr: float = setting(2.5e-4, "learning rate of Adam [Mnih15: of RMSprop]", 1e-9, 1)
    num_envs: int = setting(8, "[+] environments side by side; 1: off", 1, 1000)
    double: bool = setting(True, "[+] Double DQN [van Hasselt 2016]; --no-double: off", 0, 1)
    n_steps: int = setting(5, "[+] rewards in a target: n-step returns; 1: off", 1, 100)
    mirror: bool = setting(True, "[+] reflect half of every batch; --no-mirror: off", 0, 1)
    huber_delta: float = setting(10.0, "[+] error where the loss turns linear; Mnih: 1", 1e-3, 1e6)
    lr_final: float = setting(0.1, "[+] share of lr left in the end; 1: off", 0, 1)
    swa_fraction: float = setting(0.1, "[+] average weights in this last share; 0: off", 0, 0.5)
    # 16 bits in place of 32: quicker convolutions on some processors. A lesson switches it off.
    bfloat16: ClassVar[bool] = bool(torch.cpu.get_capabilities().get("avx512_bf16"))

    def __post_init__(self) -> None:
        for f in fields(self):
            legal, value = f.metadata["legal"], getattr(self, f.name)
            if f.type is not str and not legal[0] <= value <= legal[1]:
                raise InputError(f"{f.name} is {value}, allowed are {legal[0]:,} to {legal[1]:,}")
        # The least that `sample` can draw from: one row, three before it for its observation, and
        # n_steps after it for its rewards.
        least = self.num_envs * (self.n_steps + 4)
        if min(self.replay_size, self.learning_starts) < least:
            raise InputError(f"replay_size and learning_starts must be {least} or more")


class QNetwork(nn.Module):
    """The network of [Mnih15, Methods]: an observation goes in, Q(s, .) of all actions comes out.

    Each number that leaves a layer is a weighted sum of numbers that enter it, plus a constant, its
    bias: inputs 2 and -1, weights 3 and 4 and bias 1 make 3 * 2 + 4 * -1 + 1 = 3. In a linear layer
    every output sees all inputs. In a convolution it sees a small square of each input image, with
    the same weights in every place: a filter. A filter of two pixels with weights -1 and 1 makes
    0 4 0 of the row 5 5 9 9: it finds the edge. Filters of 8x8 pixels that move on by 4 have
    (84 - 8) / 4 + 1 = 20 places in a row of 84. ReLU turns negative numbers into 0; without it, two
    layers could do no more than one. The last layer has none, because values may be negative.

    A Tensor is an ndarray that remembers how it was made, so backward() can find the gradient of
    every weight (see `learn`). Under no_grad() it forgets. A Module is a function with weights, and
    state_dict() lists these by name.
    """

    def __init__(self, actions: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            nn.Conv2d(4, 32, 8, 4), nn.ReLU(),  # (B, 32, 20, 20): 4 frames, 32 filters of 8x8, by 4
            nn.Conv2d(32, 64, 4, 2), nn.ReLU(),  # (B, 64, 9, 9)
            nn.Conv2d(64, 64, 3, 1), nn.ReLU(), nn.Flatten(),  # (B, 64, 7, 7), then (B, 3136)
        )  # fmt: skip
        self.head = nn.Sequential(nn.Linear(3136, 512), nn.ReLU(), nn.Linear(512, actions))

    def forward(self, s: Tensor, bfloat16: bool = False) -> Tensor:
        """Q(s, .) (B, A) float32 of s (B, 4, 84, 84) uint8; PyTorch calls this for q(s).

        Near 100, where many values are, bfloat16 has steps of 0.5, and actions would tie. So the
        last layers stay float32, and acting is all in float32.
        """
        grey = s.to(torch.bfloat16 if bfloat16 else torch.float32).div_(255)  # (B, 4, 84, 84) 0..1
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            features = self.conv(grey)  # (B, 3136)
        return self.head(features.float())  # (B, A)

    @torch.no_grad()
    def values(self, s: ndarray, drones: Any) -> ndarray:
        """Q(s, .) (E, A) of s (E, 4, 84, 84) uint8, for acting. drones: whose s; unused here."""
        return self(torch.from_numpy(s)).numpy()


# B transitions drawn from the replay:
#     s (B, 4, 84, 84) uint8     a (B,) int64     r (B,) the discounted sum of up to n_steps rewards
#     s2 (B, 4, 84, 84) uint8    the observation after these rewards; meaningless after TERMINAL
#     gamma_n (B,)               gamma to the number of rewards in r
#     end (B,) uint8             how the transition ended
Batch = namedtuple("Batch", "s a r s2 gamma_n end")


class Replay:
    """The last transitions of L environments side by side (Algorithm 1, line 1: see `train`).

    Each frame is kept once, 7,056 bytes; s and s2 are put together when they are drawn. Keeping
    both whole would cost eight times as much. Row t, environment l holds the newest frame of s_t,
    the action taken there, its reward, and how it ended. The rows are a ring: after the last one
    the first is written again.

        rows ->         0 1 2 3 4 5 6 7 8 9 10
        environment 0   x x x|x x x x x x x x     |: an episode's end
        environment 1   x x x x x|x x x x x x     W: the row that is written next
                                      W
    Neither the four frames of an observation nor the n rewards of a target reach across an
    episode's end, or across W. An example with one environment and n = 2:

        row        0    1    2    3    4    5
        frame      A    B    C    D    E    F
        reward     1    1   -10   0    0    2      the episode of rows 0 to 2 ends in a crash

        observation of row 3: D D D D, of row 5: D D E F
        from row 1: r = 1 + gamma * -10, and the episode ends there
        from row 3: r = 0 + gamma * 0, and s2 is the observation of row 5
    """

    def __init__(self, capacity: int, num_envs: int) -> None:
        self.rows, self.num_envs = capacity // num_envs, num_envs  # T, L
        shape = (self.rows, num_envs)
        self.frames = np.full((*shape, 84, 84), 0, np.uint8)  # (T, L, 84, 84) takes memory now
        self.actions, self.ends = np.zeros(shape, np.int64), np.zeros(shape, np.uint8)  # (T, L)
        self.rewards = np.zeros(shape, np.float32)  # (T, L)
        self.last_frames: dict[tuple[int, int], ndarray] = {}  # (row, env) -> (84, 84)
        self.added = 0  # rows ever written

    def add(self, s: ndarray, a: ndarray, r: ndarray, s2: ndarray,
            terminated: ndarray, truncated: ndarray) -> None:  # fmt: skip
        """Write one transition per environment: s, s2 (L, 4, 84, 84), all others (L,).

        The next row holds the newest frame of s2. If the time limit ends an episode, the next row
        begins another one, but the target needs s2's newest frame, so `last_frames` keeps it. After
        a crash no target needs it.
        """
        row = self.added % self.rows
        self.frames[row], self.actions[row], self.rewards[row] = s[:, -1], a, r
        self.ends[row] = np.where(terminated, TERMINAL, np.where(truncated, TRUNCATED, LIVE))
        for env in np.flatnonzero(truncated):
            self.last_frames[row, env] = s2[env, -1].copy()
        self.added += 1

    def sample(self, size: int, n: int, gamma: float, rng: np.random.Generator) -> Batch:
        """Draw transitions uniformly.

        The oldest three rows are left out, because the frames before them may be missing. The
        newest n rows are left out, because their s2 may be missing. In the ring above, row 7 is
        written next. With n = 2, rows 7, 8 and 9 and rows 5 and 6 are left out.
        """
        oldest = max(self.added - self.rows, 0) + 3
        row = rng.integers(oldest, self.added - n, size) % self.rows  # (B,)
        env = rng.integers(self.num_envs, size=size)  # (B,)
        return self.window(row, env, n, gamma)

    def window(self, row: ndarray, env: ndarray, n: int, gamma: float) -> Batch:
        """The transitions from row (B,), env (B,), over n steps or to the end of the episode.

        [+n_steps] With n = 2 the target of Q(s_0, a_0) is r_0 + gamma * r_1 + gamma**2 * (the
        greatest Q^ of s_2): two true rewards, so the truth moves back by two steps in each update.
        The price: an older agent chose the action in s_1, often not the best one, so such a
        target is often too low.
        """
        rows, envs = (row[:, None] + np.arange(n)) % self.rows, env[:, None]  # (B, n), (B, 1)
        ended = self.ends[rows, envs] != LIVE  # (B, n)
        # reached: no earlier step has ended the episode. In the example of the class, row 1 with
        # n = 3: ended 0 1 0, ends so far 0 1 1, ends before 0 0 1, reached 1 1 0, count 2, last 2.
        reached = np.cumsum(ended, 1) - ended == 0  # (B, n)
        discounts = np.float32(gamma) ** np.arange(n + 1, dtype=np.float32)  # (n + 1,)
        r = (reached * discounts[:n] * self.rewards[rows, envs]).sum(1)  # (B,)
        count = reached.sum(1)  # (B,) rewards in r
        last = (row + count - 1) % self.rows  # (B,) the row of the last one
        end = self.ends[last, env]  # (B,)
        # LIVE: s2 stands one row later. TERMINAL: it is never used. TRUNCATED: mended below.
        s2 = self.stack(np.where(end == LIVE, (last + 1) % self.rows, last), env)  # (B, 4, 84, 84)
        for i in np.flatnonzero(end == TRUNCATED):  # s2 lacks the newest frame
            s2[i] = [*s2[i, 1:], self.last_frames[last[i], env[i]]]
        s, a = self.stack(row, env), self.actions[row, env]  # (B, 4, 84, 84), (B,)
        return Batch(*map(torch.from_numpy, (s, a, r, s2, discounts[count], end)))

    def stack(self, row: ndarray, env: ndarray) -> ndarray:
        """The observations (B, 4, 84, 84) at row (B,), env (B,). Where an episode began less than
        three rows before, its first frame repeats."""
        rows = [row]
        for _ in range(3):
            before = (rows[0] - 1) % self.rows  # (B,)
            rows.insert(0, np.where(self.ends[before, env] == LIVE, before, rows[0]))
        return self.frames[np.stack(rows, 1), env[:, None]]  # (B, 4, 84, 84)


def mirror(b: Batch, actions: int, rng: np.random.Generator) -> Batch:
    """[+mirror] Reflect half of the transitions: frames left to right, a -> A - 1 - a.

    Flight, reward and camera are symmetric, so the reflection is one more valid transition (data
    augmentation). Only the forest's grid is not quite symmetric: it stands 0.5 m off centre.
    """
    half = torch.from_numpy(rng.random(len(b.a)) < 0.5)  # (B,)
    for frames in (b.s, b.s2):
        frames[half] = frames[half].flip(-1)
    b.a[half] = actions - 1 - b.a[half]
    return b


class Agent(nn.Module):
    """What learning changes: Q, the target network Q^, the optimizer, and the mean of Q's weights
    (Algorithm 1, lines 2 and 3). channels_last and fused only make it quicker.

    [+swa_fraction] Each update changes how Q flies, for better or worse. The mean of the weights
    over many updates is steadier (stochastic weight averaging), so it is what flies in the end.
    """

    def __init__(self, c: DQNConfig, actions: int, rng: np.random.Generator) -> None:
        super().__init__()
        with torch.random.fork_rng():  # afterwards torch's generator is as it was
            torch.manual_seed(int(rng.integers(2**63)))
            self.q = QNetwork(actions).to(memory_format=torch.channels_last)  # line 2
        self.q_target = copy.deepcopy(self.q)  # line 3
        self.averaged = torch.optim.swa_utils.AveragedModel(self.q)  # [+swa_fraction]
        eps = 1.5e-4 * c.huber_delta  # see `learn`
        self.optimizer = torch.optim.Adam(self.q.parameters(), c.lr, eps=eps, fused=True)
        self.epsilon, self.loss = 1.0, 0.0


def td_target(b: Batch, q2: Tensor, q2_online: Tensor) -> Tensor:
    """The TD target y (B,): r + gamma_n * max_a2 Q^(s2, a2), or r where the episode terminated.

    q2 (B, A): Q^(s2, .), which says what an action is worth. q2_online (B, A): the values by which
    a2 is chosen. In [Mnih15] both are the same, so the value of a2 is the maximum.

    [+double] A maximum of noisy values is too high (overestimation bias). Let two actions both be
    worth 0, and let Q^ err by +1 and -1: the maximum is 1. If Q, whose errors differ, chooses a2
    instead, it hits +1 and -1 about equally often, which makes 0 on average.
    """
    a2 = q2_online.argmax(1, keepdim=True)  # (B, 1)
    v2 = q2.gather(1, a2)[:, 0]  # (B,) q2[i, a2[i]] of each i
    return b.r + b.gamma_n * torch.where(b.end == TERMINAL, 0.0, v2)


def learn(agent: Agent, b: Batch, c: DQNConfig) -> None:
    """One update (Algorithm 1, lines 13 and 14: see `train`).

    The loss is one number that says how wrong a batch is, and its gradient says for each weight how
    the loss changes if that weight grows. An example with one weight w = 2 and one input x = 4: Q
    is w * x = 8, the target 10.4, and half the error's square 2.88. If w grew by a little d, Q
    would grow by 4 d and the loss would fall by 2.4 * 4 d = 9.6 d: the gradient is -9.6. In plain
    gradient descent with a learning rate of 0.01, w becomes 2 + 0.01 * 9.6 = 2.096, and Q 8.38.

    [+huber_delta] The Huber loss is half the error's square up to delta and a straight line beyond,
    so no error pulls harder than delta. Say that nine targets of ten are 0 and one is -10, a crash.
    Q should be their mean, -1. With Mnih's delta of 1 it comes to rest where nine small pulls
    balance one pull of 1: 9 * (0 - Q) = 1, so Q = -0.11, and the crash is nearly ignored.

    Adam, the optimizer, moves each weight by -lr * m / (sqrt(v) + eps). m = 0.9 * m + 0.1 * g is a
    running mean of its gradient g, and v = 0.999 * v + 0.001 * g**2 one of g**2 (both corrected for
    their start at 0). m / sqrt(v) is rarely above 1, so all weights move about equally fast, but
    slower where gradients are below eps. Ours is Rainbow's 1.5e-4 [Hessel 2018] times huber_delta,
    because our gradients may be larger by this factor.
    """
    with torch.no_grad():
        q2 = agent.q_target(b.s2, c.bfloat16)  # (B, A)
        q2_online = agent.q(b.s2, c.bfloat16) if c.double else q2  # (B, A) [+double]
        y = td_target(b, q2, q2_online)  # line 13 (B,)
    q_sa = agent.q(b.s, c.bfloat16).gather(1, b.a[:, None])[:, 0]  # (B,) Q of the actions taken
    loss = nn.functional.huber_loss(q_sa, y, delta=c.huber_delta)  # line 14 [+huber_delta]
    agent.optimizer.zero_grad()  # backward() adds to what is there
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
    """How many multiples of `every` one pass holds, if its last step is `step`: the steps 9 to 16
    hold two multiples of 4, so two updates are due.

    >>> due(4, 16, 8), due(2_000, 16, 8)
    (2, 0)
    """
    return step // every - (step - num_envs) // every


# Algorithm 1 of [Mnih15]; numbers in `train` are its lines. phi(s): four frames, theta: weights.
#      1  initialize replay memory D to capacity N
#      2  initialize action-value function Q with random weights theta
#      3  initialize target action-value function Q^ with weights theta- = theta
#      4  for episode = 1, M do
#      5      initialize sequence s_1 = {x_1} and preprocessed sequence phi_1 = phi(s_1)
#      6      for t = 1, T do
#      7          with probability epsilon select a random action a_t
#      8          otherwise select a_t = argmax_a Q(phi(s_t), a; theta)
#      9          execute action a_t in emulator and observe reward r_t and image x_{t+1}
#     10          set s_{t+1} = s_t, a_t, x_{t+1} and preprocess phi_{t+1} = phi(s_{t+1})
#     11          store transition (phi_t, a_t, r_t, phi_{t+1}) in D
#     12          sample random minibatch of transitions (phi_j, a_j, r_j, phi_{j+1}) from D
#     13          set y_j = r_j if the episode terminates at step j+1,
#                     r_j + gamma * max_a' Q^(phi_{j+1}, a'; theta-) otherwise
#     14          perform a gradient descent step on (y_j - Q(phi_j, a_j; theta))^2 w.r.t. theta
#     15          every C steps reset Q^ = Q


def train(c: DQNConfig, envs: Any, rng: np.random.Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1, for L environments side by side, which share each pass through Q [+num_envs].

    envs: a vector environment like env.VecForest. shaped: makes the rewards to learn from. This is
    a generator: after each pass it yields agent and replay to deepflight.Run, which logs and saves.
    It also yields once before the first step, so that Run can restore an interrupted training.
    """
    replay = Replay(c.replay_size, c.num_envs)  # 1
    agent = Agent(c, envs.num_actions, rng)  # 2, 3
    yield agent, replay
    while envs.steps < c.steps:
        step = envs.steps + c.num_envs  # control steps, this pass included
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_final, c.steps)  # [+lr_final]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 4, 5, 6 (L, 4, 84, 84)
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        random_a = rng.integers(envs.num_actions, size=c.num_envs)  # (L,)
        a = np.where(explore, random_a, agent.q.values(s, envs.drones).argmax(1))  # 8 (L,)
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11
        updates = due(c.update_every, step, c.num_envs) if step >= c.learning_starts else 0
        for _ in range(updates):
            batch = replay.sample(c.batch_size, c.n_steps, c.gamma, rng)  # 12 [+n_steps]
            batch = mirror(batch, envs.num_actions, rng) if c.mirror else batch  # [+mirror]
            learn(agent, batch, c)  # 13, 14
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        if due(c.target_every, step, c.num_envs):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15
        yield agent, replay
