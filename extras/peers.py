"""The benchmark's runners, ours and the peers': each a generator that works when asked for more.

Every generator yields how many steps it has just done, for ever;

    xvfb-run -a extras/.venv/bin/python -m extras.bench

times them in turns. What to install for it stands in bench.py.
Not in this file: clocks, ratios, what the numbers mean.
"""

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import numpy as np
import torch
import vizdoom

from deepflight import Config, Training
from env import ForestEnv
from extras.sb3_train import make_model

REPLAY = 20_000  # transitions: Stable-Baselines3's take 1.1 GB
# 1-step DQN, past exploration
PLAIN = dict(n=1, double=False, mirror=False, replay=REPLAY, warmup=400, epsilon_start=0.05)
RNG = np.random.default_rng(0)


def forest() -> Iterator[int]:
    """Our environment."""
    env = ForestEnv()
    while True:
        env.reset()
        while not env.outcome:
            env.step(int(RNG.integers(9)))
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
    import miniworld  # noqa: F401, not before the benchmark has chosen the core: it starts threads

    env = gymnasium.make(f"MiniWorld-{scene}-v0", obs_width=84, obs_height=84)
    while True:
        env.reset()
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
            yield 1


def begun(c: Config) -> Training:
    """A training of ours that stands at its first step; what it saves is thrown away."""
    with TemporaryDirectory() as folder:
        run = Training(c, Path(folder))
        run.begin()
    return run


def training(precision: str) -> Iterator[int]:
    """Our training, past its warm-up."""
    run = begun(Config(**PLAIN, precision=precision))
    while True:
        run.step()
        if run.book["step"] > run.c.warmup:
            yield run.c.lanes


def sb3() -> Iterator[int]:
    """Stable-Baselines3's training, past its warm-up."""
    model = make_model(Config(**PLAIN), REPLAY)
    model.verbose = 0
    model.learn(PLAIN["warmup"])
    while True:
        model.learn(200, reset_num_timesteps=False, log_interval=10**9)
        yield 200


def updates(batch: int) -> Iterator[int]:
    """Our updates alone, of Double DQN in float32."""
    c = Config(**PLAIN | {"double": True, "precision": "float32", "batch": batch})
    run = begun(c)
    for _ in range(100):
        run.advance(run.choose(1.0))
    while True:
        run.agent.learn(run.memory, c.lr, 1.0, 1.0, run.learn_rng)
        yield 1


def products() -> Iterator[int]:
    """Multiplications in a product of two matrices, float32."""
    a = torch.ones(1024, 1024)
    while True:
        torch.mm(a, a)
        yield 1024**3
