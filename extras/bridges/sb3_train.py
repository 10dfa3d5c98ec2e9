"""Train with Stable-Baselines3's DQN instead of dqn.py, and fly the result with our `eval`.

    extras/.venv/bin/python -m extras.bridges.sb3_train --steps 100000
    extras/.venv/bin/python deepflight.py eval --weights runs/sb3.pt

The environment, the network, the batch, the ratio of updates to steps and the schedules are those
of dqn.DQNConfig; the optimizer is Adam. What Stable-Baselines3 does not have, the training goes
without: Double DQN, mirroring, our shaped reward, bfloat16, averaged weights, and our wider loss.
It keeps s and s2 whole, 56.4 kB a transition, so the replay here is 50,000 transitions, 2.8 GB, a
quarter of ours.

Every hundred episodes it prints their mean return and length, and as success_rate the share that
crossed. Every 5,000 steps it flies the same 24 validation forests without random actions, and
prints the same of them as `eval/`. It writes the last weights, and to runs/sb3-best.pt the best of
validation by the score of deepflight.Run. Ctrl-C, SIGTERM and SIGUSR1 write those so far.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from deepflight import Config, save_weights
from dqn import InputError, QNetwork, linear_schedule
from extras.bridges.gym_env import Forest
from extras.bridges.signals import ended_by_signals

REPLAY = 50_000  # transitions
VALIDATION = 24  # episodes
ADAM_EPSILON = 1.5e-4  # that of dqn.Agent at huber_delta 1
NAMES = {"features_extractor.cnn.": "conv.", "features_extractor.linear.0": "head.0",
         "q_net.0": "head.2"}  # fmt: skip  # theirs -> ours


@dataclass(frozen=True)
class SB3Config(Config):
    """Our settings, as far as Stable-Baselines3 knows them."""

    pilot: ClassVar[str] = "sb3"


def make_envs(c: Config, forests: str) -> VecMonitor:
    """Drones side by side in "training" or "validation" forests; a VecMonitor counts returns."""
    return VecMonitor(DummyVecEnv([lambda: Forest(forests=forests, beacon=c.beacon)] * c.num_envs))


def make_model(c: Config, replay: int = REPLAY) -> DQN:
    """Stable-Baselines3's DQN with the settings of `c`."""
    return DQN(
        "CnnPolicy", make_envs(c, "training"), buffer_size=replay,
        learning_rate=lambda left: linear_schedule(1 - left, c.lr, c.lr * c.lr_final, 1),
        learning_starts=c.learning_starts, batch_size=c.batch_size, gamma=c.gamma,
        n_steps=c.n_steps, train_freq=1, gradient_steps=c.num_envs // c.update_every,
        target_update_interval=c.target_every, exploration_fraction=c.epsilon_decay / c.steps,
        exploration_initial_eps=1.0, exploration_final_eps=c.epsilon_final,
        max_grad_norm=math.inf,  # ours cuts no gradient
        policy_kwargs={"optimizer_kwargs": {"eps": ADAM_EPSILON}}, seed=c.seed, device="cpu",
        verbose=1,
    )  # fmt: skip


def convert(model: DQN) -> QNetwork:
    """The trained network as ours: the layers are the same, the names are not."""
    state = {}
    for name, value in model.q_net.state_dict().items():
        theirs = next(prefix for prefix in NAMES if name.startswith(prefix))
        state[NAMES[theirs] + name.removeprefix(theirs)] = value
    q = QNetwork(model.action_space.n)
    q.load_state_dict(state)
    return q


class Validation(EvalCallback):
    """Stable-Baselines3's own, but in the same forests each time. It writes the weights of the best
    score: the share that crossed (with the beacon: arrived), then the progress."""

    def __init__(self, c: Config, best: Path) -> None:
        every, envs = min(c.validate_every, c.steps) // c.num_envs, make_envs(c, "validation")
        super().__init__(envs, n_eval_episodes=VALIDATION, eval_freq=every, verbose=0)
        self.c, self.best, self.score = c, best, (-1.0, 0.0)

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        if locals_["done"]:
            info = locals_["info"]
            share = info["outcome"] == "goal" if self.c.beacon else info["is_success"]
            self.ended.append((share, info["progress"]))

    def _on_step(self) -> bool:
        self.ended: list[tuple[bool, float]] = []
        self.eval_env.seed(self.c.seed)  # holds from the next reset on, which begins a validation
        going = super()._on_step()
        if self.ended and (score := tuple(np.mean(self.ended, 0))) > self.score:
            save_weights(self.best, convert(self.model), self.c)
            self.score = score
        return going


def train(c: Config, out: Path) -> int:
    """Train, convert, save, even if a signal ends the training. Returns 0, or 128 + the signal."""
    torch.set_num_threads(c.threads)
    model, end = make_model(c, min(REPLAY, c.steps)), ""
    validation = Validation(c, out.with_stem(f"{out.stem}-best"))
    with ended_by_signals() as stopped:
        try:
            print(f"{c.steps:,} steps, from {c.learning_starts:,} on it learns", flush=True)
            model.learn(c.steps, validation, log_interval=100)
        except KeyboardInterrupt:
            end = f"\ninterrupted at step {model.num_timesteps:,}; "
        save_weights(out, convert(model), c)
    best = f", and the best of validation, {validation.best}" if validation.score[0] >= 0 else ""
    print(f"{end}wrote {out}{best}; fly it: python deepflight.py eval --weights {out}")
    return 128 + stopped[0] if stopped else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Check what is given, then train. Trouble comes with one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="sb3_train", usage=argparse.SUPPRESS)
    parser.add_argument("--steps", type=int, default=Config.steps, help="control steps in all")
    parser.add_argument("--learning-starts", type=int, default=Config.learning_starts,
                        help="step of the first update, at most half of --steps")  # fmt: skip
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--out", type=Path, default="runs/sb3.pt", help="the weights' file")
    args = parser.parse_args(argv)
    try:
        starts = min(args.learning_starts, args.steps // 2)  # so that it learns something
        c = SB3Config(steps=args.steps, beacon=args.beacon, learning_starts=starts)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.open("ab").close()  # better to fail now than after the training
        return train(c, args.out)
    except (InputError, MemoryError, OSError) as error:
        print(f"sb3_train: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
