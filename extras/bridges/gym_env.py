"""The forest for Gymnasium: `DeepFlight/Forest-v0`. The paper's authors released one for Gym.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.gym_env     # films a flight to runs/gym/

    import gymnasium, extras.bridges.gym_env                     # from the root of the repository
    env = gymnasium.make("DeepFlight/Forest-v0", render_mode="rgb_array", beacon=True)
    observation, info = env.reset(seed=3_000_000_000)
    envs = gymnasium.make_vec("DeepFlight/Forest-v0", num_envs=8)    # a Fleet: one camera call

Observation: Box(0, 255, (4, 84, 84), uint8), oldest frame first. Action: Discrete(9), 0 turns
right, 8 left. Every field of env.World is a keyword argument. The world itself truncates after
`max_steps`, and Gymnasium's time limit is 1,000 steps as well: for longer flights give
`gymnasium.make` both `max_steps=2000` and `max_episode_steps=2000`.

A seed is a forest. `reset(seed=k)` plants forest k, the same that `deepflight.py eval` flies as k.
A reset without a seed draws one below 10^9, the range of training, from the environment's own
generator. `info["forest"]` says which: keep it and the actions, and you can fly the flight again.

With `forests="test"` every forest comes from [10^9, 2 * 10^9). A reset without a seed draws one
there, and `reset(seed=k)` plants forest 10^9 + k % 10^9. So a test shares no forest with a training
whose seeds are below 10^9, even if both get the same seeds, as from Stable-Baselines3:

    EvalCallback(Monitor(gymnasium.make("DeepFlight/Forest-v0", forests="test")))

`make_vec` gives eight drones side by side. `reset(seed=k)` plants forests k, k + 1, and so on. The
step after a flight's end begins the next flight in that lane, ignores its action, and pays 0.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy import ndarray
from PIL import Image

from deepflight import EVAL_FIRST, TEST_FIRST, TRAIN_END
from env import STACK, Fleet, ForestEnv, World, whole_number
from render import PIXELS, draw_map, draw_ways

ID = "DeepFlight/Forest-v0"
RENDER: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}
LIMIT = World.max_steps  # control steps, of gymnasium.make's own time limit
RANGES = {"training": range(TRAIN_END), "test": range(TEST_FIRST, EVAL_FIRST)}  # of forests
AnyEnv = gymnasium.Env | VectorEnv
Path = list[tuple[float, float]]  # m, from the start to where the drone is


def dress(env: AnyEnv, render_mode: str | None, forests: str, world: World) -> None:
    """Give an environment its metadata, its range of forests and the spaces of one drone."""
    if render_mode not in (None, *RENDER["render_modes"]):
        raise ValueError(f"render_mode is {render_mode!r}, allowed: None, 'rgb_array'")
    if forests not in tuple(RANGES):
        raise ValueError(f"forests is {forests!r}, allowed: 'training', 'test'")
    env.render_mode, env.forests = render_mode, forests
    env.metadata = env.metadata | {"render_fps": max(1, round(1 / world.dt))}
    env.observation_space = Box(0, 255, (STACK, PIXELS, PIXELS), np.uint8)
    env.action_space = Discrete(world.actions)


def choose(env: AnyEnv, seed: int | None) -> int:
    """The number of the next forest: what the seed says, or drawn from the range if it is None."""
    numbers = RANGES[env.forests]
    if seed is None:
        return int(env.np_random.integers(numbers.start, numbers.stop))
    return seed if env.forests == "training" else numbers[seed % len(numbers)]


def picture(flyer: ForestEnv, path: Path) -> ndarray:
    """What the drone sees beside the map with its way: (232, 624, 3) uint8 by default."""
    chart = draw_map(flyer.trunks, (flyer.world.length, flyer.world.width))
    chart = draw_ways(chart, [(np.array(path), flyer.edge or flyer.outcome, "")]).reduce(2)
    frame = Image.fromarray(flyer.observation[-1]).convert("RGB")
    seen = frame.resize((chart.height, chart.height), Image.Resampling.NEAREST)
    return np.hstack([seen, chart])


class Forest(gymnasium.Env):
    """A ForestEnv in Gymnasium's clothes.

    render_mode: None or "rgb_array". forests: "training" or "test", the range of its forests. The
    rest are fields of env.World. Raises ValueError for any other value, and for a world that
    env.World refuses.
    """

    metadata: ClassVar[dict[str, Any]] = RENDER

    def __init__(
        self, render_mode: str | None = None, *, forests: str = "training", **world: Any
    ) -> None:
        self.flyer, self.path = ForestEnv(World(**world)), []
        dress(self, render_mode, forests, self.flyer.world)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant the forest of this seed, or one drawn from `np_random`; `options` is unused.

        Returns the observation (4, 84, 84) uint8 and the info of ForestEnv, with the forest's
        number. The head of this file says which forest a seed plants. Raises ValueError if the seed
        is no whole number from 0. Then no flight is in the air.
        """
        if not self.flyer.outcome and len(self.flyer.actions) == LIMIT:
            gymnasium.logger.warn(f"a flight was cut at step {LIMIT}: give max_episode_steps too")
        self.path = []  # a reset that fails leaves no flight in the air
        seed = seed if seed is None else whole_number("seed", seed)
        super().reset(seed=seed)
        observation, info = self.flyer.reset(seed=choose(self, seed))
        self.path = [info["pose"][:2]]
        return observation, info | {"forest": self.flyer.seed}

    def step(self, action: int) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """One control step, as ForestEnv.step; info has the number of the forest too.

        Raises ResetNeeded before the first reset and after one that failed.
        """
        if not self.path:
            raise gymnasium.error.ResetNeeded("call reset before step")
        observation, reward, terminated, truncated, info = self.flyer.step(action)
        self.path.append(info["pose"][:2])
        return observation, reward, terminated, truncated, info | {"forest": self.flyer.seed}

    def render(self) -> ndarray | None:
        """The picture, if there is a render mode. Raises ResetNeeded as step does."""
        if not self.path:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return picture(self.flyer, self.path) if self.render_mode else None


class Forests(VectorEnv):
    """A Fleet in Gymnasium's clothes. E drones; every step draws what all of them see at once.

    The arguments are those of Forest. max_episode_steps is what gymnasium.make_vec passes on; it
    stands for max_steps, unless that is given.
    """

    metadata: ClassVar[dict[str, Any]] = RENDER | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        *,
        forests: str = "training",
        max_episode_steps: int = LIMIT,
        **world: Any,
    ) -> None:
        self.num_envs = num_envs
        self.fleet = Fleet(World(**{"max_steps": max_episode_steps} | world), num_envs)
        self.paths: list[Path] = [[] for _ in range(num_envs)]
        dress(self, render_mode, forests, self.fleet.world)
        self.single_observation_space = self.observation_space
        self.single_action_space = self.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant the forests of `seed`, `seed` + 1, ..., or those of a list; `options` is unused.

        Where there is no seed, `np_random` draws one. The first seed given seeds `np_random`.
        Raises ValueError if a seed is no whole number from 0, or a list has not one for each drone.
        Then no flight is in the air.
        """
        self.paths = [[] for _ in self.paths]  # a reset that fails leaves no flight in the air
        if seed is None or np.ndim(seed) == 0:
            first = seed if seed is None else whole_number("seed", seed)
            seed = [first if first is None else first + lane for lane in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed has {len(seed)} numbers, allowed are {self.num_envs}")
        seeds = [k if k is None else whole_number("seed", k) for k in seed]
        super().reset(seed=next((k for k in seeds if k is not None), None))
        self._begin(range(self.num_envs), seeds)
        return self._observe()

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, dict[str, Any]]:
        """One control step of the drones in the air; the landed ones begin their next flight.

        actions (E,). Returns observations (E, 4, 84, 84), rewards (E,), terminated (E,),
        truncated (E,) and infos in Gymnasium's form for vectors. Raises ResetNeeded before the
        first reset and after one that failed, and ValueError for actions of another shape or
        outside the space; then no drone has moved.
        """
        if not all(self.paths):
            raise gymnasium.error.ResetNeeded("call reset before step")
        if np.shape(actions) != (self.num_envs,):
            raise ValueError(f"actions have shape {np.shape(actions)}, needed: ({self.num_envs},)")
        landed, last = self.fleet.landed, self.fleet.world.actions - 1
        flying = [lane for lane in range(self.num_envs) if lane not in landed]
        turns = [whole_number("action", actions[lane], last) for lane in flying]
        rewards = np.zeros(self.num_envs)  # (E,)
        if flying:
            _, rewards[flying], *_ = self.fleet.step(turns)
        for lane in flying:
            self.paths[lane].append(self.fleet.envs[lane].pose[:2])
        self._begin(landed, [None] * len(landed))
        ends = [(env.terminated, env.truncated) for env in self.fleet.envs]
        terminated, truncated = np.array(ends).T.copy()  # (E,), (E,)
        observations, infos = self._observe()
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[ndarray, ...] | None:
        """The picture of each drone, if there is a render mode. Raises ResetNeeded as step does."""
        if not all(self.paths):
            raise gymnasium.error.ResetNeeded("call reset before render")
        pairs = zip(self.fleet.envs, self.paths, strict=True)
        return tuple(picture(*pair) for pair in pairs) if self.render_mode else None

    def _begin(self, lanes: Sequence[int], seeds: Sequence[int | None]) -> None:
        self.fleet.reset(lanes, [choose(self, seed) for seed in seeds])
        for lane in lanes:
            self.paths[lane] = [self.fleet.envs[lane].pose[:2]]
            del self.fleet.records[lane][:-1]  # of flights that are over: nobody asks for them

    def _observe(self) -> tuple[ndarray, dict[str, Any]]:
        infos: dict[str, Any] = {}
        for lane, env in enumerate(self.fleet.envs):
            infos = self._add_info(infos, env.info() | {"forest": env.seed}, lane)
        return np.stack([env.observation for env in self.fleet.envs]), infos  # (E, 4, 84, 84)


gymnasium.register(
    id=ID,
    entry_point=f"{__name__}:Forest",
    vector_entry_point=f"{__name__}:Forests",
    max_episode_steps=LIMIT,
)


def main() -> None:
    """Film one flight of random actions."""
    env = gymnasium.make(ID, render_mode="rgb_array")
    env = gymnasium.wrappers.RecordVideo(env, "runs/gym", name_prefix="random")
    env.reset(seed=0)
    env.action_space.seed(0)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    env.close()


if __name__ == "__main__":
    main()
