"""deepflight.py: the experiment. Train a pilot, fly it against others, print honest numbers.

    python deepflight.py train                  the default recipe, in the paper's world
    python deepflight.py train --beacon         where the goal is visible
    python deepflight.py train --preset mnih    the paper's training parameters [Mnih15]
    python deepflight.py train --resume DIR     go on with an interrupted training
    python deepflight.py eval                   fly weights/paper.pt against three other pilots
    python deepflight.py eval --beacon          fly weights/beacon.pt where the goal is visible

Seeds: training plants forests from [0, 10^9), test points choose weights on [10^9, 2 * 10^9), and
`eval` flies from 2 * 10^9 on unless told otherwise: forests that neither shaped nor chose weights.
A run's folder holds config.json, log.csv, timing.csv, best.pt and checkpoint.pt, each whole at any
time; while a training runs, it alone holds the folder's lock.
Not in this file: anything about pictures (render.py), flying (env.py) or learning (dqn.py).
"""

import argparse
import json
import math
import shlex
import signal
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from numpy import ndarray

import dqn
import render
from dqn import DQN, QNetwork, Replay, greedy, linear_schedule, load, save, write_whole
from env import OUTCOMES, ForestEnv, World, plant, refly

TRAIN_END, TEST_FIRST, EVAL_FIRST = 10**9, 10**9, 2 * 10**9  # forest seeds
CHECKPOINT = "checkpoint.pt"
RANDOM_FLIGHTS = 2000  # a hundred would move the bar itself, random's mean flight, by a fifth
TORCH = str(torch.__version__)
# Where the processor has no bfloat16 of its own, float32 is faster.
PRECISION = "bfloat16" if torch.cpu.get_capabilities().get("avx512_bf16") else "float32"


def setting(value: Any, text: str, *allowed: Any) -> Any:
    """One field of Config: default, help with unit and source, and the range or choice allowed."""
    return field(default=value, metadata=dict(help=f"{text} (default: {value})", allowed=allowed))


@dataclass(frozen=True)
class Config:
    """Every setting of a training; each is a flag of `train`."""

    steps: int = setting(300_000, "control steps in all", 1, math.inf)
    seed: int = setting(0, "of everything random", 0, math.inf)
    beacon: bool = setting(False, "put a visible pole at the goal", 0, 1)
    lanes: int = setting(8, "drones flown at once, one forest each", 1, 1000)
    gamma: float = setting(0.99, "discount a step [DF II-A]", 0, 1)
    n: int = setting(5, "rewards in a return before the bootstrap", 1, 100)
    double: bool = setting(True, "let Q choose the action that the target network values", 0, 1)
    goal_value: float = setting(125.0, "of arrival in the target: 1.25 a step for ever", -1e6, 1e6)
    far_value: float = setting(200.0, "of leaving by the far edge in the target", -1e6, 1e6)
    ahead: float = setting(6.0, "reward in the target for a metre nearer the far edge", 0, 1e3)
    mirror: bool = setting(True, "reflect half of every batch left to right", 0, 1)
    batch: int = setting(32, "transitions an update [Mnih15]", 1, 10_000)
    update_every: int = setting(4, "control steps an update [Mnih15]", 1, math.inf)
    target_every: int = setting(500, "updates between copies to the target network", 1, math.inf)
    replay: int = setting(200_000, "transitions remembered, 7.1 kB each", 1, math.inf)
    warmup: int = setting(5_000, "control steps before the first update", 1, math.inf)
    epsilon_start: float = setting(1.0, "share of random actions at first [Mnih15]", 0, 1)
    epsilon_final: float = setting(0.05, "share of random actions in the end", 0, 1)
    epsilon_decay: int = setting(40_000, "control steps from first to final", 1, math.inf)
    optimizer: str = setting("adam", "adam, or Mnih's rmsprop", "adam", "rmsprop")
    lr: float = setting(2.5e-4, "learning rate at first", 0, 1)
    lr_final: float = setting(2.5e-5, "and in the end, linear between", 0, 1)
    huber: float = setting(100.0, "Huber's delta: larger errors pull no harder", 1e-3, 1e6)
    huber_after: int = setting(100_000, "control steps with Mnih's delta of 1 before", 0, math.inf)
    optimizer_eps: float = setting(1.5e-4, "the optimizer's epsilon", 0, 1)
    average: float = setting(0.1, "last share of the steps: the mean of Q is Q^ and flies", 0, 1)
    max_grad_norm: float = setting(10.0, "longer gradients are cut to this; 0: never", 0, math.inf)
    precision: str = setting(PRECISION, "of the convolutions", "bfloat16", "float32")
    device: str = setting("cpu", "cpu; cuda is untested", "cpu", "cuda")
    threads: int = setting(2, "of torch; another number gives other last digits", 1, 256)
    torch: str = setting(TORCH, "its version, noted here since others differ", TORCH)
    test_every: int = setting(5_000, "control steps between test points", 1, math.inf)
    test_forests: int = setting(48, "forests a test point", 1, 10_000)
    checkpoint_every: int = setting(5_000, "control steps between checkpoints", 1, math.inf)

    def __post_init__(self) -> None:
        for f in fields(self):
            value, allowed = getattr(self, f.name), f.metadata["allowed"]
            legal = value in allowed if f.type is str else allowed[0] <= value <= allowed[1]
            if not legal:
                text = " or ".join(allowed) if f.type is str else "{:g} to {:g}".format(*allowed)
                raise ValueError(f"{f.name} is {value}, allowed: {text}")
        # The least: three rows to complete a stack, n that wait for rewards, one to draw.
        given, least = min(self.replay, self.warmup), self.lanes * (self.n + 4)
        if given < least:
            raise ValueError(f"replay or warmup is {given}, below lanes * (n + 4) = {least}")


# [Mnih15, Extended Data Table 1], as the paper says [DF II-B]; 1.4 M steps are the paper's own
MNIH = dict(
    steps=1_400_000, n=1, double=False, goal_value=0.0, far_value=0.0, ahead=0.0, mirror=False,
    target_every=10_000, replay=1_000_000, warmup=50_000, epsilon_final=0.1,
    epsilon_decay=1_000_000, optimizer="rmsprop", lr=2.5e-4, lr_final=2.5e-4, optimizer_eps=0.01,
    huber=1.0, average=0.0, max_grad_norm=0.0, precision="float32", test_every=20_000,
)  # fmt: skip

# Of `train --beacon`: where the goal can be seen, no other way out should be worth as much.
BEACON = dict(far_value=50.0, ahead=0.0)


# -------------------------------------------------- pilots: a list of forests -> an action in each

Pilot = Callable[[Sequence[ForestEnv]], Sequence[int]]
Flights = list[dict]  # of ForestEnv.flight


def random_pilot(rng: np.random.Generator) -> Pilot:
    """Every action uniform and independent: the paper's bar."""
    return lambda envs: rng.integers(envs[0].world.actions, size=len(envs))


def straight_pilot(envs: Sequence[ForestEnv]) -> Sequence[int]:
    """Dead ahead, whatever comes."""
    return [env.world.actions // 2 for env in envs]


def laser_pilot(envs: Sequence[ForestEnv]) -> Sequence[int]:
    """A dynamic window on the scan and the goal's bearing: the bar for the camera."""
    return [dynamic_window(*env.scan(), env.goal_bearing(), env.world) for env in envs]


def dynamic_window(bearings: ndarray, distances: ndarray, goal_bearing: float, world: World) -> int:
    """Simulate 1.5 s of each yaw rate against the scan's points and take the best.

    score = 10 * seconds until the clearance is below 0.8 m + 2 * least clearance (2 m at most)
            - 4 * heading error to the goal at the arc's end in rad
    """
    # In the drone's axes a point is the complex number x + iy.
    points = (distances * np.exp(1j * bearings))[distances < world.laser_range]  # (P,) m
    rates = world.yaw_rate * np.linspace(-1, 1, world.actions)  # (A,) rad/s
    headings = rates[:, None] * world.dt * np.arange(1, 16)  # (A, 15) rad
    arcs = np.cumsum(world.speed * world.dt * np.exp(1j * headings), 1)  # (A, 15) m
    clearance = np.abs(arcs[..., None] - points).min(-1, initial=world.laser_range)  # (A, 15) m
    safe = np.logical_and.accumulate(clearance >= 0.8, 1).sum(1) * world.dt  # (A,) s
    error = np.abs(np.angle(np.exp(1j * (goal_bearing - headings[:, -1]))))  # (A,) rad, wrapped
    return int(np.argmax(10 * safe + 2 * np.minimum(clearance.min(1), 2) - 4 * error))


def dqn_pilot(q: QNetwork) -> Pilot:
    """The greedy policy of a Q-network: four frames and nothing else."""
    return lambda envs: greedy(q, np.stack([env.observation for env in envs]))


def fly(who: str, pilot: Pilot, seeds: Sequence[int], world: World, camera: bool = True) -> Flights:
    """Fly one forest a seed, a hundred at once; returns the flights in the order of the seeds."""
    flights, fleet = [], [ForestEnv(world, camera=camera) for _ in seeds[:100]]
    for group in (seeds[i : i + 100] for i in range(0, len(seeds), 100)):
        envs = fleet[: len(group)]
        for env, seed in zip(envs, group, strict=True):
            env.reset(seed=seed)
        while flying := [env for env in envs if not env.outcome]:
            show(f"{who}: {len(flights) + len(envs) - len(flying):,} of {len(seeds):,} landed")
            for env, a in zip(flying, pilot(flying), strict=True):
                env.step(a)
        flights += [env.flight() for env in envs]
    return flights


def fly_random(seeds: Sequence[int], world: World, rng: np.random.Generator) -> Flights:
    """The bar: 2,000 random flights or more, equally many through each forest."""
    repeats = math.ceil(RANDOM_FLIGHTS / len(seeds))
    return fly("random", random_pilot(rng), list(seeds) * repeats, world, camera=False)


def measure(flights: Flights) -> dict[str, ndarray]:
    """One number a flight (F,): steps, progress in m, return, and 0 or 1 for how it ended.

    Crossed means arrived at the goal or left by the far edge.
    """
    table = {key: np.array([f[key] for f in flights]) for key in ("steps", "progress", "return")}
    table["crossed"] = np.array([f["outcome"] == "goal" or f["edge"] == "far" for f in flights])
    return table | {o: np.array([f["outcome"] == o for f in flights]) for o in OUTCOMES}


def mean(flights: Flights, key: str) -> float:
    """Of the flights, or not a number where none has ended yet."""
    return sum(f[key] for f in flights) / len(flights) if flights else math.nan


# -------------------------------------------------- train

END = {"": dqn.LIVE, "far": dqn.FAR, "goal": dqn.GOAL, "time": dqn.TRUNCATED}  # else DEAD
COLUMNS = {  # a status line: key -> heading, format
    "step": ("step", "9,"), "episodes": ("episodes", "9,"), "epsilon": ("epsilon", "8.2f"),
    "speed": ("steps/s", "8.0f"), "eta": ("min left", "9.1f"),
    "train_return": (" | train: return", "16.1f"), "train_steps": ("steps", "7.1f"),
    "test_return": (" | test: return", "15.1f"), "test_steps": ("steps", "7.1f"),
    "test_over_random": ("over random", "12.0%"), "test_progress": ("progress", "9.1f"),
    **{f"test_{key}": (key, "8.0%") for key in ("crossed", "crash", "goal", "left", "time")},
}  # fmt: skip


class Training:
    """All that a training is made of: it flies, learns, tests, saves itself and is taken up again.

    At first Q flies in tests, and Q^ is a copy of it now and then. In the last share of the steps,
    c.average, Q^ is the mean of Q since then: it is still what Q learns from, and it flies in tests
    and becomes best.pt, for what one more update does to Q moves a mean little.
    book: step, log and what else is a plain number. flights: of every lane, the seed and the
    actions of each flight in the replay and of the one in the air. These are all that a checkpoint
    keeps of the replay, one byte a step: a flight is its seed and its actions.
    """

    def __init__(self, c: Config, folder: Path) -> None:
        torch.set_flush_denormal(True)  # else RMSProp's dead moments, below 1e-38, halve the speed
        torch.set_num_threads(c.threads)
        self.c, self.folder, self.world, self.stopped = c, folder, World(beacon=c.beacon), 0
        self.fly_rng, self.learn_rng, self.bar_rng = np.random.default_rng(c.seed).spawn(3)
        self.test_seeds = range(TEST_FIRST, TEST_FIRST + c.test_forests)
        self.memory = Replay(c.replay, c.lanes)  # line 1
        self.agent = DQN(c, self.world.actions, c.seed)  # lines 2, 3
        self.envs = [ForestEnv(self.world) for _ in range(c.lanes)]
        self.flights: list[list] = [[] for _ in self.envs]
        self.plans: list[Iterator[int]] = [iter(()) for _ in self.envs]  # seeds flown before
        self.book = dict(step=0, episodes=0, seconds=0.0, recent=[], log=[], timing=[], best=[])

    def stop(self, number: int, _frame: object) -> None:
        """A first Ctrl-C or SIGTERM lets the step end and saves; a second stops at once."""
        if self.stopped:
            raise KeyboardInterrupt
        self.stopped = number

    def begin(self) -> None:
        """Take off in every lane, and save, so that all that follows can be interrupted."""
        for lane in range(self.c.lanes):
            self.take_off(lane)
        self.save()

    def take_off(self, lane: int) -> None:
        """Begin an episode (lines 4, 5) and its record, which grows as the drone flies."""
        seed = next(self.plans[lane], int(self.fly_rng.integers(TRAIN_END)))
        self.envs[lane].reset(seed=seed)
        self.flights[lane].append((seed, self.envs[lane].actions))

    def step(self) -> dict[str, float]:
        """One control step in every lane (line 6) and the updates then due; returns a log row."""
        c, book = self.c, self.book
        step = book["step"] = book["step"] + c.lanes
        eps = linear_schedule(step, c.epsilon_start, c.epsilon_final, c.epsilon_decay)
        lr = linear_schedule(step, c.lr, c.lr_final, c.steps)
        delta = c.huber if step > c.huber_after else 1.0
        share = c.update_every / max(step - (1 - c.average) * c.steps, c.update_every)
        landed = self.advance(self.choose(eps))
        book["episodes"] += len(landed)
        book["recent"] = (book["recent"] + landed)[-100:]
        for _ in range(times_due(step, c.lanes, c.update_every) if step >= c.warmup else 0):
            self.agent.learn(self.memory, lr, delta, share, self.learn_rng)
        total = sum(p.sum().item() for p in self.agent.q.state_dict().values())
        if not math.isfinite(total):  # as weights are after a loss that is no number
            why = f"{total} at step {step:,}: learning rate too high or optimizer_eps too low?"
            raise FloatingPointError(f"loss, weights: {why} Last good: {self.folder / CHECKPOINT}")
        row = dict(step=step, episodes=book["episodes"], updates=self.agent.updates, epsilon=eps)
        return row | {f"train_{key}": mean(book["recent"], key) for key in ("return", "steps")}

    def choose(self, eps: float) -> ndarray:
        """An action for every lane (L,), epsilon-greedily."""
        s = np.stack([env.observation for env in self.envs])  # (L, 4, 84, 84)
        explore = self.fly_rng.random(len(s)) < eps  # (L,) line 7
        anything = self.fly_rng.integers(self.world.actions, size=len(s))  # (L,)
        return np.where(explore, anything, greedy(self.agent.q, s))  # (L,) line 8

    def advance(self, a: ndarray) -> Flights:
        """Fly actions a (L,) and remember what came of them, each metre ahead paid for in the
        target alone; returns the flights that ended."""
        s, x = np.stack([env.observation for env in self.envs]), self.x()  # (L, 4, 84, 84), (L,)
        steps = [env.step(action) for env, action in zip(self.envs, a.tolist(), strict=True)]
        s2, r, *_ = zip(*steps, strict=True)  # lines 9, 10
        end = [END.get(env.edge or env.outcome, dqn.DEAD) for env in self.envs]
        self.memory.add(s, a, r + self.c.ahead * (self.x() - x), s2, end)  # line 11
        landed = {lane: env.flight() for lane, env in enumerate(self.envs) if env.outcome}
        for lane in landed:
            self.take_off(lane)
        return list(landed.values())

    def x(self) -> ndarray:
        """How far along the forest each drone is, (L,) m."""
        return np.array([env.drone.position.x for env in self.envs])

    def test(self, row: dict[str, float]) -> dict[str, float]:
        """Fly the test forests greedily, log it, and keep the best weights, or the mean of the
        last ones, whatever it scores, for a best score is lucky; returns the log row."""
        book, log = self.book, self.book["log"]
        late = self.c.average > 0 and row["step"] > (1 - self.c.average) * self.c.steps
        q = self.agent.q_target if late else self.agent.q
        flights = measure(fly("dqn", dqn_pilot(q), self.test_seeds, self.world))
        row |= {f"test_{key}": float(values.mean()) for key, values in flights.items()}
        log.append(row | {"test_over_random": row["test_steps"] / book["bar"] - 1})
        book["timing"].append({"step": book["step"], "seconds": round(book["seconds"], 1)})
        for name in ("log", "timing"):
            write_csv(self.folder / f"{name}.csv", book[name])
        score = [row["test_goal" if self.c.beacon else "test_crossed"], row["test_progress"]]
        if late or score > book["best"]:
            book["best"] = score
            save_weights(self.folder / "best.pt", q, self.c.beacon)
        return log[-1]

    def record(self) -> list[list[tuple[int, str]]]:
        """Of every lane, the seed and actions of each flight that has a frame in the replay."""
        for lane in self.flights:
            while sum(len(actions) for _, actions in lane[1:]) >= self.memory.rows:
                lane.pop(0)
        return [[(seed, "".join(map(str, a))) for seed, a in lane] for lane in self.flights]

    def save(self) -> None:
        """Write the checkpoint: 27 MB, and about one byte for each step in the replay."""
        content = {"config": asdict(self.c), "book": self.book, "added": self.memory.added}
        content |= {"flights": self.record(), "agent": self.agent.state_dict()}
        content |= {"optimizer": self.agent.optimizer.state_dict(), "updates": self.agent.updates}
        content |= {"rngs": [r.bit_generator.state for r in (self.fly_rng, self.learn_rng)]}
        save(self.folder / CHECKPOINT, "checkpoint", content)

    def restore(self, saved: dict) -> None:
        """Take up a saved training: fly its replay again, then set everything else as it was."""
        rows = min(saved["added"], self.memory.rows)
        self.memory.added = saved["added"] - rows
        self.plans = [iter([seed for seed, _ in lane]) for lane in saved["flights"]]
        digits = ["".join(actions for _, actions in lane) for lane in saved["flights"]]
        for lane, env in enumerate(self.envs):
            self.take_off(lane)
            for a in digits[lane][:-rows]:  # frames that were overwritten already
                env.step(int(a))
        for row in range(-rows, 0):
            show(f"flying the replay again: {row * -len(digits):,} steps to go")
            self.advance(np.array([int(actions[row]) for actions in digits]))
        if self.record() != saved["flights"]:
            raise ValueError(f"{self.folder}: its flights fly otherwise here; another machine?")
        self.book, self.agent.updates = saved["book"], saved["updates"]
        self.agent.load_state_dict(saved["agent"])
        self.agent.optimizer.load_state_dict(saved["optimizer"])
        for rng, state in zip((self.fly_rng, self.learn_rng), saved["rngs"], strict=True):
            rng.bit_generator.state = state


def train(run: Training) -> int:
    """Algorithm 1 of [Mnih15], over c.lanes forests at once; its line numbers are in dqn.py.

    Returns the exit code: 0, or 128 and the signal that interrupted it.
    """
    c = run.c
    write_whole(run.folder / "config.json", json.dumps(vars(c), indent=2).encode())
    if "bar" not in run.book:  # mean flight time of the random pilot, in steps
        bar = fly_random(run.test_seeds, run.world, run.bar_rng)
        run.book["bar"] = float(measure(bar)["steps"].mean())
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, run.stop)
    print(f"to {run.folder}; its best.pt holds the best weights so far, at last their mean\n")
    print("".join(f"{head:>{len(format(0, form))}}" for head, form in COLUMNS.values()), flush=True)
    start = time.perf_counter() - run.book["seconds"]
    while run.book["step"] < c.steps and not run.stopped:
        row = run.step()
        step, seconds = row["step"], time.perf_counter() - start
        speed = {"speed": step / seconds, "eta": max(c.steps - step, 0) * seconds / step / 60}
        show(status(row | speed))
        if times_due(step, c.lanes, c.test_every) or step >= c.steps:
            print(status(run.test(row) | speed), flush=True)
        run.book["seconds"] = time.perf_counter() - start
        if times_due(step, c.lanes, c.checkpoint_every) or step >= c.steps or run.stopped:
            run.save()
    if run.book["step"] >= c.steps:
        return 0
    again = [sys.orig_argv[0], sys.argv[0], "train", "--resume", str(run.folder)]
    print(f"\nsaved at step {run.book['step']:,}; to go on:\n{shlex.join(again)}")
    return 128 + run.stopped


def times_due(step: int, stride: int, every: int) -> int:
    """How often a thing done every so many steps falls due in the last stride of them.

    >>> times_due(16, 8, 4), times_due(16, 8, 10), times_due(24, 8, 10)
    (2, 1, 1)
    """
    return step // every - (step - stride) // every


def status(row: dict) -> str:
    """One line of a training: the columns that the row has."""
    return "".join(format(row[key], form) for key, (_, form) in COLUMNS.items() if key in row)


def show(text: str) -> None:
    """Show a passing status on a terminal; nothing when piped."""
    if sys.stdout.isatty():
        print(f"\r{text}\x1b[K\r", end="", flush=True)


def write_csv(path: Path, rows: Sequence[dict]) -> None:
    """One line of numbers a row, under a line of names."""
    lines = (rows[0], *(row.values() for row in rows))
    write_whole(path, "".join(",".join(map(str, line)) + "\n" for line in lines).encode())


def save_weights(path: Path, q: QNetwork, beacon: bool) -> None:
    """Half precision, 3.4 MB, and the world they were trained in."""
    half = {name: value.half().cpu() for name, value in q.state_dict().items()}
    save(path, "weights", {"beacon": beacon, "network": half})


def load_weights(path: Path, beacon: bool) -> QNetwork:
    """Read what save_weights wrote. Raises ValueError."""
    saved, q = load(path, "weights"), QNetwork(World.actions)
    for name, needed in q.state_dict().items():
        shape = tuple(saved["network"].get(name, torch.empty(0)).shape)
        if shape != needed.shape:
            raise ValueError(f"{path}: {name} is {shape}, the network needs {tuple(needed.shape)}")
    if saved["beacon"] != beacon:
        raise ValueError(f"{path} was trained with{'' if saved['beacon'] else 'out'} the beacon")
    q.load_state_dict(saved["network"])
    return q


# -------------------------------------------------- eval

ROWS = {  # the table: figure -> label, factor, digits
    "seconds": ("flight time, s", 1, 2), "steps": ("flight time, steps", 1, 1),
    "over_random": ("over random, %", 100, 0), "crossed": ("crossed, %", 100, 1),
    "progress": ("progress, m", 1, 1), "crash": ("crashed, %", 100, 1),
    "goal": ("arrived, %", 100, 1), "left": ("left the forest, %", 100, 1),
    "time": ("out of time, %", 100, 1), "return": ("return", 1, 1),
}  # fmt: skip


def evaluate(args: argparse.Namespace) -> int:
    """Fly every pilot through the same forests; print the table, write pictures and JSON."""
    torch.set_num_threads(Config.threads)
    world, rng = World(beacon=args.beacon), np.random.default_rng(0)
    seeds = range(args.first_seed, args.first_seed + args.episodes)
    pilots = {"straight": straight_pilot, "laser": laser_pilot, "dqn": dqn_pilot(args.q)}
    bar = fly_random(seeds, world, rng)
    flights = {p: bar if p == "random" else fly(p, pilots[p], seeds, world) for p in args.pilots}
    figures = {p: summarize(flights[p], bar, len(seeds), rng) for p in flights}
    print(f"{len(seeds)} forests from seed {seeds[0]}; the random pilot flies {len(bar):,} times\n")
    print_table(figures)
    draw_pictures(flights, seeds, world, args.out)
    if args.json:
        head = dict(weights=str(args.weights), beacon=args.beacon, first_seed=seeds[0])
        report = {p: figures[p] | {"flights": flights[p]} for p in flights}
        write_whole(args.json, json.dumps(head | dict(forests=len(seeds), pilots=report)).encode())
    return 0


def summarize(flights: Flights, bar: Flights, forests: int, rng: np.random.Generator) -> dict:
    """Every figure with its 95 % interval: value, low, high.

    Means are bootstrapped over forests, for flights through one forest are no independent draws;
    shares have Wilson's interval, which takes flights as independent: one flight a forest is.
    """
    # Flights through one forest stand as far apart as there are forests: (F,) means.
    table, random_steps = measure(flights), measure(bar)["steps"].reshape(-1, forests).mean(0)
    draws = rng.integers(forests, size=(2000, forests))  # (2000, F) resampled forests
    means = {k: table[k].reshape(-1, forests).mean(0) for k in ("steps", "progress", "return")}
    figures = {key: interval(x.mean(), x[draws].mean(1)) for key, x in means.items()}
    ratios = means["steps"][draws].mean(1) / random_steps[draws].mean(1)
    figures["over_random"] = interval(means["steps"].mean() / random_steps.mean() - 1, ratios - 1)
    figures["seconds"] = {k: v * World.dt for k, v in figures["steps"].items()}
    for key in ("crossed", *OUTCOMES):
        figures[key] = wilson(int(table[key].sum()), len(flights))
    return figures


def interval(value: float, resampled: ndarray) -> dict[str, float]:
    """A figure and the middle 95 % of its bootstrap."""
    low, high = np.percentile(resampled, [2.5, 97.5])
    return {"value": float(value), "low": float(low), "high": float(high)}


def wilson(hits: int, n: int) -> dict[str, float]:
    """A share and its 95 % interval by Wilson's score [Wilson 1927].

    >>> {key: round(x, 3) for key, x in wilson(10, 10).items()}
    {'value': 1.0, 'low': 0.722, 'high': 1.0}
    """
    z, p = 1.96, hits / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return {"value": p, "low": max(middle - half, 0.0), "high": min(middle + half, 1.0)}


def print_table(figures: dict[str, dict]) -> None:
    """One row a figure, one column a pilot, 95 % intervals in brackets."""
    print(f"{'':20}" + "".join(f"{name:>26}" for name in figures))
    for key, (label, factor, digits) in ROWS.items():
        cells = [[f"{factor * x:.{digits}f}" for x in p[key].values()] for p in figures.values()]
        print(f"{label:20}" + "".join(f"{f'{x} [{low}, {high}]':>26}" for x, low, high in cells))


def draw_pictures(flights: dict[str, Flights], seeds: range, world: World, out: Path) -> None:
    """Draw every pilot in the first three forests, and film the last pilot in the first."""
    size, maps = (world.length, world.width), []
    for i, seed in enumerate(seeds[:3]):
        tracks = [(*track(f[i], world), name) for name, f in flights.items()]
        maps.append(render.draw_map(plant(seed, world), size, tracks, f"forest {seed}"))
    render.Image.fromarray(np.vstack(maps)).save(out / "flights.png")
    shown = list(flights.values())[-1][0]
    trunks, title, (path, ended) = plant(seeds[0], world), f"forest {seeds[0]}", track(shown, world)
    growing = [(path[:t], "", "") for t in range(1, len(path))] + [(path, ended, "")]
    maps = [render.draw_map(trunks, size, [part], title) for part in growing]
    frames = [step[0][-1] for step in refly(shown["seed"], shown["actions"], world)]
    render.save_film(out / "flight.gif", frames, maps, round(1000 * world.dt))
    print(f"\nwrote {out / 'flights.png'} and {out / 'flight.gif'}")


def track(flight: dict, world: World) -> tuple[ndarray, str]:
    """Where a flight went (T + 1, 2) in m, by flying it again, and its edge or outcome."""
    steps = refly(flight["seed"], flight["actions"], world, camera=False)
    return np.array([info["pose"][:2] for *_, info in steps]), flight["edge"] or flight["outcome"]


# -------------------------------------------------- command line


class Parser(argparse.ArgumentParser):
    """argparse, but a bad command line gets one line instead of the whole usage."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and no more."""
        self.exit(2, f"{self.prog}: error: {message}\n")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; every field of Config is a flag of `train`."""
    parser = Parser(prog="deepflight.py", description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    sub = commands.add_parser("train", help="train a pilot", argument_default=argparse.SUPPRESS)
    sub.add_argument("--preset", choices=("default", "mnih"), default="default")
    which = sub.add_mutually_exclusive_group()
    which.add_argument("--name", default="", help="of the folder in runs/; else a fresh number")
    which.add_argument("--resume", type=Path, default=None, help="the folder to go on in")
    for f in fields(Config):
        kind = {"action": argparse.BooleanOptionalAction} if f.type is bool else {"type": f.type}
        sub.add_argument("--" + f.name.replace("_", "-"), help=f.metadata["help"], **kind)
    sub = commands.add_parser("eval", help="fly trained weights against three other pilots")
    names = ("random", "straight", "laser", "dqn")
    sub.add_argument("--weights", type=Path, help="default: weights/paper.pt or weights/beacon.pt")
    sub.add_argument("--pilots", nargs="+", choices=names, default=names, help="which to show")
    sub.add_argument("--episodes", type=int, default=100, help="forests, the same for every pilot")
    sub.add_argument("--first-seed", type=int, default=EVAL_FIRST, help="of the first forest")
    sub.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write every figure and flight")
    sub.add_argument("--out", type=Path, default="runs/eval", help="folder of the pictures")
    return parser.parse_args(argv)


def prepare_train(args: argparse.Namespace) -> Callable[[], int]:
    """Check everything and make or reopen the run's folder."""
    given = {f.name: getattr(args, f.name) for f in fields(Config) if hasattr(args, f.name)}
    preset = MNIH if args.preset == "mnih" else {}
    if args.resume:
        saved = load(args.resume / CHECKPOINT, "checkpoint")
        given = preset | {"steps": saved["config"]["steps"]} | given  # a preset lengthens nothing
        run = Training(agreed(saved, given, args.resume), args.resume)
        run.lock = lock_folder(args.resume)
        run.restore(saved)
        return lambda: train(run)
    c = Config(**(BEACON if given.get("beacon") else {}) | preset | given)
    if c.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device is 'cuda', but torch finds none here: use cpu")
    numbers = (Path(f"runs/{i:03d}") for i in range(1, 10**6))
    folder = Path("runs") / args.name if args.name else next(p for p in numbers if not p.exists())
    if folder.parent != Path("runs") or folder.name == ".." or folder.exists():
        raise ValueError(f"name is {args.name!r}, allowed is that of a new folder in runs/")
    run = Training(c, folder)  # before the folder is made, for memory may not suffice
    folder.mkdir(parents=True)
    run.lock = lock_folder(folder)
    run.begin()
    return lambda: train(run)


def agreed(saved: dict, given: dict[str, Any], folder: Path) -> Config:
    """The settings of a checkpoint, if nothing that is given now contradicts them. Only the number
    of steps may change; the learning rate is then that of the new number."""
    c, was = Config(**saved["config"] | given), saved["config"]
    other = [k for k, x in vars(c).items() if x != was.get(k) and k != "steps"]
    differ = ", ".join(f"{k} {getattr(c, k)}, was {was.get(k)}" for k in other)
    if differ:
        raise ValueError(f"{folder} has other settings: {differ}; leave them out or begin anew")
    if (flown := saved["book"]["step"]) >= c.steps:
        raise ValueError(f"{folder} has flown {flown:,} steps: give more by --steps")
    return c


def lock_folder(folder: Path) -> sqlite3.Connection:
    """Keep a second training out as long as what this returns is held, however it is let go.

    SQLite's lock is the one in the standard library that works everywhere and dies with its owner.
    """
    try:
        lock = sqlite3.connect(folder / "lock", timeout=0, isolation_level=None)
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        raise ValueError(f"{folder} is another training's, or cannot be held: {error}") from None
    return lock


def prepare_eval(args: argparse.Namespace) -> Callable[[], int]:
    """Check everything and read the weights, before anything flies."""
    if args.episodes < 1 or args.first_seed < 0:
        raise ValueError(f"episodes {args.episodes} < 1 or first-seed {args.first_seed} < 0")
    if args.json and (args.json.is_dir() or not args.json.absolute().parent.is_dir()):
        raise ValueError(f"{args.json} cannot be written: it needs an existing folder")
    shipped = Path(__file__).parent / "weights" / ("beacon.pt" if args.beacon else "paper.pt")
    args.weights = args.weights or shipped
    args.q = load_weights(args.weights, args.beacon) if "dqn" in args.pilots else None
    args.out.mkdir(parents=True, exist_ok=True)
    return lambda: evaluate(args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; what goes wrong is one line: bad input exit code 2, trouble on the way 1."""
    args, code, trouble = parse(argv), 2, (ValueError, OSError, MemoryError)
    try:
        job = (prepare_train if args.command == "train" else prepare_eval)(args)
        code, trouble = 1, (FloatingPointError, OSError)
        return job()
    except trouble as error:
        print(f"deepflight.py {args.command}: error: {error}", file=sys.stderr)
        return code
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
