"""The native vector environment flies as Gymnasium's synchronous one, and keeps its rules."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

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


def test_the_native_vector_renders_wants_a_reset_and_refuses_an_impossible_world() -> None:
    envs = Forests(2, render_mode="rgb_array", dt=0.05)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.array([4, 4]))
    envs.reset(seed=3)
    envs.step(np.array([0, 8]))
    assert [picture.shape for picture in envs.render()] == [(232, 624, 3)] * 2
    assert Forests(1).render() is None
    with pytest.raises(ValueError, match="speed"):
        Forests(2, speed=-1.0)
