"""Train with Stable-Baselines3's DQN instead of dqn.py, and fly the result with our `eval`.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.sb3_train --steps 100000
    extras/.venv/bin/python deepflight.py eval --weights runs/sb3.pt

The environment, the network, the batch, the ratio of updates to steps and the schedules are those
of dqn.DQNConfig; the optimizer is Adam with our epsilon. What Stable-Baselines3 does not have,
the training goes without: Double DQN, mirroring, our additions to the reward, bfloat16, averaged
weights, and the late change of Huber's delta. It keeps s and s2 whole, 56.4 kB a transition, so the
replay here is 50,000 transitions, 2.8 GB, a quarter of ours.
"""

import argparse
from pathlib import Path

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv

from deepflight import RunConfig
from dqn import DQNConfig, QNetwork, linear_schedule, save_weights
from extras.bridges.gym_env import Forest

REPLAY = 50_000  # transitions
ADAM_EPSILON = 1.5e-4  # that of dqn.make_optimizer
NAMES = {  # theirs -> ours
    "features_extractor.cnn.": "conv.",
    "features_extractor.linear.0": "head.0",
    "q_net.0": "head.2",
}


def make_model(c: DQNConfig, r: RunConfig, replay: int = REPLAY) -> DQN:
    """Stable-Baselines3's DQN with the settings of `c` and `r` as far as it knows them."""
    envs = DummyVecEnv([lambda: Forest(beacon=r.beacon)] * c.num_envs)
    return DQN(
        "CnnPolicy",
        envs,
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
        max_grad_norm=c.max_grad_norm,
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


def main() -> None:
    """Train, convert, save."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=DQNConfig.steps, help="control steps in all")
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--out", type=Path, default="runs/sb3.pt", help="the weights' file")
    args = parser.parse_args()
    c, r = DQNConfig(steps=args.steps), RunConfig(beacon=args.beacon)
    torch.set_num_threads(r.threads)
    model = make_model(c, r).learn(c.steps, log_interval=100)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_weights(args.out, convert(model), beacon=r.beacon)
    beacon = " --beacon" if r.beacon else ""
    print(f"wrote {args.out}; fly it: python deepflight.py eval{beacon} --weights {args.out}")


if __name__ == "__main__":
    main()
