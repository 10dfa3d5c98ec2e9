"""deepflight.py: the experiment. Train a pilot, fly it beside others, print numbers with intervals.

    python deepflight.py train                  learn from rewards, in the paper's world
    python deepflight.py train --beacon         in a world where a pole makes the goal visible
    python deepflight.py train --resume DIR     go on with an interrupted training
    python deepflight.py eval                   fly weights/dqn.pt, which `train` made
    python deepflight.py eval --weights DIR     fly the weights of a training, or of any file

The loop that learns is dqn.train. This file holds the rest of the experiment: the settings, the
shaped reward, validation, files, then `eval` with its statistics, and the command line.

`train` prints a row after each validation:

         step  eps   /s   min  return | return length  cross  crash
       15,000 0.64  108    29   -16.8 |   -6.7    119    21%     6%

After 15,000 control steps 64 % of the actions are random. The training makes 108 steps a second, 29
minutes are left, and the last 100 episodes had a mean return of -16.8 (in tables and logs the plain
sum of rewards, without gamma). Without random actions the network flew through 48 validation
forests: return -6.7, episodes of 119 steps (random ones have about 27), 21 % crossed, and 6 %
crashed (shares of 48 are uncertain by up to 14 points).

A seed is a forest, and there are three sets of them:
    training    [0, 10^9)
    validation  [10^9, 2 * 10^9)    48 of them may choose the weights (best.pt)
    test        from 4 * 10^9 on    flown by `eval`: training and validation never see them

A run's folder holds config.json, log.csv, validation.jsonl (one line an episode), checkpoint.pt and
best.pt: the weights that did best in validation; in the last tenth, the mean of those in it.

Sources, for all four files
    [DF]                Deep Flight: autonomous quadrotor navigation with deep RL, CMU, 2017
    [Mnih15]            Human-level control through deep reinforcement learning, Nature 518
    [van Hasselt 2016]  Deep reinforcement learning with double Q-learning, AAAI
    [Hessel 2018]       Rainbow: combining improvements in deep reinforcement learning, AAAI
    [Ng 1999]           Policy invariance under reward transformations, ICML
    [Wilson 1927]       Probable inference, the law of succession, and statistical inference, JASA
"""

import argparse
import copy
import io
import json
import signal
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

try:
    import numpy as np
    import torch
except ModuleNotFoundError as error:
    sys.exit(f"deepflight.py: {error}; set up .venv as README.md says, and use its Python")
from numpy import ndarray

from dqn import DQNConfig, InputError, QNetwork, due, setting, train
from env import OUTCOMES, Drone, Pilot, VecForest, World, fly, random_pilot, refly, straight_pilot
from render import draw_panel

TRAIN_END, TEST_FIRST = 10**9, 4 * 10**9  # seeds of forests
VALIDATION = range(10**9, 10**9 + 48)


@dataclass(frozen=True)
class Config(DQNConfig):
    """All settings; each is a flag of `train`. [+] as in dqn.py: not in [Mnih15]."""

    seed: int = setting(0, "of everything random", 0, 10**18)
    beacon: bool = setting(False, "[+] put a visible pole at the goal", 0, 1)
    camera: str = setting("grey", "what a pixel says", "grey", "disparity")
    threads: int = setting(1, "of the CPU; another number changes the last digits", 1, 64)
    forward_reward: float = setting(2.0, "[+] for each metre forward; 0: off", 0, 1e3)
    goal_bonus: float = setting(125.0, "[+] for arrival at the goal; 0: off", 0, 1e6)
    far_bonus: float = setting(200.0, "[+] for leaving by the far edge; 0: off", 0, 1e6)

    # Skip at first: no settings, but a lesson in extras/ may replace them.
    train: ClassVar[Callable] = staticmethod(train)
    network: ClassVar[type] = QNetwork
    pilot: ClassVar[str] = "dqn"  # what the trained network is called
    program: ClassVar[str] = f'"{__file__}"'  # what Python is told to run
    baselines: ClassVar[dict[str, Pilot]] = {"straight": straight_pilot}
    validate_every: ClassVar[int] = 5_000  # control steps
    # With the beacon the goal can be seen, so arrival should be worth more than the far edge.
    beacon_recipe: ClassVar[dict] = {"steps": 400_000, "forward_reward": 0.0, "far_bonus": 50.0}


def shaped_reward(r: ndarray, drones: Sequence[Drone], c: Config) -> ndarray:
    """The rewards (L,) that the network learns from: the paper's r (L,) and three parts more.

        r                          -10 to 1.25 a step             the paper's reward [DF §II-A]
        + forward_reward * metres  2 * 0.5 = 1.0 a step at most   -1.0 for flying back
        + gamma * goal_bonus       0.99 * 125 = 123.75, once      on arrival at the goal
        + gamma * far_bonus        0.99 * 200 = 198, once         on leaving by the far edge

    forward_reward: r pays for where the drone is and not for moving on, so a drone that circles in
    one place earns as much as one that flies past it.
    goal_bonus: arrival ends the episode, and with it all rewards. To stay near the goal for ever
    would earn 1.25 + 0.99 * 1.25 + ... = 1.25 / (1 - 0.99) = 125 at most. So arrival earns the
    same, 1.25 for the step and 125 a step later: 1.25 + 0.99 * 125 = 125.
    far_bonus: the frames hardly show which edge is the far one, so a drone that leaves is not sure
    whether it gets -10 or -10 + 198. The bonus makes this risk worth it; 200 was found in
    validation. It changes the task: the paper counts the far edge as a crash, and here it is worth
    more than arrival. So look at the share that arrived too, and not only at that which crossed.

    On purpose, these parts change which way of flying is best. Parts of the form gamma * f(s2) -
    f(s), with f = 0 at an episode's end, would not: in the discounted sum they cancel to -f(start),
    whatever the drone does [Ng 1999]. Printed returns leave the three out.
    """
    forward = np.array([drone.forward for drone in drones])  # (L,) m
    worth = {"goal": c.goal_bonus, "far": c.far_bonus}
    bonus = np.array([worth.get(drone.outcome, 0.0) for drone in drones])  # (L,)
    # [+forward_reward] [+goal_bonus] [+far_bonus]
    return r + c.forward_reward * forward + c.gamma * bonus


# -------------------------------------------------- train: what stands around the loop of dqn.py

HEAD = "     step  eps   /s   min  return | return length  cross  crash"
ROW = "{step:9,} {epsilon:4.2f} {speed:4.0f} {left:z5.0f} {train_return:7.1f} |"
ROW += "{validation_return:7.1f} {validation_steps:6.0f} {validation_crossed:6.0%}"
ROW += " {validation_crash:6.0%}"


class Run:
    """One training: the loop of dqn.py, and all that must be saved to go on with it."""

    def __init__(self, c: Config, folder: Path, saved: dict | None = None) -> None:
        """saved: the checkpoint of a training to go on with."""
        torch.set_num_threads(c.threads)
        torch.set_flush_denormal(True)  # numbers below 1e-38 count as 0, or they slow the optimizer
        self.c, self.folder, self.log, self.validations = c, folder, [], []
        self.rng = np.random.default_rng(c.seed)
        self.forest_rng = np.random.default_rng([c.seed, 1])  # its own, because rng explores
        seeds = iter(lambda: int(self.forest_rng.integers(TRAIN_END)), None)  # endless
        self.envs = VecForest(World(beacon=c.beacon, camera=c.camera), c.num_envs, seeds)
        self.loop = c.train(c, self.envs, self.rng, shaped_reward)  # dqn.train, or a lesson's
        self.agent, self.replay = next(self.loop)
        if saved:
            self.restore(saved)
        self.began = time.perf_counter() - (saved["seconds"] if saved else 0.0)

    def go(self) -> int:
        """Train, validate, log and save, until the last step or a signal; returns the exit code."""
        envs, c = self.envs, self.c
        save(self.folder / "config.json", json.dumps(asdict(c), indent=2).encode())
        with stop_signals() as stopped:
            print(f"{c.steps:,} steps in {self.folder}; live: {sys.executable} -m extras.cockpit")
            print(f"\n{HEAD}", flush=True)
            for _ in self.loop:
                if not np.isfinite(self.agent.loss):
                    raise FloatingPointError(f"step {envs.steps:,}: the loss is {self.agent.loss}")
                if due(c.validate_every, envs.steps, c.num_envs) or envs.steps >= c.steps:
                    self.validate()
                if stopped:
                    self.save_checkpoint()
                    break
        finished = envs.steps >= c.steps
        print("to fly it:" if finished else f"saved at step {envs.steps:,}; to go on:")
        todo = "eval --weights" if finished else "train --resume"
        print(f'"{sys.executable}" {c.program} {todo} "{self.folder}"')
        return 0 if finished else 128 + stopped[0]

    def validate(self) -> None:
        """Fly the validation forests without exploring, add a row to the log, and keep the weights
        of the best score: the share that crossed (with the beacon: arrived), then, if equal, the
        progress. The last tenth's mean is always kept, because the best of many is partly luck."""
        envs, averaged = self.envs, self.agent.averaged.n_averaged > 0
        # best.pt keeps half precision, so fly what it will hold.
        q = copy.deepcopy(self.agent.averaged.module if averaged else self.agent.q).half().float()
        recent = measure(envs.episodes[-100:] or [drone.episode() for drone in envs.drones])
        episodes = fly(dqn_pilot(q), VALIDATION, envs.world)
        self.validations += [json.dumps({"step": envs.steps} | e) + "\n" for e in episodes]
        row = {"step": envs.steps, "episodes": len(envs.episodes), "epsilon": self.agent.epsilon}
        row |= {f"train_{key}": float(x.mean()) for key, x in recent.items()}
        row |= {f"validation_{key}": float(x.mean()) for key, x in measure(episodes).items()}
        seconds = time.perf_counter() - self.began
        last = self.log[-1] if self.log else {"step": 0, "seconds": 0.0}
        speed = (envs.steps - last["step"]) / (seconds - last["seconds"])  # steps a second
        self.log.append(row | {"seconds": seconds})
        share = "validation_goal" if self.c.beacon else "validation_crossed"
        scores = [(row[share], row["validation_progress"]) for row in self.log]
        if averaged or scores[-1] > max(scores[:-1], default=(-1, 0)):
            save_weights(self.folder / "best.pt", q, self.c)
        rows = [self.log[0].keys(), *(row.values() for row in self.log)]
        save(self.folder / "log.csv", "".join(",".join(map(str, x)) + "\n" for x in rows).encode())
        save(self.folder / "validation.jsonl", "".join(self.validations).encode())
        self.save_checkpoint()
        left = (self.c.steps - envs.steps) / speed / 60  # minutes
        print(ROW.format(**row, speed=speed, left=left), flush=True)

    # Skip on a first reading: how a training goes on after an interruption.
    def save_checkpoint(self) -> None:
        """Write the checkpoint, 34 MB. In place of the replay it holds all actions, a byte each."""
        save(self.folder / "checkpoint.pt", {
            "config": asdict(self.c), "fingerprint": fingerprint(self.c), "log": self.log,
            "validations": self.validations, "actions": self.envs.history,
            "seconds": time.perf_counter() - self.began, "rng": self.rng.bit_generator.state,
            "forests": self.forest_rng.bit_generator.state, "agent": self.agent.state_dict(),
            "optimizer": self.agent.optimizer.state_dict()})  # fmt: skip

    def restore(self, saved: dict[str, Any]) -> None:
        """Set everything as it was. To fly all actions again puts the same into the replay."""
        print(f"flying {len(saved['actions']) * self.c.num_envs:,} steps again", flush=True)
        for actions in saved["actions"]:
            s = self.envs.reset_done()  # (L, 4, 84, 84)
            s2, r, *ended, drones = self.envs.step(actions)  # ended: terminated, truncated
            r = shaped_reward(r, drones, self.c)  # (L,)
            self.replay.add(s, np.array([*actions]), r, s2, *ended)
        if self.forest_rng.bit_generator.state != saved["forests"]:  # another number of episodes
            raise InputError(f"{self.folder}: its actions lead to other episodes on this machine")
        self.agent.load_state_dict(saved["agent"])
        self.agent.optimizer.load_state_dict(saved["optimizer"])
        self.rng.bit_generator.state = saved["rng"]
        self.log, self.validations = saved["log"], saved["validations"]
        if saved["config"]["steps"] != self.c.steps:  # a later last tenth: its mean begins again
            self.agent.averaged.n_averaged.zero_()


def dqn_pilot(q: QNetwork) -> Pilot:
    """The pilot that takes the action of greatest value: four frames and nothing else."""
    return lambda s, envs: q.values(s, envs.active).argmax(1)


def evaluate(args: argparse.Namespace, config: type[Config]) -> int:
    """Fly a network and other pilots through the same forests: a table, JSON, and a film."""
    q, world, name = load_weights(args.weights, config.network)
    seeds = range(args.first_seed, args.first_seed + args.episodes)
    film = args.out / f"{args.weights.resolve().name.removesuffix('.pt')}.gif"
    if not (0 < args.episodes <= 10**4 and args.first_seed >= 0 and 0 < args.threads <= 64):
        raise InputError("allowed: episodes 1 to 10,000, first-seed 0 or more, threads 1 to 64")
    for path in {film, args.json or film}:  # better to fail now than after all episodes
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    torch.set_num_threads(args.threads)
    print(f"{len(seeds)} forests from seed {seeds[0]}; 95 % intervals in [ ]\n", flush=True)
    flown, pilots = {}, {"random": random_pilot(np.random.default_rng(0))} | config.baselines
    for who, pilot in (pilots | {name: dqn_pilot(q)}).items():
        print(f"flying {who}", file=sys.stderr)
        flown[who] = fly(pilot, seeds, world)
    metrics = {who: summarize(flown[who], flown["random"]) for who in flown}
    print_table(metrics)
    if args.json:
        report = {"weights": args.weights.name, "forests": len(seeds), "first_seed": seeds[0]}
        report["pilots"] = {who: metrics[who] | {"episodes": flown[who]} for who in flown}
        save(args.json, json.dumps(report).encode())
    shown = flown[name][measure(flown[name])["crossed"].argmax()]  # the first that crossed, else 0
    save_film(film, shown, world, q, name)
    print(f"\nwrote {film}: forest {shown['seed']}")
    return 0


def measure(episodes: list[dict]) -> dict[str, ndarray]:
    """Arrays (F,), one number for each of F episodes: steps, progress in m, return, and 0 or 1 for
    each way to end, where crossed means arrived at the goal, or left by the far edge."""
    table = {key: np.array([e[key] for e in episodes]) for key in ("steps", "progress", "return")}
    ended = {key: np.array([e["outcome"] == key for e in episodes]) for key in OUTCOMES}
    return table | {"crossed": ended["goal"] | ended["far"]} | ended


def summarize(episodes: list[dict], baseline: list[dict]) -> dict[str, dict]:
    """Every metric with its 95 % interval. baseline: random episodes through the same F forests.

    The interval of a mean comes from resampling (the statistician's bootstrap): draw as many
    forests again, with replacement, 2,000 times, and see how the mean varies. A share has Wilson's,
    because resampling 0 % would give [0, 0].
    """
    n, table, random = len(episodes), measure(episodes), measure(baseline)["steps"]
    draws = np.random.default_rng(0).integers(n, size=(2000, n))  # (2000, F)
    ratios = table["steps"][draws].mean(1) / random[draws].mean(1)  # (2000,) the same forests
    metrics = {"longer": interval(table["steps"].mean() / random.mean() - 1, ratios - 1)}
    for key, x in table.items():
        share = x.dtype == bool
        metrics[key] = wilson(x.mean(), n) if share else interval(x.mean(), x[draws].mean(1))
    return metrics


def interval(value: float, resampled: ndarray) -> dict[str, float]:
    """A metric and the middle 95 % of its bootstrap."""
    low, high = np.percentile(resampled, [2.5, 97.5])
    return {"value": float(value), "low": float(low), "high": float(high)}


def wilson(p: float, n: int, z: float = 1.96) -> dict[str, float]:
    """A share p of n, and its 95 % interval by Wilson's score [Wilson 1927].

    >>> {key: round(x, 3) for key, x in wilson(1.0, 10).items()}
    {'value': 1.0, 'low': 0.722, 'high': 1.0}
    """
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * (p * (1 - p) / n + z * z / (4 * n * n)) ** 0.5
    return {"value": float(p), "low": max(middle - half, 0.0), "high": min(middle + half, 1.0)}


TABLE = {"goal": "arrived, %", "crossed": "crossed, %", "crash": "hit a trunk, %", "steps": "steps",
         "longer": "longer, %", "return": "return"}  # fmt: skip


def print_table(metrics: dict[str, dict]) -> None:
    """One row a metric, one column a pilot."""
    print(f"{'':14}" + "".join(f"{name:>17}" for name in metrics))
    for key, label in TABLE.items():
        factor = 100 if "%" in label else 1
        cells = [[f"{factor * x:z.0f}" for x in metrics[name][key].values()] for name in metrics]
        print(f"{label:14}" + "".join(f" {f'{x} [{low}, {high}]':>16}" for x, low, high in cells))


def save_film(path: Path, episode: dict, world: World, q: QNetwork, name: str) -> None:
    """Write an endless GIF of an episode: frame, path, and what the network says of each action."""
    places, images = [], []
    for t, drone in enumerate(refly(episode, world)):
        places.append(drone.pose[:2])
        values = q.values(drone.observation[None], [drone])[0]  # (A,)
        text = f"{name}: {t * world.dt:.1f} s, {drone.d_goal:.1f} m to the goal\n"
        text += f"return {drone.episode_return:.1f}   {drone.outcome and 'end: ' + drone.outcome}"
        images.append(draw_panel(drone, np.array(places), values, text))
    first, *rest = images + 20 * images[-1:]  # the end stays in view
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=1000 * world.dt, loop=0)
    save(path, buffer.getvalue())


# ---------------------------- files, signals, the command line: skip on a first reading


def save(path: Path, content: bytes | dict[str, Any]) -> None:
    """Write bytes, or tensors and plain values. The file stands under its name only when whole."""
    part = path.with_name(f".{path.name}.part")
    if isinstance(content, dict):
        torch.save(content, buffer := io.BytesIO())  # torch.save says nothing of a full disk
        content = buffer.getvalue()
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def load(path: Path | str, *keys: str) -> dict[str, Any]:
    """Read what save wrote, without running any code from the file. InputError if it cannot be
    read, is damaged, or does not hold these keys."""
    try:
        archive = zipfile.ZipFile(path)  # testzip leaves out flags, which mislead torch if damaged
        if archive.testzip() or any(part.external_attr for part in archive.infolist()):
            raise zipfile.BadZipFile
        content = torch.load(path, weights_only=True)
        return {key: content[key] for key in keys}
    except Exception as error:  # a foreign file can fail in any way
        why = getattr(error, "strerror", None) or "it is damaged, or another kind of file"
        raise InputError(f"{path} cannot be read: {why}") from error


def save_weights(path: Path, q: QNetwork, c: Config) -> None:
    """Write a weights file, 3.4 MB: a network in half precision, its pilot, and its world."""
    network = {name: tensor.half() for name, tensor in q.state_dict().items()}
    save(path, {"pilot": c.pilot, "beacon": c.beacon, "camera": c.camera, "network": network})


def load_weights(path: Path | str, network: type = QNetwork) -> tuple[QNetwork, World, str]:
    """Read a weights file, or that in a run's folder: the network, its world, its pilot's name."""
    path = Path(path) / "best.pt" if Path(path).is_dir() else path
    saved, q = load(path, "pilot", "beacon", "camera", "network"), network(World.num_actions)
    try:
        q.load_state_dict(saved["network"])
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{path} holds weights of another network: {saved['pilot']}") from error
    return q, World(beacon=saved["beacon"], camera=saved["camera"]), saved["pilot"]


def fingerprint(c: Config | type[Config]) -> list:
    """What must be the same where a training goes on, or its numbers would differ."""
    return [c.pilot, str(torch.__version__), f"bfloat16 {c.bfloat16}"]


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list that Ctrl-C and the other signals are written to, so that the running step can end.
    One that nohup ignores stays ignored."""
    stopped: list[int] = []
    names = "SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"  # clusters send SIGUSR1; Windows lacks some
    with ExitStack() as afterwards:
        for number in {getattr(signal, name, signal.SIGINT) for name in names}:
            if signal.getsignal(number) != signal.SIG_IGN:
                old = signal.signal(number, lambda number, _: stopped.append(number))
                afterwards.callback(signal.signal, number, old)
        yield stopped


def whole(text: str) -> int:
    """The whole number that a user typed, maybe as 1e6; ValueError if it is none."""
    return int(text if text.isdecimal() else f"{float(text):.19g}")  # 1e6 is 1000000


def parse(argv: Sequence[str] | None, config: type[Config]) -> argparse.Namespace:
    """Read the command line; every setting is a flag of `train`."""
    common = {"prog": "deepflight.py", "usage": argparse.SUPPRESS}  # so an error is a single line
    common["formatter_class"] = lambda prog: argparse.RawTextHelpFormatter(prog, 2, 26)
    common["description"] = __doc__.split("\n\n")[1]
    parser = argparse.ArgumentParser(**common)
    commands = parser.add_subparsers(dest="command", required=True, metavar="train, eval or -h")
    sub = commands.add_parser("train", help="train a pilot", **common)
    sub.add_argument("--name", default="", help="of the folder in runs/; default: a number")
    sub.add_argument("--resume", type=Path, help="folder of a training to go on with")
    group = sub.add_argument_group("settings; [+] marks what [Mnih15] does not have")
    for f in fields(config):
        more = {"type": whole if f.type is int else f.type, "metavar": ""}
        more |= {"choices": f.metadata["legal"] or None} if f.type is str else {}
        more = {"action": argparse.BooleanOptionalAction} if f.type is bool else more
        text = f"{f.metadata['help']} (default: {f.default})"
        group.add_argument("--" + f.name.replace("_", "-"), help=text, **more)
    sub = commands.add_parser("eval", help="fly trained weights beside other pilots", **common)
    shipped = Path(__file__).parent / f"weights/{config.pilot}.pt"
    sub.add_argument("--weights", type=Path, default=shipped, help="a file, or a run's folder")
    sub.add_argument("--episodes", type=whole, default=100, help="one a forest (default: 100)")
    sub.add_argument("--first-seed", type=whole, default=TEST_FIRST, help="(default: %(default)s)")
    sub.add_argument("--json", type=Path, help="write every metric and episode to this file")
    sub.add_argument("--out", type=Path, default="runs/eval", help="folder of the film")
    sub.add_argument("--threads", type=whole, default=Config.threads, help="of the CPU")
    return parser.parse_args(argv)


def make_run(args: argparse.Namespace, config: type[Config]) -> Run:
    """A new training, or one to go on with."""
    given = {f.name: x for f in fields(config) if (x := getattr(args, f.name)) is not None}
    if not args.resume:
        free = (f"{i:03d}" for i in range(1, 10**9) if not Path(f"runs/{i:03d}").exists())
        folder = Path("runs", args.name or next(free))
        c = config(**(config.beacon_recipe if given.get("beacon") else {}) | given)
        folder.mkdir(parents=True)  # fails if it exists, so no two trainings share one
        return Run(c, folder)
    if args.name or given.keys() - {"steps"}:
        raise InputError(f"{args.resume} keeps its settings: only --steps may be given")
    keys = "config fingerprint log validations actions seconds forests rng agent optimizer"
    saved = load(args.resume / "checkpoint.pt", *keys.split())
    if (made_by := saved["fingerprint"]) != (here := fingerprint(config)):
        raise InputError(f"{args.resume} was made by {made_by}, and here is {here}")
    c = config(**saved["config"] | given)
    if (steps := len(saved["actions"]) * c.num_envs) >= c.steps:
        raise InputError(f"{args.resume} has flown {steps:,} steps: give more by --steps")
    return Run(c, args.resume, saved)


def main(argv: Sequence[str] | None = None, config: type[Config] = Config) -> int:
    """Run one command; returns the exit code: 0, 2 after trouble, 128 + n after signal n."""
    args = parse(argv, config)
    try:
        code = make_run(args, config).go() if args.command == "train" else evaluate(args, config)
        sys.stdout.flush()  # here, so that a full disk is an error of ours
        return code
    except KeyboardInterrupt:
        return 130
    except (InputError, OSError, MemoryError, FloatingPointError) as error:
        print(f"deepflight.py: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # after `| head` end in silence
    sys.exit(main())
