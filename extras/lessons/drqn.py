"""drqn.py: can a network find out alone where it is? DRQN [Hausknecht 2015].

    python -m extras.lessons.drqn train
    python -m extras.lessons.drqn eval --weights runs/001
    python -m extras.lessons.drqn forget train       the control: it forgets at every step

**The question.** In memory.py we add up the drone's turns, and the network gets the sum. Can it
find out alone where it is? Here nobody adds. The network gets its four frames and the action that
it took last, and it carries a **hidden state** h from step to step: 256 numbers, which are 0 when
an episode begins. What it writes there is its own affair. If a heading helps to tell the edges
apart, learning has to find out how to keep one.

**A recurrent layer** computes the next hidden state from the last one and from what comes in, with
the same weights at every step. The GRU [Cho 2014] computes two numbers for each number of h, a
candidate n from -1 to 1 and a gate z from 0 to 1, both from all of h and from the input x (we leave
out a third, the reset gate):

    h_t = z * h_(t-1) + (1 - z) * n

With z = 1 it keeps what it has; with z = 0 it forgets and takes the candidate. Can it add up turns?
In numbers: let h = 0.30 be a heading in rad and let the drone turn by 0.07. With z = 0.5 the
candidate must be 0.30 + 2 * 0.07 = 0.44, a weighted sum of h and x, and the new h is
0.5 * 0.30 + 0.5 * 0.44 = 0.37. Almost: n passes through tanh, which makes 0.41 of 0.44, so h is
0.36. Over a hundred steps such errors grow, unless the weights keep h small or correct it by what
is seen.

**Backpropagation through time.** The loss at step t depends on the weights through h_t, and through
h_(t-1) inside it, and so on. So a minibatch is no longer a set of single steps: it is a few drones,
each with its whole rollout of 32 steps in order, and gradients run back through all 32. They stop
there, at 3.2 s. What lies before left a trace in the first hidden state only: a constant now,
computed by older weights (a stale state).

**What differs from pqn.py**
    QNetwork   a GRU in place of the layer of 512. `look` makes of frames and last action what
               enters it, `recall` makes one step, `unroll` a rollout; `hidden_states` keeps those
               of a pilot's drones from step to step
    Rollout    keeps the action before each s too; there is none where an episode begins
    Agent      keeps the hidden states of the drones, and those that enter the rollout; a
               checkpoint holds both
    learn      unrolls: minibatches of 8 drones, 32 steps each
    mirror     off: a hidden state has no mirror image
    settings   64 drones, 32 steps each; rewards as in pqn.py

**What came out**, over 1,000 test forests; 250,000 steps each, pqn 500,000:

                         arrived   crossed   hit a trunk   return
    pqn, seed 0            8.9 %    59.4 %       3.8 %     105.9
    drqn, seed 0          20.7 %    47.5 %       6.4 %      31.9
    drqn, seed 1           9.8 %    33.6 %       1.7 %      59.4
    forget, seed 0         4.6 %    32.6 %       3.4 %       7.6
    forget, seed 1        10.5 %    48.9 %      12.7 %      28.3

The control differs in one thing: its h is 0 before every step, in training too. It earns less, and
crosses as often, as far as two seeds can tell. So h is worth something, but hardly tells where the
drone is: memory.py, which is told, crosses twice as often. Flown with h = 0,
drqn's seed 0 still crosses 46 %, but earns -27 (`drqn forget eval --episodes 200`).

[Cho 2014] Learning phrase representations using RNN encoder-decoder, EMNLP. [Hausknecht 2015] Deep
recurrent Q-learning for partially observable MDPs, AAAI Fall Symposium.
"""

import sys
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn

from deepflight import Config
from dqn import linear_schedule
from env import Drone, VecForest, World
from extras.lessons import pqn, recipe, run
from extras.lessons.pqn import PQNConfig, lambda_returns, minibatches

HIDDEN = 256  # H, numbers in a hidden state
NONE = -1  # the last action at the start of an episode


class QNetwork(pqn.QNetwork):
    """pqn.QNetwork, where a GRU takes the place of the layer of 512."""

    def __init__(self, actions: int) -> None:
        super().__init__(actions)
        self.squeeze = nn.Sequential(nn.Linear(3136, HIDDEN), nn.LayerNorm(HIDDEN), nn.ReLU())
        self.gru = nn.GRUCell(HIDDEN + actions + 1, HIDDEN)
        self.head = nn.Linear(HIDDEN, actions)

    def look(self, s: Tensor, last: Tensor, bfloat16: bool = False) -> Tensor:
        """What enters the GRU (B, 266): features of s (B, 4, 84, 84) uint8, and which of the nine
        actions, or NONE, was the last one (B,)."""
        grey = s.to(torch.bfloat16 if bfloat16 else torch.float32).div_(255)  # (B, 4, 84, 84)
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            features = self.conv(grey)  # (B, 3136)
        action = nn.functional.one_hot(last - NONE, World.num_actions + 1)  # (B, 10)
        return torch.cat([self.squeeze(features.float()), action], 1)

    def recall(self, x: Tensor, last: Tensor, h: Tensor) -> Tensor:
        """The next hidden state (B, H) of what was looked at, x (B, 266), and of the one before, h
        (B, H), which counts as 0 at the start of an episode."""
        return self.gru(x, torch.where(last[:, None] == NONE, 0.0, h))  # (B, H)

    def unroll(self, s: Tensor, last: Tensor, h: Tensor, bfloat16: bool = False) -> Tensor:
        """All hidden states (T, B, H) along s (T, B, 4, 84, 84) and last (T, B), from h (B, H)."""
        x = self.look(s.flatten(0, 1), last.flatten(), bfloat16).unflatten(0, last.shape)
        states = []
        for t in range(len(x)):
            h = self.recall(x[t], last[t], h)  # (B, H)
            states.append(h)
        return torch.stack(states)

    @torch.no_grad()
    def values(self, s: ndarray, drones: Sequence[Drone]) -> ndarray:
        """Q(s, .) (E, A) of E drones, for acting."""
        return self.head(self.hidden_states(drones)).numpy()

    @torch.no_grad()
    def hidden_states(self, drones: Sequence[Drone]) -> Tensor:
        """The hidden states (E, H). Each drone keeps its own, so that it is computed once a step,
        from that of the step before."""
        now = [(drone.seed, len(drone.actions)) for drone in drones]
        todo = [d for d, key in zip(drones, now, strict=True) if getattr(d, "key", None) != key]
        if todo:
            s, last = torch.from_numpy(np.stack([d.observation for d in todo])), last_actions(todo)
            zero = torch.zeros(HIDDEN)
            h = torch.stack([d.hidden if d.actions else zero for d in todo])  # (B, H)
            for drone, state in zip(todo, self.recall(self.look(s, last), last, h), strict=True):
                drone.hidden, drone.key = state, (drone.seed, len(drone.actions))
        return torch.stack([drone.hidden for drone in drones])


class Forgetful(QNetwork):
    """The control: the same network, whose hidden state is 0 before every step."""

    def recall(self, x: Tensor, last: Tensor, h: Tensor) -> Tensor:
        """The next hidden state (B, H) of x (B, 266) alone."""
        return super().recall(x, last, torch.zeros_like(h))  # (B, H)


def last_actions(drones: Sequence[Drone], before: int = 0) -> Tensor:
    """The last action (E,) of each drone, or what it was so many steps before."""
    flown = (drone.actions[: len(drone.actions) - before] for drone in drones)
    return torch.tensor([actions[-1] if actions else NONE for actions in flown])


class Rollout(pqn.Rollout):
    """pqn.Rollout with one column more: the last actions (L,) of s."""

    def __init__(self, length: int, envs: VecForest) -> None:
        super().__init__(length)
        self.envs = envs

    def add(self, *row: ndarray) -> None:
        """Keep a row. drone.actions ends with this row's action; we want the one before."""
        super().add(*row, last_actions(self.envs.drones, before=1).numpy())


class Agent(pqn.Agent):
    """pqn.Agent, which keeps the hidden states (L, H) of the drones, and what they were when the
    rollout began. A checkpoint holds both, so a resumed training goes on with the same."""

    def __init__(self, c: Config, actions: int, rng: Generator) -> None:
        super().__init__(c, actions, rng)
        self.register_buffer("hidden", torch.zeros(c.num_envs, HIDDEN))
        self.register_buffer("first", torch.zeros(c.num_envs, HIDDEN))

    @torch.no_grad()
    def remember(self, s: ndarray, drones: Sequence[Drone], begins: bool) -> ndarray:
        """Go on by one step, to s (L, 4, 84, 84); returns Q(s, .) (L, A)."""
        if begins:
            self.first.copy_(self.hidden)
        last = last_actions(drones)  # (L,)
        x = self.q.look(torch.from_numpy(s), last)  # (L, 266)
        self.hidden.copy_(self.q.recall(x, last, self.hidden))
        return self.q.head(self.hidden).numpy()


def learn(agent: Agent, rollout: Rollout, c: Config, rng: Generator) -> None:
    """pqn.learn, where a minibatch is the whole rollout of a few drones, in order."""
    s, a, r, s2, terminated, truncated, last = rollout.tensors()
    q = agent.q
    with torch.no_grad():
        h = q.unroll(s, last, agent.first, c.bfloat16)  # (T, L, H)
        steps = zip(s2, a, h, strict=True)
        # Not h[1:], because where an episode ends, s2 is not the next s.
        h2 = torch.stack([q.recall(q.look(x, u, c.bfloat16), u, h) for x, u, h in steps])
        v2 = q.head(h2).amax(2)  # (T, L)
    y = lambda_returns(r.float(), v2, terminated, truncated, c.gamma, c.lam)  # (T, L)
    for i in minibatches(c.num_envs, c, rng):  # (B,) drones
        h = q.unroll(s[:, i], last[:, i], agent.first[i], c.bfloat16)  # (T, B, H)
        q_sa = q.head(h).gather(2, a[:, i, None])[..., 0]  # (T, B)
        loss = nn.functional.huber_loss(q_sa, y[:, i], delta=c.huber_delta)
        agent.optimizer.zero_grad()
        loss.backward()
        agent.optimizer.step()
        agent.loss = loss.item()


def train(c: Config, envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """pqn.train; [!] marks what differs."""
    rollout = Rollout(c.rollout, envs)  # [!]
    agent = Agent(c, envs.num_actions, rng)  # 2
    yield agent, rollout
    while envs.steps < c.steps:
        step = envs.steps + c.num_envs  # control steps, this pass included
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_final, c.steps)  # [+lr_final]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 4, 5, 6 (L, 4, 84, 84)
        q = agent.remember(s, envs.drones, len(rollout.rows) % c.rollout == 0)  # (L, A) [!]
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        random_a = rng.integers(envs.num_actions, size=c.num_envs)  # (L,)
        a = np.where(explore, random_a, q.argmax(1))  # 8 (L,) [!]
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        rollout.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11
        if len(rollout.rows) == c.rollout:
            learn(agent, rollout, c, rng)  # 12, 13, 14
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        yield agent, rollout


DRQNConfig = recipe(
    "DRQNConfig", PQNConfig,
    program="-m extras.lessons.drqn", pilot="drqn", train=staticmethod(train),
    network=QNetwork, steps=250_000, num_envs=64, rollout=32, batch_size=8, mirror=False,
)  # fmt: skip

ForgetConfig = recipe(
    "ForgetConfig", DRQNConfig, program="-m extras.lessons.drqn forget", network=Forgetful
)


def main() -> int:
    """A network that remembers, or after the word `forget` one that does not."""
    forget = sys.argv[1:2] == ["forget"]
    return run(ForgetConfig if forget else DRQNConfig, sys.argv[1 + forget :])


if __name__ == "__main__":
    sys.exit(main())
