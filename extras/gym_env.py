"""The forest for Gymnasium: `DeepFlight/Forest-v0`. The paper's authors released one for Gym.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.gym_env     # films a flight to runs/gym/

    import gymnasium, extras.gym_env                     # from the root of the repository
    env = gymnasium.make("DeepFlight/Forest-v0", render_mode="rgb_array", beacon=True)
    observation, info = env.reset(seed=3_000_000_000)

Observation: Box(0, 255, (4, 84, 84), uint8), oldest frame first. Action: Discrete(9), 0 turns
right, 8 left. Every field of env.World is a keyword argument. `reset(seed=k)` plants forest k, the
same that `deepflight.py eval` flies as k; a reset without a seed draws one below 10^9, the range of
training, from the environment's own generator, and `info["forest"]` says which: keep it and the
actions, and you can fly the flight again. The world itself truncates after `max_steps`.
"""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy import ndarray
from PIL import Image

from deepflight import TRAIN_END
from env import STACK, ForestEnv, World
from render import PIXELS, draw_map

ID = "DeepFlight/Forest-v0"


class Forest(gymnasium.Env):
    """A ForestEnv in Gymnasium's clothes. Raises ValueError for a world that env.World refuses."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, **world: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is {render_mode!r}, allowed: None, 'rgb_array'")
        self.render_mode, self.flyer = render_mode, ForestEnv(World(**world))
        self.metadata = self.metadata | {"render_fps": round(1 / self.flyer.world.dt)}
        self.observation_space = Box(0, 255, (STACK, PIXELS, PIXELS), np.uint8)
        self.action_space = Discrete(self.flyer.world.actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant forest number `seed`, or one drawn from `np_random`; `options` is unused."""
        super().reset(seed=seed)
        forest = int(self.np_random.integers(TRAIN_END)) if seed is None else seed
        observation, info = self.flyer.reset(seed=forest)
        self.path = [info["pose"][:2]]  # m, from the start to where the drone is
        return observation, info | {"forest": forest}

    def step(self, action: int) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """One control step, as ForestEnv.step."""
        observation, reward, terminated, truncated, info = self.flyer.step(action)
        self.path.append(info["pose"][:2])
        return observation, reward, terminated, truncated, info | {"forest": self.flyer.seed}

    def render(self) -> ndarray | None:
        """What the drone sees beside the map with its way: (232, 624, 3) uint8 by default."""
        if self.render_mode is None:
            return None
        flyer, world = self.flyer, self.flyer.world
        flights = [(np.array(self.path), flyer.edge or flyer.outcome, "")]
        chart = draw_map(flyer.trunks, (world.length, world.width), flights).reduce(2)
        frame = Image.fromarray(flyer.observation[-1]).convert("RGB")
        seen = frame.resize((chart.height, chart.height), Image.Resampling.NEAREST)
        return np.hstack([seen, chart])


gymnasium.register(id=ID, entry_point=f"{__name__}:Forest")


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
