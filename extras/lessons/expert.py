"""expert.py: learn from somebody who knows [DF §IV].

    python -m extras.lessons.expert train             imitate a planner that has a laser
    python -m extras.lessons.expert train --bellman   and learn from TD targets too
    python -m extras.lessons.expert demonstrations train --demos FILE
                                                      DQN that begins with recorded episodes
    python -m extras.lessons.expert eval --weights weights/imitation.pt

DQN finds out by trial what an action is worth. Here somebody knows it already. The paper ends with
two wishes, demonstrations before the learning and demonstrations in its loop, and this file tries
both. Compare its `train` with that of dqn.py: the loop is the same but for the marked lines.

**The expert** is a planner, `plan`. It has a laser scanner and knows its pose, so it is privileged:
the network has four frames and nothing else. It adds up the rewards to come along 81 candidate
trajectories. Each is one of the nine yaw rates for 0.6 s, then one for 1.6 s, and it ends early
where it crashes, leaves the forest or arrives. The reward of step k counts gamma^k times. Where a
trajectory does not end early, more is to come. So the planner adds the bonus of the goal times
gamma^n, as if the drone turned to the goal and flew straight to it in n steps, through all trunks
and without reward; or the bonus of the far edge in the same manner, if that is more. An action is
worth what the best trajectory is worth that begins with it. These nine values are its scores.

In numbers, where arrival is worth 125 and no other bonus is paid: fly straight on from the start,
far from trunks. The 22 steps earn 6.2. The goal is then 79 m or 158 steps away, so
0.99^(22 + 158) * 125 = 20.5 more are added, and the value is 26.7.

**Imitation learning.** Of every observation that the drones meet, the expert scores all nine
actions, so each observation comes with nine labels, and no label needs to be bootstrapped. Where Q
would explore, the expert's best action is flown. So the expert flies at first, and after 15,000
steps the network flies alone. Why not let the expert fly all the time? Because a network errs a
little, and its errors take it to places where the expert never was. It would have no labels there.
In its own episodes it has them [Ross 2011, DAgger].

The network cannot do all that the expert does, because it sees less. It learns what an action is
worth on average over all the places that look alike. Say that it sees an edge, and one time in four
this is the far one. Then straight on is worth 6 more than turning, otherwise 6 less: on average 3
less. So it turns.

The nine numbers of a network that only imitates are not Q. From the scores and from the outputs
their mean over the actions is taken away, so what is compared are advantages: by how much an action
is better than another, and not how good the observation is. The level of the outputs means nothing.
With `--bellman` the TD targets of dqn.py are learned too, and they set the level.

**Demonstrations** are recorded episodes, of any pilot or of a person. An episode says less than an
expert: somebody took action a where he saw s. So Q(s, a) should be the greatest of the nine, by a
margin [Hester 2018]. The network learns from these episodes alone at first, and their rewards count
like all others. With `--demo-share 0.25` a quarter of every later batch is theirs. Then
`--epsilon-decay 40000` is needed, so that the drones explore as usual: demonstrated episodes do not
crash, and a network that has seen few crashes does not see one coming.

Legend, beside that of dqn.py
    W, T, P   candidate trajectories, steps of each, points of trunks that the laser sees
    [Ross 2011]     A reduction of imitation learning to no-regret online learning, AISTATS
    [Hester 2018]   Deep Q-learning from demonstrations, AAAI
"""

import json
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn

import deepflight
import dqn
from deepflight import Config
from dqn import Agent, InputError, due, greedy, linear_schedule, setting, td_target
from env import Drone, Episode, Pilot, VecForest, World
from extras.lessons import recipe
from render import raycast

BEAMS = 360  # of the laser, all around: ours


@dataclass(frozen=True)
class DemoConfig(Config):
    """DQN with recorded episodes, and the switches of this file."""

    command: ClassVar[str] = "python -m extras.lessons.expert demonstrations"
    pilot: ClassVar[str] = "demonstrations"
    # A network that has seen demonstrations need not begin by chance.
    epsilon_decay: int = setting(1, "control steps until epsilon_final", 1, 10**9)
    imitation: bool = setting(False, "learn the expert's scores; it flies, not chance", 0, 1)
    bellman: bool = setting(True, "learn from TD targets", 0, 1)
    demos: str = setting("", "file of episodes that eval --json wrote")
    demo_pilot: str = setting("laser", "whose episodes of that file are the demonstrations")
    demo_updates: int = setting(2_000, "updates on demonstrations alone, at first", 1, 10**7)
    demo_share: float = setting(0.0, "share of them in every later batch; 0: none", 0, 0.9)
    margin: float = setting(5.0, "by which a demonstrated action must be the best", 0, 1e3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.imitation and not self.bellman:
            raise InputError("there is nothing to learn from: give --imitation or --bellman")


# -------------------------------------------------- the expert


def scan(drone: Drone) -> tuple[ndarray, ndarray]:
    """The laser: bearings (beams,) in rad from straight ahead, counter-clockwise, and distances
    (beams,) in m, 20 where nothing is hit within 20 m."""
    bearings = np.arange(BEAMS) * (2 * np.pi / BEAMS)  # (beams,)
    centres = drone.trunks - drone.pose[:2]  # (N, 2) m
    distance, _ = raycast(centres, drone.world.trunk_radius, bearings + drone.pose[2])  # (1, beams)
    return bearings, np.minimum(distance[0], drone.world.laser_range)


def plan(bearings: ndarray, distances: ndarray, pose: tuple, world: World, c: Config) -> ndarray:
    """The value (A,) of each action, by the rewards that c says, as the header explains.

    bearings, distances (beams,): the scan. pose: x, y in m and heading in rad.
    """
    # A place is the complex number x + iy, in m. A product with exp(i psi) turns it left by psi.
    (ahead, turned), here, heading = trajectories(world), complex(*pose[:2]), pose[2]
    at, headings = here + ahead * np.exp(1j * heading), heading + turned  # (W, T), (W, T) rad
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
    return (c.gamma**k * r * (k <= last)).sum(1).reshape(world.num_actions, -1).max(1)


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


def consult(envs: VecForest, c: DemoConfig) -> None:
    """Let `envs.scores` (E, A) be what the expert says of the observations that `reset_done`
    returned last; 0 without imitation. A resumed training, which flies all its actions again, calls
    `reset_done` before every step too, so it gets the same scores."""
    reset_done = envs.reset_done

    def reset_and_score() -> ndarray:
        s = reset_done()  # (E, 4, 84, 84)
        envs.scores = expert_scores(envs, c) if c.imitation else 0.0
        return s

    envs.reset_done = reset_and_score


# -------------------------------------------------- learning from it

# B transitions, and what the expert said of s: scores (B, A) float32. is_demo (B,) bool: whether a
# was demonstrated.
ExpertBatch = namedtuple("ExpertBatch", (*dqn.Batch._fields, "scores", "is_demo"))


class ExpertReplay(dqn.Replay):
    """A replay that keeps the expert's scores beside each transition."""

    def __init__(self, capacity: int, envs: VecForest, is_demo: bool = False) -> None:
        super().__init__(capacity, len(envs.drones))
        self.envs, self.is_demo = envs, is_demo
        self.scores = np.zeros((*self.actions.shape, envs.num_actions), np.float32)  # (T, L, A)

    def add(self, *transition: ndarray) -> None:
        """Write one transition per environment, and its scores."""
        self.scores[self.added % self.rows] = self.envs.scores
        super().add(*transition)

    def window(self, row: ndarray, env: ndarray, n: int, gamma: float) -> ExpertBatch:
        """The transitions that start at row (B,), env (B,), and the scores of these rows."""
        scores, is_demo = self.scores[row, env], torch.full((len(row),), self.is_demo)
        return ExpertBatch(*super().window(row, env, n, gamma), torch.from_numpy(scores), is_demo)


def mirror(b: ExpertBatch, actions: int, rng: Generator) -> ExpertBatch:
    """dqn.mirror, where the scores change places too."""
    flip = torch.from_numpy(rng.random(len(b.a)) < 0.5)  # (B,)
    for x in (b.s, b.s2, b.scores):  # left to right is the last axis of each
        x[flip] = x[flip].flip(-1)
    b.a[flip] = actions - 1 - b.a[flip]
    return b


def sample(replay: ExpertReplay, demo_replay: Any, c: DemoConfig, rng: Generator) -> ExpertBatch:
    """A batch, of which demo_share are demonstrations unless demo_replay is None."""
    n_demos = round(c.demo_share * c.batch_size) if demo_replay else 0
    parts = [(replay, c.batch_size - n_demos), (demo_replay, n_demos)]
    drawn = [part.sample(n, c.n_steps, c.gamma, rng) for part, n in parts if n]
    b = ExpertBatch(*map(torch.cat, zip(*drawn, strict=True)))
    return mirror(b, b.scores.shape[1], rng) if c.mirror else b


def imitation_loss(outputs: Tensor, scores: Tensor, delta: float) -> Tensor:
    """How far the advantages by the network's outputs (B, A) are from those by the expert's scores
    (B, A). An action that is worse than the best one by more than 20 counts as worse by 20."""
    scores = (scores - scores.amax(1, keepdim=True)).clamp(-20)  # (B, A) 0 for the best
    outputs, scores = (x - x.mean(1, keepdim=True) for x in (outputs, scores))  # (B, A), (B, A)
    return nn.functional.huber_loss(outputs, scores, delta=delta)


def margin_loss(q: Tensor, a: Tensor, margin: float) -> Tensor:
    """The large-margin loss (B,) of [Hester 2018]: 0 where q (B, A) of the demonstrated action
    a (B,) is the greatest by the margin or more, else by how much it misses that.

    >>> q = torch.tensor([[1.0, 9.0, 0.0]])
    >>> [margin_loss(q, torch.tensor([a]), 5.0).item() for a in (0, 1)]
    [13.0, 0.0]
    """
    others = 1 - nn.functional.one_hot(a, q.shape[1])  # (B, A)
    return (q + margin * others).amax(1) - q.gather(1, a[:, None])[:, 0]


def learn(agent: Agent, b: ExpertBatch, c: DemoConfig) -> None:
    """Move the weights once, by up to three losses."""
    q, loss = agent.q(b.s, dqn.BFLOAT16), torch.zeros(())  # (B, A), ()
    if c.bellman:
        with torch.no_grad():
            q2 = agent.q_target(b.s2, dqn.BFLOAT16)  # (B, A)
            q2_online = agent.q(b.s2, dqn.BFLOAT16) if c.double else q2  # (B, A)
            y = td_target(b, q2, q2_online)  # 13 (B,)
        q_sa = q.gather(1, b.a[:, None])[:, 0]  # (B,)
        loss = loss + nn.functional.huber_loss(q_sa, y, delta=c.huber_delta)  # 14
    if c.imitation:
        loss = loss + imitation_loss(q, b.scores, c.huber_delta)
    # By huber_delta a missed margin pulls as hard as the largest TD error.
    loss = loss + c.huber_delta * (b.is_demo * margin_loss(q, b.a, c.margin)).mean()
    agent.optimizer.zero_grad()
    loss.backward()
    agent.optimizer.step()
    agent.loss = loss.item()


def read_demos(c: DemoConfig) -> list[Episode]:
    """The recorded episodes. InputError if there are none."""
    try:
        return json.loads(Path(c.demos).read_bytes())["pilots"][c.demo_pilot]["episodes"]
    except (ValueError, LookupError, TypeError):
        raise InputError(f"{c.demos} holds no episodes of a pilot called {c.demo_pilot}") from None


def load_demos(demos: list[Episode], c: DemoConfig, world: World, shaped: Callable) -> ExpertReplay:
    """Fly these episodes again, one after another, into a replay of their own."""
    if (
        steps := sum(len(e["actions"]) for e in demos)
    ) < c.n_steps + 4:  # the least to draw from, see DQNConfig
        raise InputError(f"the demonstrations have {steps} steps, too few for n_steps")
    envs = VecForest(world, 1, [episode["seed"] for episode in demos])
    consult(envs, c)
    replay = ExpertReplay(steps, envs, is_demo=True)
    for a in (np.array([int(digit)]) for episode in demos for digit in episode["actions"]):
        s = envs.reset_done()  # (1, 4, 84, 84)
        s2, r, terminated, truncated, drones = envs.step(a)
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)
    if [e["outcome"] for e in envs.episodes] != [e["outcome"] for e in demos]:
        raise InputError("on this machine the demonstrations end elsewhere")
    return replay


def pretrain(agent: Agent, demo_replay: ExpertReplay, c: DemoConfig, rng: Generator) -> None:
    """Learn from demonstrations alone."""
    for i in range(1, c.demo_updates + 1):
        learn(agent, sample(demo_replay, None, c, rng), c)
        if due(c.target_every, i * c.update_every, c.update_every):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15


def train(c: DemoConfig, envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1 of [Mnih15] with an expert; [!] marks what differs from dqn.train."""
    consult(envs, c)  # [!]
    replay = ExpertReplay(c.replay_size, envs)  # 1 [!]
    agent = Agent(c, envs.num_actions, rng)  # 2, 3
    demo_replay = load_demos(read_demos(c), c, envs.world, shaped) if c.demos else None  # [!]
    yield agent, replay
    if demo_replay and not envs.steps:  # [!]
        pretrain(agent, demo_replay, c, rng)
    for step in range(envs.steps + c.num_envs, c.steps + c.num_envs, c.num_envs):  # 4
        agent.epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_decay, c.steps)  # [+lr_decay]
        agent.optimizer.param_groups[0]["lr"] = lr
        s = envs.reset_done()  # 5, 6 (L, 4, 84, 84)
        explore = rng.random(c.num_envs) < agent.epsilon  # 7 (L,)
        random = rng.integers(envs.num_actions, size=c.num_envs)  # (L,)
        exploratory = envs.scores.argmax(1) if c.imitation else random  # (L,) [!]
        a = np.where(explore, exploratory, greedy(agent.q, s))  # 8 (L,)
        s2, r, terminated, truncated, drones = envs.step(a)  # 9, 10
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)  # 11
        updates = due(c.update_every, step, c.num_envs) if step >= c.learning_starts else 0
        for _ in range(updates):
            batch = sample(replay, demo_replay, c, rng)  # 12 [!]
            learn(agent, batch, c)  # 13, 14
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.mean.update_parameters(agent.q)
        if due(c.target_every, step, c.num_envs):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15
        yield agent, replay


DemoConfig.train = staticmethod(train)
DemoConfig.baselines = Config.baselines | {"laser": laser_pilot(DemoConfig.gamma)}
# The expert knows where the far edge is, so a smaller bonus for it and for metres is enough. 115
# was found by trial: with 125 the pilot leaves sooner, and its return is smaller; with 80 and half
# a point a metre its return is larger, but it crosses less often.
ExpertConfig = recipe(
    "ExpertConfig", DemoConfig, pilot="imitation", validate_every=20_000,
    imitation=True, bellman=False, learning_starts=500, epsilon_final=0.0, epsilon_decay=15_000,
    lr_decay=0.0, forward_reward=1.0, far_bonus=115.0, command="python -m extras.lessons.expert",
)  # fmt: skip


def main() -> int:
    """The command line of deepflight.py; the word `demonstrations` before `train` takes the recipe
    that does not imitate."""
    recorded = sys.argv[1:2] == ["demonstrations"]
    return deepflight.main(sys.argv[1 + recorded :], DemoConfig if recorded else ExpertConfig)


if __name__ == "__main__":
    sys.exit(main())
