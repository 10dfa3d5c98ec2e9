"""Train with Stable-Baselines3's DQN instead of dqn.py, and fly the result with our `eval`.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.sb3_train --steps 100000
    extras/.venv/bin/python deepflight.py eval --weights runs/sb3.pt

The environment, the network, the batch, the ratio of updates to steps and the schedules are those
of dqn.DQNConfig; the optimizer is Adam with our epsilon. What Stable-Baselines3 does not have,
the training goes without: Double DQN, mirroring, our additions to the reward, bfloat16, averaged
weights, and our wider loss. It keeps s and s2 whole, 56.4 kB a transition, so the
replay here is 50,000 transitions, 2.8 GB, a quarter of ours.

Every hundred flights it prints their mean return and length. Every 5,000 steps it flies 24 forests
of the test range without random actions, and prints the same of them as `eval/`. The weights that
it writes are the last ones. Ctrl-C writes those so far.
"""

import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from deepflight import WEIGHTS, Parser, RunConfig, configure, place
from dqn import DQNConfig, QNetwork, check_output, linear_schedule, save_weights
from env import say
from extras.bridges.gym_env import Forest

REPLAY = 50_000  # transitions
TESTS = 24  # flights of a test
ADAM_EPSILON = 1.5e-4  # that of dqn.make_optimizer
NAMES = {  # theirs -> ours
    "features_extractor.cnn.": "conv.",
    "features_extractor.linear.0": "head.0",
    "q_net.0": "head.2",
}


def make_envs(c: DQNConfig, r: RunConfig, forests: str) -> VecMonitor:
    """Drones side by side in "training" or "test" forests; a VecMonitor counts their returns."""
    return VecMonitor(DummyVecEnv([lambda: Forest(forests=forests, beacon=r.beacon)] * c.num_envs))


def make_model(c: DQNConfig, r: RunConfig, replay: int = REPLAY) -> DQN:
    """Stable-Baselines3's DQN with the settings of `c` and `r` as far as it knows them."""
    return DQN(
        "CnnPolicy",
        make_envs(c, r, "training"),
        learning_rate=lambda left: linear_schedule(1 - left, c.lr, c.lr * c.lr_decay, 1),
        buffer_size=replay,
        learning_starts=c.learning_starts,
        batch_size=c.batch_size,
        gamma=c.gamma,
        n_steps=c.n_steps,
        train_freq=1,
        gradient_steps=c.num_envs // c.update_every,
        target_update_interval=c.target_every * c.update_every,
        exploration_fraction=c.epsilon_decay / c.steps,
        exploration_initial_eps=1.0,
        exploration_final_eps=c.epsilon_final,
        max_grad_norm=math.inf,  # ours cuts no gradient
        policy_kwargs={"optimizer_kwargs": {"eps": ADAM_EPSILON}},
        seed=r.seed,
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


def make_test(c: DQNConfig, r: RunConfig) -> EvalCallback:
    """Stable-Baselines3's own test: some flights through test forests every `test_every` steps."""
    envs = make_envs(c, r, "test")
    envs.seed(r.seed)
    return EvalCallback(envs, n_eval_episodes=TESTS, eval_freq=r.test_every // c.num_envs)


def train(c: DQNConfig, r: RunConfig, out: Path) -> int:
    """Train, convert, save, even if Ctrl-C ends the training. Returns the exit code, 0 or 130."""
    torch.set_num_threads(r.threads)
    model, end, code = make_model(c, r), "", 0
    try:
        model.learn(c.steps, make_test(c, r), log_interval=100)
    except KeyboardInterrupt:
        end, code = f"\ninterrupted at step {model.num_timesteps:,}; ", 130
    out.parent.mkdir(parents=True, exist_ok=True)
    save_weights(out, convert(model), beacon=r.beacon, camera=r.camera)
    fly = ["deepflight.py", "eval", *["--beacon"] * r.beacon, "--weights", str(out)]
    say(f"{end}wrote {out}; fly it: python {shlex.join(fly)}")
    return code


def parse(argv: Sequence[str] | None) -> tuple[DQNConfig, RunConfig, Path]:
    """Read and check the command line. Raises ValueError."""
    parser = Parser(prog="sb3_train", description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=DQNConfig.steps, help="control steps in all")
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--out", type=place, default="runs/sb3.pt", help="the weights' file")
    args = parser.parse_args(argv)
    check_output(args.out, WEIGHTS)
    return *configure({"steps": args.steps, "beacon": args.beacon}), args.out


def main(argv: Sequence[str] | None = None) -> int:
    """Check all that is given, then train. Exit codes: 2 bad input, 1 trouble on the way, 130
    Ctrl-C; each comes with one line."""
    try:
        settings = parse(argv)
    except ValueError as error:
        print(f"sb3_train: error: {error}", file=sys.stderr)
        return 2
    try:
        return train(*settings)
    except (MemoryError, FloatingPointError, OSError) as error:
        print(f"sb3_train: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; no weights are written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
