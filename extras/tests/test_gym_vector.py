"""The native vector environment flies as Gymnasium's synchronous one, and keeps its rules."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from env import VecForest, World
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


@pytest.mark.parametrize("world", [{}, {"beacon": True, "max_steps": 12, "num_actions": 5}])
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
        for i in np.flatnonzero(over):  # lead theirs into the forest that ours has drawn
            forest = int(a[4]["forest"][i])
            theirs.envs[i].unwrapped.numbers = range(forest, forest + 1)
            assert 0 <= forest < 10**9 and a[1][i] == 0 and not a[2][i] and not a[3][i]
        b = theirs.step(actions)
        for x, y in zip(a[:4], b[:4], strict=True):
            assert x.dtype == y.dtype and np.array_equal(x, y)
        same(a[4], b[4])
        over = a[2] | a[3]
        ends += over.sum()
    assert ends > 15


def test_each_forest_of_the_native_vector_is_the_one_that_infos_name() -> None:
    envs, rng = Forests(2), np.random.default_rng(0)
    s, infos = envs.reset(seed=[7, 90])
    assert list(infos["forest"]) == [7, 90]
    alone, done = [VecForest(World(), 1, ()) for _ in range(2)], np.ones(2, bool)
    actions, rewards = np.zeros(2, int), np.zeros(2)
    for _ in range(150):
        for i, one in enumerate(alone):
            if done[i]:
                one.seeds = iter([int(infos["forest"][i])])
                assert np.array_equal(one.reset_done()[0], s[i])
            else:
                s2, r, *_ = one.step([actions[i]])
                assert r == rewards[i] and np.array_equal(s2[0], s[i])
        done = np.array([not one.active for one in alone])
        actions = rng.integers(9, size=2)
        s, rewards, _, _, infos = envs.step(actions)


def test_a_seed_decides_all_forests_of_the_native_vector() -> None:
    drawn = []
    for seed in (5, [5, 6, 7], None):
        envs = Forests(3, max_steps=1)
        envs.reset(seed=seed)
        envs.step(np.full(3, 4))
        infos = envs.step(np.full(3, 4))[4]
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
        Forests(2, speed=50.0)
    with pytest.raises(ValueError, match="forests is 'eval', allowed: "):
        Forests(2, forests="eval")


@pytest.mark.parametrize("actions", [[4, 9], [4, -1], [4], [4, 4, 4], 4])
def test_after_a_refused_action_no_drone_has_moved(actions: object) -> None:
    envs = Forests(2)
    envs.reset(seed=1)
    with pytest.raises(ValueError, match="action"):
        envs.step(np.array(actions))
    assert np.all(envs.step(np.array([4, 4]))[4]["progress"] == 0.5)


def test_equal_seeds_give_training_and_validation_different_forests() -> None:
    flown = {}
    for forests in ("training", "validation"):
        envs = gymnasium.make_vec(ID, num_envs=3, forests=forests, max_steps=1)
        seen = [envs.reset(seed=seed)[1]["forest"] for seed in (0, None, [7, None, 9])]
        envs.step(np.full(3, 4))
        flown[forests] = np.concatenate([*seen, envs.step(np.full(3, 4))[4]["forest"]])
    assert list(flown["validation"][[0, 1, 2, 6, 8]]) == [10**9 + k for k in (0, 1, 2, 7, 9)]
    assert np.all(flown["training"] < 10**9)
    assert np.all((flown["validation"] >= 10**9) & (flown["validation"] < 2 * 10**9))


def test_the_native_vector_takes_gymnasiums_time_limit_or_the_worlds() -> None:
    for limits, end in (({}, 1000), ({"max_episode_steps": 2}, 2), ({"max_steps": 2000}, 2000)):
        envs = gymnasium.make_vec(ID, num_envs=2, **limits)
        assert envs.envs.world.max_steps == end
    assert gymnasium.make_vec(ID, num_envs=2).spec.max_episode_steps == 1000


def test_the_statistics_of_a_vector_are_the_sums_of_its_rewards() -> None:
    envs, total = RecordEpisodeStatistics(Forests(2, max_steps=3)), np.zeros(2)
    envs.reset(seed=1)
    for _ in range(3):
        _, rewards, *_, infos = envs.step(np.array([4, 4]))
        total += rewards
    assert np.allclose(infos["episode"]["r"], total) and list(infos["episode"]["l"]) == [3, 3]
