"""The native vector environment flies as Gymnasium's synchronous one, and keeps its rules."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from env import ForestEnv
from extras.bridges.gym_env import ID, Forests


def test_the_native_vector_declares_next_step_autoreset_and_batched_spaces() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = gymnasium.make_vec(ID, num_envs=8, vectorization_mode="vector_entry_point")
        assert isinstance(gymnasium.make_vec(ID, num_envs=2), Forests)
    assert isinstance(envs, Forests) and envs.num_envs == 8 and envs.spec.id == ID
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.metadata["render_fps"] == 10
    other = gymnasium.make_vec(ID, num_envs=8, vectorization_mode="sync")
    for space in ("observation_space", "single_observation_space", "single_action_space"):
        assert getattr(envs, space) == getattr(other, space)
    assert envs.action_space == other.action_space
    assert envs.reset(seed=1)[0] in envs.observation_space


def same(ours: dict, theirs: dict) -> None:
    """Both infos have the same keys, masks, types and values."""
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert value.dtype == theirs[key].dtype and np.array_equal(value, theirs[key]), key


@pytest.mark.parametrize("world", [{}, {"beacon": True, "max_steps": 12, "actions": 5}])
def test_the_native_vector_flies_as_the_synchronous_one(world: dict) -> None:
    ours = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", **world)
    theirs = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="sync", **world)
    rng, ends, over = np.random.default_rng(0), 0, np.zeros(3, bool)
    a, b = ours.reset(seed=40), theirs.reset(seed=40)
    assert np.array_equal(a[0], b[0])
    same(a[1], b[1])
    for _ in range(300):
        actions = rng.integers(ours.single_action_space.n, size=3)
        a = ours.step(actions)
        for lane in np.flatnonzero(over):  # lead their lane into the forest that ours has drawn
            flyer = theirs.envs[lane].unwrapped
            plant = flyer.flyer.reset
            flyer.flyer.reset = lambda seed, plant=plant, f=a[4]["forest"][lane]: plant(seed=int(f))
        b = theirs.step(actions)
        for lane in np.flatnonzero(over):
            del theirs.envs[lane].unwrapped.flyer.reset
            forest = theirs.envs[lane].unwrapped.flyer.seed
            assert forest == a[4]["forest"][lane] and 0 <= forest < 10**9
            b[4]["forest"][lane] = forest
            assert a[1][lane] == 0 and not a[2][lane] and not a[3][lane]
        for x, y in zip(a[:4], b[:4], strict=True):
            assert x.dtype == y.dtype and np.array_equal(x, y)
        same(a[4], b[4])
        over = a[2] | a[3]
        ends += over.sum()
    assert ends > 15


def test_each_forest_of_the_native_vector_is_the_one_that_infos_name() -> None:
    envs, rng = Forests(2), np.random.default_rng(0)
    frames, infos = envs.reset(seed=[7, 90])
    assert list(infos["forest"]) == [7, 90]
    single, over = [ForestEnv(), ForestEnv()], np.ones(2, bool)
    actions, rewards = np.zeros(2, int), np.zeros(2)
    for _ in range(150):
        for lane in range(2):
            if over[lane]:
                frame, _ = single[lane].reset(seed=int(infos["forest"][lane]))
            else:
                frame, r, *_ = single[lane].step(int(actions[lane]))
                assert r == rewards[lane]
            assert np.array_equal(frame, frames[lane])
        over = np.array([bool(env.outcome) for env in single])
        actions = rng.integers(9, size=2)
        frames, rewards, _, _, infos = envs.step(actions)


def test_a_seed_decides_all_forests_of_the_native_vector() -> None:
    drawn = []
    for seed in (5, [5, 6, 7], None):
        envs = Forests(3, max_steps=1)
        envs.reset(seed=seed)
        envs.step(np.full(3, 4))
        infos = envs.step(np.full(3, -1))[4]  # a landed lane ignores its action
        drawn.append([*infos["forest"], *envs.reset()[1]["forest"]])
    assert drawn[0] == drawn[1] != drawn[2]
    assert len({*drawn[0]}) == 6 and max(drawn[0]) < 10**9


def test_the_native_vector_renders_and_refuses_an_impossible_world() -> None:
    envs = Forests(2, render_mode="rgb_array", dt=0.05)
    envs.reset(seed=3)
    envs.step(np.array([0, 8]))
    assert [picture.shape for picture in envs.render()] == [(232, 624, 3)] * 2
    envs = Forests(1)
    envs.reset(seed=3)
    assert envs.render() is None
    with pytest.raises(ValueError, match="speed"):
        Forests(2, speed=-1.0)
    with pytest.raises(ValueError, match="forests is 'eval', allowed: 'training', 'test'"):
        Forests(2, forests="eval")


def refuses_to_fly(envs: Forests) -> None:
    """Neither step nor render does anything before a reset."""
    for call in (lambda: envs.step(np.array([4, 4])), envs.render):
        with pytest.raises(ResetNeeded, match=r"^call reset before \w+$"):
            call()


@pytest.mark.parametrize("seed", [-1, 1.5, "7", True, [1, -1], [1, 2.5], [1], [1, 2, 3]])
def test_before_a_reset_and_after_a_failed_one_nothing_is_in_the_air(seed: object) -> None:
    envs = Forests(2, render_mode="rgb_array")
    refuses_to_fly(envs)
    envs.reset(seed=1)
    with pytest.raises(ValueError, match=r"^seed (is|has) .*, allowed are "):
        envs.reset(seed=seed)
    refuses_to_fly(envs)
    assert envs.reset(seed=[np.int64(7), None])[1]["forest"][0] == 7


@pytest.mark.parametrize("actions", [[4, 9], [4, -1], [4.0, 4.0], [4], [4, 4, 4], 4])
def test_after_a_refused_action_no_drone_has_moved(actions: object) -> None:
    envs = Forests(2)
    envs.reset(seed=1)
    with pytest.raises(ValueError, match="action"):
        envs.step(np.array(actions))
    assert np.all(envs.step(np.array([4, 4]))[4]["progress"] == 0.5)


def test_equal_seeds_give_training_and_test_lanes_different_forests() -> None:
    flown = {}
    for forests in ("training", "test"):
        envs = gymnasium.make_vec(ID, num_envs=3, forests=forests, max_steps=1)
        seen = [envs.reset(seed=seed)[1]["forest"] for seed in (0, None, [7, None, 9])]
        envs.step(np.full(3, 4))
        flown[forests] = np.concatenate([*seen, envs.step(np.full(3, 4))[4]["forest"]])
    assert list(flown["test"][[0, 1, 2, 6, 8]]) == [10**9 + k for k in (0, 1, 2, 7, 9)]
    assert np.all(flown["training"] < 10**9)
    assert np.all((flown["test"] >= 10**9) & (flown["test"] < 2 * 10**9))


def test_the_native_vector_takes_gymnasiums_time_limit_or_the_worlds() -> None:
    for limits, end in (({}, 1000), ({"max_episode_steps": 2}, 2), ({"max_steps": 2000}, 2000)):
        envs = gymnasium.make_vec(ID, num_envs=2, **limits)
        assert envs.fleet.world.max_steps == end
    assert gymnasium.make_vec(ID, num_envs=2).spec.max_episode_steps == 1000


def test_the_statistics_of_a_vector_are_the_sums_of_its_rewards() -> None:
    envs, total = RecordEpisodeStatistics(Forests(2, max_steps=3)), np.zeros(2)
    envs.reset(seed=1)
    for _ in range(3):
        _, rewards, *_, infos = envs.step(np.array([4, 4]))
        total += rewards
    assert np.allclose(infos["episode"]["r"], total) and list(infos["episode"]["l"]) == [3, 3]
