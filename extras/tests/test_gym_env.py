"""The Gymnasium environment passes both checkers and works with what people wrap around it."""

import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from env import VecForest, World
from extras.bridges.gym_env import ID, Forest, main


@pytest.mark.parametrize("check", [check_env, check_env_sb3])
def test_both_checkers_find_nothing_not_even_to_warn_of(check: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(gymnasium.make(ID, render_mode="rgb_array").unwrapped)


def test_a_seed_is_the_forest_of_that_number_and_flies_as_in_the_core() -> None:
    ours, theirs, rng = VecForest(World(), 1, [7]), gymnasium.make(ID), np.random.default_rng(0)
    s, info = theirs.reset(seed=7)
    assert np.array_equal(ours.reset_done()[0], s) and info["forest"] == 7
    while ours.active:
        action = int(rng.integers(9))
        (s,), (r,), (terminated,), (truncated,), (drone,) = ours.step([action])
        *b, info = theirs.step(action)
        assert np.array_equal(s, b[0]) and b[1:] == [r, terminated, truncated]
        for key in ("d_obs", "d_goal", "pose", "forward", "progress", "outcome"):
            assert info[key] == getattr(drone, key)


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


def test_render_shows_the_frame_beside_the_map() -> None:
    env = gymnasium.make(ID, render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    picture = env.render()
    height = picture.shape[0]
    assert picture.shape[2] == 3 and picture.dtype == np.uint8
    middle = (2 * np.arange(84) + 1) * height // 168  # where each pixel's middle is drawn
    assert np.array_equal(picture[np.ix_(middle, middle)][..., 0], observation[-1])
    assert len(np.unique(picture[:, height:].reshape(-1, 3), axis=0)) > 3


def test_every_action_of_the_space_means_what_the_int_means() -> None:
    kinds = (int, np.array, np.int64, np.uint8)
    for action in range(9):
        envs = [gymnasium.make(ID) for _ in kinds]
        for env in envs:
            env.reset(seed=1)
        steps = [env.step(kind(action)) for env, kind in zip(envs, kinds, strict=True)]
        assert all(step[1:] == steps[0][1:] for step in steps)
    with pytest.raises(ValueError, match="no action 9"):
        envs[0].unwrapped.step(np.array(9))


def test_who_writes_into_an_observation_changes_no_other() -> None:
    ours, theirs = Forest(), Forest()
    for step in (lambda env: env.reset(seed=1), *[lambda env: env.step(4)] * 5):
        seen = step(ours)[0]
        assert np.array_equal(seen, step(theirs)[0])
        seen[:] = 0


def test_a_validation_environment_shares_no_forest_with_a_training_of_equal_seeds() -> None:
    flown = {}
    for forests in ("training", "validation"):
        env = gymnasium.make(ID, forests=forests)
        seeds = [0, None, None, 7, None, 999_999_999, None]
        flown[forests] = [env.reset(seed=seed)[1]["forest"] for seed in seeds]
    assert all(0 <= forest < 10**9 for forest in flown["training"])
    assert all(10**9 <= forest < 2 * 10**9 for forest in flown["validation"])
    assert len({*flown["training"]} | {*flown["validation"]}) == 14


def test_a_seed_of_a_validation_environment_leads_into_its_range() -> None:
    env, first = Forest(forests="validation"), 10**9
    pairs = {0: first, 7: first + 7, first + 5: first + 5, 2 * first - 1: 2 * first - 1}
    for seed, forest in (pairs | {3 * first + 2: first + 2}).items():
        observation, info = env.reset(seed=seed)
        assert info["forest"] == forest
        assert np.array_equal(observation, Forest().reset(seed=forest)[0])
    with pytest.raises(ValueError, match="forests is 'eval', allowed: "):
        Forest(forests="eval")


def test_the_time_limit_is_the_worlds_and_gymnasiums() -> None:
    assert gymnasium.spec(ID).max_episode_steps == gymnasium.make(ID).spec.max_episode_steps == 1000
    world = {"grid": (0, 0), "back": 30.0}  # no trunk is in the way of a circle
    for limits, end in (({}, (1000, "time")), ({"max_steps": 1003}, (1000, ""))):
        env = gymnasium.make(ID, **world, **limits)
        assert circle(env) == end
    both = {"max_steps": 1003, "max_episode_steps": 1003}
    assert circle(gymnasium.make(ID, **world, **both)) == (1003, "time")


def circle(env: gymnasium.Env) -> tuple[int, str]:
    """Turn left until the episode is truncated: its steps and its outcome."""
    env.reset(seed=1)
    for steps in range(1, 2000):
        *_, truncated, info = env.step(8)
        if truncated:
            return steps, info["outcome"]


def test_a_world_is_changed_by_keywords_and_an_impossible_one_refused() -> None:
    slow = gymnasium.make(ID, dt=0.05, num_actions=3)
    assert slow.action_space.n == 3 and slow.metadata["render_fps"] == 20
    assert Forest(speed=0.4, dt=2.5).metadata["render_fps"] == 1
    with pytest.raises(ValueError, match="speed"):
        Forest(speed=50.0)
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        Forest(render_mode="human")


def test_the_film_is_where_the_script_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    main()
    told = capsys.readouterr().out.splitlines()[-1]
    film = tmp_path / told.removeprefix("wrote ")
    assert [*(tmp_path / "runs/gym").glob("*.mp4")] == [film]


def test_an_episode_is_a_success_if_the_drone_crossed() -> None:
    for back, length, goal, end in (
        (2.0, 20.0, 3.0, "goal"), (2.0, 2.8, 0.1, "far"), (-1.0, 90.0, 3.0, "back")
    ):  # fmt: skip
        env, told = Forest(grid=(0, 0), back=back, length=length, goal_radius=goal), []
        env.reset(seed=1)
        while not env.drone.outcome:
            told.append(env.step(4)[4])
        assert told[-1]["outcome"] == end and told[-1]["is_success"] is (end != "back")
        assert not any(info["is_success"] for info in told[:-1])


def test_no_key_and_opposite_keys_fly_straight_on_and_every_other_set_of_keys_turns() -> None:
    keys = {"".join(sorted(key)): action for key, action in Forest().get_keys_to_action().items()}
    assert keys == {
        "": 4, "w": 4, "ad": 4, "adw": 4, "a": 8, "aw": 6, "dw": 2, "d": 0
    }  # fmt: skip
    few = Forest(num_actions=3)
    assert {*few.get_keys_to_action().values()} <= {0, 1, 2}
    assert few.get_keys_to_action()[""] == 1 and few.get_keys_to_action()["a"] == 2


def test_gymnasium_s_play_flies_by_the_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of matplotlib, which it would plot with
        from gymnasium.utils.play import play
    env, flown = gymnasium.make(ID, render_mode="rgb_array"), []
    down, up = pygame.KEYDOWN, pygame.KEYUP
    presses = [[(down, "a")], [(down, "w")], [(up, "a"), (down, "d")], [(up, "w"), (up, "d")]]

    def press(*step: object) -> None:
        """Note the action, and press what comes next; in the end close the window."""
        flown.append(step[2])
        for kind, key in presses[len(flown) - 1] if len(flown) <= len(presses) else ():
            pygame.event.post(pygame.event.Event(kind, key=ord(key)))
        if len(flown) > len(presses):
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    play(env, fps=1000, callback=press, seed=1)
    assert flown == [4, 8, 6, 2, 4]
