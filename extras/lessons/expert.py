"""expert.py: learn from somebody who knows [DF §IV].

    python -m extras.lessons.expert train             imitate a planner that has a laser
    python -m extras.lessons.expert train --bellman   and learn from TD targets too
    python -m extras.lessons.expert eval --weights runs/NAME
    python -m extras.lessons.expert diff              its loop beside that of dqn.py

**The question.** DQN finds out by trial what an action is worth. Suppose that somebody knows it
already. How well can a network fly that learns from this expert and not from rewards?

**The expert** is a planner, `plan`. It has a laser scanner and knows its pose, so it is privileged:
the network has four frames only. The planner adds up the rewards to come along 81 candidate
trajectories. Each holds one yaw rate for 0.6 s, then another or the same for 1.6 s. It ends early
where it crashes, leaves the forest or arrives. The reward of step k counts gamma^k times. Where it
does not end early, `plan` pretends that the drone then turns to the goal or to the far edge and
flies straight there, through all trunks and without rewards. A bonus n steps from now counts
gamma^n times, and the better one is added. An action is worth what the best trajectory is worth
that begins with it. These nine values are the scores.

In numbers, where arrival is worth 125 and no other bonus is paid: fly straight on from the start,
far from trunks. The 22 steps earn 6.2. The goal is then 79 m or 158 steps away, so
0.99^(22 + 158) * 125 = 20.5 more are added, and the value is 26.7.

**Imitation learning.** Each observation that the drones meet comes with the expert's nine scores as
labels, so no label is bootstrapped. The expert's share of the actions, epsilon, falls from 1 to 0
in 15,000 steps, and then the network flies alone. Why not let the expert fly all the time? A
network errs a little, and its errors take it to places where the expert never was. It would have no
labels there. In its own episodes it has them [Ross 2011, DAgger].

The network cannot do all that the expert does, because it sees less. It learns what an action is
worth on average over all the places that look alike. Say that it sees an edge, and one time in four
this is the far one. If so, straight on is worth 6 more than turning, else 6 less: on average 3
less. So it turns.

Its nine outputs are not Q. From scores and outputs we subtract their mean over the actions: 26, 24
and 19 become 3, 1 and -4. These are advantages: how much better an action is than the others,
whatever the observation is worth. Only with --bellman does the level of the outputs mean anything.

**What is different from dqn.py**, marked [!] in `train`:
    consult, ExpertReplay  the expert scores each observation, and the replay keeps the scores
    a                      where DQN's action is random, it is the expert's best one
    mirror                 the scores are reflected too
    learn                  a loss on advantages; r, s2 and Q^ serve the TD loss of --bellman only
    settings               115 for the far edge, 1 for a metre, and others: see ExpertConfig

**What came out.** 1,000 test forests each, one training a row, 95 % intervals in results/README.md:

                            crossed   hit a trunk   return
    dqn                     65.6 %       2.0 %       64.4
    imitation, seed 0       88.5 %       0.3 %       83.7
    imitation, seed 1       87.2 %       0.3 %       84.1
    the planner             98.9 %       0.0 %       88.7      (arrival alone pays)

With the beacon 90.3 and 90.6 % arrive, at returns of 88.3 and 87.3 (dqn: 90.6 and 90.8 % at 56.9
and 53.4).

Legend, beside that of dqn.py: W candidate trajectories, T steps of each, P points that a laser sees
[Ross 2011]  A reduction of imitation learning to no-regret online learning, AISTATS
"""

import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn

import dqn
from deepflight import Config
from dqn import Agent, due, linear_schedule, setting, td_target
from env import Drone, Pilot, VecForest, World
from extras.lessons import recipe, run
from render import raycast

BEAMS = 360  # of the laser, all around: ours


# -------------------------------------------------- the expert


def scan(drone: Drone) -> tuple[ndarray, ndarray]:
    """The laser: bearings (beams,) in rad from straight ahead, counter-clockwise, and distances
    (beams,) in m, 20 where nothing is hit within 20 m."""
    bearings = np.arange(BEAMS) * (2 * np.pi / BEAMS)  # (beams,)
    centres = drone.trunks - drone.pose[:2]  # (N, 2) m
    distance, _ = raycast(centres, drone.world.trunk_radius, bearings + drone.pose[2])  # (beams,)
    return bearings, np.minimum(distance, drone.world.laser_range)


def plan(bearings: ndarray, distances: ndarray, pose: tuple, world: World, c: Config) -> ndarray:
    """The value (A,) of each action, by the rewards that c says, as the header explains: where the
    trajectories lead, which step ends each, the rewards up to it, and the bonus that comes after.

    bearings, distances (beams,): the scan. pose: x, y in m and heading in rad.
    """
    # A place is the complex number x + iy, in m. A product with exp(i psi) turns it left by psi.
    ahead, turned = trajectories(world)  # (W, T) m, (W, T) rad, as the drone sees them
    here, heading = complex(*pose[:2]), pose[2]
    at, headings = here + ahead * np.exp(1j * heading), heading + turned  # (W, T) m, (W, T) rad
    beams = here + distances * np.exp(1j * (heading + bearings))  # (beams,) where they end
    surface = beams[distances < world.laser_range][:, None, None]  # (P, 1, 1)
    d_obs = np.abs(at - surface).min(0, initial=np.inf)  # (W, T) m
    d_goal, x, y = np.abs(world.length - at), at.real, np.abs(at.imag)  # (W, T) m each
    # 0.1 m to spare, because the scan shows single points of the near side only.
    crash, goal = d_obs < world.d_crash + 0.1, d_goal < world.goal_radius  # (W, T), (W, T)
    far, out = x > world.length, (x < -world.back) | (y > world.width / 2)  # (W, T), (W, T)
    done, k = crash | goal | far | out, np.arange(at.shape[1])  # (W, T), (T,)
    done[:, -1] = True
    last = done.argmax(1)[:, None]  # (W, 1) the first step that is done
    # The reward of env.py, of all steps at once.
    r_safe = world.r_safe * (d_obs > world.d_neg)  # (W, T)
    too_near = np.maximum(world.d_neg - d_obs, 0) / (world.d_neg - world.d_crash)  # (W, T) 0 to 1
    r = r_safe + world.r_precrash * too_near + (1 - d_goal / world.length)  # (W, T)
    r = np.where(crash | ((far | out) & ~goal), world.r_crash, r)  # (W, T)
    r = r + c.forward_reward * world.speed * world.dt * np.cos(headings)  # (W, T)
    # What comes after the last step: its own bonus if that ended the episode, else one ahead.
    later = bonus_ahead(at, headings, world, c)  # (W, T)
    bonus = np.select([crash, goal, far, out], [0, c.goal_bonus, c.far_bonus, 0], later)  # (W, T)
    r = r + np.where(k == last, c.gamma * bonus, 0)  # (W, T)
    values = (c.gamma**k * r * (k <= last)).sum(1)  # (W,)
    return values.reshape(world.num_actions, -1).max(1)  # (A,) the best that begins with each


def bonus_ahead(at: ndarray, headings: ndarray, world: World, c: Config) -> ndarray:
    """The value of the better bonus to drones at these places, x + iy in m, with these headings in
    rad, if they turn to it and fly straight there: all (W, T)."""
    values = []
    for way, bonus in ((world.length - at, c.goal_bonus), (world.length - at.real, c.far_bonus)):
        turn = np.abs(np.angle(way * np.exp(-1j * headings)))  # (W, T) rad
        steps = (turn / world.yaw_rate + np.abs(way) / world.speed) / world.dt  # (W, T)
        values.append(bonus * c.gamma**steps)  # (W, T)
    return np.maximum(*values)


@cache
def trajectories(world: World) -> tuple[ndarray, ndarray]:
    """The candidates of a drone at 0 that faces along x: places (W, T) m and headings (W, T) rad.
    Number a * A + b begins with yaw rate a and goes on with b."""
    rates = world.yaw_rate * np.linspace(-1, 1, world.num_actions)  # (A,) rad/s
    steps = [max(round(seconds / world.dt), 1) for seconds in (0.6, 1.6)]
    pairs = np.stack(np.meshgrid(rates, rates, indexing="ij"), -1).reshape(-1, 2)  # (W, 2)
    headings = np.cumsum(np.repeat(pairs, steps, 1), 1) * world.dt  # (W, T) rad
    return np.cumsum(world.speed * world.dt * np.exp(1j * headings), 1), headings


def expert_scores(envs: VecForest, c: Config) -> ndarray:
    """What `plan` says to each of the E active drones: (E, A)."""
    return np.array([plan(*scan(d), d.pose, d.world, c) for d in envs.active])


def laser_pilot(gamma: float) -> Pilot:
    """The planner as a pilot, a baseline for the camera. Arrival is worth as much as the most that
    a step can earn, for ever, and no other bonus is paid."""
    for_ever = (World.r_safe + 1) / (1 - gamma)
    c = Config(gamma=gamma, forward_reward=0.0, goal_bonus=for_ever, far_bonus=0.0)
    return lambda s, envs: expert_scores(envs, c).argmax(1)


# -------------------------------------------------- learning from it

# B transitions, and what the expert said of s: scores (B, A) float32.
ExpertBatch = namedtuple("ExpertBatch", (*dqn.Batch._fields, "scores"))


def consult(envs: VecForest, c: Config) -> None:
    """Let `envs.reset_done` also keep, in `envs.scores` (L, A), what the expert says of the
    observations that it returns. Resuming refills the replay through it, with the same scores."""
    reset_done = envs.reset_done

    def reset_and_score() -> ndarray:
        s = reset_done()  # (L, 4, 84, 84)
        envs.scores = expert_scores(envs, c)  # (L, A)
        return s

    envs.reset_done = reset_and_score


class ExpertReplay(dqn.Replay):
    """A replay that keeps the expert's scores beside each transition."""

    def __init__(self, capacity: int, envs: VecForest) -> None:
        super().__init__(capacity, len(envs.drones))
        self.envs = envs
        self.scores = np.zeros((*self.actions.shape, envs.num_actions), np.float32)  # (T, L, A)

    def add(self, *transition: ndarray) -> None:
        """Write one transition per environment, and its scores."""
        self.scores[self.added % self.rows] = self.envs.scores
        super().add(*transition)

    def window(self, row: ndarray, env: ndarray, n: int, gamma: float) -> ExpertBatch:
        """The transitions that start at row (B,), env (B,), and the scores of these rows."""
        scores = torch.from_numpy(self.scores[row, env])  # (B, A)
        return ExpertBatch(*super().window(row, env, n, gamma), scores)


def mirror(b: ExpertBatch, actions: int, rng: Generator) -> ExpertBatch:
    """dqn.mirror, where the scores change places too."""
    flip = torch.from_numpy(rng.random(len(b.a)) < 0.5)  # (B,)
    for x in (b.s, b.s2, b.scores):  # left to right is the last axis of each
        x[flip] = x[flip].flip(-1)
    b.a[flip] = actions - 1 - b.a[flip]
    return b


def imitation_loss(outputs: Tensor, scores: Tensor, delta: float) -> Tensor:
    """How far the advantages by the network's outputs (B, A) are from those by the expert's scores
    (B, A). An action that is worse than the best one by more than 20 counts as worse by 20."""
    scores = (scores - scores.amax(1, keepdim=True)).clamp(-20)  # (B, A) 0 for the best
    outputs, scores = (x - x.mean(1, keepdim=True) for x in (outputs, scores))  # (B, A), (B, A)
    return nn.functional.huber_loss(outputs, scores, delta=delta)


def td_loss(agent: Agent, q: Tensor, b: dqn.Batch, c: Config) -> Tensor:
    """The loss of dqn.learn, where q (B, A) is Q(s, .)."""
    with torch.no_grad():
        q2 = agent.q_target(b.s2, c.bfloat16)  # (B, A)
        q2_online = agent.q(b.s2, c.bfloat16) if c.double else q2  # (B, A) [+double]
        y = td_target(b, q2, q2_online)  # 13 (B,)
    q_sa = q.gather(1, b.a[:, None])[:, 0]  # (B,) Q of the actions taken
    return nn.functional.huber_loss(q_sa, y, delta=c.huber_delta)  # 14 [+huber_delta]


def learn(agent: Agent, b: ExpertBatch, c: "ExpertConfig") -> None:
    """One update."""
    q = agent.q(b.s, c.bfloat16)  # (B, A)
    loss = td_loss(agent, q, b, c) if c.bellman else 0.0
    loss = loss + imitation_loss(q, b.scores, c.huber_delta)
    agent.optimizer.zero_grad()
    loss.backward()
    agent.optimizer.step()
    agent.loss = loss.item()


def train(c: "ExpertConfig", envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1 with labels from an expert; [!] marks what differs from dqn.train."""
    consult(envs, c)  # [!]
    replay = ExpertReplay(c.replay_size, envs)  # 1 [!]
    agent = Agent(c, envs.num_actions, rng)  # 2, 3
    yield agent, replay
    while envs.steps < c.steps:
        step = envs.steps + c.num_envs  # control steps, this pass included
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_final, c.steps)  # [+lr_final]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 4, 5, 6 (L, 4, 84, 84)
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        rng.integers(envs.num_actions, size=c.num_envs)  # [!] unused; keeps rng as in dqn.py
        best = envs.scores.argmax(1)  # (L,) [!]
        a = np.where(explore, best, agent.q.values(s, envs.drones).argmax(1))  # 8 (L,) [!]
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11
        updates = due(c.update_every, step, c.num_envs) if step >= c.learning_starts else 0
        for _ in range(updates):
            batch = replay.sample(c.batch_size, c.n_steps, c.gamma, rng)  # 12 [+n_steps]
            batch = mirror(batch, envs.num_actions, rng) if c.mirror else batch  # [+mirror] [!]
            learn(agent, batch, c)  # 13, 14 [!]
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        if due(c.target_every, step, c.num_envs):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15
        yield agent, replay


# The expert knows where the far edge is, so a smaller bonus for it and for metres is enough. 115
# was found by trial: with 125 the pilot leaves sooner, and its return is smaller; with 80, and 0.5
# for a metre, its return is larger, but it crosses less often.
ExpertConfig = recipe(
    "ExpertConfig", Config,
    program="-m extras.lessons.expert", pilot="imitation", train=staticmethod(train),
    baselines=Config.baselines | {"laser": laser_pilot(Config.gamma)}, validate_every=20_000,
    bellman=setting(False, "learn from TD targets too", 0, 1),
    learning_starts=500, epsilon_final=0.0, epsilon_decay=15_000, lr_final=0.0,
    forward_reward=1.0, far_bonus=115.0,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(run(ExpertConfig, sys.argv[1:]))
