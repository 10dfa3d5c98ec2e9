"""The benchmark's runners, ours and the peers'.

    xvfb-run -a extras/.venv/bin/python -m extras.experiments.bench    # times them in turns

What to install stands in bench.py. Most runners are generators: each works when asked for more,
yields how many steps it has just done, and never ends. `training` has an end, so it clocks itself.
Not in this file: ratios, and what the numbers mean.
"""

import io
import os
import signal
from collections.abc import Iterator
from contextlib import closing, redirect_stdout
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import numpy as np
import vizdoom

from deepflight import RunConfig, train
from dqn import DQNConfig, load
from env import Fleet, ForestEnv, World
from extras.bridges.sb3_train import make_model

REPLAY = 20_000  # transitions: Stable-Baselines3's take 1.1 GB
DRONES, STEPS = 8, 800  # side by side; of a training that is timed
PLAIN = DQNConfig(  # 1-step DQN, past exploration
    **{"replay_size": REPLAY, "learning_starts": 400, "epsilon_decay": 1, "num_envs": DRONES},
    **{"double": False, "n_steps": 1, "mirror": False, "average": 0.0},
)
RUN = RunConfig(test_every=10**9)
RNG = np.random.default_rng(0)


def forest() -> Iterator[int]:
    """Our environment, eight drones side by side."""
    fleet, seeds = Fleet(World(), DRONES), count()
    while True:
        fleet.reset(fleet.landed, [next(seeds) for _ in fleet.landed])
        fleet.step(RNG.integers(World.actions, size=DRONES))
        yield DRONES


def forest_alone() -> Iterator[int]:
    """Our environment, one drone."""
    env = ForestEnv()
    while True:
        env.reset()
        while not env.outcome:
            env.step(int(RNG.integers(World.actions)))
            yield 1


def doom(scenario: str) -> Iterator[int]:
    """ViZDoom at its smallest, 160x120 grey, one tic an action."""
    game = vizdoom.DoomGame()
    game.load_config(os.path.join(vizdoom.scenarios_path, f"{scenario}.cfg"))
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_160X120)
    game.set_screen_format(vizdoom.ScreenFormat.GRAY8)
    game.set_window_visible(False)
    buttons = np.eye(game.get_available_buttons_size()).tolist()
    with TemporaryDirectory() as folder, closing(game):
        game.set_doom_config_path(f"{folder}/vizdoom.ini")  # else it is left lying here
        game.init()
        while True:
            game.new_episode()
            while not game.is_episode_finished():
                frame = game.get_state().screen_buffer  # (120, 160)
                assert frame.shape == (120, 160)
                game.make_action(buttons[RNG.integers(len(buttons))])
                yield 1


def rooms(scene: str) -> Iterator[int]:
    """MiniWorld, 84x84 in colour, as it always is."""
    import miniworld  # noqa: F401, here, because it starts threads: the core must be chosen

    env = gymnasium.make(f"MiniWorld-{scene}-v0", obs_width=84, obs_height=84)
    while True:
        env.reset()
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
            yield 1


def sb3() -> Iterator[int]:
    """Stable-Baselines3's training, past its warm-up."""
    model = make_model(PLAIN, RUN, REPLAY)
    model.verbose = 0
    model.learn(PLAIN.learning_starts)
    while True:
        model.learn(200, reset_num_timesteps=False, log_interval=10**9)
        yield 200


def training(bfloat16: bool) -> float:
    """Steps a second of our training, past its warm-up: a long training less a short one."""
    short, long = PLAIN.learning_starts, PLAIN.learning_starts + STEPS
    c = replace(PLAIN, bfloat16=bfloat16)
    return STEPS / (seconds(replace(c, steps=long)) - seconds(replace(c, steps=short)))


def seconds(c: DQNConfig) -> float:
    """What the steps of one whole training take, flying and learning, by its own clock.

    The clock starts after the random pilot's flights and is read before the last test point.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        try:
            if train(c, RUN, Path(folder)):
                raise KeyboardInterrupt  # the training has taken the signal for itself
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return load(Path(folder) / "checkpoint.pt", "checkpoint")["book"]["seconds"]
