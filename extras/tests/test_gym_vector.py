"""The native vector environment flies as Gymnasium's synchronous one, and keeps its rules."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
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
        if isinstance(value, dict):
            same(value, theirs[key])
            continue
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


@pytest.mark.parametrize(
    ("limits", "end"),
    [({}, 1000), ({"max_steps": 1003}, 1000), ({"max_episode_steps": 1003}, 1000),
     ({"max_steps": 3}, 3), ({"max_episode_steps": 3}, 3),
     ({"max_steps": 3, "max_episode_steps": 5}, 3), ({"max_steps": 5, "max_episode_steps": 3}, 3),
     ({"max_steps": 1003, "max_episode_steps": 1003}, 1003),
     ({"max_steps": 1003, "max_episode_steps": -1}, 1003),
     ({"max_steps": 1003, "max_episode_steps": None}, 1000)],
)  # fmt: skip
def test_the_smaller_time_limit_ends_an_episode_alone_and_in_a_vector(
    limits: dict[str, int], end: int
) -> None:
    world = {"grid": (0, 0), "back": 30.0} | limits  # no trunk is in the way of a circle
    alone, envs = gymnasium.make(ID, **world), gymnasium.make_vec(ID, num_envs=1, **world)
    alone.reset(seed=1)
    envs.reset(seed=1)
    ends = [(alone.step(8)[3], envs.step(np.array([8]))[3][0]) for _ in range(end)]
    assert not np.any(ends[:-1]) and all(ends[-1])
    assert envs.spec.max_episode_steps == 1000


def pair(**kwargs: object) -> tuple[Forests, SyncVectorEnv]:
    """Our vector of three, and Gymnasium's of three in the same mode."""
    mode = kwargs.pop("autoreset_mode", "NextStep")
    ours = gymnasium.make_vec(ID, num_envs=3, autoreset_mode=mode, **kwargs)
    options = {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": mode}}
    return ours, gymnasium.make_vec(ID, num_envs=3, **options, **kwargs)


def test_a_mask_resets_its_drones_and_no_other_as_in_gymnasium() -> None:
    ours, theirs = pair(autoreset_mode="Disabled", max_steps=4)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    same_step(ours.reset(seed=40), theirs.reset(seed=40))
    actions = np.array([0, 4, 8])
    for mask, seed in (([False, True, False], 7), ([True, False, True], [9, None, 3])):
        same_step(ours.step(actions), theirs.step(actions))
        options = [{"reset_mask": np.array(mask)} for _ in range(2)]  # theirs empties it
        a = ours.reset(seed=seed, options=options[0])
        same_step(a, theirs.reset(seed=seed, options=options[1]))
        assert list(a[1]["_forest"]) == mask
    assert [len(drone.actions) for drone in ours.envs.drones] == [0, 1, 0]
    assert list(a[1]["forest"]) == [9, 0, 3] and ours.envs.drones[1].seed == 8


def test_where_autoreset_is_disabled_a_drone_waits_for_its_mask() -> None:
    envs = Forests(2, max_steps=2, autoreset_mode="Disabled")
    envs.reset(seed=1)
    envs.step(np.array([4, 4]))
    envs.reset(options={"reset_mask": np.array([True, False])})
    assert list(envs.step(np.array([4, 4]))[3]) == [False, True]
    with pytest.raises(ValueError, match="reset_mask"):
        envs.step(np.array([4, 4]))
    assert [len(drone.actions) for drone in envs.envs.drones] == [1, 2]
    envs.reset(options={"reset_mask": np.array([False, True])})
    envs.step(np.array([4, 4]))


def test_a_mask_begins_the_next_episode_in_place_of_the_next_step() -> None:
    envs = Forests(2, max_steps=1)
    envs.reset(seed=1)
    envs.step(np.array([4, 4]))
    envs.reset(seed=[5, None], options={"reset_mask": np.array([True, False])})
    _, rewards, _, truncated, infos = envs.step(np.array([4, 4]))
    assert infos["forest"][0] == 5 and rewards[0] != 0 and truncated[0]
    assert infos["progress"][1] == rewards[1] == 0 and not truncated[1]


@pytest.mark.parametrize("mask", [[True], [False, False], [1, 0], np.array(True), "yes"])
def test_a_mask_that_means_no_drone_is_refused_and_changes_nothing(mask: object) -> None:
    envs = Forests(2)
    envs.reset(seed=3)
    with pytest.raises(ValueError, match="allowed: 2 bools"):
        envs.reset(seed=7, options={"reset_mask": mask})
    assert [drone.seed for drone in envs.envs.drones] == [3, 4]


def same_step(ours: tuple, theirs: tuple) -> None:
    """Both have answered a reset or a step alike."""
    for x, y in zip(ours[:-1], theirs[:-1], strict=True):
        assert x.dtype == y.dtype and np.array_equal(x, y)
    same(ours[-1], theirs[-1])


def test_same_step_autoreset_flies_as_gymnasiums() -> None:
    (ours, theirs), ends = pair(autoreset_mode="SameStep", max_steps=30), 0
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert Forests(1).metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    same_step(ours.reset(seed=40), theirs.reset(seed=40))
    rng = np.random.default_rng(0)
    for _ in range(100):
        actions = rng.integers(9, size=3)
        a = ours.step(actions)
        for i in range(3):  # lead theirs into the forest that ours has drawn
            forest = int(a[4]["forest"][i])
            theirs.envs[i].unwrapped.numbers = range(forest, forest + 1)
        b = theirs.step(actions)
        over = a[2] | a[3]
        assert ("final_obs" in a[4]) == over.any()
        for i in np.flatnonzero(over):
            assert np.array_equal(a[4]["final_obs"][i], b[4]["final_obs"][i])
            assert not a[4]["is_success"][i] and a[4]["progress"][i] == 0
        for infos in (a[4], b[4]):
            infos.pop("final_obs", None)
        same_step(a, b)
        ends += over.sum()
    assert ends > 9


def test_the_statistics_of_a_vector_begin_anew_where_a_mask_does() -> None:
    envs = RecordEpisodeStatistics(Forests(2, max_steps=3, autoreset_mode="Disabled"))
    envs.reset(seed=1)
    envs.step(np.array([4, 4]))
    envs.reset(options={"reset_mask": np.array([True, False])})
    lengths = []
    for mask in ([False, True], [True, False]):
        while not np.any((step := envs.step(np.array([4, 4])))[3]):
            pass
        lengths.append(list(step[4]["episode"]["l"]))
        envs.reset(options={"reset_mask": np.array(mask)})
    assert lengths == [[0, 3], [3, 0]]


def test_a_mask_before_all_drones_have_begun_leaves_none_out() -> None:
    infos = Forests(2).reset(seed=3, options={"reset_mask": np.array([True, False])})[1]
    assert list(infos["forest"]) == [3, 4]


def test_an_unknown_autoreset_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="'Sometimes'"):
        gymnasium.make_vec(ID, num_envs=2, autoreset_mode="Sometimes")


def test_the_statistics_of_a_vector_are_the_sums_of_its_rewards() -> None:
    envs, total = RecordEpisodeStatistics(Forests(2, max_steps=3)), np.zeros(2)
    envs.reset(seed=1)
    for _ in range(3):
        _, rewards, *_, infos = envs.step(np.array([4, 4]))
        total += rewards
    assert np.allclose(infos["episode"]["r"], total) and list(infos["episode"]["l"]) == [3, 3]
