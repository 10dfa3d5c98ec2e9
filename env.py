"""env.py: the world. A quadrotor at constant speed and altitude in a random forest [DF §II-A].

        y = +25  +-----------------------------------------------+
                 | o    o   o     o   o    o   o    o     o    o |o
     left edge   |    o   o    o    o    o    o   o   o    o     |   o  trunks of the last row
                 |  o    o  o     o    o   o     o   o    o  o   |       stand beyond the far edge
    start (0, 0) *~~~~.  o    o    o  o    o   o    o   o    o   G goal (90, 0)
                 | o   `~~~~~~> o    o   o    o   o    o    o    |
    right edge   |   o    o        o    o   o    o   o   o     o | o
        y = -25  +-----------------------------------------------+
               x = 0                                           x = 90

The drone never slows down. Ten times a second it picks one of nine yaw rates, flies 0.5 m, and gets
a new frame from its camera. Each step earns a reward, which says how good the step was:

    | the step ends                        | the reward is                                       |
    |--------------------------------------|-----------------------------------------------------|
    | in the air, d_obs > 2.0 m            | r_safe + r_goal                                     |
    | in the air, d_obs from 2.0 to 0.75 m | r_near + r_goal                                     |
    | in a crash, d_obs < 0.75 m           | r_crash                                             |
    | outside: x < -2, x > 90, abs(y) > 25 | r_crash                                             |
    | within 3 m of goal, or out of time   | as in the air                                       |

    r_safe = 0.25    r_crash = -10    r_goal = 1 - d_goal / d_max, 0 at the start and 1 at the goal
    r_near = -5 * (2.0 - d_obs) / (2.0 - 0.75), 0 at d_neg = 2.0 m and -5 at d_crash = 0.75 m

One step in numbers: the drone is at x = 30 on the middle line, so d_goal = 60, and the nearest
trunk is 1.5 m away: r_near = -5 * 0.5 / 1.25 = -2. A third of the way is made: r_goal = 1 - 60 / 90
= 0.33. The reward of the step is -1.67.

One flight from the start to its end is an **episode**. It is **terminated** when the world ends it:
by a crash, at the goal, or outside the forest. No more reward can follow. It is **truncated** when
only the clock ends it, after 1,000 steps: the drone was still flying, and more reward would have
followed. A learner must keep the two apart, or it takes the clock for a crash.

The drone sees its last four frames, an **observation**. That is less than the whole state of the
world: the frames hardly show which edge of the forest is the far one, and never what stands behind
a trunk. The world is partially observed.

pymunk, a physics library, moves the drone and measures d_obs. An episode is a deterministic
function of its seed and its actions, so these two are all it takes to fly it again.

Legend
    d_obs     m, from the drone's centre to the nearest trunk's surface, at most 20
    d_goal    m, from the drone's centre to the goal
    d_max     m, the forest's length
    heading   rad, counter-clockwise from x; y points to the left
    N, E      trunks; active drones: those in the midst of an episode
    [DF]      the Deep Flight paper; "authors' simulator": its code; "ours": from neither

Not in this file: rotors, wind, inertia, a change of altitude.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pymunk
from numpy import ndarray

from render import Scene, draw_frame

STACK = 4  # frames in an observation [DF §II-A]; dqn.py takes 4 for granted
OUTCOMES = ("crash", "goal", "far", "back", "side", "time")  # how an episode may end


@dataclass(frozen=True)
class World(Scene):
    """Forest, drone and rules, in SI units; the length and all looks are inherited from Scene."""

    width: float = 50.0  # m; this and all down to jitter: authors' simulator
    back: float = 2.0  # m, how far the drone may retreat behind the start
    grid: tuple[int, int] = (15, 10)  # trunks along x and along y
    first: tuple[float, float] = (7.5, -22.0)  # m, x and y of the first trunk, before jitter
    spacing: tuple[float, float] = (6.0, 5.0)  # m
    jitter: tuple[float, float] = (1.0, 2.5)  # m, uniform, either way
    speed: float = 5.0  # m/s, authors' simulator
    dt: float = 0.1  # s, one control step: ours
    yaw_rate: float = 0.7  # rad/s, the sharpest turn [DF §II-A]
    num_actions: int = 9  # yaw rates from -0.7 (right) to +0.7 (left) [DF §II-A]
    laser_range: float = 20.0  # m, authors' simulator
    d_neg: float = 2.0  # m, this and the next four: [DF §II-A]
    d_crash: float = 0.75  # m
    r_safe: float = 0.25
    r_precrash: float = -5.0  # r_near at d_crash
    r_crash: float = -10.0
    goal_radius: float = 3.0  # m: ours
    max_steps: int = 1000  # then the episode is truncated, authors' evaluation


def reward(outcome: str, d_obs: float, d_goal: float, world: World) -> float:
    """The reward of one step [DF §II-A].

    outcome: "" in the air, else one of OUTCOMES. d_obs, d_goal: m. We correct two slips: the paper
    has r_near's inequality reversed, and the authors' simulator forgets to add r_goal.

    >>> reward("", 3.0, 45.0, World()), reward("", 0.75, 90.0, World())
    (0.75, -5.0)
    >>> reward("crash", 0.7, 45.0, World())
    -10.0
    """
    if outcome in ("crash", "far", "back", "side"):
        return world.r_crash
    r_near = world.r_precrash * (max(world.d_neg - d_obs, 0) / (world.d_neg - world.d_crash))
    return world.r_safe * (d_obs > world.d_neg) + r_near + (1 - d_goal / world.length)


def plant(seed: int, world: World) -> ndarray:
    """Trunk centres (N, 2) in m: a jittered grid; the same seed makes the same forest."""
    cells = np.indices(world.grid).reshape(2, -1).T  # (N, 2): 0 0, 0 1, ... 14 9
    jitter = np.random.default_rng(seed).uniform(-1, 1, cells.shape)  # (N, 2)
    return world.first + cells * world.spacing + jitter * world.jitter


class Drone:
    """A drone, and a new forest for it every episode.

    An action is a whole number: 0 turns right at 0.7 rad/s, 4 flies straight, 8 turns left. An
    observation is (4, 84, 84) uint8, oldest frame first; at the start of an episode its first frame
    is repeated four times. While an episode is active its outcome is "".

    A pymunk space holds shapes, here the trunks, and moves bodies, here the drone. A kinematic body
    goes where its velocity says, and nothing pushes it.
    """

    def __init__(self, world: World) -> None:
        self.world, self.outcome = world, "not reset"  # counts as ended

    def reset(self, seed: int) -> None:
        """Plant forest number `seed`, and stand at the start. ValueError if it is negative."""
        self.seed, self.trunks = seed, plant(seed, self.world)  # (N, 2)
        self.space, self.body = pymunk.Space(), pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        fixed, radius = self.space.static_body, self.world.trunk_radius
        self.space.add(self.body, *(pymunk.Circle(fixed, radius, c) for c in self.trunks.tolist()))
        self.pose, self.actions, self.outcome = (0.0, 0.0, 0.0), [], ""
        self.progress = self.episode_return = 0.0
        self.sense()

    def step(self, action: int) -> float:
        """Turn at the action's yaw rate, fly for one control step; returns the reward.

        ValueError if the episode has ended, or if there is no such action.
        """
        world = self.world
        if self.outcome or not 0 <= action < world.num_actions:
            raise ValueError(f"no action {action}, or the episode is over: {self.outcome!r}")
        self.actions.append(int(action))
        yaw_rate = world.yaw_rate * (2 * action / (world.num_actions - 1) - 1)  # rad/s
        heading = self.body.angle + yaw_rate * world.dt  # rad, after this step's turn
        self.body.velocity = world.speed * math.cos(heading), world.speed * math.sin(heading)
        self.body.angular_velocity = yaw_rate
        self.space.step(world.dt)  # pymunk moves the drone for dt seconds
        self.sense()
        x, y, _ = self.pose
        ended = {"crash": self.d_obs < world.d_crash, "goal": self.d_goal < world.goal_radius,
                 "far": x > world.length, "back": x < -world.back, "side": abs(y) > world.width / 2,
                 "time": len(self.actions) >= world.max_steps}  # fmt: skip
        # The first of these that holds, or "" in the air.
        self.outcome = next((name for name, holds in ended.items() if holds), "")
        r = reward(self.outcome, self.d_obs, self.d_goal, world)
        self.episode_return += r
        return r

    def sense(self) -> None:
        """Measure pose (x, y in m, heading in rad), forward (m of x in this step), progress (m, the
        largest x so far), d_obs and d_goal; then look."""
        (x, y), x_before = self.body.position, self.pose[0]
        self.pose = (x, y, self.body.angle)
        self.forward, self.progress = x - x_before, max(self.progress, x)
        trunk = self.space.point_query_nearest((x, y), self.world.laser_range, pymunk.ShapeFilter())
        self.d_obs = trunk.distance if trunk else self.world.laser_range  # None: out of reach
        self.d_goal = math.dist((x, y), (self.world.length, 0))
        frame = draw_frame(self.pose, self.trunks, self.world)  # (84, 84)
        older = self.observation[1:] if self.actions else [frame] * (STACK - 1)
        self.observation = np.stack([*older, frame])  # (4, 84, 84)

    def episode(self) -> dict:
        """The episode so far: seed, actions as one digit each, and what came of them."""
        return {"seed": self.seed, "actions": "".join(map(str, self.actions)),
                "outcome": self.outcome, "steps": len(self.actions), "progress": self.progress,
                "return": self.episode_return}  # fmt: skip


class VecForest:
    """A vector environment: drones side by side, each in a forest of its own.

    One pass through a network can pick the actions of all. seeds: one for each forest to fly.
    When they run out, a drone stays inactive after its last episode.
    """

    def __init__(self, world: World, num_envs: int, seeds: Iterable) -> None:
        self.world, self.num_actions = world, world.num_actions
        self.drones, self.seeds = [Drone(world) for _ in range(num_envs)], iter(seeds)
        self.episodes: list[dict] = []  # all that have ended
        self.history: list[bytes] = []  # all actions; deepflight.Run resumes by flying them
        self.steps = 0  # control steps of all drones together

    @property
    def active(self) -> list[Drone]:
        """The E drones whose episodes have not ended."""
        return [drone for drone in self.drones if not drone.outcome]

    def reset_done(self) -> ndarray:
        """Reset the drones whose episodes have ended; returns all observations (E, 4, 84, 84)."""
        for drone in self.drones:
            if drone.outcome and (seed := next(self.seeds, None)) is not None:
                drone.reset(seed)
        return np.array([drone.observation for drone in self.active])  # (E, 4, 84, 84)

    def step(self, actions: Iterable[int]) -> tuple[ndarray, ndarray, ndarray, ndarray, list]:
        """One control step of the active drones; actions: one for each, in order.

        Returns the new observations (E, 4, 84, 84), rewards (E,), terminated (E,), truncated (E,),
        and the drones that flew, also those that just ended.
        """
        drones = self.active
        r = np.array([drone.step(a) for drone, a in zip(drones, actions, strict=True)])  # (E,)
        s2 = np.array([drone.observation for drone in drones])  # (E, 4, 84, 84)
        self.history.append(bytes(drone.actions[-1] for drone in drones))
        self.steps += len(drones)
        self.episodes += [drone.episode() for drone in drones if drone.outcome]
        outcomes = np.array([drone.outcome for drone in drones])  # (E,)
        terminated = ~np.isin(outcomes, ("", "time"))  # (E,)
        return s2, r, terminated, outcomes == "time", drones


Pilot = Callable[[ndarray, VecForest], Sequence[int]]  # a policy: (E, 4, 84, 84) -> actions (E,)


def random_pilot(rng: np.random.Generator) -> Pilot:
    """Every action uniform and independent: the paper's baseline."""
    return lambda s, envs: rng.integers(envs.num_actions, size=len(s))


def straight_pilot(s: ndarray, envs: VecForest) -> list[int]:
    """Always straight ahead."""
    return [envs.num_actions // 2] * len(s)


def fly(pilot: Pilot, seeds: Sequence[int], world: World) -> list[dict]:
    """Fly one episode per seed, up to 100 side by side; returns them sorted by seed, so that
    pilots can be compared forest by forest."""
    envs = VecForest(world, min(len(seeds), 100), seeds)
    while len(s := envs.reset_done()):  # (E, 4, 84, 84)
        envs.step(pilot(s, envs))
    return sorted(envs.episodes, key=lambda episode: episode["seed"])


def refly(episode: dict, world: World) -> Iterator[Drone]:
    """Fly an episode again: yields the drone at the start and after each step."""
    drone = Drone(world)
    drone.reset(episode["seed"])
    yield drone
    for action in episode["actions"]:
        drone.step(int(action))
        yield drone
