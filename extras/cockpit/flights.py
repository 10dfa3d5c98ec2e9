"""What the cockpit answers: flights, what the network thinks of them, and why.

An answer is a function of the request alone. A request is a dictionary of texts: world, weights,
seed and actions say which flight is meant, because a flight is its seed and its actions. The last
few flights stay in memory, so that the next step costs one step.

Legend
    t  moments of a flight, 0 at its start
    A  actions
    R  things that are taken out of a decision, one at a time: trunks, the goal's pole; and first
       nothing

Not in this file: HTTP, which is in __main__.py. No rule of the world either: they are env.py's.
"""

import re
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from deepflight import TRAIN_END
from dqn import DQNConfig, QNetwork, load_weights
from env import STACK, Fleet, World, laser_pilot, random_pilot, straight_pilot
from render import BEARINGS, ENDS, camera, seen_from

ROOT = Path(__file__).parents[2]
WORLDS = {"plain": World(), "beacon": World(beacon=True), "disparity": World(camera="disparity")}
KEPT = 8  # flights in memory, 8 MB each at most
Ask = dict[str, str]


class Flight:
    """A drone in its forest, with all that it has seen and met since the start."""

    def __init__(self, world: World, q: QNetwork, seed: int) -> None:
        self.q, self.fleet = q, Fleet(world, 1)  # a fleet, because a pilot wants one
        self.fleet.reset([0], [seed])
        self.drone = self.fleet.envs[0]
        self.frames: list[ndarray] = []  # (84, 84) each
        self.moments: list[dict] = []
        self.known: dict[int, list[float]] = {}  # t -> Q
        self.note(0.0)

    def step(self, action: int) -> None:
        """Fly one step. Raises ValueError if the flight is over."""
        _, r, *_ = self.drone.step(action)
        self.note(r)

    def note(self, r: float) -> None:
        """Keep what there is to show of this moment."""
        self.frames.append(self.drone.observation[-1].copy())
        self.moments.append(self.drone.info() | {"reward": r, "return": self.drone.total})

    def state(self, t: int) -> ndarray:
        """The last four pictures at moment t: (4, 84, 84)."""
        return np.stack([self.frames[i] for i in last_four(t)])

    def values(self, t: int) -> list[float]:
        """Q(s_t, .): A numbers."""
        if t not in self.known:
            self.known[t] = think(self.q, self.state(t)[None])[0]
        return self.known[t]

    def show(self, t: int, pictures: bool) -> dict[str, Any]:
        """Moment t as the page wants it."""
        picture = {"frame": encode(self.frames[t])} if pictures else {}
        return self.moments[t] | {"q": self.values(t)} | picture


def last_four(t: int) -> list[int]:
    """The moments of the pictures that make up the state at moment t.

    >>> last_four(1), last_four(7)
    ([0, 0, 0, 1], [4, 5, 6, 7])
    """
    return [max(t - k, 0) for k in reversed(range(STACK))]


@torch.no_grad()
def think(q: QNetwork, s: ndarray) -> list[list[float]]:
    """Q(s, .) of each state: B lists of A numbers. s (B, 4, 84, 84)."""
    return q(torch.from_numpy(s)).tolist()


def encode(frame: ndarray) -> str:
    """A picture (84, 84) as text: its grey levels, row by row, in base64."""
    return b64encode(frame.tobytes()).decode()


# -------------------------------------------------- who flies


def greedy(flight: Flight) -> int:
    """The network's action: the one of greatest Q."""
    return int(np.argmax(flight.values(len(flight.moments) - 1)))


def chance(flight: Flight) -> int:
    """A random action, the same one each time that this flight is asked for."""
    rng = np.random.default_rng([flight.drone.seed, len(flight.moments)])
    return int(random_pilot(rng)(flight.fleet)[0])


PILOTS: dict[str, Callable[[Flight], int]] = {
    "network": greedy,
    "laser": lambda flight: int(laser_pilot(DQNConfig.gamma)(flight.fleet)[0]),
    "random": chance,
    "straight": lambda flight: int(straight_pilot(flight.fleet)[0]),
}


# -------------------------------------------------- which flight is meant

# What a request may hold, as patterns. More is asked of some: weights are looked up by name, and
# actions must fly.
LEGAL = {
    "world": "|".join(WORLDS), "weights": ".{1,300}", "seed": "[0-9]{1,18}",
    "actions": f"[0-{World.actions - 1}]{{0,{World.max_steps}}}", "pilot": "|".join(PILOTS),
    "more": "[0-9]{1,4}", "since": "[0-9]{1,4}", "time": "[0-9]{1,4}", "pictures": "[01]",
}  # fmt: skip
FLIGHT = ("world", "weights", "seed", "actions")


def check(ask: Any, *keys: str) -> None:
    """Raise ValueError unless a request holds just these keys, each with a legal text."""
    if type(ask) is not dict or ask.keys() != {*keys}:
        raise ValueError(f"a request here is an object of: {', '.join(keys) or 'nothing'}")
    for key, value in ask.items():
        if type(value) is not str or not re.fullmatch(LEGAL[key], value):
            raise ValueError(f"{key} is {str(value)[:40]!r}, allowed is a text like {LEGAL[key]}")


class Hangar:
    """The networks on disk, and the last flights. One thread at a time may ask it."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root, self.flights = root, {}
        self.read: dict[Path, tuple[int, tuple[str, QNetwork] | None]] = {}

    def networks(self) -> dict[str, dict[str, QNetwork]]:
        """World -> name -> network, of weights/*.pt and runs/*/best.pt. A file that is none of ours
        is left out, and so is a world without networks."""
        names = {path.stem: path for path in self.root.glob("weights/*.pt")}
        names |= {f"runs/{path.parent.name}": path for path in self.root.glob("runs/*/best.pt")}
        found: dict[str, dict[str, QNetwork]] = {world: {} for world in WORLDS}
        for name in sorted(names, key=lambda name: ("/" in name, name)):
            if home := self.load(names[name]):
                world, q = home
                found[world][name] = q
        return {world: networks for world, networks in found.items() if networks}

    def load(self, path: Path) -> tuple[str, QNetwork] | None:
        """A network and the name of its world, read again if the file has changed."""
        with suppress(OSError):
            changed = path.stat().st_mtime_ns
            if self.read.get(path, (0,))[0] != changed:
                self.read[path] = changed, read_network(path)
            return self.read[path][1]
        return None

    def find(self, ask: Ask) -> Flight:
        """The flight of a request. It goes on with the one in memory that is the longest part of
        the way. Raises ValueError if there are no such weights, or if it ends sooner."""
        q = self.networks().get(ask["world"], {}).get(ask["weights"])
        if q is None:
            raise ValueError(f"there are no weights {ask['weights']!r} of world {ask['world']}")
        actions, route = ask["actions"], (q, int(ask["seed"]))
        known = [key for key in self.flights if key[:2] == route and actions.startswith(key[2])]
        key = max(known, key=lambda key: len(key[2]), default=None)
        flight = self.flights.pop(key, None) or Flight(WORLDS[ask["world"]], *route)
        for action in actions[len(flight.drone.actions) :]:
            flight.step(int(action))
        return flight

    def keep(self, flight: Flight) -> None:
        """Remember it, and forget the one that was asked for longest ago."""
        record = flight.drone.flight()
        self.flights[(flight.q, record["seed"], record["actions"])] = flight
        while len(self.flights) > KEPT:
            del self.flights[next(iter(self.flights))]

    def options(self, ask: Any) -> dict[str, Any]:
        """What one may choose from, and the numbers of each world that the page draws with."""
        check(ask)
        worlds = self.networks()
        worlds = {w: asdict(WORLDS[w]) | {"weights": [*names]} for w, names in worlds.items()}
        view = float(BEARINGS[0])  # rad, from ahead to the left edge of a picture
        pilots = ["you", *PILOTS]
        return {"worlds": worlds, "pilots": pilots, "half_view": view, "train_end": TRAIN_END}

    def fly(self, ask: Any) -> dict[str, Any]:
        """Fly the actions, then let the pilot fly `more` steps. Tells the moments from `since`, and
        the trunks if that is 0."""
        check(ask, *FLIGHT, "pilot", "more", "since", "pictures")
        flight = self.find(ask)
        for _ in range(int(ask["more"])):
            if flight.drone.outcome:
                break
            flight.step(PILOTS[ask["pilot"]](flight))
        self.keep(flight)
        first, record = int(ask["since"]), flight.drone.flight()
        told = range(first, len(flight.moments))
        answer = {"flight": record, "ended": ENDS[record["edge"] or record["outcome"]]}
        answer |= {"trunks": flight.drone.trunks.tolist()} if first == 0 else {}
        return answer | {"moments": [flight.show(t, ask["pictures"] == "1") for t in told]}

    def why(self, ask: Any) -> dict[str, Any]:
        """What each thing in view does to the decision at moment `time`: Q with and without it.

        `weight` says how much of the chosen action's lead hangs on it. The lead is its Q less the
        mean of all Q. Trunk -1 is the goal's pole. A trunk that changes no pixel is left out.
        """
        check(ask, *FLIGHT, "time")
        flight, t = self.find(ask), int(ask["time"])
        self.keep(flight)
        if t >= len(flight.moments):
            raise ValueError(f"time is {t}, and the flight has {len(flight.moments) - 1} steps")
        poses = np.array([flight.moments[i]["pose"] for i in last_four(t)])  # (4, 3)
        names, states = without(poses, flight)  # (R,), (R, 4, 84, 84)
        changed = (states != states[0]).any((1, 2, 3))  # (R,)
        changed[0] = True  # nothing is taken out there
        names, states = names[changed], states[changed]  # (R,), (R, 4, 84, 84)
        before, *after = think(flight.q, states)
        chosen = int(np.argmax(before))
        reasons = [
            {"trunk": int(name), "q": q, "frame": encode(s[-1]),
             "weight": lead(before, chosen) - lead(q, chosen)}
            for name, q, s in zip(names[1:], after, states[1:], strict=True)
        ]  # fmt: skip
        return {"before": before, "chosen": chosen, "without": reasons}


def read_network(path: Path) -> tuple[str, QNetwork] | None:
    """A network and the name of the world that it was trained in; None if it is of no such."""
    for name, world in WORLDS.items():
        with suppress(ValueError):
            seen = {"beacon": world.beacon, "camera": world.camera}
            return name, load_weights(path, world.actions, **seen)
    return None


# -------------------------------------------------- why


def without(poses: ndarray, flight: Flight) -> tuple[ndarray, ndarray]:
    """The state as it is, and with each thing taken out that may be in view.

    poses (4, 3): where the four pictures were taken. Returns names (R,), states (R, 4, 84, 84).
    The names: -2 is nothing, -1 the goal's pole, others are numbers of trunks.
    """
    drone, world = flight.drone, flight.drone.world
    goal = drone.goal if world.beacon else None
    near = np.flatnonzero([may_see(poses, trunk, world) for trunk in drone.trunks])  # (N,)
    forests = [drone.trunks, *(np.delete(drone.trunks, i, 0) for i in near)]
    eyes = np.tile(poses, (len(forests), 1))  # (4 * (N + 1), 3)
    frames = camera(eyes, [f for f in forests for _ in poses], world, goal)  # (4 (N + 1), 84, 84)
    names = [-2, *near]
    if world.beacon:
        no_pole = camera(poses, [drone.trunks] * len(poses), world)  # (4, 84, 84)
        names, frames = [*names, -1], np.concatenate([frames, no_pole])
    return np.array(names), frames.reshape(-1, *flight.state(0).shape)


def may_see(poses: ndarray, trunk: ndarray, world: World) -> bool:
    """Whether a trunk (2,) could be in a picture from one of these poses (4, 3)."""
    ahead, left = np.concatenate([seen_from(pose, trunk[None]) for pose in poses]).T  # (4,), (4,) m
    return bool(((ahead > 0) & (np.abs(left) < ahead + 2 * world.trunk_radius)).any())


def lead(q: list[float], action: int) -> float:
    """By how much an action's Q exceeds the mean of all.

    >>> lead([1.0, 2.0, 6.0], 2)
    3.0
    """
    return q[action] - sum(q) / len(q)
