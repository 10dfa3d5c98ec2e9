"""env.py: the world. A quadrotor at constant speed and altitude in a random forest [DF §II-A].

        y = +25  +-----------------------------------------------+
                 | o    o   o     o   o    o   o    o     o    o |o
     left edge   |    o   o    o    o    o    o   o   o    o     |   o  trunks of the last row
                 |  o    o  o     o    o   o     o   o    o  o   |       stand beyond the far edge
    start (0, 0) *~~~~.  o    o    o  o    o   o    o   o    o   G goal (90, 0)
                 | o   `~~~~~~> o    o   o    o   o    o    o    |
    right edge   |   o    o   psi  o    o   o    o   o   o     o | o
        y = -25  +-----------------------------------------------+
               x = 0    x: start to goal, y: left, heading psi: counter-clockwise from x   x = 90

The drone never slows down. Ten times a second it takes a picture, keeps the last four, and picks
one of nine yaw rates: 0 is the sharpest right turn, 4 is straight on, 8 is the sharpest left turn.
Each such step earns one number, the reward. It says how good the step was. To fly well is to
collect much reward over a whole flight.

    | the step ends                        | the reward is                                       |
    |--------------------------------------|-----------------------------------------------------|
    | in the air, d_obs > 2.0 m            | r_safe + r_goal                                     |
    | in the air, d_obs from 2.0 to 0.75 m | r_near + r_goal                                     |
    | in a crash, d_obs < 0.75 m           | r_crash                                             |
    | outside: x < -2, x > 90, abs(y) > 25 | r_crash                                             |
    | at the goal, or out of time          | as in the air                                       |

    r_safe = 0.25    r_crash = -10    r_goal = 1 - d_goal / d_max, 0 at the start and 1 at the goal
    r_near falls in a straight line from 0 at d_neg = 2.0 m to r_precrash = -5 at d_crash = 0.75 m

One step in numbers: the drone is at x = 30 on the middle line, so d_goal = 60, and the nearest bark
is 1.5 m away. That is too close: -5 * (2.0 - 1.5) / (2.0 - 0.75) = -2. A third of the way is made:
1 - 60 / 90 = 0.33. The reward of the step is -1.67.

This is the paper's reward. By it a drone that circles in one place earns as much a step as one that
passes through, and leaving by the far edge costs 10, although the goal stands there. So in training
the network is paid more than this: see `learner_reward` in deepflight.py.

A flight ends in one of two ways. It is **terminated** when the world itself ends it: by a crash, by
arrival, or by leaving the forest. No more reward can follow. It is **truncated** when only the
clock ends it, after 1,000 steps: the drone was still flying, and more reward would have followed.
Whoever learns from the flight must not confuse the two, or it learns that late states are bad.

Each step is: turn, fly 0.5 m, sense (d_obs, d_goal), judge (is it over?), reward, look. pymunk, a
physics library, moves the drone and measures d_obs. render.py draws what the drone sees. A flight
is a deterministic function of its seed and its actions. Keep those two and you can fly it again,
picture by picture.

Legend
    d_obs     m, from the drone's centre to the nearest bark, at most 20 m, the range of a laser
    d_goal    m, from the drone's centre to the goal
    d_max     m, the forest's length
    psi       rad, the heading
    N         trunks
    L         drones that fly side by side, one in each lane
    F         those of them that are in the air; in `measure`, flights
    A         actions
    W, T, P   in `plan`: ways, steps of a way, points of bark that the laser sees
    [DF]      the Deep Flight paper; "authors' simulator" is the code released with it
    ours      a number that neither gives, chosen by us

Not in this file: rotors, wind, inertia, altitude. `ForestEnv` has the methods of a Gymnasium
environment (the usual interface in this field) and does not need gymnasium.
"""

import errno
import math
import operator
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from typing import Any, TextIO

import numpy as np
import pymunk
from numpy import ndarray

from render import CAMERAS, PIXELS, Scene, camera, raycast

STACK = 4  # pictures in an observation [DF §II-A]
Record = list[tuple[int, str]]  # flights: seed and actions of each, which are all of it
OUTCOMES = ("crash", "goal", "left", "time")  # tested in this order; left: the forest, by an edge


@dataclass(frozen=True)
class World(Scene):
    """The forest, the drone and the rules, in SI units; from `Scene`, what they look like."""

    length: float = 90.0  # m, x of the goal edge; d_max of the reward [DF §II-A]
    width: float = 50.0  # m; this and all down to jitter_y: authors' simulator
    back: float = 2.0  # m, how far the drone may retreat behind the start edge
    rows: int = 15  # trunks along x
    columns: int = 10  # trunks along y
    first_x: float = 7.5  # m, of the grid before jitter
    first_y: float = -22.0  # m
    spacing_x: float = 6.0  # m
    spacing_y: float = 5.0  # m
    jitter_x: float = 1.0  # m, uniform, either way
    jitter_y: float = 2.5  # m
    speed: float = 5.0  # m/s, authors' simulator
    dt: float = 0.1  # s, one control step; the paper is silent: ours
    yaw_rate: float = 0.7  # rad/s, the sharpest turn [DF §II-A]
    actions: int = 9  # yaw rates from -0.7 (right) to +0.7 (left) [DF §II-A]
    beams: int = 360  # of the laser, all around: ours
    laser_range: float = 20.0  # m, authors' simulator
    d_neg: float = 2.0  # m, this and the next four: [DF §II-A]
    d_crash: float = 0.75  # m
    r_safe: float = 0.25
    r_precrash: float = -5.0
    r_crash: float = -10.0
    goal_radius: float = 3.0  # m: ours
    max_steps: int = 1000  # then the flight is truncated, authors' evaluation
    beacon: bool = False  # a pole at the goal makes it visible; off in the paper's world

    def __post_init__(self) -> None:
        check_world(self)


def reward(outcome: str, d_obs: float, d_goal: float, world: World) -> float:
    """The reward of one step, [DF §II-A] line by line.

    outcome: "" while in the air, else one of OUTCOMES. d_obs, d_goal in m.
    The paper prints the inequality of the middle case in reverse. The authors' simulator computes
    r_goal and forgets to add it. We follow the paper's text.

    >>> reward("", 3.0, 45.0, World()), reward("", 0.75, 90.0, World())
    (0.75, -5.0)
    >>> reward("crash", 0.7, 45.0, World())
    -10.0
    """
    return world.r_crash if outcome in ("crash", "left") else float(live(d_obs, d_goal, world))


def live(d_obs: Any, d_goal: Any, world: World) -> Any:
    """The reward of a step that does not end badly; of many steps, if given arrays."""
    r_safe = world.r_safe * (d_obs > world.d_neg)
    too_near = np.maximum(world.d_neg - d_obs, 0) / (world.d_neg - world.d_crash)  # 0 to 1
    return r_safe + world.r_precrash * too_near + (1 - d_goal / world.length)


def plant(seed: int, world: World) -> ndarray:
    """Trunk centres (N, 2) in m: a jittered grid, a function of the seed alone. Raises ValueError
    if the seed is no whole number from 0."""
    rng = np.random.default_rng(whole_number("seed", seed))
    centres = grid(world)  # (N, 2)
    return centres + rng.uniform(-1, 1, centres.shape) * (world.jitter_x, world.jitter_y)


@cache
def grid(world: World) -> ndarray:
    """Trunk centres (N, 2) in m before jitter."""
    x = world.first_x + world.spacing_x * np.arange(world.rows)
    y = world.first_y + world.spacing_y * np.arange(world.columns)
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)  # (N, 2)


class ForestEnv:
    """One drone, one forest, a new one every flight; Gymnasium 1.x signatures.

    Observation: (4, 84, 84) uint8, oldest picture first, the first one repeated at reset. It is a
    copy, so writing into it changes nothing here.
    Action: an int, 0 turns right at 0.7 rad/s, 4 flies straight, 8 turns left.
    `blind=True` leaves the pictures black, for pilots that do not look at them.
    pymunk in short: a space holds shapes, the trunks, and moves bodies, the drone. A kinematic body
    goes where its velocity says, and nothing pushes it.
    """

    def __init__(self, world: World | None = None, *, blind: bool = False) -> None:
        self.world, self.blind = world or World(), blind
        self.goal = pymunk.Vec2d(self.world.length, 0.0)  # m, mid of the far edge
        self.space = pymunk.Space()
        ground, radius = self.space.static_body, self.world.trunk_radius
        self.bark = [pymunk.Circle(ground, radius) for _ in grid(self.world)]
        self.drone = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.space.add(self.drone, *self.bark)
        self.seed, self.actions, self.edge, self.progress, self.total = -1, [], "", 0.0, 0.0
        self.outcome = "not reset"  # any outcome counts as landed

    def reset(self, *, seed: int | None = None, options: object = None) -> tuple[ndarray, dict]:
        """Plant forest number `seed`, or the one after the last, and stand at the start.

        Uses no random generator: the forest is a function of the seed. `options` is unused. Raises
        ValueError unless the seed is a whole number, 0 or more. After that no flight is in the air.
        """
        self.place(self.seed + 1 if seed is None else seed)
        self.observation = np.repeat(look([self]), STACK, 0)  # (4, 84, 84)
        return self.observation.copy(), self.info()

    def step(self, action: int) -> tuple[ndarray, float, bool, bool, dict]:
        """Turn at the action's yaw rate, fly one control step, look.

        Returns observation, reward, terminated, truncated, info. info holds d_obs, d_goal, forward
        (x gained in this step) and progress in m, the pose (x, y, heading), the outcome ("" while
        in the air) and the edge that the drone left by. Raises ValueError if no flight is in the
        air, or if the action is no whole number from 0 to 8, of whatever integer type.
        """
        r = self.advance(action)
        self.observation = np.concatenate([self.observation[1:], look([self])])  # (4, 84, 84)
        return self.observation.copy(), r, self.terminated, self.truncated, self.info()

    def place(self, seed: int) -> None:
        """All of a reset but the looking."""
        self.outcome = "not reset"  # a reset that fails leaves no flight in the air
        self.trunks, self.seed = plant(seed, self.world), int(seed)  # (N, 2)
        for circle, centre in zip(self.bark, self.trunks.tolist(), strict=True):
            circle.unsafe_set_offset(centre)  # moves a trunk: ten times as quick as a new circle
        self.space.reindex_static()  # tells pymunk that they moved
        self.drone.position, self.drone.angle, self.pose = (0.0, 0.0), 0.0, (0.0, 0.0, 0.0)
        self.actions, self.progress, self.total = [], 0.0, 0.0
        self.outcome, self.edge, self.terminated, self.truncated = "", "", False, False
        self._sense()

    def advance(self, action: int) -> float:
        """All of a step but the looking: turn, fly, sense, judge. Returns the reward."""
        if self.outcome:
            raise ValueError(f"step needs a flight in the air, this one is {self.outcome}: reset")
        action = whole_number("action", action, self.world.actions - 1)
        self.actions.append(action)
        yaw_rate = self.world.yaw_rate * (2 * action / (self.world.actions - 1) - 1)  # rad/s
        heading = self.drone.angle + yaw_rate * self.world.dt  # rad: turn first, then fly
        speed = self.world.speed  # m/s
        self.drone.velocity = speed * math.cos(heading), speed * math.sin(heading)
        self.drone.angular_velocity = yaw_rate
        self.space.step(self.world.dt)  # pymunk moves the drone for dt seconds
        self._sense()
        self.outcome = self._judge()
        self.terminated, self.truncated = self.outcome not in ("", "time"), self.outcome == "time"
        r = reward(self.outcome, self.d_obs, self.d_goal, self.world)
        self.total += r
        return r

    def _sense(self) -> None:
        x_before, self.pose = self.pose[0], (*self.drone.position, self.drone.angle)
        x, y, _ = self.pose
        self.forward = x - x_before
        self.progress = max(self.progress, x)
        reach = self.world.laser_range
        bark = self.space.point_query_nearest((x, y), reach, EVERYTHING)  # None: out of reach
        self.d_obs = bark.distance if bark else reach
        self.d_goal = math.dist((x, y), self.goal)

    def _judge(self) -> str:
        if self.d_obs < self.world.d_crash:
            return "crash"
        if self.d_goal < self.world.goal_radius:
            return "goal"
        x, y, _ = self.pose
        far, back, side = x > self.world.length, x < -self.world.back, abs(y) > self.world.width / 2
        self.edge = "far" if far else "back" if back else "side" if side else ""
        late = len(self.actions) >= self.world.max_steps
        return "left" if self.edge else "time" if late else ""

    def info(self) -> dict[str, Any]:
        """Where the drone is, and what has become of it."""
        info = {"d_obs": self.d_obs, "d_goal": self.d_goal, "pose": self.pose}
        info |= {"forward": self.forward, "progress": self.progress}
        return info | {"outcome": self.outcome, "edge": self.edge}

    def flight(self) -> dict[str, Any]:
        """The flight so far: seed and actions, which are all of it, and what came of them."""
        digits = "".join(map(str, self.actions))
        flown = {"seed": self.seed, "actions": digits, "outcome": self.outcome, "edge": self.edge}
        return flown | {"steps": len(digits), "progress": self.progress, "return": self.total}

    def scan(self) -> tuple[ndarray, ndarray]:
        """The laser's beams: bearings from the heading (360,) rad, counter-clockwise from dead
        ahead, and distances (360,) m, 20 where nothing is hit within 20 m."""
        bearings = np.arange(self.world.beams) * (2 * math.pi / self.world.beams)  # (360,)
        offsets = self.trunks - self.pose[:2]  # (N, 2) m
        distance, _ = raycast(offsets, self.world.trunk_radius, bearings + self.pose[2])
        return bearings, np.minimum(distance, self.world.laser_range)


EVERYTHING = pymunk.ShapeFilter()  # a query that leaves nothing out


def look(envs: Sequence[ForestEnv]) -> ndarray:
    """What each of F drones sees, drawn in one call: pictures (F, 84, 84) uint8."""
    world = envs[0].world
    if envs[0].blind:
        return np.zeros((len(envs), PIXELS, PIXELS), np.uint8)
    poses = np.array([env.pose for env in envs])  # (F, 3)
    return camera(poses, [e.trunks for e in envs], world, envs[0].goal if world.beacon else None)


def refly(seed: int, actions: Iterable, world: World, *, blind: bool = False) -> Iterator[tuple]:
    """Fly a recorded flight again: yields what `step` returned, the reset (reward 0) first.

    actions: numbers, or the digits that `ForestEnv.flight` writes.
    """
    env = ForestEnv(world, blind=blind)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for action in actions:
        yield env.step(int(action))


class Fleet:
    """L drones that fly side by side, each through its own forest: a ForestEnv L times, where only
    the drawing is shared. Gymnasium calls such an object a vector environment.

    One camera call draws what all of them see, which is quicker than a call for each. A drone that
    has landed waits, and takes no action, until its lane is reset. Each lane keeps a record of its
    flights, seeds and actions: that is all it takes to fly them again.
    """

    def __init__(self, world: World, lanes: int, *, blind: bool = False) -> None:
        self.world, self.envs = world, [ForestEnv(world, blind=blind) for _ in range(lanes)]
        self.records: list[list[tuple[int, list[int]]]] = [[] for _ in range(lanes)]

    @property
    def flying(self) -> list[ForestEnv]:
        """The F drones that are in the air."""
        return [env for env in self.envs if not env.outcome]

    @property
    def landed(self) -> list[int]:
        """The lanes of the others."""
        return [lane for lane, env in enumerate(self.envs) if env.outcome]

    @property
    def observations(self) -> ndarray:
        """What the drones in the air see: (F, 4, 84, 84) uint8."""
        return np.stack([env.observation for env in self.flying])

    def reset(self, lanes: Sequence[int], seeds: Iterable[int]) -> None:
        """Begin a flight in these lanes, through the forests of these seeds."""
        envs = [self.envs[lane] for lane in lanes]
        for lane, env, seed in zip(lanes, envs, seeds, strict=True):
            env.place(seed)
            self.records[lane].append((env.seed, env.actions))  # the list grows as it flies
        if not envs:
            return
        for env, frame in zip(envs, look(envs), strict=True):
            env.observation = np.repeat(frame[None], STACK, 0)  # (4, 84, 84)

    def step(self, actions: Iterable[int]) -> tuple[ndarray, ndarray, ndarray, ndarray, list[dict]]:
        """One control step of the drones in the air; actions: one for each of them, in order.

        Returns their observations (F, 4, 84, 84), rewards (F,), terminated (F,), truncated (F,) and
        infos, as ForestEnv.step does for one.
        """
        envs = self.flying
        r = np.array([env.advance(a) for env, a in zip(envs, actions, strict=True)])  # (F,)
        s2 = np.empty((len(envs), STACK, PIXELS, PIXELS), np.uint8)  # (F, 4, 84, 84)
        s2[:, -1] = look(envs)
        for env, stack in zip(envs, s2, strict=True):
            stack[:-1] = env.observation[1:]
            env.observation = stack.copy()
        terminated = np.array([env.terminated for env in envs])  # (F,)
        truncated = np.array([env.truncated for env in envs])  # (F,)
        return s2, r, terminated, truncated, [env.info() for env in envs]

    def record(self, steps: int) -> list[Record]:
        """Of each lane, the flights that its last steps belong to, as seeds and actions. The file
        of an unfinished training keeps these."""
        for flights in self.records:
            while sum(len(actions) for _, actions in flights[1:]) >= steps:
                flights.pop(0)
        return [[(seed, "".join(map(str, a))) for seed, a in lane] for lane in self.records]


# -------------------------------------------------- pilots without a network, many flights

Pilot = Callable[[Fleet], Sequence[int]]  # an action for each drone in the air
Flights = list[dict[str, Any]]  # of ForestEnv.flight


def random_pilot(rng: np.random.Generator) -> Pilot:
    """Every action uniform and independent: the paper's bar."""
    return lambda fleet: rng.integers(fleet.world.actions, size=len(fleet.flying))


def straight_pilot(fleet: Fleet) -> Sequence[int]:
    """Dead ahead, whatever comes. Of an even number of yaw rates none is straight: then it takes
    the two in the middle in turn."""
    return [(env.world.actions - 1 + len(env.actions) % 2) // 2 for env in fleet.flying]


def laser_pilot(gamma: float) -> Pilot:
    """A planner, the bar for the camera: it takes the yaw rate that `plan` values most. Arrival is
    worth as much as the most that a step can earn, for ever."""

    def act(fleet: Fleet) -> ndarray:
        goal_value = (fleet.world.r_safe + 1) / (1 - gamma)
        return teach(fleet, gamma, 0.0, goal_value, 0.0).argmax(1)

    return act


def fly(pilot: Pilot, seeds: Sequence[int], world: World, *, blind: bool = False) -> Flights:
    """Fly one forest per seed, a hundred at once; returns the flights in the order of the seeds."""
    flights: Flights = []
    fleet = Fleet(world, min(len(seeds), 100), blind=blind)
    for group in (seeds[i : i + 100] for i in range(0, len(seeds), 100)):
        fleet.reset(range(len(group)), group)
        while flying := fleet.flying:
            show(f"{len(flights) + len(group) - len(flying):,} of {len(seeds):,} flights landed")
            fleet.step(pilot(fleet))
        flights += [env.flight() for env in fleet.envs[: len(group)]]
    show("")
    return flights


def fly_random(seeds: Sequence[int], world: World, rng: np.random.Generator) -> Flights:
    """The bar that others are compared with: 2,000 random flights or more, equally many through
    each forest. The mean of only a hundred could be off by a fifth."""
    repeats = math.ceil(2000 / len(seeds))
    return fly(random_pilot(rng), list(seeds) * repeats, world, blind=True)


def measure(flights: Flights) -> dict[str, ndarray]:
    """One number a flight (F,): steps, progress in m, return, and 0 or 1 for how it ended.

    Crossed means arrived at the goal or left by the far edge.
    """
    table = {key: np.array([f[key] for f in flights]) for key in ("steps", "progress", "return")}
    table["crossed"] = np.array([f["outcome"] == "goal" or f["edge"] == "far" for f in flights])
    return table | {o: np.array([f["outcome"] == o for f in flights]) for o in OUTCOMES}


# -------------------------------------------------- a planner: read it after dqn.py


def teach(fleet: Fleet, gamma: float, *paid: float) -> ndarray:
    """What `plan` says to each of F drones: (F, A)."""
    return np.array([plan(*e.scan(), e.pose, e.world, gamma, *paid) for e in fleet.flying])


def plan(
    bearings: ndarray, distances: ndarray, pose: tuple, world: World,
    gamma: float, forward_reward: float, goal_value: float, far_value: float,
) -> ndarray:  # fmt: skip
    """What each yaw rate is worth (A,) to a drone that has a laser scanner and knows its pose.
    bearings, distances (beams,): the scan. pose: x, y, heading. forward_reward, goal_value,
    far_value: what is paid beside the paper's reward, as `learner_reward` in deepflight.py says.

    It adds up the rewards to come. A way is one of the yaw rates for 0.6 s, then one for 1.6 s: W =
    A * A ways of T steps. It ends early where it crashes, leaves or arrives. The reward of step k
    counts gamma^k times. Where a way does not end early, more is to come. So we add goal_value
    times gamma^n, as if the drone turned to the goal and flew straight to it in n steps, through
    all trunks and without reward. Or far_value, in the same manner, if that is more. A yaw rate is
    worth what the best way is worth that begins with it. In numbers, where arrival is worth 125 and
    nothing else is paid: straight on from the start, far from trunks. 22 steps earn 6.2. The goal
    is then 79 m or 158 steps away, so 0.99^(22 + 158) * 125 = 20.5 more: 26.7.
    """
    # A place is the complex number x + iy, in m. A product with exp(i psi) turns it left by psi.
    (ahead, turned), here, heading = ways(world), complex(*pose[:2]), pose[2]
    at, headings = here + ahead * np.exp(1j * heading), heading + turned  # (W, T), (W, T) rad
    beams = here + distances * np.exp(1j * (heading + bearings))  # (beams,) where they end
    bark = beams[distances < world.laser_range][:, None, None]  # (P, 1, 1)
    d_obs = np.abs(at - bark).min(0, initial=np.inf)  # (W, T) m
    d_goal, x, y = np.abs(world.length - at), at.real, np.abs(at.imag)  # (W, T) m each
    # 0.1 m to spare: the scan shows single points of the bark, on the near side only.
    crash, arrived = d_obs < world.d_crash + 0.1, d_goal < world.goal_radius  # (W, T), (W, T)
    far, side = x > world.length, (x < -world.back) | (y > world.width / 2)  # (W, T), (W, T)
    over, k = crash | arrived | far | side, np.arange(at.shape[1])  # (W, T), (T,)
    over[:, -1] = True
    last = over.argmax(1)[:, None]  # (W, 1) the first step that is over
    lost = crash | ((far | side) & ~arrived)  # (W, T)
    r = np.where(lost, world.r_crash, live(d_obs, d_goal, world))  # (W, T)
    r = r + forward_reward * world.speed * world.dt * np.cos(headings)  # (W, T)
    # What comes after the last step: if it is over its prize, else the way to one.
    rest = prize_ahead(at, headings, world, gamma, goal_value, far_value)  # (W, T)
    prize = np.select([crash, arrived, far, side], [0, goal_value, far_value, 0], rest)  # (W, T)
    r = r + np.where(k == last, gamma * prize, 0)  # (W, T)
    worth = (gamma**k * r * (k <= last)).sum(1)  # (W,)
    return worth.reshape(world.actions, -1).max(1)


def prize_ahead(
    at: ndarray, headings: ndarray, world: World, gamma: float, goal_value: float, far_value: float
) -> ndarray:
    """What the better prize is worth to drones at these places, x + iy in m, with these headings,
    if they turn to it and fly straight there: all (W, T)."""
    worths = []
    for way, value in ((world.length - at, goal_value), (world.length - at.real, far_value)):
        turn = np.abs(np.angle(way * np.exp(-1j * headings)))  # (W, T) rad
        steps = (turn / world.yaw_rate + np.abs(way) / world.speed) / world.dt  # (W, T)
        worths.append(value * gamma**steps)  # (W, T)
    return np.maximum(*worths)


@cache
def ways(world: World) -> tuple[ndarray, ndarray]:
    """The ways of `plan` for a drone at 0 that faces along x: places (W, T) m, and headings (W, T)
    rad. Way a * A + b begins with yaw rate a and goes on with b."""
    rates = world.yaw_rate * np.linspace(-1, 1, world.actions)  # (A,) rad/s
    steps = [max(round(seconds / world.dt), 1) for seconds in (0.6, 1.6)]
    pairs = np.stack(np.meshgrid(rates, rates, indexing="ij"), -1).reshape(-1, 2)  # (W, 2)
    headings = np.cumsum(np.repeat(pairs, steps, 1), 1) * world.dt  # (W, T) rad
    return np.cumsum(world.speed * world.dt * np.exp(1j * headings), 1), headings


# -------------------------------------------------- printing, legal worlds: skip on a first reading


def say(text: str, end: str = "\n", file: TextIO | None = None) -> None:
    """Print, and work on if nobody reads: what goes to a closed pipe or terminal is lost."""
    file = file or sys.stdout
    try:
        print(text, end=end, file=file, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
        if file is not sys.stderr and error.errno not in (errno.EPIPE, errno.EIO):
            error.filename = file.name
            raise


def show(text: str) -> None:
    """Show a passing status on a terminal, over the last one; nothing when piped."""
    if getattr(sys.stdout, "isatty", bool)() and os.environ.get("TERM") != "dumb":
        room = min(shutil.get_terminal_size().columns, 999) - 1
        say(f"{text[:room]:{room}}", "\r")


# A world's numbers may go from 0.001 to 10,000; these have other limits. There are at most ten
# actions, because a flight's record has one digit per action.
LIMITS = dict.fromkeys(("first_x", "first_y", "r_safe", "r_precrash", "r_crash"), (-1e4, 1e4))
LIMITS |= dict.fromkeys(("back", "jitter_x", "jitter_y", "beacon_pixels"), (0, 1e4))
LIMITS |= dict.fromkeys(("sky", "ground", "trunk_facing", "trunk_grazing", "beacon_grey"), (0, 255))
LIMITS |= {"rows": (0, 1e4), "columns": (0, 1e4), "beacon": (0, 1), "actions": (2, 10)}
LIMITS |= {"camera": CAMERAS}


def whole_number(name: str, value: Any, high: float = math.inf) -> int:
    """The value as an int, whatever its integer type; ValueError unless it is from 0 to high."""
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number <= high:
        end = f" to {high}" if high < math.inf else ""
        raise ValueError(f"{name} is {value!r}, allowed are whole numbers from 0{end}")
    return number


# type -> what passes for it, in Python and in words
KINDS = {bool: (bool, "true or false"), int: (Integral, "whole numbers"), float: (Real, "numbers")}


def check_numbers(settings: Any, limits: dict[str, tuple[float, float]]) -> None:
    """Raise ValueError if a field of a dataclass is of another type or outside its limits."""
    for f in fields(settings):
        value, (low, high) = getattr(settings, f.name), limits.get(f.name, (1e-3, 1e4))
        if f.type is str:
            if value not in (low, high):
                raise ValueError(f"{f.name} is {value!r}, allowed are {low} and {high}")
            continue
        kind, words = KINDS[f.type]
        if (isinstance(value, bool) and kind is not bool) or not isinstance(value, kind):
            raise ValueError(f"{f.name} is {value!r}, allowed are {words}")
        if not low <= value <= high:
            raise ValueError(f"{f.name} is {value}, allowed are {words} from {low:,g} to {high:,g}")


def check_world(world: World) -> None:
    """Raise ValueError if no drone could fly in this world by its own rules."""
    check_numbers(world, LIMITS)
    # A stride is below reach, or the drone could step over a trunk's middle.
    reach, spread = world.trunk_radius + world.d_crash, (world.jitter_x, world.jitter_y)  # m
    nearest = np.hypot(*np.maximum(np.abs(grid(world)) - spread, 0).T).min(initial=math.inf)
    for small, big, rule in (
        (world.speed * world.dt, reach, "speed * dt < trunk_radius + d_crash"),
        (reach, nearest, "trunk_radius + d_crash < the way from the start to any trunk"),
        (2 * world.d_crash, world.width, "2 * d_crash < width"),
        (world.d_crash, world.d_neg, "d_crash < d_neg"),
        (world.d_neg, world.laser_range, "d_neg < laser_range"),
    ):
        if not small < big:
            raise ValueError(f"a legal world has {rule}; here they are {small:g} and {big:g}")
