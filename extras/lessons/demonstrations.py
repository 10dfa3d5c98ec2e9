"""demonstrations.py: learn from recorded episodes before the first step of one's own [DF §IV].

    python -m extras.lessons.expert eval --first-seed 0 --episodes 32 --json demos.json
                                                      record the planner of expert.py
    python -m extras.lessons.demonstrations train --demos demos.json
    python -m extras.lessons.demonstrations eval --weights runs/NAME
    python -m extras.lessons.demonstrations diff      its loop beside that of dqn.py

**The question.** DQN begins with a network that knows nothing, so it crashes many times until it
has learned not to. Often somebody has flown before: an older pilot, or a person. Can a network
learn from the records of these episodes, before it flies at all?

**The episodes** come from a file that `eval --json` writes: --demo-pilot says whose they are, by
default the planner's. A person's come from the cockpit, which saves them in the same form:
--demo-pilot you. An episode is its seed and its actions, so it is flown again here, and each step
becomes a transition with frames and rewards like any other. (--first-seed 0 above, because a forest
that teaches cannot test.)

**The idea** is that of [Hester 2018], DQfD. A transition says what reward followed, and the TD loss
learns that. But nobody tried the other eight actions, so nothing corrects their Q, and the maximum
in the TD target may pick a false one. A demonstration says more: that somebody who saw s chose a.
So Q(s, a) should be the greatest of the nine, by a margin, 5. The large-margin loss is how far it
falls short of that:

    max over b of (Q(s, b) + m)  -  Q(s, a)        m is 0 where b = a, and otherwise 5

In numbers: let Q be 1, 9 and 0, and let the first action be the demonstrated one. Plus 5 the others
are 14 and 5, so the loss is 14 - 1 = 13. It pulls the 9 down and the 1 up. If the
second one was demonstrated, the others count as 6 and 5, 9 is more, and the loss is 0.

The network learns from the demonstrations alone at first, in 2,000 updates. Then it flies, and
because it need not fly at random first, epsilon is 0.05 from the start. Its next update comes after
5,000 steps. Later batches hold none, or with --demo-share 0.25 a quarter.

**What is different from dqn.py**, marked [!] in `train`:
    demo_replay   a second replay, for demonstrations alone
    pretrain      updates on demonstrations alone, before the first step
    sample        a batch may hold demonstrations, and says which transitions are
    learn         the TD loss, and on demonstrations the large-margin loss

**What came out**, seed 0 and seed 1, in the same 200 test forests (results/demonstrations.json):

                                        crossed       hit a trunk    return
    32 episodes alone (--steps 80)      16.5, 0 %     20, 13.5 %     15, -13
    the same with --margin 0            4, 14 %       14, 11 %       8, 23
    32 episodes, then 60,000 steps      52, 57.5 %    23, 6.5 %      40, 38
    dqn, 60,000 steps                   61.5, 66.5 %  3, 7 %         21, 17
    line 3 with --demo-share 0.25       34.5, 44.5 %  45.5, 23 %     38, 58
    and with --epsilon-decay 40000      29.5, 32 %    12, 27.5 %     29, 32

In 80 steps no update is due, so the first line is what the 2,000 updates on demonstrations make.
Its pilots fly 371 and 233 % longer than random, for which dqn needs 10,000 steps. With a margin of
0 a demonstrated action need only be as good as the others, and the two seeds differ more than the
two margins do. After 60,000 steps the head start is worth 20 of return in both seeds, but fewer
cross. With demonstrations in later batches fewer still cross, and more crash. Perhaps that is
because demonstrations hold no crash; but more exploring (last line) mends it in one seed only.

[Hester 2018]  Deep Q-learning from demonstrations, AAAI; it also has a prioritized replay
"""

import json
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor, nn

import dqn
from deepflight import Config
from dqn import Agent, InputError, Replay, due, linear_schedule, mirror, setting
from env import VecForest, World
from extras.lessons import recipe, run
from extras.lessons.expert import laser_pilot, td_loss

# B transitions. is_demo (B,) bool: whether this one was demonstrated.
DemoBatch = namedtuple("DemoBatch", (*dqn.Batch._fields, "is_demo"))


# -------------------------------------------------- the demonstrations


def read_demos(c: "DemoConfig") -> list[dict]:
    """The recorded episodes. InputError if there are none."""
    if not c.demos:
        raise InputError("there is nothing to learn from: give --demos FILE")
    try:
        return json.loads(Path(c.demos).read_bytes())["pilots"][c.demo_pilot]["episodes"]
    except (ValueError, LookupError, TypeError):
        raise InputError(f"{c.demos} holds no episodes of a pilot called {c.demo_pilot}") from None


def load_demos(demos: list[dict], c: "DemoConfig", world: World, shaped: Callable) -> Replay:
    """Fly these episodes again, one after another, into a replay of their own."""
    actions = "".join(episode["actions"] for episode in demos)  # one digit each
    if len(actions) < c.n_steps + 4:  # the least to draw from, see DQNConfig
        raise InputError(f"the demonstrations have {len(actions)} steps, too few for n_steps")
    envs = VecForest(world, 1, [episode["seed"] for episode in demos])
    replay = Replay(len(actions), 1)
    for action in actions:
        a = np.array([int(action)])  # (1,)
        s = envs.reset_done()  # (1, 4, 84, 84)
        s2, r, terminated, truncated, drones = envs.step(a)
        replay.add(s, a, shaped(r, drones, c), s2, terminated, truncated)
    if [e["outcome"] for e in envs.episodes] != [e["outcome"] for e in demos]:
        raise InputError("on this machine the demonstrations end elsewhere")
    return replay


# -------------------------------------------------- learning from them


def sample(
    replay: Replay, demo_replay: Replay, share: float, c: "DemoConfig", rng: Generator
) -> DemoBatch:
    """A batch with this share of demonstrations."""
    n_demos = round(share * c.batch_size)
    parts = [(replay, c.batch_size - n_demos), (demo_replay, n_demos)]
    drawn = [part.sample(n, c.n_steps, c.gamma, rng) for part, n in parts if n]
    is_demo = torch.arange(c.batch_size) >= c.batch_size - n_demos  # (B,)
    return DemoBatch(*map(torch.cat, zip(*drawn, strict=True)), is_demo)


def margin_loss(q: Tensor, a: Tensor, margin: float) -> Tensor:
    """The large-margin loss (B,): 0 where q (B, A) of the demonstrated action a (B,) is the
    greatest by the margin or more, else by how much it misses that.

    >>> q = torch.tensor([[1.0, 9.0, 0.0]])
    >>> [margin_loss(q, torch.tensor([a]), 5.0).item() for a in (0, 1)]
    [13.0, 0.0]
    """
    others = 1 - nn.functional.one_hot(a, q.shape[1])  # (B, A)
    return (q + margin * others).amax(1) - q.gather(1, a[:, None])[:, 0]


def learn(agent: Agent, b: DemoBatch, c: "DemoConfig") -> None:
    """One update: lines 13 and 14, and the margin."""
    q = agent.q(b.s, c.bfloat16)  # (B, A)
    # Times huber_delta, so that a missed margin pulls as hard as the largest TD error.
    missed = c.huber_delta * b.is_demo * margin_loss(q, b.a, c.margin)  # (B,)
    loss = td_loss(agent, q, b, c) + missed.mean()
    agent.optimizer.zero_grad()
    loss.backward()
    agent.optimizer.step()
    agent.loss = loss.item()


def pretrain(agent: Agent, demo_replay: Replay, c: "DemoConfig", rng: Generator) -> None:
    """Learn from demonstrations alone."""
    for i in range(1, c.demo_updates + 1):
        batch = sample(demo_replay, demo_replay, 1.0, c, rng)
        batch = mirror(batch, World.num_actions, rng) if c.mirror else batch  # [+mirror]
        learn(agent, batch, c)
        # An update stands for update_every steps, so Q^ is synced as often as in `train`.
        if due(c.target_every, i * c.update_every, c.update_every):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15


def train(c: "DemoConfig", envs: VecForest, rng: Generator, shaped: Callable) -> Iterator[tuple]:
    """Algorithm 1 with demonstrations; [!] marks what differs from dqn.train."""
    replay = Replay(c.replay_size, c.num_envs)  # 1
    agent = Agent(c, envs.num_actions, rng)  # 2, 3
    demo_replay = load_demos(read_demos(c), c, envs.world, shaped)  # [!]
    yield agent, replay
    if not envs.steps:  # [!] a restored training has done this
        pretrain(agent, demo_replay, c, rng)  # [!]
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
            batch = sample(replay, demo_replay, c.demo_share, c, rng)  # 12 [!]
            batch = mirror(batch, envs.num_actions, rng) if c.mirror else batch  # [+mirror]
            learn(agent, batch, c)  # 13, 14 [!]
            if c.swa_fraction and step > (1 - c.swa_fraction) * c.steps:  # [+swa_fraction]
                agent.averaged.update_parameters(agent.q)
        if due(c.target_every, step, c.num_envs):
            agent.q_target.load_state_dict(agent.q.state_dict())  # 15
        yield agent, replay


DemoConfig = recipe(
    "DemoConfig", Config,
    program="-m extras.lessons.demonstrations", pilot="demonstrations",
    train=staticmethod(train), baselines=Config.baselines | {"laser": laser_pilot(Config.gamma)},
    epsilon_decay=1,  # epsilon_final from the start
    demos=setting("", "file of episodes that eval --json wrote, or the cockpit"),
    demo_pilot=setting("laser", "whose episodes of that file are the demonstrations"),
    demo_updates=setting(2_000, "updates on demonstrations alone, at first", 1, 10**7),
    demo_share=setting(0.0, "share of them in every later batch; 0: none", 0, 0.9),
    margin=setting(5.0, "by which a demonstrated action must be the best", 0, 1e3),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(run(DemoConfig, sys.argv[1:]))
