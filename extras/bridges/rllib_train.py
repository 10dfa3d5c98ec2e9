"""Train on Ray RLlib's DQN, where one machine is not enough, and fly the result in our `eval`.

    extras/.venv/bin/python -m extras.bridges.rllib_train --runners 2 --steps 100000  # a Ray here
    extras/.venv/bin/python -m extras.bridges.rllib_train --runners 64 --address HOST:6379  # join
    extras/.venv/bin/python deepflight.py eval --weights runs/rllib.pt

The network is dqn.QNetwork itself, inside RLlib's current API stack: its convolutions are the
encoder, its head the Q-function, so the trained weights are ours as they are. Settings are those
of dqn.DQNConfig; RLlib has no mirroring, shaped reward, averaged weights, bfloat16 or wider loss.

Runners share the flying, which is cheap. Learning stays in one process, a batch of 32 every 4 steps
however many runners there are, and is the limit at once. What helps then is a GPU for the learner
(`.learners(num_learners=1, num_gpus_per_learner=1)`), larger batches, or many seeds at once. The
replay of 50,000 transitions lies in this machine's memory; Ray logs to ~/ray_results.

At the end the script prints how many steps a second each node added. If a node dies, the others fly
on, and its runners start again where a CPU is free. The node of this script must live: it holds the
learner and the replay; Ctrl-C, SIGTERM, SIGUSR1 write the weights. A test kills one of three nodes.
Send a signal to this script alone: if Ray's own processes end first, they end it unsaved.

We did not try a cluster of several machines. There, start Ray on every machine (`ray start --head`
on one, `ray start --address HOST:6379` on the others), with this Python and these packages on each,
and run the script on one of them; the code travels from here.
"""

import argparse
import logging
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import ray
from ray.exceptions import RayError
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.dqn import DQNConfig as RayConfig
from ray.rllib.algorithms.dqn.default_dqn_rl_module import QF_PREDS
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.utils.schedules.scheduler import Scheduler
from ray.tune.registry import register_env
from torch import Tensor, nn

from deepflight import Config, save_weights
from dqn import InputError, QNetwork
from extras.bridges.gym_env import ID, Forest
from extras.bridges.signals import ended_by_signals

ROOT = Path(__file__).parents[2]
ENVS = 4  # drones of a runner
REPLAY = 50_000  # transitions, 28 kB each
ADAM_EPSILON = 1.5e-4  # that of dqn.Agent at huber_delta 1
PROBE = 0.05  # s to wait, before each batch, for a lost runner that may be back
ANSWER = 20  # s within which a Ray must answer


@dataclass(frozen=True)
class RLlibConfig(Config):
    """Our settings, as far as RLlib knows them."""

    pilot: ClassVar[str] = "rllib"


class Nature(DefaultDQNTorchRLModule):
    """RLlib's DQN module around our network: encoder = convolutions, af = the Q head."""

    def setup(self) -> None:
        """Build the network, in place of the one that RLlib's catalog would."""
        self.uses_dueling, self.uses_double_q, self.num_atoms = False, Config.double, 1
        self.epsilon_schedule = Scheduler(self.model_config["epsilon"], framework="torch")
        q = QNetwork(self.action_space.n)
        self.encoder, self.af = q.conv, q.head

    def _qf_forward_helper(
        self, batch: dict[str, Tensor], encoder: nn.Module, head: nn.Module
    ) -> dict[str, Tensor]:
        return {QF_PREDS: head(encoder(batch[Columns.OBS].float() / 255))}  # (B, actions)


def count(env_runner: Any, metrics_logger: Any, samples: Sequence[Any], **_: Any) -> None:
    """Count the steps of a sample under the node on which the runner lives; RLlib calls this."""
    key = ("nodes", ray.get_runtime_context().get_node_id(), str(env_runner.worker_index))
    metrics_logger.log_value(key, sum(map(len, samples)), reduce="lifetime_sum")


def make_config(c: Config, runners: int) -> RayConfig:
    """RLlib's DQN with the settings of `c`."""
    replay = {"type": "EpisodeReplayBuffer", "capacity": REPLAY}
    epsilon = [[0, 1.0], [c.epsilon_decay, c.epsilon_final]]
    # RLlib counts one runner too many when it works out how often to learn.
    intensity = c.batch_size / c.update_every * runners / (runners + 1)
    learning = dict(
        lr=[[0, c.lr], [c.steps, c.lr * c.lr_final]], gamma=c.gamma, n_step=c.n_steps,
        double_q=c.double, dueling=False, num_atoms=1, epsilon=epsilon,
        train_batch_size_per_learner=c.batch_size, training_intensity=intensity,
        num_steps_sampled_before_learning_starts=c.learning_starts, td_error_loss_fn="huber",
        target_network_update_freq=c.target_every, adam_epsilon=ADAM_EPSILON,
        replay_buffer_config=replay,
    )  # fmt: skip
    flying = {"num_env_runners": runners, "num_envs_per_env_runner": ENVS}
    config = RayConfig().environment(ID).training(**learning).debugging(seed=c.seed)
    config.env_runners(**flying, rollout_fragment_length=c.n_steps).callbacks(on_sample_end=count)
    # A lost runner starts again where a CPU is free; until then the others fly on.
    config.fault_tolerance(restart_failed_env_runners=True, env_runner_health_probe_timeout_s=PROBE)
    return config.rl_module(rl_module_spec=RLModuleSpec(module_class=Nature))


def network(algorithm: Algorithm) -> QNetwork:
    """The network as our own class."""
    module: Any = algorithm.get_module()
    q = QNetwork(module.action_space.n)
    q.conv.load_state_dict(module.encoder.state_dict())
    q.head.load_state_dict(module.af.state_dict())
    return q


def train(c: Config, runners: int, out: Path) -> int:
    """Train, and write the weights, even if a signal ends it. Returns 0, or 128 + the signal."""
    register_env(ID, lambda _context: Forest(beacon=c.beacon))
    algorithm, end = make_config(c, runners).build_algo(), ""
    with ended_by_signals() as stopped:
        try:
            learn(algorithm, c.steps)
        except KeyboardInterrupt:
            end = "\ninterrupted; "
        save_weights(out, network(algorithm), c)
        print(f"{end}wrote {out}; fly it: python deepflight.py eval --weights {out}", flush=True)
    algorithm.stop()
    return 128 + stopped[0] if stopped else 0


def learn(algorithm: Algorithm, total: int) -> None:
    """Train for so many steps, with a line each thousand or so."""
    steps = 0
    nodes: dict[str, dict[str, float]] = {}  # steps of each runner on each node
    busy: Counter[str] = Counter()  # s in which each node flew
    while steps < total:
        result = algorithm.train()
        flown, seconds, before = result["env_runners"], result["time_total_s"], nodes
        nodes = {node: dict(each) for node, each in flown["nodes"].items()}
        live = [node for node in nodes if nodes[node] != before.get(node)]
        busy.update(dict.fromkeys(live, result["time_this_iter_s"]))
        steps = int(flown["num_env_steps_sampled_lifetime"])
        left = max(total - steps, 0) * seconds / steps / 60
        text = f"{steps:9,} steps, {steps / seconds:5.0f} a second, {left:5.1f} min left"
        text += f", {algorithm.env_runner_group.num_healthy_remote_env_runners()} runners"
        print(f"{text}, episodes of {flown.get('episode_len_mean', 0):.1f} steps", flush=True)
    report(nodes, busy, live)


def report(nodes: dict[str, dict[str, float]], busy: Counter[str], live: list[str]) -> None:
    """Print what each node added while it flew."""
    address = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes()}
    for node, runners in nodes.items():
        steps, lost = sum(runners.values()), "" if node in live else ", lost on the way"
        text = f"node {address[node]} {node[:8]}: {steps:,.0f} steps, "
        print(f"{text}{steps / busy[node]:.0f} a second, runners: {len(runners)}{lost}", flush=True)


def knock(address: str) -> None:
    """Raise ConnectionError if no Ray of this version answers there.

    A process of its own asks, because ray.init would print warnings for minutes.
    """
    ask = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        subprocess.run(ask, check=True, capture_output=True, timeout=ANSWER)
    except subprocess.SubprocessError:
        raise ConnectionError(f"no Ray of version {ray.__version__} answers at {address}") from None


def start(address: str | None, runners: int) -> None:
    """Join the Ray at this address, or start one here; every runner gets the code."""
    if address:
        knock(address)
    code = {"working_dir": str(ROOT), "excludes": [".venv", "runs", "results", "figures"]}
    quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    ray.init(address=address or "local", runtime_env=code, **quiet)
    free = int(ray.available_resources().get("CPU", 0))
    if not 1 <= runners <= free:
        raise InputError(f"runners is {runners}, allowed here: 1 to {free}, one a free CPU")


def main(argv: Sequence[str] | None = None) -> int:
    """Join or start a Ray, and train. Trouble comes with one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="rllib_train", usage=argparse.SUPPRESS)
    parser.add_argument("--runners", type=int, default=2, help="processes that fly, one a CPU")
    parser.add_argument("--steps", type=int, default=Config.steps, help="control steps in all")
    parser.add_argument("--beacon", action="store_true", help="put a visible pole at the goal")
    parser.add_argument("--address", help="of a running Ray; else one is started here")
    parser.add_argument("--out", type=Path, default="runs/rllib.pt", help="the weights' file")
    args = parser.parse_args(argv)
    try:
        c = RLlibConfig(steps=args.steps, beacon=args.beacon)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.open("ab").close()  # better to fail now than after the training
        start(args.address, args.runners)
        return train(c, args.runners, args.out)
    except (InputError, RuntimeError, OSError, RayError) as error:
        print(f"rllib_train: {str(error).strip().splitlines()[-1]}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted; no weights are written", file=sys.stderr)
        return 130
    finally:
        ray.shutdown()


if __name__ == "__main__":
    sys.exit(main())
