"""The Gymnasium environment passes both checkers and works with what people wrap around it."""

import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import RecordVideo, TimeLimit
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from env import ForestEnv
from extras.bridges.gym_env import ID, Forest


@pytest.mark.parametrize("check", [check_env, check_env_sb3])
def test_both_checkers_find_nothing_not_even_to_warn_of(check: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(gymnasium.make(ID, render_mode="rgb_array").unwrapped)


def test_a_seed_is_the_forest_of_that_number_and_flies_as_in_the_core() -> None:
    ours, theirs = ForestEnv(), gymnasium.make(ID)
    a, b = ours.reset(seed=7), theirs.reset(seed=7)
    rng, over = np.random.default_rng(0), False
    assert np.array_equal(a[0], b[0]) and b[1] == a[1] | {"forest": 7}
    while not over:
        action = int(rng.integers(9))
        a, b = ours.step(action), theirs.step(action)
        assert np.array_equal(a[0], b[0]) and a[1:4] == b[1:4] and b[4] == a[4] | {"forest": 7}
        over = a[2] or a[3]


def test_after_a_seed_the_forests_that_follow_are_drawn_by_it() -> None:
    env, forests = gymnasium.make(ID), []
    for _ in range(2):
        env.reset(seed=5)
        forests.append([env.reset()[1]["forest"] for _ in range(3)])
    assert forests[0] == forests[1]
    assert len({*forests[0]}) == 3 and max(forests[0]) < 10**9


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_three_in_a_vector_fly_as_three_alone(vector: type) -> None:
    mode = "sync" if vector is SyncVectorEnv else "async"
    envs = gymnasium.make_vec(ID, num_envs=3, vectorization_mode=mode, beacon=True)
    assert isinstance(envs, vector)
    alone = [Forest(beacon=True) for _ in range(3)]
    seen = envs.reset(seed=20)[0]
    assert np.array_equal(seen, [env.reset(seed=20 + i)[0] for i, env in enumerate(alone)])
    for _ in range(5):
        seen, rewards, *_ = envs.step(np.array([0, 4, 8]))
        steps = [env.step(action) for env, action in zip(alone, (0, 4, 8), strict=True)]
        assert np.array_equal(seen, [step[0] for step in steps])
        assert np.allclose(rewards, [step[1] for step in steps])
    envs.close()


def test_a_flight_is_filmed(tmp_path: Path) -> None:
    env = RecordVideo(gymnasium.make(ID, render_mode="rgb_array"), str(tmp_path / "film"))
    env.reset(seed=1)
    while not any(env.step(4)[2:4]):
        pass
    env.close()
    assert next(tmp_path.glob("film/*.mp4")).stat().st_size > 1000


def test_render_shows_the_frame_beside_the_map() -> None:
    env = gymnasium.make(ID, render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    picture = env.render()
    height = picture.shape[0]
    assert picture.shape[2] == 3 and picture.dtype == np.uint8
    middle = (2 * np.arange(84) + 1) * height // 168  # where each pixel's middle is drawn
    assert np.array_equal(picture[np.ix_(middle, middle)][..., 0], observation[-1])
    assert len(np.unique(picture[:, height:].reshape(-1, 3), axis=0)) > 3


def test_a_time_limit_truncates() -> None:
    env = TimeLimit(gymnasium.make(ID), 2)
    env.reset(seed=1)
    assert [env.step(4)[2:4] for _ in range(2)] == [(False, False), (False, True)]


def test_a_world_is_changed_by_keywords_and_an_impossible_one_refused() -> None:
    slow = gymnasium.make(ID, dt=0.05, actions=3)
    assert slow.action_space.n == 3 and slow.metadata["render_fps"] == 20
    with pytest.raises(ValueError, match="speed"):
        Forest(speed=-1.0)
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        Forest(render_mode="human")
