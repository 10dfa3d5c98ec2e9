"""pqn.py: what if the replay and the target network go? PQN [Gallici 2025].

    python -m extras.lessons.pqn train
    python -m extras.lessons.pqn eval --weights runs/001
    python -m extras.lessons.pqn plain train      the experiment: without normalized layers

DQN needs a replay because the steps of one drone are alike, and a target network because each
update of Q moves its own targets. Here 128 drones fly at the same time, each in a forest of its
own. 16 steps of each make a **rollout** of 2,048 transitions that are unlike enough.
Q learns from these, twice, and forgets them. Nothing is drawn from a memory, and the targets come
from Q itself, as it was when the rollout began.

**The lambda-return.** A rollout is in order, so a target may look further than one step. After
(s, a, r, s2) it can go on with the return that was flown from s2, or with the greatest Q(s2, .), an
estimate. The flown return is true for one flight only, so it is noisy; the estimate is steady but
at first wrong. The lambda-return G mixes both at every step, and is computed backwards:

    G_t = r_t + gamma * ((1 - lambda) * max Q(s2_t, .) + lambda * G_(t+1))

If the world ended the episode at t, then G_t = r_t. If the clock ended it, or the rollout is over,
then nothing flown follows, so all weight is on max Q(s2_t, .). In numbers, with lambda = 0.65: the
rewards of three steps are 0.5, 0.5 and -10, which is a crash, and max Q(s2, .) is 4, then 2.

    G_3 = -10                                                          all of it is true
    G_2 = 0.5 + 0.99 * (0.35 * 2 + 0.65 * -10)   = -5.2                a TD target would be 2.5
    G_1 = 0.5 + 0.99 * (0.35 * 4 + 0.65 * -5.2)  = -1.5                a TD target would be 4.5

In one update the crash reached the first step. One-step TD targets need three, see dqn.py.

**Normalized layers** take the target network's place. An update that raises Q(s, a) raises Q(s2, .)
too, because s and s2 look alike, so the next target is higher, and Q may run away. Layer
normalization [Ba 2016] takes from the numbers of a layer their mean and divides them by their
standard deviation: 1, 3, 8 become -1.0, -0.3, 1.4, and 10, 30, 80 become the same. So Q cannot grow
by making its features larger. Under some conditions this is proven to be stable [Gallici 2025].

**What differs from dqn.py**
    network    a normalization before each ReLU; no target network, so no Double DQN
    replay     a rollout that is thrown away; `train` learns when it is full, not in each pass
    learn      lambda-returns instead of n-step targets; two passes over the rollout
    optimizer  RAdam, which is Adam with short first steps
    settings   500,000 steps, 1 for a metre and 115 for the far edge, see PQNConfig

**Why it is quick.** DQN learns from each step eight times (32 transitions every 4 steps). Each time
it makes three passes forward, Q(s), Q(s2) and Q^(s2), and one backward, which costs as much as two:
8 * (3 + 2) = 40 for each step flown. PQN makes 2 * (1 + 2) and one for max Q(s2, .), 7 in all. But
it throws away what it could learn from again. In a slow world, as with a real drone, steps are dear
and multiplications cheap, so there a replay is the better idea.

**What came out** over 1,000 test forests; its smaller bonuses may explain part of the return:

    three seeds   crossed, %         hit a trunk, %    return          steps     minutes
    pqn           59.4, 56.6, 56.4   3.8, 16.9, 5.2    106, 102, 110   500,000   17, 16, 16
    dqn           65.6, 64.2, 66.9   2.0, 2.4, 1.6     64, 61, 54      200,000   34, 39, 41

It is jumpy: 71 % of seed 0's validation episodes crashed at step 175,000, none at 200,000. After
150,000 steps 58 % crossed with normalization and 31 % without (returns 72 and -4, one seed each),
though the latter training ends there, its rate already low (results/pqn, results/pqn-plain).

[Ba 2016] arXiv:1607.06450. [Gallici 2025] Simplifying deep temporal difference learning, ICLR.
"""

import sys
from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

import dqn
from deepflight import Config
from dqn import linear_schedule, setting
from env import VecForest, World
from extras.lessons import recipe, run


class QNetwork(dqn.QNetwork):
    """dqn.QNetwork with a normalization before each ReLU.

    A group normalization with one group is the layer normalization of a convolution: mean and
    deviation are those of all numbers of one observation in this layer. Each filter then has a
    factor and a constant of its own, which are learned.
    """

    def __init__(self, actions: int) -> None:
        super().__init__(actions)
        for place, filters in ((1, 32), (4, 64), (7, 64)):  # behind each convolution
            self.conv.insert(place, nn.GroupNorm(1, filters))
        self.head.insert(1, nn.LayerNorm(512))


class Rollout:
    """The transitions of one rollout: T rows of one transition per environment.

    It stands where DQN's replay stands. When it is full the next row begins another one, so a
    training that is resumed has the same rows in it, after all its transitions were added again.
    """

    def __init__(self, length: int) -> None:
        self.length, self.rows = length, []

    def add(self, *row: ndarray) -> None:
        """Keep s, a, r, s2, terminated, truncated: s and s2 (L, 4, 84, 84), all others (L,)."""
        if len(self.rows) == self.length:
            self.rows = []
        self.rows.append(row)

    def tensors(self) -> list[Tensor]:
        """The same six, each with the rows as its first axis: (T, L, ...)."""
        return [torch.from_numpy(np.stack(column)) for column in zip(*self.rows, strict=True)]


def lambda_returns(
    r: Tensor, v2: Tensor, terminated: Tensor, truncated: Tensor, gamma: float, lam: float
) -> Tensor:
    """The targets (T, L) of a rollout, as the header says; all (T, L). v2: max Q(s2, .).

    >>> r, v2 = torch.tensor([[0.5], [0.5], [-10]]), torch.tensor([[4.0], [2.0], [9.0]])
    >>> crash, late = torch.tensor([[False], [False], [True]]), torch.zeros(3, 1, dtype=torch.bool)
    >>> lambda_returns(r, v2, crash, late, gamma=0.99, lam=0.65).flatten()
    tensor([ -1.4872,  -5.2420, -10.0000])
    """
    v2 = torch.where(terminated, 0.0, v2)  # (T, L) nothing follows a crash
    ended = terminated | truncated  # (T, L)
    g, returns = v2[-1], []  # (L,): nothing flown follows the last row
    for t in reversed(range(len(r))):
        flown = torch.where(ended[t], v2[t], g)  # (L,) there g is of another episode
        g = r[t] + gamma * ((1 - lam) * v2[t] + lam * flown)  # (L,)
        returns.insert(0, g)
    return torch.stack(returns)


class Agent(nn.Module):
    """dqn.Agent without a target network, and with RAdam.

    Adam divides by the root of the mean of g^2. In the first updates this mean is made of so few
    gradients that it may be far too small, and the step far too large. RAdam shortens these steps.
    """

    def __init__(self, c: Config, actions: int, rng: Generator) -> None:
        super().__init__()
        with torch.random.fork_rng():  # torch draws the first weights from a generator of its own
            torch.manual_seed(int(rng.integers(2**63)))
            self.q = c.network(actions).to(memory_format=torch.channels_last)
        self.averaged = AveragedModel(self.q)  # [+swa_fraction]
        self.optimizer = torch.optim.RAdam(self.q.parameters(), c.lr)
        self.epsilon, self.loss = 1.0, 0.0


def minibatches(size: int, c: Config, rng: Generator) -> Iterator[Tensor]:
    """Indices (B,): each of 0 to size - 1 once in every epoch, in random order."""
    for _ in range(c.epochs):
        yield from torch.from_numpy(rng.permutation(size)).split(c.batch_size)


def learn(agent: Agent, rollout: Rollout, c: Config, rng: Generator) -> None:
    """Learn from a full rollout. Its targets are computed once, so they stand still meanwhile."""
    s, a, r, s2, terminated, truncated = rollout.tensors()
    with torch.no_grad():
        v2 = torch.stack([agent.q(row, c.bfloat16).amax(1) for row in s2])  # (T, L)
    y = lambda_returns(r.float(), v2, terminated, truncated, c.gamma, c.lam).flatten()  # (T * L,)
    s, a = s.flatten(0, 1), a.flatten()  # (T * L, 4, 84, 84), (T * L,)
    for i in minibatches(len(y), c, rng):
        b_s, b_a = s[i], a[i]  # (B, 4, 84, 84), (B,)
        if c.mirror:  # [+mirror]
            flip = torch.from_numpy(rng.random(len(i)) < 0.5)  # (B,)
            b_s[flip] = b_s[flip].flip(-1)
            b_a[flip] = World.num_actions - 1 - b_a[flip]
        q_sa = agent.q(b_s, c.bfloat16).gather(1, b_a[:, None])[:, 0]  # (B,)
        loss = nn.functional.huber_loss(q_sa, y[i], delta=c.huber_delta)
        agent.optimizer.zero_grad()
        loss.backward()
        agent.optimizer.step()
        agent.loss = loss.item()


def train(c: Config, envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1 of [Mnih15] without replay and target network; [!] marks what differs."""
    rollout = Rollout(c.rollout)  # [!]
    agent = Agent(c, envs.num_actions, rng)  # 2 [!]
    yield agent, rollout  # [!]
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
        rollout.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11 [!]
        if len(rollout.rows) == c.rollout:  # [!]
            learn(agent, rollout, c, rng)  # 12, 13, 14 [!]
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        yield agent, rollout  # [!]


# Without effect: replay_size, learning_starts, update_every, target_every, double and n_steps.
PQNConfig = recipe(
    "PQNConfig", Config,
    program="-m extras.lessons.pqn", pilot="pqn", train=staticmethod(train),
    network=QNetwork, validate_every=25_000,
    rollout=setting(16, "control steps of each drone between two updates", 1, 10**4),
    epochs=setting(2, "passes over each rollout", 1, 100),
    lam=setting(0.65, "lambda: share of the flown return; 0: TD targets", 0.0, 1.0),
    steps=500_000, num_envs=128, batch_size=128, lr=1e-3, epsilon_decay=50_000,
    forward_reward=1.0, far_bonus=115.0,
)  # fmt: skip
PlainConfig = recipe(
    "PlainConfig", PQNConfig, program="-m extras.lessons.pqn plain", pilot="plain",
    network=dqn.QNetwork, steps=150_000,
)  # fmt: skip


def main() -> int:
    """PQN, or after the word `plain` the same without normalization."""
    plain = sys.argv[1:2] == ["plain"]
    return run(PlainConfig if plain else PQNConfig, sys.argv[1 + plain :])


if __name__ == "__main__":
    sys.exit(main())
