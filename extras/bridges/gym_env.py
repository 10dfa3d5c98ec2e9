"""The forest for Gymnasium: `DeepFlight/Forest-v0`. The paper's authors released one for Gym.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.gym_env     # films a flight to runs/gym/

    import gymnasium, extras.bridges.gym_env                     # from the root of the repository
    env = gymnasium.make("DeepFlight/Forest-v0", render_mode="rgb_array", beacon=True)
    observation, info = env.reset(seed=3_000_000_000)
    envs = gymnasium.make_vec("DeepFlight/Forest-v0", num_envs=8)    # a Fleet: one camera call

Observation: Box(0, 255, (4, 84, 84), uint8), oldest frame first. Action: Discrete(9), 0 turns
right, 8 left. Every field of env.World is a keyword argument. `reset(seed=k)` plants forest k, the
same that `deepflight.py eval` flies as k; a reset without a seed draws one below 10^9, the range of
training, from the environment's own generator, and `info["forest"]` says which: keep it and the
actions, and you can fly the flight again. The world itself truncates after `max_steps`.

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

from deepflight import TRAIN_END
from env import STACK, Fleet, ForestEnv, World
from render import PIXELS, draw_map, draw_ways

ID = "DeepFlight/Forest-v0"
RENDER: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}
Path = list[tuple[float, float]]  # m, from the start to where the drone is


def dress(env: gymnasium.Env | VectorEnv, render_mode: str | None, world: World) -> None:
    """Give an environment its metadata and the spaces of one drone."""
    if render_mode not in (None, *RENDER["render_modes"]):
        raise ValueError(f"render_mode is {render_mode!r}, allowed: None, 'rgb_array'")
    env.render_mode = render_mode
    env.metadata = env.metadata | {"render_fps": round(1 / world.dt)}
    env.observation_space = Box(0, 255, (STACK, PIXELS, PIXELS), np.uint8)
    env.action_space = Discrete(world.actions)


def picture(flyer: ForestEnv, path: Path) -> ndarray:
    """What the drone sees beside the map with its way: (232, 624, 3) uint8 by default."""
    flights = [(np.array(path), flyer.edge or flyer.outcome, "")]
    chart = draw_map(flyer.trunks, (flyer.world.length, flyer.world.width))
    chart = draw_ways(chart, flights).reduce(2)
    frame = Image.fromarray(flyer.observation[-1]).convert("RGB")
    seen = frame.resize((chart.height, chart.height), Image.Resampling.NEAREST)
    return np.hstack([seen, chart])


class Forest(gymnasium.Env):
    """A ForestEnv in Gymnasium's clothes. Raises ValueError for a world that env.World refuses."""

    metadata: ClassVar[dict[str, Any]] = RENDER

    def __init__(self, render_mode: str | None = None, **world: Any) -> None:
        self.flyer = ForestEnv(World(**world))
        dress(self, render_mode, self.flyer.world)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant forest number `seed`, or one drawn from `np_random`; `options` is unused."""
        super().reset(seed=seed)
        forest = int(self.np_random.integers(TRAIN_END)) if seed is None else seed
        observation, info = self.flyer.reset(seed=forest)
        self.path: Path = [info["pose"][:2]]
        return observation, info | {"forest": forest}

    def step(self, action: int) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """One control step, as ForestEnv.step."""
        observation, reward, terminated, truncated, info = self.flyer.step(action)
        self.path.append(info["pose"][:2])
        return observation, reward, terminated, truncated, info | {"forest": self.flyer.seed}

    def render(self) -> ndarray | None:
        """The picture, if there is a render mode."""
        return picture(self.flyer, self.path) if self.render_mode else None


class Forests(VectorEnv):
    """A Fleet in Gymnasium's clothes. E drones; every step draws what all of them see at once."""

    metadata: ClassVar[dict[str, Any]] = RENDER | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **world: Any) -> None:
        self.num_envs, self.fleet = num_envs, Fleet(World(**world), num_envs)
        self.paths: list[Path] = [[] for _ in range(num_envs)]
        dress(self, render_mode, self.fleet.world)
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
        """Plant forests `seed`, `seed` + 1, ..., or those of a list; `options` is unused.

        Where there is no seed, `np_random` draws one. The first seed given seeds `np_random`.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seed = [seed if seed is None else int(seed) + i for i in range(self.num_envs)]
        given = [int(forest) for forest in seed if forest is not None]
        super().reset(seed=given[0] if given else None)
        self._begin(range(self.num_envs), seed)
        return self._observe()

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, dict[str, Any]]:
        """One control step of the drones in the air; the landed ones begin their next flight.

        actions (E,). Returns observations (E, 4, 84, 84), rewards (E,), terminated (E,),
        truncated (E,) and infos in Gymnasium's form for vectors.
        """
        if not all(self.paths):
            raise gymnasium.error.ResetNeeded("call reset before step")
        landed = self.fleet.landed
        rewards = np.zeros(self.num_envs)  # (E,)
        if flying := [lane for lane in range(self.num_envs) if lane not in landed]:
            _, rewards[flying], *_ = self.fleet.step(np.asarray(actions)[flying])
        for lane in flying:
            self.paths[lane].append(self.fleet.envs[lane].pose[:2])
        self._begin(landed, [None] * len(landed))
        ends = [(env.terminated, env.truncated) for env in self.fleet.envs]
        terminated, truncated = np.array(ends).T.copy()  # (E,), (E,)
        observations, infos = self._observe()
        return observations, rewards, terminated, truncated, infos

    def render(self) -> tuple[ndarray, ...] | None:
        """The picture of each drone, if there is a render mode."""
        pairs = zip(self.fleet.envs, self.paths, strict=True)
        return tuple(picture(*pair) for pair in pairs) if self.render_mode else None

    def _begin(self, lanes: Sequence[int], seeds: Sequence[int | None]) -> None:
        draw = (self.np_random.integers(TRAIN_END) if seed is None else seed for seed in seeds)
        self.fleet.reset(lanes, draw)
        for lane in lanes:
            self.paths[lane] = [self.fleet.envs[lane].pose[:2]]
            del self.fleet.records[lane][:-1]  # of flights that are over: nobody asks for them

    def _observe(self) -> tuple[ndarray, dict[str, Any]]:
        infos: dict[str, Any] = {}
        for lane, env in enumerate(self.fleet.envs):
            infos = self._add_info(infos, env.info() | {"forest": env.seed}, lane)
        return np.stack([env.observation for env in self.fleet.envs]), infos  # (E, 4, 84, 84)


gymnasium.register(
    id=ID, entry_point=f"{__name__}:Forest", vector_entry_point=f"{__name__}:Forests"
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
