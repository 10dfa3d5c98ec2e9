"""mnih.py: the optimizer and the settings of [Mnih15], Nature 518, Extended Data Table 1.

    python -m extras.lessons.mnih train            his settings; 1.4 million steps, as in the paper
    python -m extras.lessons.mnih textbook train   no piece marked [+] in dqn.py, but Adam, and our
                                                   shorter training

Left as it is in dqn.py is what only saves time, eight environments side by side, and that rewards
are not cut to [-1, 1], because a crash would then count no more than being near a trunk.

Mnih's RMSprop moves a weight with gradient g by -lr * g / sqrt(variance + epsilon). The variance is
the running mean of g^2 less the square of the running mean of g. A running mean goes 5 % of the way
to each number that comes. In numbers: both means begin at 0, and g = 2. The mean of g becomes 0.1,
that of g^2 0.2, so the variance is 0.2 - 0.01 = 0.19, and with lr = 0.1 the weight moves by
-0.1 * 2 / sqrt(0.19) = -0.46. All weights move about equally fast, as with Adam.

His table has a "gradient momentum" of 0.95 and a "squared gradient momentum" of 0.95. Both are
decay factors of these means. PyTorch's own RMSprop with momentum 0.95 is another algorithm: there
each move goes on with 0.95 of the last one, which makes it 6 to 10 times as strong.
"""

import sys
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

import deepflight
import dqn
from env import VecForest
from extras.lessons import recipe

TextbookConfig = recipe(
    "TextbookConfig", deepflight.Config, command="python -m extras.lessons.mnih textbook",
    double=False, n_steps=1, mirror=False, huber_delta=1.0,
    lr_decay=1.0, swa_fraction=0.0, forward_reward=0.0, goal_bonus=0.0, far_bonus=0.0,
)  # fmt: skip

# Mnih's table says that the target network is synced every 10,000 updates. His code does it every
# 10,000 steps. We follow the code.
MnihConfig = recipe(
    "MnihConfig", TextbookConfig, pilot="mnih", command="python -m extras.lessons.mnih",
    steps=1_400_000, replay_size=1_000_000, learning_starts=50_000,
    target_every=10_000, epsilon_final=0.1, epsilon_decay=1_000_000,
)  # fmt: skip


class RMSprop(torch.optim.Optimizer):
    """Mnih's, as the header says. His epsilon (not that of exploring) is 0.01 for the gradient of
    a sum over 32 transitions. Ours is that of a mean, so our epsilon is 0.01 / 32^2."""

    def __init__(self, weights: Iterable[Tensor], lr: float) -> None:
        super().__init__(weights, {"lr": lr})
        for w in self.param_groups[0]["params"]:
            self.state[w] = {"mean": torch.zeros_like(w), "mean_square": torch.zeros_like(w)}

    @torch.no_grad()
    def step(self) -> None:
        """Move every weight once."""
        for w in self.param_groups[0]["params"]:
            mean, mean_square = self.state[w]["mean"], self.state[w]["mean_square"]
            mean.lerp_(w.grad, 0.05)
            mean_square.lerp_(w.grad.square(), 0.05)
            deviation = (mean_square - mean.square()).add_(0.01 / 32**2).sqrt_()
            w.addcdiv_(w.grad, deviation, value=-self.param_groups[0]["lr"])


def train(
    c: deepflight.Config, envs: VecForest, rng: dqn.Generator, shaped: Callable
) -> Iterator[tuple]:
    """dqn.train with Mnih's optimizer, in float32."""
    dqn.BFLOAT16 = False
    loop = dqn.train(c, envs, rng, shaped)
    agent, replay = next(loop)
    agent.optimizer = RMSprop(agent.q.parameters(), c.lr)
    yield agent, replay
    yield from loop


MnihConfig.train = staticmethod(train)


def main() -> int:
    """The command line of deepflight.py."""
    if sys.argv[1:2] == ["textbook"]:
        return deepflight.main(sys.argv[2:], TextbookConfig)
    dqn.BFLOAT16 = False  # here too, because a checkpoint that goes on must have the same
    return deepflight.main(sys.argv[1:], MnihConfig)


if __name__ == "__main__":
    sys.exit(main())
