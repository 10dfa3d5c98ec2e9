"""deepflight.py: the experiment. Train a pilot, fly it against others, print honest numbers.

    python deepflight.py train                  the default recipe, in the paper's world
    python deepflight.py train --beacon         where a pole makes the goal visible
    python deepflight.py train --camera disparity    pictures say how near things are
    python deepflight.py train --teacher        a planner with a laser says what turns are worth
    python deepflight.py train --demos FILE     learn first from flights that eval --json wrote
    python deepflight.py train --preset dqn     textbook DQN, but with Adam and eight drones
    python deepflight.py train --preset mnih    [Mnih15]'s training parameters
    python deepflight.py train --resume DIR     go on with an interrupted training
    python deepflight.py eval                   fly weights/paper.pt against three other pilots
    python deepflight.py eval --beacon          fly weights/beacon.pt where the goal is visible
    python deepflight.py eval --pilots FILE dqn    recorded flights, and dqn in the same forests

The story stands first: the settings, what the network is paid, `train`, teachers, `evaluate`.
Statistics, film and plumbing (files, signals, clocks, the command line) stand last. Skip them at
first.

`train` prints a row at every test point:

         step  eps    /s left reward |  test longer cross crash
       15,000 0.64   244   13  -17.5 |   6.5   401%   31%    4%

The drones have flown 15,000 control steps, and 64 % of the actions are random at this point. They
fly 244 steps a second, on one thread, and 13 minutes are left. The last 100 training flights earned
a reward of -17.5 each on average. Then came the test: the network flew through 48 forests without
random actions. It earned 6.5 per flight, stayed in the air 401 % longer than the random pilot,
crossed the forest in 31 % of the flights, and crashed in 4 %.

A seed is a forest. Training plants forests from [0, 10^9). Test points fly forests from [10^9,
2 * 10^9), and may choose which weights best.pt keeps. `eval` starts at 2 * 10^9, so its forests
neither shaped the weights nor chose them. A run's folder holds config.json, log.csv, best.pt and
checkpoint.pt.

Legend
    L  drones that fly side by side
    B  transitions in a batch
    A  actions
    F  flights
    The other symbols are those of dqn.py.

Not in this file: how pictures are drawn (render.py), drones fly (env.py) or networks learn (dqn.py
has the parts, and `train` puts them together).

Sources, beside those of dqn.py
    [DF]            Deep Flight: autonomous quadrotor navigation with deep RL, CMU, 2017
    [Ng 1999]       Policy invariance under reward transformations, ICML
    [Ross 2011]     A reduction of imitation learning to no-regret online learning, AISTATS
    [Wilson 1927]   Probable inference, the law of succession, and statistical inference, JASA 22
"""

import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while torch loads, for seconds

import argparse
import copy
import json
import math
import os
import re
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import Field, asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from numpy import ndarray
from numpy.random import Generator

import dqn
import env
import render
from dqn import Agent, DQNConfig, QNetwork, Replay, greedy, linear_schedule, mirror, td_target
from env import OUTCOMES, Fleet, Flights, Pilot, World, fly, fly_random, measure, refly, say, show

TRAIN_END, TEST_FIRST, EVAL_FIRST = 10**9, 10**9, 2 * 10**9  # forest seeds
TESTS = range(TEST_FIRST, TEST_FIRST + 48)  # the forests of a test point
CORES = max(os.cpu_count() or 1, 8)  # the most threads that a setting may ask for
PILOTS = ("random", "straight", "laser", "dqn")  # whom `eval` knows


@dataclass(frozen=True)
class RunConfig:
    """The experiment's settings; dqn.py has those of the algorithm. Each is a flag of `train`."""

    seed: int = dqn.setting(0, "of everything random", 0, 1e18)
    beacon: bool = dqn.setting(False, "put a visible pole at the goal", 0, 1)
    camera: str = dqn.setting("grey", "what its pictures say of each point", *render.CAMERAS)
    threads: int = dqn.setting(2, "of the CPU; another number rounds sums otherwise", 1, CORES)
    test_every: int = dqn.setting(5_000, "control steps between test points, which also save", 1)
    forward_reward: float = dqn.setting(2.0, "[+] paid per metre flown forward; 0: off", 0, 1e3)
    goal_value: float = dqn.setting(125.0, "[+] worth of arrival at the goal; 0: off", -1e6, 1e6)
    far_value: float = dqn.setting(200.0, "[+] worth of leaving by the far edge; 0: off", -1e6, 1e6)


SETTINGS = (*fields(DQNConfig), *fields(RunConfig))


# -------------------------------------------------- what the network is paid


def learner_reward(r: ndarray, infos: Sequence[dict], rc: RunConfig, gamma: float) -> ndarray:
    """What the network is paid: the rewards (L,) that it learns from.

    r (L,): the paper's rewards of one step. infos: what ForestEnv.step says of each drone.
    To the paper's reward three parts are added. In numbers, by default:

        r                          -10 to 1.25 a step                 the paper's reward [DF §II-A]
        + forward_reward * metres  2 * 0.5 = 1.0 a step at most       -1.0 for flying back
        + gamma * goal_value       0.99 * 125 = 123.75, once          on arrival at the goal
        + gamma * far_value        0.99 * 200 = 198, once             on leaving by the far edge

    Why forward_reward: r depends on where the drone is, and not on where it goes. A drone that
    circles in one place earns there as much as one that flies through it.
    Why goal_value: arrival ends the flight, and with it all rewards. A drone that could stay near
    the goal for ever would earn at most 1.25 + 0.99 * 1.25 + ... = 1.25 / (1 - 0.99) = 125 there.
    If arrival paid less, staying near could be better. So the last reward gets gamma * 125 more, as
    if the drone lived on after its arrival.
    Why far_value: no picture shows which edge is the far one. Leaving by any other edge costs 10,
    and so does this one in the paper's reward. It must pay so much that the risk is worth it; 200
    was found by trial. It is more than 125, so this pilot crosses often and seldom arrives.

    The field calls this reward shaping. A policy is a rule that picks the action in every state.
    One kind of it leaves the best policy as it is: what it pays for a step forward, it takes for
    the step back (potential-based shaping [Ng 1999]). It pays gamma * P(s2) - P(s), where P is any
    function of the state. With P = 2 * x it pays 2 * (gamma * x2 - x). We pay 2 * (x2 - x), which
    is nearly that. The prizes are not of that kind, and are meant to change the policy. All this is
    for the network alone. Every reward that is printed or logged is the paper's.
    """
    forward = np.array([info["forward"] for info in infos])  # (L,) m
    arrived = np.array([info["outcome"] == "goal" for info in infos])  # (L,)
    far = np.array([info["edge"] == "far" for info in infos])  # (L,)
    # [+forward_reward] [+goal_value] [+far_value]
    return r + rc.forward_reward * forward + gamma * (rc.goal_value * arrived + rc.far_value * far)


# -------------------------------------------------- train

# Textbook DQN, for one drone, without files and tests:
#
#     s = the start of a flight
#     for each step:
#         a = a random action with probability epsilon, else the a of greatest Q(s, a)
#         s2, r, end = fly(a)
#         put s, a, r, s2, end into the replay
#         s = s2, or if the flight has ended the start of another one
#         every 4 steps:
#             b = 32 random transitions of the replay
#             y = b.r if b.end is TERMINAL else b.r + gamma * max Q^(b.s2, .)
#             loss = the mean of (y - Q(b.s, b.a))^2 / 2, straight lines beyond an error of 1
#             move the weights of Q a little against the gradient of the loss
#             every so many updates: Q^ = Q
#
# `train` is this loop, and the pieces marked [+name]:
#
#     [+num_envs]       eight drones fly side by side: one pass through Q serves all of them
#     [+adam]           another rule for the move of the weights (dqn.make_optimizer)
#     [+lr_decay]       the learning rate falls: large strides at first, small ones to settle. (If
#                       more --steps are given, it rises again, to fall until the new end)
#     [+forward_reward] [+goal_value] [+far_value]    what `learner_reward` adds
#     [+n_steps]        a label holds five true rewards (dqn.Replay.window)
#     [+mirror]         half of each batch is reflected (dqn.mirror)
#     [+double]         Q chooses the best action of s2, and Q^ says its worth (dqn.td_target)
#     [+bfloat16]       quicker convolutions (dqn.QNetwork)
#     [+huber]          the loss has straight lines beyond an error of 10, not of 1. Say that nine
#                       labels of ten are 0, and one is -10, a crash: Q should be their mean, -1. An
#                       error pulls Q by the slope of the loss. If that is at most 1, Q comes to
#                       rest where 9 * (0 - Q) = 1, at -0.11: the crash is nearly ignored. If it may
#                       be 10, Q becomes -1. (PyTorch divides this loss by 10. That makes all pulls
#                       smaller alike, so they balance at the same Q)
#     [+average]        in the last tenth of the steps the mean of Q's weights is taken, to be
#                       flown: every update changes how Q flies, and a mean is steady
#     [+teacher] [+demos]    off by default; they have a section of their own, after `train`
#
# What belongs to files, tests and clocks is asked of `run` (class Run, below):
#
#     run = Run(...)    makes the files; or, given a checkpoint, sets agent, replay, fleet and rng
#                       to what they were there
#     run.steps()       8, 16, 24, ...: eight drones fly, so each pass makes eight control steps
#     run.due(4)        how often something is due in this pass that is due every 4 steps. Say that
#                       this pass makes steps 9 to 16. 12 and 16 are multiples of 4: two updates
#     run.last_share    whether this is the last tenth of all steps
#     run.note()        counts flights, shows progress
#     run.test()        flies the test forests, saves, keeps the weights of the best test in
#                       best.pt; in the last tenth the mean of the weights flies, and is kept


def train(c: DQNConfig, rc: RunConfig, folder: Path, saved: Any = None, demos: Any = ()) -> int:
    """Algorithm 1 of [Mnih15]; numbers in comments are its lines, listed in dqn.py. folder: of the
    run's files. saved: a checkpoint to go on with. demos: demonstrated flights, an `env.Record`.
    Returns the exit code."""
    world, rng = World(beacon=rc.beacon, camera=rc.camera), np.random.default_rng(rc.seed)
    replay = Replay(c.replay_size, c.num_envs, world.actions if c.teacher else 0)  # 1
    agent = Agent(c, world.actions, rc.seed)  # 2, 3
    fleet = Fleet(world, c.num_envs)  # [+num_envs]
    demos = saved["demos"] if saved else list(demos)  # [+demos]
    lesson = recall(demos, c, rc) if demos else None  # a replay of their own
    run = Run(folder, c, rc, (agent, replay, fleet, rng, demos), saved)
    for step in run.steps():  # 6
        epsilon = linear_schedule(step, 1.0, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr * c.lr_decay, c.steps)  # [+lr_decay]
        agent.optimizer.param_groups[0]["lr"] = lr
        fleet.reset(fleet.landed, rng.integers(TRAIN_END, size=len(fleet.landed)))  # 4, 5
        s, scores = fleet.observations, teach(fleet, c, rc)  # (L, 4, 84, 84), (L, A) [+teacher]
        explore = rng.random(c.num_envs) < epsilon  # 7 (L,)
        trial = rng.integers(world.actions, size=c.num_envs)  # (L,)
        trial = scores.argmax(1) if c.teacher else trial  # (L,) [+teacher]
        a = np.where(explore, trial, greedy(agent.q, s))  # 8 (L,)
        s2, r, terminated, truncated, infos = fleet.step(a)  # 9, 10
        r = learner_reward(r, infos, rc, c.gamma)  # (L,)
        replay.add(s, a, r, s2, terminated, truncated, scores)  # 11
        first = lesson is not None and agent.updates == 0  # [+demos]
        if first:
            rehearse(agent, lesson, c, rng)
        updates = run.due(c.update_every) if step >= c.learning_starts else 0
        for _ in range(updates):
            learn(agent, draw(replay, lesson, c, rng), c)  # 12 to 15
            if run.last_share:  # [+average]
                agent.mean.update_parameters(agent.q)
        run.note()
        if first or run.due(rc.test_every) or step >= c.steps:
            run.test(epsilon)
    return run.finish()


def draw(replay: Replay, lesson: Replay | None, c: DQNConfig, rng: Generator) -> dqn.Batch:
    """A batch of tensors (line 12). [+demos] A share of it comes from the demonstrations."""
    shown = round(c.demo_share * c.batch_size) if lesson else 0
    parts = [(replay, c.batch_size - shown), (lesson, shown)]
    drawn = [part.sample(n, c.n_steps, c.gamma, rng) for part, n in parts if n]  # [+n_steps]
    columns = zip(*drawn, strict=True)  # s of all parts, then a of all parts, ...
    batch = dqn.Batch(*(np.concatenate(column) for column in columns))  # all with B rows
    batch = mirror(batch, env.World.actions, rng) if c.mirror else batch  # [+mirror]
    return dqn.Batch(*map(torch.from_numpy, batch))


def learn(agent: Agent, b: dqn.Batch, c: DQNConfig) -> None:
    """Lines 13 to 15: move the weights once, and now and then renew Q^."""
    q = agent.q(b.s, agent.bfloat16)  # (B, A) [+bfloat16]
    agent.loss = torch.zeros(())
    if c.bellman:
        with torch.no_grad():
            q2 = agent.q_target(b.s2, agent.bfloat16)  # (B, A)
            q2_online = agent.q(b.s2, agent.bfloat16) if c.double else q2  # (B, A) [+double]
            y = td_target(b.r, b.gamma_n, b.end, q2, q2_online)  # 13 (B,)
        q_sa = q.gather(1, b.a[:, None])[:, 0]  # (B,)
        agent.loss = torch.nn.functional.smooth_l1_loss(q_sa, y, beta=c.huber)  # 14 [+huber]
    if c.teacher:  # [+teacher]
        agent.loss = agent.loss + dqn.teacher_loss(q, b.scores)
    if b.shown.any():  # [+demos]
        agent.loss = agent.loss + (b.shown * dqn.margin_loss(q, b.a, c.margin)).mean()
    agent.optimizer.zero_grad()
    agent.loss.backward()
    agent.optimizer.step()
    agent.updates += 1
    if agent.updates % c.target_every == 0:
        agent.q_target.load_state_dict(agent.q.state_dict())  # 15


# -------------------------------------------------- a teacher, demonstrations [DF §IV]

# The paper ends with two wishes: demonstrations to begin with, and demonstrations in the loop.
#
# [+teacher], in the loop. Of each state that the network meets, a teacher says what each of the
# nine actions is worth: nine labels a state. Where Q would explore, the action is the teacher's. So
# the teacher flies at first, and after 15,000 steps the network flies alone. Why not let the
# teacher fly all the time, and learn from its flights? Because a network errs a little. Its errors
# take it to states where the teacher never was. There it would know nothing [Ross 2011, DAgger].
# The teacher is `env.plan`. It has a laser and knows its place. The network has four pictures, so
# it cannot do all that the teacher does. It learns what an action is worth on average, over all the
# places that look alike. Say that an edge is seen, and one time in four it is the far one. Then
# straight on is worth 6 more than turning, otherwise 6 less: on average 3 less. So it turns.
# By default a taught network learns no labels of line 13 (--no-bellman). Then its nine numbers are
# not Q: only their differences mean something. `--bellman` adds those labels.
#
# [+demos], to begin with. A file holds flights of any pilots, or of a person. This makes 32:
#     python deepflight.py eval --pilots laser --first-seed 0 --episodes 32 --json demos.json
# Somebody took action a in state s, and that is all that a flight says. So Q(s, a) should be the
# greatest of the nine, by a margin (dqn.margin_loss) [Hester 2018]. The network learns from these
# flights alone at first. Their rewards count like others. With `--demo-share 0.25` a quarter of
# each later batch is theirs too. Then `--epsilon-decay 40000` is needed, so that the drone explores
# as usual. Demonstrated flights do not crash, and who has seen few crashes does not see one coming.


def teach(fleet: Fleet, c: DQNConfig, rc: RunConfig) -> ndarray | float:
    """[+teacher] What each action is worth to the drones in the air (F, A). `env.plan` plans by
    what the network is paid. Without a teacher: 0."""
    if not c.teacher:
        return 0.0
    return env.teach(fleet, c.gamma, rc.forward_reward, rc.goal_value, rc.far_value)


def rehearse(agent: Agent, lesson: Replay, c: DQNConfig, rng: Generator) -> None:
    """[+demos] Learn from demonstrated flights alone."""
    for i in range(c.demo_updates):
        show(f"learning from demonstrations: {i:,} of {c.demo_updates:,} updates")
        learn(agent, draw(lesson, None, c, rng), c)  # all of each batch


def recall(demos: env.Record, c: DQNConfig, rc: RunConfig) -> Replay:
    """[+demos] A replay of demonstrated flights, in one lane, made by flying them again."""
    fleet = Fleet(World(beacon=rc.beacon, camera=rc.camera), 1)
    steps = sum(len(actions) for _, actions in demos)
    if steps < (least := c.n_steps + 4):  # see `configure`
        raise ValueError(f"demonstrations have {steps} steps, allowed are {least} or more")
    lesson = Replay(steps, 1, env.World.actions if c.teacher else 0, shown=True)
    for i, (seed, actions) in enumerate(demos):
        show(f"flying demonstration {i + 1:,} of {len(demos):,}")
        fleet.reset([0], [seed])
        for action in actions:
            remember(lesson, fleet, [int(action)], c, rc)
        if not fleet.landed:
            raise ValueError(f"demonstration {i + 1} does not end")
    show("")
    return lesson


def remember(replay: Replay, fleet: Fleet, a: list[int], c: DQNConfig, rc: RunConfig) -> None:
    """Fly a step whose actions (L,) are known, and write it into a replay."""
    s, scores = fleet.observations, teach(fleet, c, rc)  # (L, 4, 84, 84), (L, A)
    s2, r, terminated, truncated, infos = fleet.step(a)
    r = learner_reward(r, infos, rc, c.gamma)  # (L,)
    replay.add(s, a, r, s2, terminated, truncated, scores)


# -------------------------------------------------- other settings

# With the beacon the goal can be seen. So no other way out should be worth as much. Metres are not
# paid either: a pilot that is paid for them flies past the goal. Finding the goal takes longer to
# learn.
BEACON = {"steps": 400_000, "forward_reward": 0.0, "far_value": 50.0}
# A teacher acts where Q would explore, until Q acts alone. It knows where the far edge is, so less
# pay for metres and for that edge is enough. 115 was found by trial: with 125 the pilot leaves
# sooner, and earns less; with 80, and 0.5 a metre, it stays longer, earns more, and crosses less
# often.
TEACHER = dict(
    bellman=False, learning_starts=500, epsilon_final=0.0, epsilon_decay=15_000,
    test_every=20_000, forward_reward=1.0, far_value=115.0,
    lr_decay=0.0,  # the learning rate falls to 0
)  # fmt: skip
# Whoever has seen demonstrations need not begin by chance.
DEMOS = {"epsilon_decay": 1}
# Textbook DQN on the paper's reward, with Adam. What is only quicker stays: eight drones fly side
# by side, in bfloat16.
DQN = dict(
    double=False, n_steps=1, mirror=False, huber=1.0, lr_decay=1.0, average=0.0,
    forward_reward=0.0, goal_value=0.0, far_value=0.0,
)  # fmt: skip
# [Mnih15, Extended Data Table 1], as the paper says [DF §II-B], but eight drones fly, and rewards
# are not cut. 1.4 M steps are the paper's own.
# Mnih's table says: copy Q to the target network every 10,000 updates. Mnih's code does it every
# 10,000 steps, which are 2,500 updates. We follow the code.
MNIH = DQN | dict(
    steps=1_400_000, replay_size=1_000_000, learning_starts=50_000, target_every=2_500,
    epsilon_final=0.1, epsilon_decay=1_000_000, adam=False, bfloat16=False,
)  # fmt: skip
PRESETS = {"default": {}, "dqn": DQN, "mnih": MNIH}
# What these flags change, unless told otherwise; a later one outdoes an earlier one.
FLAGS = {"demos": DEMOS, "teacher": TEACHER, "beacon": BEACON}


# -------------------------------------------------- eval


def dqn_pilot(q: QNetwork) -> Pilot:
    """The greedy policy of a Q-network: four pictures and nothing else."""
    return lambda fleet: greedy(q, fleet.observations)


def evaluate(args: argparse.Namespace) -> int:
    """Fly every pilot through the same forests; print the table, write JSON and a film."""
    (q, recorded), gif = load_pilot(args), args.out / "flight.gif"
    world, rng = World(beacon=args.beacon, camera=args.camera), np.random.default_rng(0)
    seeds = range(args.first_seed, args.first_seed + args.episodes)
    seeds = [flight["seed"] for flight in recorded] or seeds
    pilots = {"straight": env.straight_pilot, "laser": env.laser_pilot(DQNConfig.gamma)}
    pilots["dqn"] = dqn_pilot(q)
    bar = fly_random(seeds, world, rng)
    flights: dict[str, Flights] = {}
    for p in args.pilots:
        if p in pilots:
            flights[p] = fly(pilots[p], seeds, world, blind=p != "dqn")
        else:
            flights[p] = bar if p == "random" else recorded
    draws = rng.integers(len(seeds), size=(2000, len(seeds)))  # (2000, forests) resampled
    figures = {p: summarize(flights[p], bar, draws) for p in flights}
    where = "of the file, the first with" if recorded else "from"
    many = f"{len(seeds)} forests {where} seed {seeds[0]}; 95 % intervals in [ ]\n"
    say(many if len(seeds) > 1 else f"1 forest, of seed {seeds[0]}\n")
    print_table(figures)
    if args.json:
        report = {"program": "Deep Flight", "weights": str(args.weights), "beacon": args.beacon}
        report |= {"camera": args.camera, "first_seed": seeds[0], "forests": len(seeds)}
        report["pilots"] = {p: figures[p] | {"flights": flights[p]} for p in flights}
        with dqn.whole_file(args.json) as file:
            file.write(json.dumps(report).encode())
    failed = [f["seed"] for f in flights.get("dqn", []) if not measure([f])["crossed"][0]]
    if failed:
        say("\na flight of dqn that did not cross, in the cockpit (extras/README.md):")
        say(cockpit(world, args.weights, failed[0]))
    say(f"\nwrote {args.json}" if args.json else "")
    shown = int(measure(flights[args.pilots[-1]])["crossed"].argmax())  # the first to cross, or 0
    with dqn.whole_file(gif) as file:
        pictures = film({p: flights[p][shown] for p in flights}, world, q)
        render.save_film(file, pictures, round(1000 * world.dt))
    say(f"wrote {gif}: forest {seeds[shown]}, {args.pilots[-1]}")
    return 0


def cockpit(world: World, weights: Path, seed: int) -> str:
    """The address where extras/cockpit shows how a network flies through a forest.

    >>> cockpit(World(), Path("runs/mine/best.pt"), 7)
    'http://127.0.0.1:8642/#world=plain&weights=runs/mine&pilot=network&seed=7'
    """
    kind = "beacon" if world.beacon else "plain" if world.camera == "grey" else world.camera
    name = f"runs/{weights.parent.name}" if weights.name == "best.pt" else weights.stem
    return f"http://127.0.0.1:8642/#world={kind}&weights={name}&pilot=network&seed={seed}"


# -------------------------------------------------- statistics, film: skip on a first reading


def summarize(flights: Flights, bar: Flights, draws: ndarray) -> dict[str, dict]:
    """Every figure with its 95 % interval: value, low, high; of one forest the value alone.

    Flights through the same forest resemble each other. So a mean is taken over forests, and its
    interval comes from the bootstrap: draw as many forests again, with replacement, 2,000 times,
    and see how the mean varies. draws (2000, forests) says which. A share has Wilson's interval.
    """
    forests = draws.shape[1]
    means = {key: x.reshape(-1, forests).mean(0) for key, x in measure(flights).items()}
    random_steps = measure(bar)["steps"].reshape(-1, forests).mean(0)  # (forests,)
    figures = {k: interval(means[k].mean(), means[k][draws].mean(1)) for k in MEANS}
    ratios = means["steps"][draws].mean(1) / random_steps[draws].mean(1)  # (2000,)
    figures["over_random"] = interval(means["steps"].mean() / random_steps.mean() - 1, ratios - 1)
    figures |= {key: wilson(means[key].mean(), forests) for key in ("crossed", *OUTCOMES)}
    return figures if forests > 1 else {k: {"value": x["value"]} for k, x in figures.items()}


def interval(value: float, resampled: ndarray) -> dict[str, float]:
    """A figure and the middle 95 % of its bootstrap."""
    low, high = np.percentile(resampled, [2.5, 97.5])
    return {"value": float(value), "low": float(low), "high": float(high)}


def wilson(p: float, n: int) -> dict[str, float]:
    """A share p of n, and its 95 % interval by Wilson's score [Wilson 1927].

    >>> {key: round(x, 3) for key, x in wilson(1.0, 10).items()}
    {'value': 1.0, 'low': 0.722, 'high': 1.0}
    """
    z = 1.96
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return {"value": float(p), "low": max(middle - half, 0.0), "high": min(middle + half, 1.0)}


MEANS = ("steps", "progress", "return")  # the other figures are shares
ROWS = {  # the table: figure -> label, factor
    "steps": ("steps", 1), "over_random": ("vs random, %", 100), "crossed": ("crossed, %", 100),
    "crash": ("crashed, %", 100), "goal": ("arrived, %", 100), "return": ("total reward", 1),
}  # fmt: skip


def print_table(figures: dict[str, dict]) -> None:
    """One row a figure, one column a pilot; more than one table where the terminal is narrow."""
    room = max((shutil.get_terminal_size().columns - 12) // 17, 1)
    for some in (list(figures)[i : i + room] for i in range(0, len(figures), room)):
        say(f"{'':12}" + "".join(f"{name[-16:]:>17}" for name in some))
        for key, (label, factor) in ROWS.items():
            cells = [[f"{factor * x:z.0f}" for x in figures[p][key].values()] for p in some]
            texts = [f"{x} [{', '.join(ends)}]" if ends else x for x, *ends in cells]
            say(f"{label:12}" + "".join(f"{text:>17}" for text in texts))


@torch.no_grad()
def film(flown: dict[str, dict], world: World, q: QNetwork) -> Iterator[render.Image.Image]:
    """The pictures of the last pilot's flight: what it sees, its Q, a map with all pilots' ways."""
    *others, (name, flight) = flown.items()
    trunks, title = env.plant(flight["seed"], world), f"forest {flight['seed']}"
    chart = render.draw_map(trunks, (world.length, world.width), title)
    chart = render.draw_ways(chart, [(*track(f, world), pilot) for pilot, f in others])
    (path, end), total = track(flight, world), 0.0
    for t, (s, r, *_, info) in enumerate(refly(flight["seed"], flight["actions"], world)):
        total += r
        action, ended = (int(flight["actions"][t]), "") if t < flight["steps"] else (-1, end)
        if t % (1 + flight["steps"] // 300) and not ended:
            continue  # of a long flight not every step is filmed
        seen = render.draw_ways(chart, [(path[: t + 1], ended, "")])
        values = q(torch.from_numpy(s)[None])[0].numpy() if name == "dqn" else None  # (A,)
        clock = f"{t * world.dt:.1f} s, {info['d_goal']:.1f} m to the goal"
        lines = (f"{name}: {clock}", f"reward so far {total:.1f}", render.ENDS[ended])
        panel = render.draw_panel(s[-1], seen, values, action, lines)
        yield panel
    yield from [panel] * 20  # the end stays for two seconds


def track(flight: dict[str, Any], world: World) -> tuple[ndarray, str]:
    """Where a flight went (T, 2) in m, by flying it again, and its edge or outcome."""
    steps = refly(flight["seed"], flight["actions"], world, blind=True)
    return np.array([info["pose"][:2] for *_, info in steps]), flight["edge"] or flight["outcome"]


# -------------------------------------------------- plumbing: skip it on a first reading

HEAD = "     step  eps    /s left reward |  test longer cross crash"
ROW = "{step:9,}{epsilon:5.2f}{speed:6.0f}{eta:5.0f}{train_return:7.1f} |{test_return:6.1f}"
ROW += "{test_over_random:z7.0%}{test_crossed:6.0%}{test_crash:6.0%}"
WEIGHTS = rb"PK.*kind.*weights.*network.*conv\.0\.weight"  # how dqn.save_weights begins a file
RUN_FILES = {  # of a run's folder, and how each begins
    "best.pt": WEIGHTS, "config.json": rb'\{\s*"steps": \d+,\s*"gamma": .*"beacon": .*"far_value"',
    "log.csv": b"step,episodes,updates,epsilon,train_steps,.*,test_over_random",
    "checkpoint.pt": b"PK.*kind.*checkpoint.*settings.*steps.*gamma",
}  # fmt: skip
# Ctrl-C, kill, a closed terminal, Ctrl-\
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Run:
    """What a training asks of the machine: a log, a clock, a checkpoint, Ctrl-C."""

    def __init__(self, folder: Path, c: DQNConfig, rc: RunConfig, parts: Any, saved: Any) -> None:
        """Begin, or go on where the checkpoint `saved` stands. Nothing is written before that."""
        torch.set_flush_denormal(True)  # else RMSprop's dead moments, below 1e-38, halve the speed
        torch.set_num_threads(rc.threads)
        self.folder, self.c, self.rc, self.stopped = folder, c, rc, 0
        self.agent, self.replay, self.fleet, self.rng, self.demos = parts
        self.book = {"step": 0, "episodes": 0, "seconds": 0.0, "recent": [], "log": [], "best": []}
        if saved:
            self.restore(saved)
        folder.mkdir(parents=True, exist_ok=True)
        for name, mark in RUN_FILES.items():
            for part in folder.glob(f".{name}.{'[0-9a-f]' * 8}.part"):
                ours = re.match(mark + rb"|\Z", dqn.head(part), re.DOTALL)  # of a killed save
                if ours and part.is_file():
                    dqn.attempt(part.unlink)
        self.save()
        with dqn.whole_file(folder / "config.json") as file:
            file.write(json.dumps(asdict(c) | asdict(rc), indent=2).encode())

    def steps(self) -> Iterator[int]:
        """The numbers of the control steps to come, until the last or a signal."""
        # Python takes signals in the main thread only. One that is ignored stays so: nohup.
        taken = STOPS if threading.current_thread() is threading.main_thread() else ()
        taken = [n for n in taken if signal.getsignal(n) != signal.SIG_IGN]
        handlers = {n: signal.signal(n, self.stop) for n in taken}
        ENDING.clear()
        self.started = time.perf_counter() - self.book["seconds"]
        steps = math.ceil(self.c.steps / self.c.num_envs) * self.c.num_envs
        try:
            say(f"to {self.folder}: {steps:,} steps, {self.c.num_envs} at a time\n\n{HEAD}")
            while self.book["step"] < self.c.steps and not self.stopped:
                self.book["step"] += self.c.num_envs
                yield self.book["step"]
        finally:
            for n, handler in handlers.items():
                signal.signal(n, handler)

    def stop(self, number: int, _frame: object) -> None:
        """A first signal lets the step end and saves; a second stops at once."""
        if self.stopped:
            stop_at_once(number, None)
        self.stopped = number
        say("\nstopping: this step ends and is saved; again: at once", file=sys.stderr)

    @property
    def last_share(self) -> bool:
        """Whether this is one of the last steps, in which the mean of Q's weights is taken."""
        return self.c.average > 0 and self.book["step"] > (1 - self.c.average) * self.c.steps

    def due(self, every: int) -> int:
        """How many updates or tests fall due on this step: one for each so many control steps."""
        return self.book["step"] // every - (self.book["step"] - self.c.num_envs) // every

    def note(self) -> None:
        """Count the flights that have landed, and show a passing status."""
        book, landed = self.book, [self.fleet.envs[lane].flight() for lane in self.fleet.landed]
        book["episodes"] += len(landed)
        book["recent"] = (book["recent"] + landed)[-100:]
        book["seconds"] = time.perf_counter() - self.started
        if not self.agent.loss.isfinite():
            why = f"the loss is {self.agent.loss.item()} at step {book['step']:,}: is lr too high?"
            raise FloatingPointError(f"{why} Last good: {self.folder / 'checkpoint.pt'}")
        speed = book["step"] / book["seconds"]
        self.clock = {"speed": speed, "eta": max(self.c.steps - book["step"], 0) / speed / 60}
        show("step {}: {speed:.0f} a second, {eta:.1f} min left".format(book["step"], **self.clock))

    def test(self, epsilon: float) -> None:
        """Fly the test forests and log it. best.pt keeps the weights of the best test so far. In
        the last share of the steps it keeps the mean of the weights instead, whatever its score,
        because the best of many scores is partly luck."""
        book, late = self.book, self.last_share and self.agent.mean.n_averaged > 0
        q = self.agent.mean.module if late else self.agent.q
        q = copy.deepcopy(q).half().float()  # what best.pt keeps is in half precision: fly that
        row = {"step": book["step"], "episodes": book["episodes"], "updates": self.agent.updates}
        row["epsilon"] = epsilon
        recent = book["recent"] or [drone.flight() for drone in self.fleet.envs]  # none has landed
        flown = {"train": recent, "test": fly(dqn_pilot(q), TESTS, self.fleet.world)}
        for who, flights in flown.items():
            row |= {f"{who}_{key}": x.mean().item() for key, x in measure(flights).items()}
        row["test_over_random"] = row["test_steps"] / random_steps(TESTS, self.fleet.world) - 1
        row["seconds"] = round(book["seconds"], 1)
        book["log"] = [*(book["log"] or [",".join(row)]), ",".join(map(str, row.values()))]
        score = [row["test_goal" if self.rc.beacon else "test_crossed"], row["test_progress"]]
        with dqn.whole_file(self.folder / "log.csv") as file:
            file.write("\n".join([*book["log"], ""]).encode())
        if late or score > book["best"]:
            seen = {"beacon": self.rc.beacon, "camera": self.rc.camera}
            dqn.save_weights(self.folder / "best.pt", q, **seen)
            book["best"] = score
        self.save()  # and then print, which may fail
        say(ROW.format(**row | self.clock))

    def content(self) -> dict[str, Any]:
        """What a checkpoint holds: 34 MB; of the replay only each flight's seed and actions."""
        content = {"settings": asdict(self.c) | asdict(self.rc), "machine": dqn.MACHINE}
        content |= {"agent": dict(self.agent.state_dict()), "rng": self.rng.bit_generator.state}
        content |= {"flights": self.fleet.record(self.replay.rows), "demos": self.demos}
        return content | {"book": self.book}

    def save(self) -> None:
        """Write the checkpoint."""
        dqn.save(self.folder / "checkpoint.pt", "checkpoint", self.content())

    def restore(self, saved: dict[str, Any]) -> None:
        """Check that a checkpoint is like one of ours, and set everything as it was."""
        flight = self.fleet.envs[0].flight()
        like = self.content() | {"flights": [[(0, "")]], "demos": [(0, "")]}
        like["book"] = self.book | {"recent": [flight], "log": [""], "best": [0.0]}
        dqn.check_like(saved, like, self.folder / "checkpoint.pt")
        self.book = saved["book"]
        if (flown := self.book["step"]) >= self.c.steps:
            raise ValueError(f"{self.folder} has flown {flown:,} steps: give more by --steps")
        try:
            self.refill(saved["flights"])
            self.rng.bit_generator.state = saved["rng"]
        except (ValueError, LookupError, StopIteration, OverflowError):
            text = f"{self.folder} cannot be flown again here; is it another machine's?"
            raise ValueError(text) from None
        self.agent.load_state_dict(saved["agent"])
        if not self.last_share:  # a longer training takes the mean of its own last share
            self.agent.mean.n_averaged.zero_()

    def refill(self, flights: list[list[tuple[int, str]]]) -> None:
        """Fill the replay by flying all its flights again, those of each lane one after another."""
        replay, fleet = self.replay, self.fleet
        rows = min(self.book["step"] // self.c.num_envs, replay.rows)
        replay.added = self.book["step"] // self.c.num_envs - rows
        seeds = [iter([seed for seed, _ in lane]) for lane in flights]
        digits = ["".join(actions for _, actions in lane) for lane in flights]
        for lane, actions in enumerate(digits if rows else ()):
            fleet.reset([lane], [next(seeds[lane])])
            for a in actions[:-rows]:  # their pictures were overwritten already
                fleet.envs[lane].step(int(a))
        for row in range(-rows, 0):
            show(f"flying the replay again: {-row * len(digits):,} steps to go")
            fleet.reset(fleet.landed, [next(seeds[lane], 0) for lane in fleet.landed])
            remember(replay, fleet, [int(actions[row]) for actions in digits], self.c, self.rc)
        show("")
        if fleet.record(replay.rows) != flights:
            raise ValueError("other flights")

    def finish(self) -> int:
        """The exit code: 0; or, saved and with the command that goes on, 128 and the signal."""
        if self.c.teacher:
            say(f"the teacher labelled {self.book['step']:,} states")
        if not self.stopped or self.book["step"] >= self.c.steps:
            return 0
        self.save()
        say(f"saved at step {self.book['step']:,}; {resume_line(self.folder)}", file=sys.stderr)
        return 128 + self.stopped


def resume_line(folder: Path) -> str:
    """How to go on with a training, from wherever one is."""
    script, folder = (str(path.resolve()) for path in (Path(__file__), folder))
    return "to go on:\n" + shlex.join([sys.executable, script, "train", "--resume", folder])


@cache
def random_steps(seeds: range, world: World) -> float:
    """How many steps the random pilot flies through these forests in the mean."""
    return measure(fly_random(seeds, world, np.random.default_rng(0)))["steps"].mean().item()


ENDING: list[int] = []  # the signal that ends the program


def stop_at_once(number: int, _frame: object) -> None:
    """End by a KeyboardInterrupt. Whoever keeps pressing Ctrl-C finds the program ending."""
    if not ENDING:
        ENDING.append(number)
        raise KeyboardInterrupt


class Parser(argparse.ArgumentParser):
    """argparse, but a bad command line gets one line instead of the whole usage."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and no more."""
        raise ValueError(message)


def place(text: str) -> Path:
    """A path on the command line."""
    if not text:
        raise argparse.ArgumentTypeError("is empty, needed is the name of a file or folder")
    return Path(text)


def describe(f: Field) -> str:
    """The help of a setting's flag: what it is, what is allowed, what the presets make of it."""
    legal = {bool: "true or false", str: "{} or {}"}.get(f.type, "{:,g} to {:,g}")
    legal = legal.format(*f.metadata["legal"])
    presets = PRESETS | FLAGS
    changes = [f"; {name} {presets[name][f.name]}" for name in presets if f.name in presets[name]]
    return f"{f.metadata['help']} ({legal}; default {f.default}{''.join(changes)})"


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; every setting is a flag of `train`. Raises ValueError."""
    parser = Parser(prog="deepflight.py", description="Train a pilot, fly it against others.")
    commands = parser.add_subparsers(metavar="train or eval", required=True)
    sub = commands.add_parser("train", help="train a pilot", argument_default=argparse.SUPPRESS)
    sub.set_defaults(run=start_training, preset=None, name=None, resume=None, demos=None)
    kinds = "dqn: textbook DQN with Adam; mnih: with [Mnih15]'s parameters"
    sub.add_argument("--preset", choices=PRESETS, metavar="NAME", help=kinds)
    sub.add_argument("--name", help="name of the folder in runs/; by default a new number")
    sub.add_argument("--resume", type=place, help="folder of a training to go on with")
    of = "learn first, and beside its own, from the flights of a file of eval --json"
    sub.add_argument("--demos", type=place, metavar="FILE", help=of)
    for f in SETTINGS:
        kind = {"action": argparse.BooleanOptionalAction} if f.type is bool else {"type": f.type}
        kind |= {} if f.type is bool else {"metavar": "N" if f.type is int else "X"}
        sub.add_argument("--" + f.name.replace("_", "-"), help=describe(f), **kind)
    sub = commands.add_parser("eval", help="fly trained weights against three other pilots")
    sub.set_defaults(run=evaluate)
    sub.add_argument("--weights", type=place, help="default: those shipped for this world")
    of = f"of {', '.join(PILOTS)}; default: all. Or one file of eval --json: then its forests"
    sub.add_argument("--pilots", nargs="+", default=PILOTS, metavar="PILOT", help=of)
    more = {"choices": render.CAMERAS, "default": "grey", "metavar": "KIND"}
    sub.add_argument("--camera", **more, help="what its pictures say: grey or disparity")
    more = {"type": int, "metavar": "N"}
    sub.add_argument("--episodes", **more, default=100, help="forests, up to 10,000; default: 100")
    first = "forest to begin with, up to 1e18; default: %(default)s"
    sub.add_argument("--first-seed", **more, default=EVAL_FIRST, help=first)
    sub.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    sub.add_argument("--json", type=place, metavar="FILE", help="write every figure and flight")
    out = "folder of the film; default: %(default)s"
    sub.add_argument("--out", type=place, default="runs/eval", help=out)
    known = "OMP_NUM_THREADS" in os.environ  # torch has read it
    threads = torch.get_num_threads() if known else RunConfig.threads
    sub.add_argument("--threads", **more, default=threads, help="default: OMP_NUM_THREADS or 2")
    return parser.parse_args(argv)


def start_training(args: argparse.Namespace) -> int:
    """Check all that is given before anything is written, then train."""
    given = {f.name: vars(args)[f.name] for f in SETTINGS if f.name in args}
    if args.resume:
        if given.keys() - {"steps"} or {args.name, args.preset, args.demos} != {None}:
            raise ValueError(f"{args.resume} keeps its own settings: give none but --steps")
        return resume_training(args.resume, given)
    if args.name is not None and not re.fullmatch(r"\w[\w.-]{0,99}", args.name, re.ASCII):
        legal = "100 of a-z, A-Z, 0-9, dot, dash, underscore; the first no dot or dash"
        raise ValueError(f"name is {args.name!r}, allowed are {legal}")
    changed = [FLAGS[name] for name in FLAGS if vars(args).get(name)]
    changed += [PRESETS[args.preset or "default"], given]
    c, rc = configure({key: value for changes in changed for key, value in changes.items()})
    flights = read_flights(args.demos, rc.beacon, TRAIN_END - 1) if args.demos else []
    demos = [(flight["seed"], flight["actions"]) for flight in flights]
    numbers = (f"{i:03d}" for i in range(1, 10**6) if not os.path.lexists(f"runs/{i:03d}"))
    folder = Path("runs", args.name or next(numbers))
    made = [path for path in (folder, folder.parent) if not os.path.exists(path)]
    try:
        make_folder(folder)
        args.resume = folder  # should it be interrupted
        with dqn.lock_folder(folder):
            return train(c, rc, folder, demos=demos)
    finally:
        for path in made:
            with suppress(OSError):  # something has been saved there
                path.rmdir()


def make_folder(folder: Path) -> None:
    """Make a run's folder. Raises ValueError where that cannot be done."""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        hint = f"; to go on with it: --resume {folder}" * os.path.exists(folder / "checkpoint.pt")
        raise ValueError(f"{error.filename} cannot be made: {error.strerror}{hint}") from None


def resume_training(folder: Path, given: dict[str, Any]) -> int:
    """Hold the folder, then read its checkpoint, and go on."""
    if not os.path.isfile(folder / "checkpoint.pt"):
        raise ValueError(f"{folder} holds no checkpoint.pt: give the folder of a training")
    with dqn.lock_folder(folder):
        for name, mark in RUN_FILES.items():
            if (folder / name).is_symlink():
                raise ValueError(f"{folder / name} is a link: take it away")
            dqn.check_output(folder / name, mark)
        saved = dqn.load(folder / "checkpoint.pt", "checkpoint")
        like = {"settings": asdict(DQNConfig()) | asdict(RunConfig()), "machine": dqn.MACHINE}
        like["demos"] = [(0, "")]
        dqn.check_like({key: saved.get(key) for key in like}, like, folder / "checkpoint.pt")
        if saved["machine"] != dqn.MACHINE:
            raise ValueError(f"{folder} is of {saved['machine']}, here is {dqn.MACHINE}")
        return train(*configure(saved["settings"] | given), folder, saved)


def configure(given: dict[str, Any]) -> tuple[DQNConfig, RunConfig]:
    """Both kinds of settings; ValueError names what is wrong."""
    c = DQNConfig(**{key: value for key, value in given.items() if hasattr(DQNConfig, key)})
    rc = RunConfig(**{key: value for key, value in given.items() if hasattr(RunConfig, key)})
    for settings in (c, rc):
        env.check_numbers(settings, {f.name: f.metadata["legal"] for f in fields(settings)})
    # The least: three rows to complete a stack, n_steps that wait for rewards, one to draw.
    window, why = c.num_envs * (c.n_steps + 4), "num_envs and n_steps"
    for name, least, by in (
        ("replay_size", window, why),
        ("learning_starts", window, why),
        ("steps", c.learning_starts + 1, "learning_starts"),
    ):
        if (value := getattr(c, name)) < least:
            text = f"{name} is {value}, allowed are whole numbers from {least}, because of {by}"
            raise ValueError(text)
    if not c.bellman and not c.teacher:
        raise ValueError("bellman is False, allowed is True, because there is no teacher")
    return c, rc


def read_flights(path: Path, beacon: bool, last_seed: float = math.inf) -> Flights:
    """The flights of a file that `eval --json` or the cockpit wrote. Raises ValueError unless they
    fly again as it says, in this world, through forests up to `last_seed`."""
    if not os.path.isfile(path) or not 0 < os.path.getsize(path) <= dqn.LARGEST:
        raise ValueError(f"{path} is no file of flights, such as eval --json writes")
    try:
        report = json.loads(path.read_bytes())
        written = [flight for pilot in report["pilots"].values() for flight in pilot["flights"]]
        if report["beacon"] is not beacon:
            raise ValueError(f"they are not of a world with beacon {beacon}")
        dqn.check_like([(f["seed"], f["actions"]) for f in written], [(0, "")], "flights")
        if not written:
            raise ValueError("it holds no flights")
        return [fly_again(i, flight, last_seed) for i, flight in enumerate(written, 1)]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        other = getattr(error, "strerror", None) or "eval --json did not write it"
        why = error if isinstance(error, ValueError) else other
        raise ValueError(f"{path} cannot be flown again: {why}") from None


def fly_again(number: int, written: dict[str, Any], last_seed: float) -> dict[str, Any]:
    """A flight of a file, flown again. Raises ValueError unless it ends as it is written."""
    show(f"flying recorded flight {number:,}")
    drone = env.ForestEnv(World(), blind=True)
    drone.reset(seed=env.whole_number("seed", written["seed"], last_seed))
    for action in written["actions"]:
        drone.step(int(action))
    flown = drone.flight()
    same = flown["outcome"] and all(flown[key] == written[key] for key in ("outcome", "edge"))
    if not (same and math.isclose(flown["return"], written["return"])):
        raise ValueError(f"flight {number} does not fly again as it is written")
    return flown


def load_pilot(args: argparse.Namespace) -> tuple[QNetwork, Flights]:
    """Check all that is given before anything flies, and read weights and recorded flights. Raises
    ValueError."""
    for name, low, high in (
        ("episodes", 1, 10**4), ("first_seed", 0, 10**18), ("threads", 1, CORES)
    ):  # fmt: skip
        if not low <= (value := vars(args)[name]) <= high:
            raise ValueError(f"{name} is {value}, allowed are whole numbers from {low} to {high:,}")
    files = [pilot for pilot in args.pilots if pilot not in PILOTS]
    if len(files) > 1 or not all(map(os.path.isfile, files)):
        raise ValueError(
            f"pilots are {', '.join(PILOTS)}, or one file; {files[-1]!r} is none of these"
        )
    torch.set_num_threads(args.threads)
    shipped = Path(__file__).resolve().parent / "weights"
    name = "beacon" if args.beacon else "paper" if args.camera == "grey" else args.camera
    args.weights = args.weights or shipped / f"{name}.pt"
    q = dqn.load_weights(args.weights, World.actions, beacon=args.beacon, camera=args.camera)
    dqn.check_output(args.out / "flight.gif", b"GIF8.*Deep Flight")
    if args.json:
        dqn.check_output(args.json, b'{"program": "Deep Flight"')
        gif, report = (os.path.realpath(x) for x in (args.out / "flight.gif", args.json))
        if f"{gif}/".startswith(f"{report}/") or f"{report}/".startswith(f"{gif}/"):
            raise ValueError(f"json is {args.json}, where the film goes: name another file")
    recorded = read_flights(Path(files[0]), args.beacon) if files else []
    return q, list({flight["seed"]: flight for flight in recorded}.values())


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. What goes wrong is one line: bad input exit code 2, trouble on the way 1."""
    args, text, code = argparse.Namespace(), "", 0
    ENDING.clear()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # names of files are printed as the bytes that they are
            stream.reconfigure(encoding=sys.getfilesystemencoding(), errors="surrogateescape")
    try:
        args = parse(argv)
        return args.run(args)
    except KeyboardInterrupt:
        text, code = "\ninterrupted", 128 + (ENDING or [signal.SIGINT])[0]
    except (ValueError, MemoryError, RuntimeError, FloatingPointError, OSError) as error:
        text = "".join(x if x.isprintable() else "?" for x in str(error) or "out of memory")
        text, code = f"deepflight.py: error: {text}", 2 if isinstance(error, ValueError) else 1
    finally:
        ENDING.append(0)  # from here on signals change nothing
        with suppress(OSError, ValueError):  # ValueError: a stream that is closed
            say("", end="")  # what was printed last
    say(text, file=sys.stderr)
    folder = vars(args).get("resume")
    if code != 2 and folder and os.path.exists(folder / "checkpoint.pt"):
        say(resume_line(folder), file=sys.stderr)
    return code


if __name__ == "__main__":
    for number in STOPS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, stop_at_once)
    os._exit(main())  # at once, because a signal could hit Python's own slow end
