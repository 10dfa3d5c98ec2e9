"""What the cockpit answers: flights, what the network thinks of them, and why.

An answer is a function of the request alone. A request is a dictionary of texts: world, weights,
seed and actions say which flight is meant, because a flight is its seed and its actions. The last
few flights stay in memory, so that the next step costs one step.

Legend
    A  actions
    N  trunks
    K  those of them that may be in view
    R  states of one decision: as it was, without each of K trunks, and without the goal's pole

Not in this file: HTTP, which is in __main__.py. No rule of the world either: they are env.py's.
"""

import re
from base64 import b64encode
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from deepflight import TRAIN_END
from dqn import DQNConfig, QNetwork, load_weights
from env import STACK, Fleet, Pilot, World, laser_pilot, random_pilot, straight_pilot
from render import BEARINGS, ENDS, camera, seen_from

ROOT = Path(__file__).parents[2]
WORLDS = {"plain": World(), "beacon": World(beacon=True), "disparity": World(camera="disparity")}


class Flight(Fleet):
    """One drone in its forest, and every moment since the start: what it saw, met and thought. A
    fleet, because that is what pilots fly."""

    def __init__(self, q: QNetwork, world: World, seed: int) -> None:
        super().__init__(world, 1)
        self.reset([0], [seed])
        self.q, self.drone, self.moments = q, self.envs[0], []
        self.note(0.0)

    def note(self, r: float) -> None:
        """Keep all that there is to show of the moment after a step of reward r."""
        s = self.drone.observation  # (4, 84, 84)
        q = self.q(torch.from_numpy(s[None]))[0].tolist()  # A numbers
        seen = {"frame": b64encode(s[-1]).decode(), "q": q, "reward": r, "return": self.drone.total}
        self.moments.append(self.drone.info() | seen)


def chance(flight: Flight) -> ndarray:
    """A random action, but the same one each time that this flight is asked for."""
    return random_pilot(np.random.default_rng([flight.drone.seed, len(flight.moments)]))(flight)


PILOTS: dict[str, Pilot] = {"network": lambda flight: [int(np.argmax(flight.moments[-1]["q"]))]}
PILOTS |= {"laser": laser_pilot(DQNConfig.gamma), "random": chance, "straight": straight_pilot}

# -------------------------------------------------- what may be asked

# As patterns. That is not all: weights must have their name in a list, and actions must fly.
LEGAL = dict.fromkeys(("more", "since", "time"), "[0-9]{1,4}")
LEGAL |= {"world": "|".join(WORLDS), "pilot": "|".join(PILOTS), "seed": "[0-9]{1,18}"}
LEGAL |= {"weights": ".{1,300}", "actions": f"[0-{World.actions - 1}]{{0,{World.max_steps}}}"}


def check(ask: Any, keys: str) -> None:
    """Raise ValueError unless a request has just these keys, each with a legal text."""
    if type(ask) is not dict or ask.keys() != {*keys.split()}:
        raise ValueError(f"this request is an object with these keys alone: {keys or 'none'}")
    for key, value in ask.items():
        if type(value) is not str or not re.fullmatch(LEGAL[key], value):
            raise ValueError(f"{key} is {str(value)[:40]!r}, allowed is a text like {LEGAL[key]}")


@cache
def read_network(path: Path, _changed: int) -> tuple[str, QNetwork | None]:
    """A network, and the name of the world that it was trained in; none if it is no file of ours.
    _changed: when the file was written, because a training writes it again."""
    for name, w in WORLDS.items():
        with suppress(ValueError):
            q = load_weights(path, w.actions, beacon=w.beacon, camera=w.camera)
            return name, q.requires_grad_(False)  # it learns nothing here
    return "", None


class Hangar:
    """The networks in two folders, and the last flights. One thread at a time may ask it."""

    def __init__(self, root: Path = ROOT) -> None:
        torch.set_num_threads(1)  # two gain nothing on so few pictures
        self.root, self.flights = root, []

    def networks(self, world: str) -> dict[str, QNetwork]:
        """Those of this world, by name, from weights/*.pt and runs/*/best.pt."""
        paths = {path.stem: path for path in self.root.glob("weights/*.pt")}
        paths |= {f"runs/{path.parent.name}": path for path in self.root.glob("runs/*/best.pt")}
        read = {x: read_network(paths[x], paths[x].stat().st_mtime_ns) for x in sorted(paths)}
        return {name: q for name, (home, q) in read.items() if home == world}

    def find(self, ask: dict[str, str]) -> Flight:
        """The flight of a request. It goes on with the one in memory that is the longest part of
        the way. Raises ValueError if there are no such weights, or if it ends sooner."""
        q = self.networks(ask["world"]).get(ask["weights"])
        if q is None:
            raise ValueError(f"there are no weights {ask['weights']!r} of world {ask['world']}")
        seed, actions = int(ask["seed"]), [int(action) for action in ask["actions"]]
        same = [flight for flight in self.flights if (flight.q, flight.drone.seed) == (q, seed)]
        begun = [f for f in same if f.drone.actions == actions[: len(f.drone.actions)]]
        flight = max(begun, key=lambda flight: len(flight.moments), default=None)
        flight = flight or Flight(q, WORLDS[ask["world"]], seed)
        for action in actions[len(flight.drone.actions) :]:
            flight.note(flight.drone.step(action)[1])
        # The last eight, of 10 MB each at most.
        self.flights = [flight, *(other for other in self.flights if other is not flight)][:8]
        return flight

    def options(self, ask: Any) -> dict[str, Any]:
        """What one may choose from, and the numbers of each world that the page draws with.
        half_view: rad, from ahead to the left edge of a picture."""
        check(ask, "")
        worlds = {w: vars(WORLDS[w]) | {"weights": [*self.networks(w)]} for w in WORLDS}
        return {"worlds": worlds, "pilots": ["you", *PILOTS], "half_view": float(BEARINGS[0]),
                "train_end": TRAIN_END}  # fmt: skip

    def fly(self, ask: Any) -> dict[str, Any]:
        """Fly the actions, then let the pilot fly `more` steps, or to the end. Tells the record as
        `eval --json` writes it, how it ended, the trunks, and the moments from `since`."""
        check(ask, "world weights seed actions pilot more since")
        flight = self.find(ask)
        last = len(flight.moments) + int(ask["more"])
        while len(flight.moments) < last and not flight.drone.outcome:
            flight.note(flight.drone.step(PILOTS[ask["pilot"]](flight)[0])[1])
        record, moments = flight.drone.flight(), flight.moments[int(ask["since"]) :]
        answer = {"record": record, "ended": ENDS[record["edge"] or record["outcome"]]}
        return answer | {"trunks": flight.drone.trunks.tolist(), "moments": moments}

    def why(self, ask: Any) -> dict[str, Any]:
        """What each thing in view does to the decision at moment `time`: Q with and without it.

        `weight` says how much of the chosen action's lead hangs on it. The lead is its Q less the
        mean of all Q. Trunk -1 is the goal's pole. A trunk that changes no pixel is left out.
        """
        check(ask, "world weights seed actions time")
        flight, t = self.find(ask), int(ask["time"])
        if t >= len(flight.moments):
            raise ValueError(f"time is {t}, and the flight has {len(flight.moments) - 1} steps")
        last = [flight.moments[max(t - k, 0)]["pose"] for k in reversed(range(STACK))]
        names, states = without(np.array(last), flight)  # (R,), (R, 4, 84, 84)
        changed = np.flatnonzero((states != states[0]).any((1, 2, 3)))  # of R: what is in view
        before, *after = flight.q(torch.from_numpy(states[[0, *changed]])).tolist()
        chosen = int(np.argmax(before))
        lead = [q[chosen] - float(np.mean(q)) for q in (before, *after)]
        reasons = [
            {"trunk": int(names[i]), "q": q, "weight": lead[0] - its,
             "frame": b64encode(states[i, -1]).decode()}
            for i, q, its in zip(changed, after, lead[1:], strict=True)
        ]  # fmt: skip
        return {"before": before, "chosen": chosen, "without": reasons}


def without(poses: ndarray, flight: Flight) -> tuple[list[int], ndarray]:
    """The state as it is, and with each thing taken out that may be in view.

    poses (4, 3): where the four pictures were taken. Returns names and states (R, 4, 84, 84). The
    names: -2 is nothing, -1 the goal's pole, others are numbers of trunks.
    """
    trunks, world = flight.drone.trunks, flight.drone.world
    ahead, left = np.stack([seen_from(pose, trunks) for pose in poses]).T  # (N, 4), (N, 4) m
    # As `camera` does it: two radii to spare, because a trunk is wide.
    inside = (ahead > 0) & (ahead < world.view) & (abs(left) < ahead + 2 * world.trunk_radius)
    near = np.flatnonzero(inside.any(1))  # (K,)
    forests = [trunks, *(np.delete(trunks, i, 0) for i in near)]  # 1 + K of (N, 2), (N - 1, 2) m
    goal = flight.drone.goal if world.beacon else None
    # (4 + 4 K, 3), and as many forests: one for each eye
    eyes, seen = np.tile(poses, (len(forests), 1)), [f for f in forests for _ in poses]
    # In a world without a pole the last state equals the first, and so is left out.
    frames = [camera(eyes, seen, world, goal), camera(poses, [trunks] * STACK, world)]
    return [-2, *near, -1], np.concatenate(frames).reshape(-1, *flight.drone.observation.shape)
