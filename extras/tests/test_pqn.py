"""Lambda-returns against brute force, and PQN's trainings cut and resumed."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import deepflight
from env import World
from extras.lessons import pqn
from extras.lessons.pqn import PQNConfig, QNetwork, Rollout, lambda_returns, minibatches
from extras.tests.test_expert import assert_same_training, finish, little_to_fly

__all__ = ["little_to_fly"]  # a fixture of all tests here too
GAMMA, T, L = 0.9, 7, 50
SMALL = {"num_envs": 8, "rollout": 4, "batch_size": 16}


def random_rollout(ends: float = 0.2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """r, v2, terminated, truncated (T, L); a share of `ends` of the rows end by each."""
    torch.manual_seed(0)
    r, v2, kind = torch.randn(T, L), torch.randn(T, L), torch.rand(T, L)
    return r, v2, kind < ends, (kind >= ends) & (kind < 2 * ends)


def n_step(rows: list[tuple], n: int) -> float:
    """n rewards, then the estimate, unless the last of them terminated the episode."""
    terminated, v2 = rows[n - 1][2], rows[n - 1][1]
    rewards = sum(GAMMA**k * r for k, (r, *_) in enumerate(rows[:n]))
    return rewards + (0 if terminated else GAMMA**n * v2)


def mixture(rows: list[tuple], lam: float) -> float:
    """The lambda-return by its definition: a weighted mean of all n-step returns up to the first
    end, or the rollout's. Return n weighs (1 - lam) * lam^(n-1), and the last one all the rest."""
    last = next((n for n, row in enumerate(rows, 1) if row[2] or row[3]), len(rows))
    returns = [n_step(rows, n) for n in range(1, last + 1)]
    weights = [(1 - lam) * lam ** (n - 1) for n in range(1, last)] + [lam ** (last - 1)]
    return sum(w * g for w, g in zip(weights, returns, strict=True))


@pytest.mark.parametrize("lam", [0.0, 0.3, 0.65, 1.0])
def test_the_backward_recursion_is_the_mixture_of_all_n_step_returns(lam: float) -> None:
    rollout = random_rollout()
    returns = lambda_returns(*rollout, GAMMA, lam)
    columns = [x.tolist() for x in rollout]
    for t in range(T):
        for env in range(L):
            rows = [tuple(x[k][env] for x in columns) for k in range(t, T)]
            assert returns[t, env].item() == pytest.approx(mixture(rows, lam), abs=1e-5)


def test_lambda_0_is_the_td_target() -> None:
    r, v2, terminated, truncated = random_rollout()
    y = r + GAMMA * torch.where(terminated, 0.0, v2)
    assert torch.allclose(lambda_returns(r, v2, terminated, truncated, GAMMA, 0.0), y)


def test_lambda_1_is_the_return_that_was_flown_up_to_the_end_of_the_rollout() -> None:
    r, v2, no, _ = random_rollout(ends=0.0)
    flown = sum(GAMMA**t * r[t] for t in range(T)) + GAMMA**T * v2[-1]
    assert torch.allclose(lambda_returns(r, v2, no, no, GAMMA, 1.0)[0], flown, atol=1e-5)


def test_a_crash_stops_the_bootstrap_and_the_time_limit_does_not() -> None:
    r, v2, no = torch.tensor([[1.0], [2.0]]), torch.tensor([[10.0], [20.0]]), torch.zeros(2, 1) > 0
    first = torch.tensor([[True], [False]])
    crash, late = (
        lambda_returns(r, v2, first, no, 0.5, 0.8),
        lambda_returns(r, v2, no, first, 0.5, 0.8),
    )
    assert crash.flatten().tolist() == [1.0, 2 + 0.5 * 20]
    assert late.flatten().tolist() == [1 + 0.5 * 10, 2 + 0.5 * 20]


def test_a_full_rollout_is_forgotten_when_the_next_row_comes() -> None:
    rollout, kept = Rollout(3), []
    for i in range(7):
        rollout.add(np.array([i]), np.array([-i]))
        kept.append(rollout.tensors()[0].flatten().tolist())
    assert kept == [[0], [0, 1], [0, 1, 2], [3], [3, 4], [3, 4, 5], [6]]


def test_each_transition_is_learned_from_once_in_each_epoch() -> None:
    batches = list(minibatches(32, PQNConfig(**SMALL), np.random.default_rng(0)))
    assert [len(i) for i in batches] == [16] * 4
    for half in (batches[:2], batches[2:]):
        assert sorted(torch.cat(half).tolist()) == list(range(32))


def test_normalized_layers_do_not_grow_with_what_enters_them() -> None:
    q, x = QNetwork(9), torch.randn(2, 32, 20, 20)
    layer = q.conv[1](x)
    assert torch.allclose(layer, q.conv[1](10 * x), atol=1e-3)
    assert torch.allclose(layer.flatten(1).mean(1), torch.zeros(2), atol=1e-5)
    assert torch.allclose(layer.flatten(1).std(1), torch.ones(2), atol=1e-3)


@pytest.mark.parametrize("config", [PQNConfig, pqn.PlainConfig])
def test_a_training_cut_inside_a_rollout_and_resumed_is_uninterrupted(
    config: type, tmp_path: Path
) -> None:
    c = config(**SMALL, steps=240)
    whole = finish(c, tmp_path / "whole")
    cut = finish(c, tmp_path / "cut", cuts=(8, 32, 112, 120, 232))
    assert_same_training(whole, cut)
    for a, b in zip(whole.replay.tensors(), cut.replay.tensors(), strict=True):
        assert torch.equal(a, b)


def test_weights_say_which_lesson_flies_them(tmp_path: Path) -> None:
    deepflight.save_weights(tmp_path / "pqn.pt", q := QNetwork(9), PQNConfig())
    again, *rest = deepflight.load_weights(tmp_path / "pqn.pt", PQNConfig.network)
    assert rest == [World(), "pqn"]
    s = torch.randint(256, (2, 4, 84, 84), dtype=torch.uint8)
    assert torch.equal(again(s), q.half().float()(s))
    with pytest.raises(deepflight.InputError, match="another network: pqn"):
        deepflight.load_weights(tmp_path / "pqn.pt")
