"""The forest for Gymnasium: `DeepFlight/Forest-v0`. The paper's authors released one for Gym.

    extras/.venv/bin/python -m extras.bridges.gym_env     # films an episode to runs/gym/

    import gymnasium, extras.bridges.gym_env                     # from the root of the repository
    env = gymnasium.make("DeepFlight/Forest-v0", render_mode="rgb_array", beacon=True)
    observation, info = env.reset(seed=3_000_000_000)
    envs = gymnasium.make_vec("DeepFlight/Forest-v0", num_envs=8)
    from gymnasium.utils.play import play; play(env)             # keys a, d and w; needs pygame

Observation: Box(0, 255, (4, 84, 84), uint8), oldest frame first. Action: Discrete(9), 0 turns
right, 8 left. Every field of env.World is a keyword argument. The smaller of `max_steps`, the
world's, and `max_episode_steps`, Gymnasium's, truncates; for more than 1,000 steps give both.

A seed is a forest. `reset(seed=k)` plants forest k, the same that `deepflight.py eval` flies as k.
A reset without a seed draws one below 10^9, the range of training, from the environment's own
generator. `info["forest"]` says which: keep it and the actions, and you can fly the episode again.

With `forests="validation"` every forest comes from [10^9, 2 * 10^9). A reset without a seed draws
one there, and `reset(seed=k)` plants forest 10^9 + k % 10^9. So it shares no forest with a training
whose seeds are below 10^9, even if Stable-Baselines3 gives both the same seeds. Its EvalCallback
meets other forests each time, unless you call `eval_env.seed(0)` before: see sb3_train.Validation.

`make_vec` gives drones side by side. `reset(seed=k)` plants forests k, k + 1, and so on; with
`options={"reset_mask": mask}` only those of the mask (E,). The keyword `autoreset_mode` is one of
Gymnasium's: "NextStep" (the default: the step after an episode's end begins the next one, ignores
its action, and pays 0), "SameStep" or "Disabled".
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
from env import STACK, Drone, VecForest, World
from extras.experiments.maps import draw_map, draw_ways
from render import PIXELS

ID = "DeepFlight/Forest-v0"
RENDER: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}
RANGES = {"training": range(TRAIN_END), "validation": range(TRAIN_END, 2 * TRAIN_END)}  # of forests
AnyEnv = gymnasium.Env | VectorEnv


def dress(env: AnyEnv, world: World, num_envs: int, render_mode: str | None, forests: str) -> None:
    """Give an environment its drones, its range of forests, and the spaces of one drone."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {render_mode!r}, allowed: None, 'rgb_array'")
    if forests not in RANGES:
        raise ValueError(f"forests is {forests!r}, allowed: {tuple(RANGES)}")
    if world.speed * world.dt >= world.trunk_radius + world.d_crash:
        raise ValueError(f"speed {world.speed} m/s: a step could jump through a trunk unseen")
    env.envs = VecForest(world, num_envs, ())  # it looks; we reset and step its drones
    env.render_mode, env.numbers = render_mode, RANGES[forests]
    env.metadata = env.metadata | {"render_fps": max(1, round(1 / world.dt))}
    env.observation_space = Box(0, 255, (STACK, PIXELS, PIXELS), np.uint8)
    env.action_space = Discrete(world.num_actions)


def begin(env: AnyEnv, drone: Drone, seed: int | None) -> None:
    """Reset a drone in the forest that the seed names, or in one drawn from the range."""
    first, last = env.numbers.start, env.numbers.stop
    if seed is None:
        seed = int(env.np_random.integers(first, last))
    drone.reset(int(seed) if first == 0 else env.numbers[seed % (last - first)])


def look(envs: VecForest) -> ndarray:
    """All observations (E, 4, 84, 84); keeps the path of every drone."""
    for drone in envs.drones:
        drone.path = [*(drone.path if drone.actions else []), drone.pose[:2]]
    return np.stack([drone.observation for drone in envs.drones])


def info(drone: Drone) -> dict[str, Any]:
    """Distances in m, the pose (x, y, heading), how the episode ended or "", and the forest;
    `is_success` if the drone has crossed, of which Stable-Baselines3 prints the share."""
    keys = "d_obs", "d_goal", "pose", "forward", "progress", "outcome"
    ended = {"forest": drone.seed, "is_success": drone.outcome in ("goal", "far")}
    return {key: getattr(drone, key) for key in keys} | ended


def picture(drone: Drone) -> ndarray:
    """What the drone sees beside the map with its path: (232, 624, 3) uint8 by default."""
    chart = draw_map(drone.trunks, (drone.world.length, drone.world.width))
    chart = draw_ways(chart, [(np.array(drone.path), drone.outcome, "")]).reduce(2)
    frame = Image.fromarray(drone.observation[-1]).convert("RGB")
    seen = frame.resize((chart.height, chart.height), Image.Resampling.NEAREST)
    return np.hstack([seen, chart])


class Forest(gymnasium.Env):
    """One drone.

    render_mode: None or "rgb_array". forests: "training" or "validation", the range of its forests.
    The rest are fields of env.World. Raises ValueError for any other value, and for a world that
    env.World refuses.
    """

    metadata: ClassVar[dict[str, Any]] = RENDER

    def __init__(
        self, render_mode: str | None = None, *, forests: str = "training", **world: Any
    ) -> None:
        dress(self, World(**world), 1, render_mode, forests)
        self.drone = self.envs.drones[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant the forest of this seed, or one drawn from `np_random`; `options` is unused."""
        super().reset(seed=seed)
        begin(self, self.drone, seed)
        return look(self.envs)[0], info(self.drone)

    def step(self, action: int) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """One control step. Raises ValueError if no episode is on, or there is no such action."""
        r, outcome = self.drone.step(int(action)), self.drone.outcome
        terminated, truncated = outcome not in ("", "time"), outcome == "time"
        return look(self.envs)[0], r, terminated, truncated, info(self.drone)

    def render(self) -> ndarray | None:
        """The picture, if there is a render mode."""
        return picture(self.drone) if self.render_mode else None

    def get_keys_to_action(self) -> dict[str, int]:
        """For gymnasium.utils.play: a turns left, d right, with w less; no key is straight on."""
        actions, straight = self.envs.num_actions, self.envs.num_actions // 2
        turns = {"a": actions - 1, "aw": (straight + actions) // 2, "dw": straight // 2, "d": 0}
        return turns | dict.fromkeys(("", "w", "ad", "adw"), straight)


class Forests(VectorEnv):
    """E drones side by side.

    The arguments are those of Forest, and two of Gymnasium's: max_episode_steps, the time limit
    that make_vec passes on (-1: none; None: 1,000), and autoreset_mode, an AutoresetMode or value.
    """

    metadata: ClassVar[dict[str, Any]] = RENDER | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self, num_envs: int = 1, render_mode: str | None = None, *, forests: str = "training",
        max_episode_steps: int | None = -1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, **world: Any,
    ) -> None:  # fmt: skip
        ours, theirs = world.get("max_steps", World.max_steps), max_episode_steps or World.max_steps
        world["max_steps"] = ours if theirs == -1 else min(ours, theirs)
        dress(self, World(**world), num_envs, render_mode, forests)
        self.num_envs, self.mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = self.metadata | {"autoreset_mode": self.mode}
        self.single_observation_space = self.observation_space
        self.single_action_space = self.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Plant the forests of `seed`, `seed` + 1, ..., or those of a list.

        Where there is no seed, `np_random` draws one. The first seed used seeds `np_random`. Only
        the drones of `options["reset_mask"]`, if it is given, begin anew and are in infos.
        """
        chosen = self._chosen((options or {}).get("reset_mask"))
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        pairs = [*zip(self.envs.drones, seed, strict=True)]
        super().reset(seed=next((pairs[i][1] for i in chosen if pairs[i][1] is not None), None))
        for i in chosen:
            begin(self, *pairs[i])
        return look(self.envs), self._infos(chosen)

    def _chosen(self, mask: ndarray | None) -> Sequence[int]:
        """The drones that begin anew: those of the mask (E,), and any that never began."""
        if mask is None:
            return range(self.num_envs)
        mask, never = np.asarray(mask), [drone.outcome == "not reset" for drone in self.envs.drones]
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(f"reset_mask is {mask}, allowed: {self.num_envs} bools, not all False")
        return np.flatnonzero(mask | never).tolist()

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, dict[str, Any]]:
        """One control step of the active drones; the others do as the autoreset mode says.

        actions (E,). Returns observations (E, 4, 84, 84), rewards (E,), terminated (E,),
        truncated (E,) and infos in Gymnasium's form for vectors. Raises ValueError for actions of
        another shape or outside the space, and in "Disabled" if an episode is over; then no drone
        has moved.
        """
        drones, rewards = self.envs.drones, np.zeros(self.num_envs)  # (E,)
        if actions not in self.action_space:
            raise ValueError(f"actions are {actions}, allowed: {self.action_space}")
        if self.mode is AutoresetMode.DISABLED and any(drone.outcome for drone in drones):
            raise ValueError("an episode is over: reset its drone by a reset_mask")
        for i, drone in enumerate(drones):
            if drone.outcome:
                begin(self, drone, None)
            else:
                rewards[i] = drone.step(int(actions[i]))
        outcomes = np.array([drone.outcome for drone in drones])  # (E,)
        terminated, truncated = ~np.isin(outcomes, ("", "time")), outcomes == "time"  # (E,), (E,)
        infos = self._infos(range(self.num_envs))
        return look(self.envs), rewards, terminated, truncated, infos

    def render(self) -> tuple[ndarray, ...] | None:
        """The picture of each drone, if there is a render mode."""
        return tuple(picture(drone) for drone in self.envs.drones) if self.render_mode else None

    def _infos(self, chosen: Sequence[int]) -> dict[str, Any]:
        """Infos of these drones; in "SameStep" the next episode begins where one is over."""
        infos: dict[str, Any] = {}
        for i in chosen:
            drone = self.envs.drones[i]
            if drone.outcome and self.mode is AutoresetMode.SAME_STEP:
                final = {"final_obs": drone.observation, "final_info": info(drone)}
                infos = self._add_info(infos, final, i)
                begin(self, drone, None)
            infos = self._add_info(infos, info(drone), i)
        return infos


gymnasium.register(
    id=ID,
    entry_point=f"{__name__}:Forest",
    vector_entry_point=f"{__name__}:Forests",
    max_episode_steps=World.max_steps,
)


def main() -> None:
    """Film one episode of random actions."""
    env = gymnasium.make(ID, render_mode="rgb_array")
    env = gymnasium.wrappers.RecordVideo(env, "runs/gym", name_prefix="random")
    env.reset(seed=0)
    env.action_space.seed(0)
    while not any(env.step(env.action_space.sample())[2:4]):
        pass
    env.close()
    print("wrote runs/gym/random-episode-0.mp4")


if __name__ == "__main__":
    main()
