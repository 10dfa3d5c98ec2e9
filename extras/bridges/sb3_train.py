"""Train with Stable-Baselines3's DQN instead of dqn.py, and fly the result with our `eval`.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.sb3_train --steps 100000
    extras/.venv/bin/python deepflight.py eval --weights runs/sb3.pt

The environment, the network, the batch, the ratio of updates to steps and the schedules are those
of dqn.DQNConfig; the optimizer is Adam. What Stable-Baselines3 does not have, the training goes
without: Double DQN, mirroring, our shaped reward, bfloat16, averaged weights, and our wider loss.
It keeps s and s2 whole, 56.4 kB a transition, so the replay here is 50,000 transitions, 2.8 GB, a
quarter of ours.

Every hundred episodes it prints their mean return and length. Every 5,000 steps it flies 24
validation forests without random actions, and prints the same of them as `eval/`. The weights that
it writes are the last ones. Ctrl-C writes those so far.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from deepflight import Config, save_weights
from dqn import InputError, QNetwork, linear_schedule
from extras.bridges.gym_env import Forest

REPLAY = 50_000  # transitions
VALIDATION = 24  # episodes
ADAM_EPSILON = 1.5e-4  # that of dqn.Agent at huber_delta 1
NAMES = {  # theirs -> ours
    "features_extractor.cnn.": "conv.",
    "features_extractor.linear.0": "head.0",
    "q_net.0": "head.2",
}


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
        "CnnPolicy",
        make_envs(c, "training"),
        learning_rate=lambda left: linear_schedule(1 - left, c.lr, c.lr * c.lr_final, 1),
        buffer_size=replay,
        learning_starts=c.learning_starts,
        batch_size=c.batch_size,
        gamma=c.gamma,
        n_steps=c.n_steps,
        train_freq=1,
        gradient_steps=c.num_envs // c.update_every,
        target_update_interval=c.target_every,
        exploration_fraction=c.epsilon_decay / c.steps,
        exploration_initial_eps=1.0,
        exploration_final_eps=c.epsilon_final,
        max_grad_norm=math.inf,  # ours cuts no gradient
        policy_kwargs={"optimizer_kwargs": {"eps": ADAM_EPSILON}},
        seed=c.seed,
        device="cpu",
        verbose=1,
    )


def convert(model: DQN) -> QNetwork:
    """The trained network as ours: the layers are the same, the names are not."""
    state = {}
    for name, value in model.q_net.state_dict().items():
        theirs = next(prefix for prefix in NAMES if name.startswith(prefix))
        state[NAMES[theirs] + name.removeprefix(theirs)] = value
    q = QNetwork(model.action_space.n)
    q.load_state_dict(state)
    return q


def make_validation(c: Config) -> EvalCallback:
    """Stable-Baselines3's own: some episodes every `validate_every` steps."""
    envs = make_envs(c, "validation")
    envs.seed(c.seed)
    return EvalCallback(envs, n_eval_episodes=VALIDATION, eval_freq=c.validate_every // c.num_envs)


def train(c: Config, out: Path) -> int:
    """Train, convert, save, even if Ctrl-C ends the training. Returns the exit code, 0 or 130."""
    torch.set_num_threads(c.threads)
    model, end, code = make_model(c), "", 0
    try:
        model.learn(c.steps, make_validation(c), log_interval=100)
    except KeyboardInterrupt:
        end, code = f"\ninterrupted at step {model.num_timesteps:,}; ", 130
    save_weights(out, convert(model), c)
    print(f"{end}wrote {out}; fly it: python deepflight.py eval --weights {out}")
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """Check what is given, then train. Trouble comes with one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="sb3_train", usage=argparse.SUPPRESS)
    parser.add_argument("--steps", type=int, default=Config.steps, help="control steps in all")
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--out", type=Path, default="runs/sb3.pt", help="the weights' file")
    args = parser.parse_args(argv)
    try:
        c = SB3Config(steps=args.steps, beacon=args.beacon)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.open("ab").close()  # better to fail now than after the training
        return train(c, args.out)
    except (InputError, MemoryError, OSError) as error:
        print(f"sb3_train: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
