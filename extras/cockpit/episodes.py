"""What the cockpit answers: episodes, what the network thinks of them, and why; and how it learned.

An answer is a function of the request alone. A request is a dictionary of texts. Its world,
weights, seed and actions say which episode is meant, because seed and actions are all it takes to
fly one again. The last few episodes stay in memory, so that the next step costs one step.

Legend
    A  actions
    N  trunks
    K  those of them that may be in view
    R  observations of one moment: as it was, without each of K trunks, and without the goal's pole

Not in this file: HTTP, which is in __main__.py, and the rules of the world, which are env.py's.
"""

import csv
import json
import re
from base64 import b64encode
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from time import time
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from deepflight import TRAIN_END, Config, load_weights
from dqn import InputError, QNetwork
from env import OUTCOMES, STACK, Pilot, VecForest, World, random_pilot, straight_pilot
from extras.lessons.expert import laser_pilot
from render import BEARINGS, draw_frame, seen_from

ROOT = Path(__file__).parents[2]
WORLDS = {"plain": World(), "beacon": World(beacon=True), "disparity": World(camera="disparity")}
EPISODE = {"seed": int, "actions": str, "outcome": str, "return": float, "steps": int}
HOMES = {world: name for name, world in WORLDS.items()}
CURVES = ("return", "steps", "crossed", "crash")  # what the page draws of each validation
BROKEN = (OSError, ValueError, TypeError, KeyError, csv.Error)  # what a foreign file raises


class Recording(VecForest):
    """One drone, one episode, and every moment since the start: what the drone saw, and what the
    network thought. It is a vector environment, because that is what pilots fly."""

    def __init__(self, q: QNetwork, world: World, seed: int) -> None:
        super().__init__(world, 1, [seed])
        self.reset_done()
        self.q, self.drone, self.moments = q, self.drones[0], []
        self.note(0.0)

    def fly(self, action: int) -> None:
        """One control step."""
        self.note(float(self.step([action])[1][0]))

    def note(self, r: float) -> None:
        """Keep all that there is to show of the moment after a step of reward r."""
        drone, s = self.drone, self.drone.observation  # (4, 84, 84)
        moment = {"pose": drone.pose, "d_obs": drone.d_obs, "reward": r}
        moment |= {"return": drone.episode_return, "q": self.q.values(s[None], [drone])[0].tolist()}
        self.moments.append(moment | {"frame": b64encode(s[-1]).decode()})


def same_random(s: ndarray, envs: Recording) -> ndarray:
    """A random action, but the same one each time that this moment is asked for."""
    return random_pilot(np.random.default_rng([envs.drone.seed, len(envs.moments)]))(s, envs)


PILOTS: dict[str, Pilot] = {"network": lambda s, envs: [int(np.argmax(envs.moments[-1]["q"]))]}
PILOTS |= {"laser": laser_pilot(Config.gamma), "random": same_random, "straight": straight_pilot}

# What may be asked, as patterns.
LEGAL = dict.fromkeys(("more", "since", "time"), "[0-9]{1,4}")
LEGAL |= {"world": "|".join(WORLDS), "pilot": "|".join(PILOTS), "seed": "[0-9]{1,18}"}
LEGAL |= dict.fromkeys(("weights", "name"), ".{1,300}")
LEGAL |= {"actions": f"[0-{World.num_actions - 1}]{{0,{World.max_steps}}}"}


def check(ask: Any, keys: str) -> None:
    """Raise ValueError unless a request has just these keys, each with a legal text."""
    if not isinstance(ask, dict) or ask.keys() != {*keys.split()}:
        raise ValueError(f"a request is an object with these keys alone: {keys or 'none'}")
    for key, value in ask.items():
        if not isinstance(value, str) or not re.fullmatch(LEGAL[key], value):
            raise ValueError(f"{key} is {str(value)[:40]!r}, allowed is a text like {LEGAL[key]}")


@cache
def read_network(path: Path, _changed: int) -> tuple[QNetwork | None, World | None, str]:
    """A network, its world, and the name of its pilot; no world if it is no weights file.
    _changed: when the file was written, because a training writes it again."""
    with suppress(InputError):
        q, world, pilot = load_weights(path)
        return q.requires_grad_(False), world, pilot
    return None, None, ""


def settings(folder: Path) -> dict[str, Any]:
    """Of a training, without those that leave its curve comparable."""
    found = dict(json.loads((folder / "config.json").read_text()))
    return {key: value for key, value in found.items() if key not in ("seed", "threads")}


def read_log(folder: Path) -> list[dict[str, float]]:
    """What each validation of a training came to."""
    with (folder / "log.csv").open() as file:
        return [{"step": int(row["step"]), "minutes": float(row["seconds"]) / 60}
                | {key: float(row[f"validation_{key}"]) for key in CURVES}
                for row in csv.DictReader(file)]  # fmt: skip


@lru_cache(1)  # the page asks every two seconds
def read_training(folder: Path, _changed: int) -> list[dict[str, Any]]:
    """The same with the episodes. The log is written first: its last row may have none yet."""
    flown: dict[int, list] = {}
    for x in map(json.loads, (folder / "validation.jsonl").read_text().splitlines()):
        if x["outcome"] not in OUTCOMES or not re.fullmatch(LEGAL["actions"], x["actions"]):
            raise ValueError(f"no such episode: {str(x)[:80]}")
        flown.setdefault(x["step"], []).append({key: of(x[key]) for key, of in EPISODE.items()})
    return [x | {"episodes": flown[x["step"]]} for x in read_log(folder) if x["step"] in flown]


class Hangar:
    """The networks and trainings in two folders each, and the last episodes. One thread at a time
    may ask it.

    runs: one more folder of trainings. weights: one more network, a file or a run's folder; it is
    the first of its world, and the page begins there. InputError if there are no such ones.
    """

    def __init__(self, root: Path = ROOT, runs: str = "", weights: str = "") -> None:
        torch.set_num_threads(1)  # more gain nothing on so few frames
        self.root, self.recordings, self.world, self.given = root.resolve(), [], "plain", {}
        self.runs = {self.root / "runs", Path(runs).resolve() if runs else self.root / "runs"}
        if weights:
            path, self.world = Path(weights).resolve(), HOMES.get(load_weights(weights)[1], "")
            name, file = (path.name, path / "best.pt") if path.is_dir() else (path.stem, path)
            ours = self.root / f"weights/{name}.pt"  # another one of this name
            self.given = {str(path) if ours.exists() and ours != file else name: file}
        if not (Path(runs).is_dir() and self.world):
            raise InputError(f"{runs} is no folder" if self.world else f"{weights}: unknown world")

    def name(self, folder: Path) -> str:
        """Of a training: its path, from the root if it is there."""
        return folder.as_posix().removeprefix(f"{self.root.as_posix()}/")

    def networks(self, world: str) -> dict[str, tuple[QNetwork, str]]:
        """Those of this world and their pilots' names, from weights/*.pt and runs/*/best.pt."""
        paths = {path.stem: path for path in self.root.glob("weights/*.pt")}
        paths |= {self.name(x.parent): x for runs in self.runs for x in runs.glob("*/best.pt")}
        found = {}
        for name, path in (self.given | dict(sorted(paths.items())) | self.given).items():
            q, home, pilot = read_network(path, path.exists() and path.stat().st_mtime_ns)
            found |= {name: (q, pilot)} if home == WORLDS[world] else {}
        return found

    def find(self, ask: dict[str, str]) -> Recording:
        """The episode of a request. It goes on with the one in memory that shares most of its
        actions. ValueError if there are no such weights, or if the episode ends sooner."""
        q, _ = self.networks(ask["world"]).get(ask["weights"], (None, ""))
        if q is None:
            raise ValueError(f"there are no weights {ask['weights']!r} of world {ask['world']}")
        seed, actions, world = int(ask["seed"]), [*map(int, ask["actions"])], WORLDS[ask["world"]]
        same = [x for x in self.recordings if (x.q, x.drone.seed) == (q, seed)]
        begun = [x for x in same if x.drone.actions == actions[: len(x.drone.actions)]]
        recording = max(begun, key=lambda x: len(x.moments), default=0) or Recording(q, world, seed)
        for action in actions[len(recording.drone.actions) :]:
            if recording.drone.outcome:
                raise ValueError(f"the episode ends after {len(recording.moments) - 1} actions")
            recording.fly(action)
        # The last eight, of 10 MB each at most.
        self.recordings = [recording, *(x for x in self.recordings if x is not recording)][:8]
        return recording

    def options(self, ask: Any) -> dict[str, Any]:
        """What one may choose from, and the numbers of each world that the page draws with.
        world: the one to begin in. half_view: rad, from ahead to the left edge of a frame."""
        check(ask, "")
        weights = {w: {x: pilot for x, (_, pilot) in self.networks(w).items()} for w in WORLDS}
        worlds = {name: vars(world) | {"weights": weights[name]} for name, world in WORLDS.items()}
        return {"worlds": worlds, "pilots": ["you", *PILOTS], "half_view": float(BEARINGS[0]),
                "train_end": TRAIN_END, "world": self.world}  # fmt: skip

    def fly(self, ask: Any) -> dict[str, Any]:
        """Fly the actions, then let the pilot fly `more` steps, or to the end. Returns the record
        as `eval --json` writes it, the trunks, and the moments from `since`."""
        check(ask, "world weights seed actions pilot more since")
        recording, pilot = self.find(ask), PILOTS[ask["pilot"]]
        last = len(recording.moments) + int(ask["more"])
        while len(recording.moments) < last and not recording.drone.outcome:
            recording.fly(int(pilot(recording.drone.observation[None], recording)[0]))
        drone, moments = recording.drone, recording.moments[int(ask["since"]) :]
        return {"record": drone.episode(), "trunks": drone.trunks.tolist(), "moments": moments}

    def moment(self, ask: Any) -> tuple[Recording, ndarray]:
        """The episode of a request, and where the frames of moment `time` were taken (4, 3)."""
        check(ask, "world weights seed actions time")
        recording, t = self.find(ask), int(ask["time"])
        if t >= len(recording.moments):
            raise ValueError(f"time is {t}, and the episode has {len(recording.moments) - 1} steps")
        last = [recording.moments[max(t - k, 0)]["pose"] for k in reversed(range(STACK))]
        return recording, np.array(last)

    def look(self, ask: Any) -> dict[str, list[str]]:
        """What each filter of the first convolution makes of the frames of moment `time`, after
        ReLU. On one scale for all of them: 0 is black, and the greatest value is white."""
        recording, poses = self.moment(ask)
        drone, layer = recording.drone, recording.q.conv[:2]
        s = np.array([draw_frame(pose, drone.trunks, drone.world) for pose in poses])  # (4, 84, 84)
        maps = layer(torch.from_numpy(s) / 255).numpy()  # (32, 20, 20)
        grey = (255 * maps / max(maps.max(), 1e-9)).round().astype(np.uint8)
        return {"maps": [b64encode(x).decode() for x in grey]}

    def why(self, ask: Any) -> dict[str, Any]:
        """What each thing in view does to the decision at moment `time`: Q with and without it.

        `weight` says how much of the chosen action's advantage hangs on it: its Q less the mean of
        all Q; the greatest comes first. Trunk -1 is the goal's pole. A trunk that changes no pixel
        is left out.
        """
        recording, poses = self.moment(ask)
        names, s = without(poses, recording)  # (R,), (R, 4, 84, 84)
        changed = np.flatnonzero((s != s[0]).any((1, 2, 3)))  # of R: what is in view
        before, *after = recording.q.values(s[[0, *changed]], ()).tolist()
        chosen = int(np.argmax(before))
        advantage, *rest = [q[chosen] - float(np.mean(q)) for q in (before, *after)]
        reasons = [
            {"trunk": int(names[i]), "q": q, "weight": advantage - other,
             "name": whereabouts(names[i], poses[-1], recording.drone.trunks),
             "frame": b64encode(s[i, -1]).decode(), "box": box(s[i, -1] != s[0, -1])}
            for i, q, other in zip(changed, after, rest, strict=True)
        ]  # fmt: skip
        reasons.sort(key=lambda x: -abs(x["weight"]))
        return {"before": before, "chosen": chosen, "without": reasons}

    def folders(self) -> dict[str, Path]:
        """Those of trainings that keep their validation episodes, the latest run first."""
        logs = [x for y in (*self.runs, self.root / "results") for x in y.glob("**/log.csv")]
        found = [path.parent for path in logs if path.with_name("validation.jsonl").exists()]
        return {self.name(x): x for x in sorted(found, reverse=True)}

    def trainings(self, ask: Any) -> list[dict[str, str]]:
        """Those in a known world. The first is to be opened: one that runs, because its log is less
        than 600 s old; or else the shipped one; or else the one with most validations. weights: of
        the final network, "" if it is not here."""
        check(ask, "")
        found = []
        for name, folder in self.folders().items():
            with suppress(*BROKEN):
                c, weights = settings(folder), name.removeprefix("results/")
                world = HOMES[World(beacon=c["beacon"], camera=c["camera"])]
                there = weights if weights in self.networks(world) else ""
                mine, age = weights == name, time() - (folder / "log.csv").stat().st_mtime
                first = (mine and age < 600, name == "results/dqn", len(read_log(folder)))
                found.append((first, {"name": name, "world": world, "weights": there}))
        return [x for _, x in sorted(found, key=lambda x: x[0], reverse=True)]

    def training(self, ask: Any) -> dict[str, Any]:
        """The validations of a training from number `since`, and how many there are. The band: the
        least and greatest values of the committed trainings that differ in the seed alone."""
        check(ask, "name since")
        if not (folder := self.folders().get(ask["name"])):
            raise ValueError(f"there is no training {ask['name']!r} with validation episodes")
        try:
            rows = read_training(folder, (folder / "validation.jsonl").stat().st_mtime_ns)
            others = [x.parent for x in self.root.glob("results/**/log.csv") if x.parent != folder]
            logs = [read_log(x) for x in others if settings(x) == settings(folder)]
        except BROKEN as error:
            raise ValueError(f"the training {ask['name']} cannot be read: {error!r}") from None
        band = [{key: [f(row[key] for row in rows) for f in (min, max)] for key in rows[0]}
                for rows in zip(*logs, strict=False)]  # fmt: skip
        return {"validations": rows[int(ask["since"]) :], "count": len(rows), "band": band,
                "others": len(logs)}  # fmt: skip


def without(poses: ndarray, recording: Recording) -> tuple[list[int], ndarray]:
    """The observation as it is, and with each thing taken out that may be in view.

    poses (4, 3): where the four frames were taken. Returns names and observations (R, 4, 84, 84).
    The names: -2 is nothing, -1 the goal's pole, others are numbers of trunks.
    """
    trunks, world = recording.drone.trunks, recording.world
    ahead, left = np.stack([seen_from(pose, trunks) for pose in poses]).T  # (N, 4), (N, 4) m
    # As `draw_frame` does it: two radii to spare, because a trunk is wide.
    inside = (ahead > 0) & (ahead < world.view) & (abs(left) < ahead + 2 * world.trunk_radius)
    near = np.flatnonzero(inside.any(1))  # (K,)
    # In a world without a pole the last observation equals the first, and so is left out.
    scenes = [(trunks, world), *((np.delete(trunks, i, 0), world) for i in near)]
    scenes.append((trunks, replace(world, beacon=False)))
    return [-2, *near, -1], np.array([[draw_frame(p, *scene) for p in poses] for scene in scenes])


def whereabouts(i: int, pose: ndarray, trunks: ndarray) -> str:
    """Where trunk i stands, in words; -1 is the goal's pole."""
    if i < 0:
        return "the goal's pole"
    ahead, left = seen_from(pose, trunks[i])
    return f"{np.hypot(ahead, left):.0f} m off, {abs(left):.1f} m {'left' if left > 0 else 'right'}"


def box(changed: ndarray) -> list[int]:
    """Left, top, width and height of what changed in a frame (84, 84); [] if nothing did."""
    x, y = [np.flatnonzero(changed.any(axis)).tolist() for axis in (0, 1)]
    return [x[0], y[0], x[-1] - x[0] + 1, y[-1] - y[0] + 1] if x else []
