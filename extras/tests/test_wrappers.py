"""Gymnasium's wrappers and Stable-Baselines3's Monitor run on the forest, and say what is true."""

import csv
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import (
    FrameStackObservation,
    RecordEpisodeStatistics,
    RecordVideo,
    TimeAwareObservation,
    TimeLimit,
)
from imageio_ffmpeg import count_frames_and_secs
from moviepy.video.io.VideoFileClip import VideoFileClip
from numpy import ndarray
from stable_baselines3.common.monitor import Monitor

from env import OUTCOMES
from extras.bridges.gym_env import ID


def episode(env: gymnasium.Env, seed: int) -> tuple[list[ndarray], list[float], dict]:
    """What the plain environment gives straight ahead: observations, rewards, last info."""
    seen, rewards, over = [env.reset(seed=seed)[0]], [], False
    while not over:
        observation, r, terminated, truncated, info = env.step(4)
        seen, rewards, over = [*seen, observation], [*rewards, r], terminated or truncated
    return seen, rewards, info


def test_numpy_to_torch_gives_the_same_numbers_and_takes_a_tensor_as_action() -> None:
    plain, env = gymnasium.make(ID), gymnasium.wrappers.NumpyToTorch(gymnasium.make(ID))
    assert np.array_equal(env.reset(seed=1)[0].numpy(), plain.reset(seed=1)[0])
    for action in (0, 4, 8):
        theirs, ours = env.step(torch.tensor(action)), plain.step(action)
        assert theirs[0].dtype == torch.uint8 and np.array_equal(theirs[0].numpy(), ours[0])
        assert theirs[1:4] == ours[1:4]


def test_time_aware_observation_counts_the_steps() -> None:
    plain = episode(gymnasium.make(ID), 1)[0]
    env = TimeAwareObservation(gymnasium.make(ID), flatten=False)
    assert env.observation_space["time"].high == 1000
    seen = episode(env, 1)[0]
    assert [int(each["time"][0]) for each in seen] == list(range(len(plain)))
    assert np.array_equal([each["obs"] for each in seen], plain)
    flat = TimeAwareObservation(gymnasium.make(ID)).reset(seed=1)[0]
    assert np.array_equal(flat, [*plain[0].ravel(), 0])


def test_record_episode_statistics_adds_up_the_rewards() -> None:
    rewards = episode(gymnasium.make(ID), 1)[1]
    counted = episode(RecordEpisodeStatistics(gymnasium.make(ID)), 1)[2]["episode"]
    assert counted["r"] == pytest.approx(sum(rewards)) and counted["l"] == len(rewards)


def test_frame_stack_observation_holds_the_last_three_observations() -> None:
    plain = episode(gymnasium.make(ID), 1)[0]
    env = FrameStackObservation(gymnasium.make(ID), 3)
    seen = episode(env, 1)[0]
    padded = [plain[0], plain[0], *plain]
    assert env.observation_space.shape == (3, 4, 84, 84)
    assert np.array_equal(seen, [padded[t : t + 3] for t in range(len(plain))])


@pytest.mark.parametrize(
    ("world", "fps"), [({}, 10), ({"dt": 0.05}, 20), ({"speed": 0.4, "dt": 2.5}, 1)]
)
def test_record_video_films_every_step_at_the_worlds_pace(
    world: dict, fps: int, tmp_path: Path
) -> None:
    folder, plain = tmp_path / "film", gymnasium.make(ID, render_mode="rgb_array", **world)
    env = RecordVideo(plain, str(folder))
    steps = len(episode(env, 1)[1])
    env.close()
    plain.reset(seed=1)
    file = str(next(folder.glob("*.mp4")))
    with VideoFileClip(file) as film:
        assert film.fps == env.metadata["render_fps"] == fps
        assert np.abs(film.get_frame(0) - plain.render().astype(float)).mean() < 3  # of 255
    assert count_frames_and_secs(file)[0] in (steps + 1, steps + 2)  # moviepy repeats the last


@pytest.mark.parametrize("limit", [3, 1000])
def test_a_monitor_notes_outcome_and_progress_under_any_time_limit(
    limit: int, tmp_path: Path
) -> None:
    env = TimeLimit(gymnasium.make(ID), limit)
    env = Monitor(env, str(tmp_path / "log"), info_keywords=("outcome", "progress"))
    _, rewards, info = episode(env, 1)
    env.close()
    (row,) = csv.DictReader((tmp_path / "log.monitor.csv").read_text().splitlines()[1:])
    assert float(row["r"]) == pytest.approx(sum(rewards)) and int(row["l"]) == len(rewards)
    assert row["outcome"] == info["outcome"] and float(row["progress"]) == info["progress"]
    assert len(rewards) == 3 if limit == 3 else row["outcome"] in OUTCOMES
