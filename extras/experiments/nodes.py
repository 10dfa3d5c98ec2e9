"""What does a second and a third node of a Ray cluster add, and what does the death of one cost?

    extras/.venv/bin/python -m extras.experiments.nodes         # writes results/nodes.json

`ray.cluster_utils.Cluster` makes the nodes, all on this machine, so they share its processors: the
numbers say what RLlib does with nodes, and not what machines would add. Each node flies one runner.
The script trains by `extras.bridges.rllib_train --address` on one, two and three nodes, and on
three of which one is killed after the first thousand steps. All of it ends before much is learnt:
the learner, of which there is one, would hide what the nodes add.
"""

import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from ray.cluster_utils import Cluster

ROOT = Path(__file__).parents[2]
STEPS = 4_000  # fewer than the 5,000 after which rllib_train learns
CASES = {"1 node": (1, False), "2 nodes": (2, False), "3 nodes": (3, False), "kill": (3, True)}
PASSED = re.compile(r" *([\d,]+) steps, +(\d+) a second")
ADDED = re.compile(r"node .*: ([\d,]+) steps, (\d+) a second, .*?(lost.*)?$")


@contextlib.contextmanager
def cluster(count: int) -> Iterator[Cluster]:
    """So many nodes of one CPU each, here; the first of them is the head."""
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        for _ in range(count - 1):
            nodes.add_node(num_cpus=1)
        yield nodes
    finally:
        nodes.shutdown()


def train(address: str, runners: int, steps: int, out: Path) -> Iterator[str]:
    """Run rllib_train on the Ray at this address; its lines, as they come."""
    command = [sys.executable, "-m", "extras.bridges.rllib_train", "--address", address]
    command += ["--runners", str(runners), "--steps", str(steps), "--out", str(out)]
    env = os.environ | {"OMP_NUM_THREADS": "1"}  # the runners need the other cores
    with subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, text=True) as run:
        yield from run.stdout or ()
    if run.returncode:
        raise RuntimeError(f"rllib_train ended with exit code {run.returncode}")


def fly(
    count: int, steps: int, out: Path, midway: Callable[[Cluster], None] | None
) -> tuple[list[re.Match], list[re.Match]]:
    """Train on so many nodes. The lines of passed steps, and those of what each node added.

    `midway` is called once, after the first line.
    """
    passed: list[re.Match] = []
    added: list[re.Match] = []
    with cluster(count) as nodes:
        for line in train(nodes.address, count, steps, out):
            print(line, end="", flush=True)
            for pattern, found in ((PASSED, passed), (ADDED, added)):
                found += [match] if (match := pattern.match(line)) else []
            if midway and len(passed) == 1:
                midway(nodes)
                midway = None
    return passed, added


def kill(nodes: Cluster) -> None:
    """Kill one node with all its processes, and let none of them say goodbye."""
    nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False)


def main() -> None:
    """Measure every case and write them down."""
    results = {}
    for name, (count, deadly) in CASES.items():
        print(f"-- {name}")
        passed, added = fly(count, STEPS, Path("/tmp/nodes.pt"), kill if deadly else None)
        each = [
            {"steps": number(m[1]), "a second": number(m[2]), "lost": bool(m[3])} for m in added
        ]
        results[name] = {"steps a second": number(passed[-1][2]), "nodes": each}
    text = json.dumps({"cores": os.cpu_count(), "steps": STEPS} | results, indent=1)
    (ROOT / "results/nodes.json").write_text(text + "\n")
    print(text)


def number(text: str) -> int:
    """A whole number with commas."""
    return int(text.replace(",", ""))


if __name__ == "__main__":
    main()
