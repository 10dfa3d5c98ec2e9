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

    | every step                      | reward                                     | d_obs        |
    |---------------------------------|--------------------------------------------|--------------|
    | safe                            | r_safe = +0.25                             | > 2.0 m      |
    | too close                       | r_neg = 0 falling to r_precrash = -5       | 2.0 - 0.75 m |
    | and in both, the way to go      | r_goal = 1 - d_goal / d_max                |              |
    | crash, or out at any d_obs      | r_crash = -10 and nothing else; the end    | < 0.75 m     |
    | arrival, or out of time         | as on every live step; the end             | >= 0.75 m    |

pymunk moves the drone and measures d_obs; render.py looks. [DF] is the Deep Flight paper.
Legend: d_obs is the distance from the drone's centre to the nearest bark, at most the laser's 20 m,
d_goal that to the goal; SI units. A flight is a deterministic function of its seed and its actions:
keep those two and you can fly it again, frame by frame (`refly`).

Not in this file: rotors, wind, inertia, altitude. `ForestEnv` has Gymnasium's signatures
without needing gymnasium.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

import numpy as np
import pymunk

from render import PIXELS, Scene, camera, raycast

STACK = 4  # frames in an observation [DF §II-A]
OUTCOMES = ("crash", "goal", "left", "time")  # tested in this order


# Least and most of a world's numbers that may be other than 0.001 to 10,000. An action is a digit.
LIMITS = dict.fromkeys(("first_x", "first_y", "r_safe", "r_precrash", "r_crash"), (-1e4, 1e4))
LIMITS |= dict.fromkeys(("back", "jitter_x", "jitter_y", "beacon_pixels", "yaw_rate"), (0, 1e4))
LIMITS |= dict.fromkeys(("sky", "ground", "trunk_facing", "trunk_grazing", "beacon_grey"), (0, 255))
LIMITS |= {"rows": (0, 1e4), "columns": (0, 1e4), "beacon": (0, 1), "actions": (2, 10)}


@dataclass(frozen=True)
class World(Scene):
    """The forest, the drone and the rules, in SI units. `Scene` adds what they look like."""

    length: float = 90.0  # m, x of the goal edge; d_max of the reward [DF §II-A]
    width: float = 50.0  # m, authors' simulator, as all of the next nine
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
        for f in fields(self):
            value, (low, high) = getattr(self, f.name), LIMITS.get(f.name, (1e-3, 1e4))
            if not (isinstance(value, f.type | int) and low <= value <= high):
                legal = f"{f.type.__name__} from {low:g} to {high:g}"
                raise ValueError(f"{f.name} is {value}, allowed: {legal}")
        # A stride is below reach, or the drone could step over a trunk's middle.
        reach, spread = self.trunk_radius + self.d_crash, (self.jitter_x, self.jitter_y)  # m
        nearest = np.hypot(*np.maximum(np.abs(grid(self)) - spread, 0).T).min(initial=math.inf)
        for small, big, rule in (
            (self.speed * self.dt, reach, "speed * dt < trunk_radius + d_crash"),
            (reach, nearest, "trunk_radius + d_crash < the way from the start to any trunk"),
            (2 * self.d_crash, self.width, "2 * d_crash < width"),
            (self.d_crash, self.d_neg, "d_crash < d_neg"),
            (self.d_neg, self.laser_range, "d_neg < laser_range"),
        ):
            if not small < big:
                raise ValueError(f"a legal world has {rule}; here they are {small:g} and {big:g}")


def grid(world: World) -> np.ndarray:
    """Trunk centres (N, 2) in m before jitter."""
    x = world.first_x + world.spacing_x * np.arange(world.rows)
    y = world.first_y + world.spacing_y * np.arange(world.columns)
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)  # (N, 2)


def plant(seed: int, world: World) -> np.ndarray:
    """Trunk centres (N, 2) in m: a jittered grid, a function of the seed alone."""
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"seed is {seed!r}, allowed are integers from 0")
    centres = grid(world)  # (N, 2)
    jitter = (world.jitter_x, world.jitter_y)
    return centres + np.random.default_rng(seed).uniform(-1, 1, centres.shape) * jitter


def reward(outcome: str, d_obs: float, d_goal: float, world: World) -> float:
    """The reward of one step, [DF §II-A] line by line.

    outcome: "" while in the air, else one of OUTCOMES. d_obs, d_goal in m.
    The paper prints the middle case's inequality reversed; the authors' simulator computes r_goal
    and forgets to add it. We follow the paper's text.

    >>> reward("", 3.0, 45.0, World()), reward("", 0.75, 90.0, World())
    (0.75, -5.0)
    >>> reward("crash", 0.7, 45.0, World())
    -10.0
    """
    if outcome in ("crash", "left"):
        return world.r_crash
    r_goal = 1 - d_goal / world.length
    if d_obs > world.d_neg:
        return world.r_safe + r_goal
    return world.r_precrash * (world.d_neg - d_obs) / (world.d_neg - world.d_crash) + r_goal


class ForestEnv:
    """One drone, one forest, a new one every episode; Gymnasium 1.x signatures.

    Observation: (4, 84, 84) uint8, oldest frame first, the first frame repeated at reset.
    Action: an int, 0 turns right at 0.7 rad/s, 4 flies straight, 8 turns left.
    `camera=False` leaves the frames black, for pilots that look at nothing or at the laser.
    """

    def __init__(self, world: World | None = None, *, camera: bool = True) -> None:
        self.world, self.has_camera = world or World(), camera
        self.goal = pymunk.Vec2d(self.world.length, 0.0)  # m, mid of the far edge
        self.space = pymunk.Space()
        ground, radius = self.space.static_body, self.world.trunk_radius
        self.bark = [pymunk.Circle(ground, radius) for _ in plant(0, self.world)]
        self.drone = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.space.add(self.drone, *self.bark)
        self.seed, self.outcome = -1, "not reset"

    def reset(self, *, seed: int | None = None, options: object = None) -> tuple[np.ndarray, dict]:
        """Plant forest number `seed`, or the one after the last, and stand at the start.

        Draws nothing from anywhere: the forest is a function of the seed. `options` is unused.
        """
        self.seed = self.seed + 1 if seed is None else seed
        self.trunks = plant(self.seed, self.world)  # (N, 2)
        for circle, centre in zip(self.bark, self.trunks.tolist(), strict=True):
            circle.unsafe_set_offset(centre)  # a tenth of the time of new circles
        self.space.reindex_static()
        self.drone.position, self.drone.angle, self.centre = (0.0, 0.0), 0.0, (math.inf, 0.0)
        self.actions: list[int] = []
        self.progress, self.total, self.outcome, self.edge = 0.0, 0.0, "", ""
        self._measure()
        self.observation = np.repeat(self._look()[None], STACK, 0)  # (4, 84, 84)
        return self.observation, self._info()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Turn at the action's yaw rate, fly one control step, look.

        Returns observation, reward, terminated, truncated, info. info holds d_obs and d_goal in m,
        pose (x, y, heading), and at the end the outcome, the edge it left by, and the progress.
        """
        if self.outcome:
            raise ValueError(f"step needs a flight in the air, this one is {self.outcome}: reset")
        if not isinstance(action, int | np.integer) or not 0 <= action < self.world.actions:
            raise ValueError(f"action is {action!r}, allowed are 0 to {self.world.actions - 1}")
        self.actions.append(int(action))
        self._move(self.world.yaw_rate * (2 * int(action) / (self.world.actions - 1) - 1))
        self._measure()
        self.outcome = self._judge()
        r = reward(self.outcome, self.d_obs, self.d_goal, self.world)
        self.total += r
        s2 = self.observation = np.concatenate([self.observation[1:], self._look()[None]])
        return s2, r, self.outcome not in ("", "time"), self.outcome == "time", self._info()

    def scan(self) -> tuple[np.ndarray, np.ndarray]:
        """The laser's beams: bearings from the heading (360,) rad, counter-clockwise from dead
        ahead, and distances (360,) m, 20 where nothing is hit."""
        bearings = np.arange(self.world.beams) * (2 * math.pi / self.world.beams)  # (360,)
        offsets = self._around() - self.drone.position  # (K, 2)
        distance, _ = raycast(offsets, self.world.trunk_radius, bearings + self.drone.angle)
        return bearings, np.minimum(distance, self.world.laser_range)

    def goal_bearing(self) -> float:
        """Angle from the heading to the goal, rad in [-pi, pi], positive to the left."""
        return math.remainder((self.goal - self.drone.position).angle - self.drone.angle, math.tau)

    def flight(self) -> dict:
        """The flight so far: seed and actions, which are all of it, and what came of them."""
        digits = "".join(map(str, self.actions))
        flown = {"seed": self.seed, "actions": digits, "outcome": self.outcome, "edge": self.edge}
        return flown | {"steps": len(digits), "progress": self.progress, "return": self.total}

    def _move(self, yaw_rate: float) -> None:
        heading = self.drone.angle + yaw_rate * self.world.dt  # turn first, then fly
        self.drone.velocity = pymunk.Vec2d.from_polar(self.world.speed, heading)
        self.drone.angular_velocity = yaw_rate
        self.space.step(self.world.dt)
        self.progress = max(self.progress, self.drone.position.x)

    def _measure(self) -> None:
        reach = self.world.laser_range
        bark = self.space.point_query_nearest(self.drone.position, reach, pymunk.ShapeFilter())
        self.d_obs = bark.distance if bark else reach
        self.d_goal = math.dist(self.drone.position, self.goal)

    def _judge(self) -> str:
        if self.d_obs < self.world.d_crash:
            return "crash"
        if self.d_goal < self.world.goal_radius:
            return "goal"
        x, y = self.drone.position
        far, back, side = x > self.world.length, x < -self.world.back, abs(y) > self.world.width / 2
        self.edge = "far" if far else "back" if back else "side" if side else ""
        late = len(self.actions) >= self.world.max_steps
        return "left" if self.edge else "time" if late else ""

    def _look(self) -> np.ndarray:
        if not self.has_camera:
            return np.zeros((PIXELS, PIXELS), np.uint8)
        beacon = self.goal if self.world.beacon else None
        return camera(self.drone.position, self.drone.angle, self._around(), self.world, beacon)

    def _around(self) -> np.ndarray:
        """Trunks (K, 2) that eye or laser may reach before the next look-up, 5 m from the last: so
        a step need not look through the whole forest."""
        if math.dist(self.drone.position, self.centre) > 5:
            w, self.centre = self.world, self.drone.position
            view = math.hypot(w.view, w.view + 2 * w.trunk_radius)  # m, to the picture's corner
            near = 5 + max(view, w.laser_range + w.trunk_radius)  # m
            self.around = self.trunks[np.hypot(*(self.trunks - self.centre).T) < near]  # (K, 2)
        return self.around

    def _info(self) -> dict:
        pose = (*self.drone.position, self.drone.angle)
        info = {"d_obs": self.d_obs, "d_goal": self.d_goal, "pose": pose}
        if self.outcome:
            info |= {"outcome": self.outcome, "edge": self.edge, "progress": self.progress}
        return info


def refly(seed: int, actions: Iterable, world: World, *, camera: bool = True) -> Iterator[tuple]:
    """Fly a recorded flight again: yields what `step` returned, the reset (reward 0) first.

    actions: numbers, or the digits that `ForestEnv.flight` writes.
    """
    env = ForestEnv(world, camera=camera)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, False, False, info
    for action in actions:
        yield env.step(int(action))
