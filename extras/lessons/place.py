"""place.py: does imitation lack practice, or information?

    python -m extras.lessons.place train              imitate the planner, and tell the place
    python -m extras.lessons.place train --beacon     and see the goal
    python -m extras.lessons.place eval --weights runs/NAME
    python -m extras.lessons.place blind train        the control: four zeros for the place
    python -m extras.lessons.place drift eval --weights runs/NAME    a gyroscope that drifts

**The question.** The planner of expert.py crosses 98.9 % of the forests. A network that imitates it
crosses 88.5 %. Perhaps it needs more practice. Or it lacks what the planner knows: four frames do
not show where the drone is. To find out, we tell it.

**The idea** is to put two lessons together. expert.py gives the labels: what the planner says of
all nine actions, in each observation that the network meets. memory.py gives the place: four
numbers by dead reckoning, which join the features of the convolutions.

In numbers: an edge is 8 m ahead, and no trunk is near. At the far edge (x = 82, y = 15) the planner
scores straight on 112.3 and the sharpest right turn 112.5. Either will do, because it can still
leave a second later. At the left edge (x = 40, y = 17) it scores them 4.0 and 58.4. Four frames are
the same in both places, so the network learns the mean of both labels: straight on is worse by
(0.2 + 20) / 2 = 10, because imitation_loss cuts differences at 20. So it turns at every edge, and
again a second later. With the place these are two inputs, each with its label.

**What differs from expert.py**
    QNetwork     that of memory.py
    PlaceReplay  keeps the pose of each observation beside the scores
    mirror       a reflection changes the sign of the sine and of y
    learn        passes the pose on; there are no TD targets
    Agent        that of pqn.py, without a target network, which only TD targets need
    settings     60,000 steps, where expert.py has 200,000

**What came out**, over 1,000 test forests each:

                            arrived   crossed   hit a trunk   return   control steps
    imitation, seed 0        20.0 %    88.5 %       0.3 %       83.7         200,000
    imitation, seed 1        20.1 %    87.2 %       0.3 %       84.1         200,000
    place, seed 0            33.0 %    97.9 %       0.4 %       81.6          60,000
    place, seed 1            42.9 %    96.7 %       1.7 %       81.5          60,000
    the planner              98.4 %    98.9 %       0.0 %       88.7    (arrival alone pays)

Most of the gap is closed. Normalized layers and RAdam came along, so there is a control: with four
zeros for the place, one training crossed 81 % of 48 validation forests in the end, where both
trainings with the place crossed 98 % or more (results/place-blind, place, place-1). So what
imitation lacked was information more than practice. The labels pay 115 for the far edge, so more
episodes leave there than arrive.

With a drift of 10 degrees a minute seed 0 crosses 95 % [89, 98] of 100 validation forests (`place
drift eval --weights weights/place.pt --first-seed 1000000048 --episodes 100`). With the beacon,
after 40,000 steps with labels that pay nothing for the far edge, 91 % [89, 93] and 90 % [88, 92] of
1,000 arrive (two seeds), at a return of 81. That is no more than imitation without a place (90.3 %
at 88.3, other settings).
"""

import sys
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator

from deepflight import Config
from dqn import due, linear_schedule
from env import Drone, VecForest
from extras.lessons import memory, recipe, run
from extras.lessons.expert import ExpertBatch, ExpertConfig, ExpertReplay, consult, imitation_loss
from extras.lessons.memory import QNetwork
from extras.lessons.pqn import Agent

# B transitions, what the expert said of s, and the pose in s: (B, 4) float32.
PlaceBatch = namedtuple("PlaceBatch", (*ExpertBatch._fields, "pose"))


class PlaceReplay(ExpertReplay):
    """A replay that keeps the poses too."""

    def __init__(self, capacity: int, q: QNetwork, envs: VecForest) -> None:
        super().__init__(capacity, envs)
        self.q, self.poses = q, np.zeros((*self.actions.shape, 4), np.float32)  # (T, L, 4)

    def add(self, *transition: ndarray) -> None:
        """Write one transition per environment, with the pose in s: the drones have flown on."""
        self.poses[self.added % self.rows] = self.q.poses(self.envs.drones, before=1)
        super().add(*transition)

    def window(self, row: ndarray, env: ndarray, n: int, gamma: float) -> PlaceBatch:
        """The transitions that start at row (B,), env (B,), with scores and poses."""
        pose = torch.from_numpy(self.poses[row, env])  # (B, 4)
        return PlaceBatch(*super().window(row, env, n, gamma), pose)


def mirror(b: PlaceBatch, actions: int, rng: Generator) -> PlaceBatch:
    """expert.mirror of what `learn` reads; the sine and y change their sign."""
    flip = torch.from_numpy(rng.random(len(b.a)) < 0.5)  # (B,)
    for x in (b.s, b.scores):
        x[flip] = x[flip].flip(-1)
    b.pose[flip] *= torch.tensor([1, -1, 1, -1])
    return b


def learn(agent: Agent, b: PlaceBatch, c: Config) -> None:
    """One update."""
    loss = imitation_loss(agent.q(b.s, b.pose, c.bfloat16), b.scores, c.huber_delta)
    agent.optimizer.zero_grad()
    loss.backward()
    agent.optimizer.step()
    agent.loss = loss.item()


def train(c: Config, envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """expert.train; [!] marks what differs."""
    consult(envs, c)
    agent = Agent(c, envs.num_actions, rng)  # 2 [!]
    replay = PlaceReplay(c.replay_size, agent.q, envs)  # 1 [!]
    yield agent, replay
    while envs.steps < c.steps:
        step = envs.steps + c.num_envs  # control steps, this pass included
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_final, c.steps)  # [+lr_final]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 4, 5, 6 (L, 4, 84, 84)
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        best = envs.scores.argmax(1)  # (L,)
        a = np.where(explore, best, agent.q.values(s, envs.drones).argmax(1))  # 8 (L,)
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11
        updates = due(c.update_every, step, c.num_envs) if step >= c.learning_starts else 0
        for _ in range(updates):
            batch = replay.sample(c.batch_size, c.n_steps, c.gamma, rng)  # 12 [+n_steps]
            batch = mirror(batch, envs.num_actions, rng) if c.mirror else batch  # [+mirror]
            learn(agent, batch, c)  # 13, 14 [!]
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        yield agent, replay


# Without effect: target_every, double and bellman.
PlaceConfig = recipe(
    "PlaceConfig", ExpertConfig,
    program="-m extras.lessons.place", pilot="place", train=staticmethod(train),
    network=QNetwork, steps=60_000, validate_every=10_000,
    beacon_recipe={"far_bonus": 0.0, "steps": 40_000},
)  # fmt: skip


class BlindQNetwork(QNetwork):
    """The control: it has the same layers, and is told nothing."""

    def poses(self, drones: Sequence[Drone], before: int = 0) -> ndarray:
        """Zeros (E, 4)."""
        return 0 * super().poses(drones, before)


BlindConfig = recipe(
    "BlindConfig", PlaceConfig, program="-m extras.lessons.place blind", pilot="blind",
    network=BlindQNetwork,
)  # fmt: skip

if __name__ == "__main__":
    if sys.argv[1:2] == ["blind"]:
        sys.exit(run(BlindConfig, sys.argv[2:]))
    sys.exit(memory.main(PlaceConfig))
