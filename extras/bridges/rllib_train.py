"""Train on Ray RLlib's DQN, where one machine is not enough, and fly the result in our `eval`.

    extras/.venv/bin/pip install -r extras/requirements.txt
    extras/.venv/bin/python -m extras.bridges.rllib_train --runners 2 --steps 100000  # a Ray here
    extras/.venv/bin/python -m extras.bridges.rllib_train --runners 64 --address auto  # join others
    extras/.venv/bin/python deepflight.py eval --weights runs/rllib.pt

The network is dqn.QNetwork itself, inside RLlib's current API stack: its convolutions are the
encoder, its head the Q-function, so the trained weights are ours as they are. Settings are those
of dqn.DQNConfig; RLlib has no mirroring, additions to the reward, averaged weights, bfloat16 or
late Huber delta.

On a real cluster, which we have not tried: start Ray on every machine (`ray start --head` on one,
`ray start --address HOST:6379` on the others), with this Python and these packages on each; the
code travels from here. Runners share the flying, which is cheap. Learning stays in one process, a
batch of 32 every 4 steps however many runners there are, and is the limit at once: two runners on
two cores flew 790 steps a second while nothing learned and 80 once it did. What helps then is a GPU
for the learner (`.learners(num_learners=1, num_gpus_per_learner=1)`), larger batches, or many seeds
at once. The replay of 50,000 transitions lies in this machine's memory; Ray logs to ~/ray_results.
"""

import argparse
from pathlib import Path
from typing import Any

import ray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.dqn import DQNConfig as RayConfig
from ray.rllib.algorithms.dqn.default_dqn_rl_module import QF_PREDS
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils.schedules.scheduler import Scheduler
from ray.tune.registry import register_env
from torch import Tensor, nn

from deepflight import RunConfig
from dqn import DQNConfig, QNetwork, save_weights
from extras.bridges.gym_env import ID, Forest

ROOT = Path(__file__).parents[2]
ENVS = 4  # forests a runner flies at once
REPLAY = 50_000  # transitions, 28 kB each
ADAM_EPSILON = 1.5e-4  # that of dqn.make_optimizer


class Nature(DefaultDQNTorchRLModule):
    """RLlib's DQN module around our network: encoder = convolutions, af = the Q head."""

    def setup(self) -> None:
        """Build the network, in place of the one that RLlib's catalog would."""
        self.uses_dueling, self.uses_double_q, self.num_atoms = False, DQNConfig.double, 1
        self.epsilon_schedule = Scheduler(self.model_config["epsilon"], framework="torch")
        q = QNetwork(self.action_space.n)
        self.encoder, self.af = q.conv, q.head

    def _qf_forward_helper(
        self, batch: dict[str, Tensor], encoder: nn.Module, head: nn.Module
    ) -> dict[str, Tensor]:
        return {QF_PREDS: head(encoder(batch[Columns.OBS].float() / 255))}  # (B, actions)


def make_config(c: DQNConfig, r: RunConfig, runners: int) -> RayConfig:
    """RLlib's DQN with the settings of `c` and `r` as far as it knows them."""
    replay = {"type": "EpisodeReplayBuffer", "capacity": REPLAY}
    epsilon = [[0, 1.0], [c.epsilon_decay, c.epsilon_final]]
    # RLlib counts one runner too many when it works out how often to learn.
    intensity = c.batch_size / c.update_every * runners / (runners + 1)
    return (
        RayConfig()
        .environment(ID)
        .env_runners(
            num_env_runners=runners, num_envs_per_env_runner=ENVS, rollout_fragment_length=c.n_steps
        )
        .rl_module(rl_module_spec=RLModuleSpec(module_class=Nature))
        .training(
            lr=[[0, c.lr], [c.steps, c.lr * c.lr_decay]],
            gamma=c.gamma,
            n_step=c.n_steps,
            double_q=c.double,
            dueling=False,
            num_atoms=1,
            epsilon=epsilon,
            train_batch_size_per_learner=c.batch_size,
            training_intensity=intensity,
            num_steps_sampled_before_learning_starts=c.learning_starts,
            target_network_update_freq=c.target_every * c.update_every,
            td_error_loss_fn="huber",
            adam_epsilon=ADAM_EPSILON,
            grad_clip=c.max_grad_norm,
            grad_clip_by="global_norm",
            replay_buffer_config=replay,
        )
        .debugging(seed=r.seed)
    )


def network(algorithm: Algorithm) -> QNetwork:
    """The network as our own class."""
    module: Any = algorithm.get_module()
    q = QNetwork(module.action_space.n)
    q.conv.load_state_dict(module.encoder.state_dict())
    q.head.load_state_dict(module.af.state_dict())
    return q


def train(c: DQNConfig, r: RunConfig, runners: int, out: Path) -> None:
    """Train for c.steps, with a line each thousand steps or so, and write the weights."""
    register_env(ID, lambda _context: Forest(beacon=r.beacon))
    algorithm, steps = make_config(c, r, runners).build_algo(), 0
    while steps < c.steps:
        result = algorithm.train()
        flown, seconds = result["env_runners"], result["time_total_s"]
        steps = int(flown["num_env_steps_sampled_lifetime"])
        left = (c.steps - steps) * seconds / steps / 60
        text = f"{steps:9,} steps, {steps / seconds:5.0f} a second, {left:5.1f} min left"
        print(f"{text}, flights of {flown.get('episode_len_mean', 0):.1f} steps", flush=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_weights(out, network(algorithm), beacon=r.beacon)
    algorithm.stop()
    print(f"wrote {out}; fly it: deepflight.py eval{' --beacon' * r.beacon} --weights {out}")


def start(address: str | None) -> None:
    """Join the Ray at this address, or start one here; every runner gets the code."""
    code = {"working_dir": str(ROOT), "excludes": [".venv", "runs", "results", "figures"]}
    ray.init(
        address=address or "local", runtime_env=code, include_dashboard=False, log_to_driver=False
    )


def main() -> None:
    """Join or start a Ray, train, and stop it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runners", type=int, default=2, help="processes that fly")
    parser.add_argument("--steps", type=int, default=DQNConfig.steps, help="control steps in all")
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--address", help="of a running Ray; else one is started here")
    parser.add_argument("--out", type=Path, default="runs/rllib.pt", help="the weights' file")
    args = parser.parse_args()
    if args.runners < 1:
        parser.error(f"runners is {args.runners}, allowed: 1 or more")
    start(args.address)
    try:
        c, r = DQNConfig(steps=args.steps), RunConfig(beacon=args.beacon)
        train(c, r, args.runners, args.out)
    finally:
        ray.shutdown()


if __name__ == "__main__":
    main()
