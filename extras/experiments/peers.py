"""The benchmark's runners, ours and the peers'.

    xvfb-run -a extras/.venv/bin/python -m extras.experiments.bench    # times them in turns

What to install stands in bench.py. Each runner is a generator: it works when asked for more, yields
how many steps it has just done, and never ends. Not in this file: what the numbers mean.
"""

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import numpy as np
import vizdoom

from deepflight import Config, Run
from env import VecForest, World
from extras.bridges.sb3_train import make_model
from extras.lessons import recipe

REPLAY, DRONES = 20_000, 8  # transitions: Stable-Baselines3's take 1.1 GB; side by side
PLAIN = Config(  # 1-step DQN, past exploration
    **{"steps": 10**9, "replay_size": REPLAY, "learning_starts": 400, "epsilon_decay": 1},
    **{"double": False, "n_steps": 1, "mirror": False, "swa_fraction": 0.0},
    num_envs=DRONES,
    threads=2,
)
RNG = np.random.default_rng(0)


def forest(drones: int) -> Iterator[int]:
    """Our environment, so many drones side by side."""
    envs = VecForest(World(), drones, count())
    while True:
        envs.reset_done()
        envs.step(RNG.integers(World.num_actions, size=drones))
        yield drones


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
    model = make_model(PLAIN, REPLAY)
    model.verbose = 0
    model.learn(PLAIN.learning_starts)
    while True:
        model.learn(200, reset_num_timesteps=False, log_interval=10**9)
        yield 200


def ours(bfloat16: bool) -> Iterator[int]:
    """Our training, past its warm-up."""
    config = recipe("Precise", Config, bfloat16=bfloat16)
    run = Run(config(**asdict(PLAIN)), Path())  # it writes nothing there
    while True:
        next(run.loop)
        if run.envs.steps > PLAIN.learning_starts:
            yield DRONES
