"""Export a trained network to ONNX, for where there is no torch: the paper's next step was a drone.

    extras/.venv/bin/python -m extras.bridges.export_onnx      # weights/dqn.pt -> runs/dqn.onnx
    extras/.venv/bin/python -m extras.bridges.export_onnx --camera disparity
    extras/.venv/bin/python -m extras.bridges.export_onnx --weights runs/a/best.pt

The last one writes runs/a/best.onnx. A file that exists is replaced only if `--out` names it. The
export's metadata say what it is: `pilot`, `run`, `camera`, `beacon`, and as JSON the whole `world`.

Input `observation` (B, 4, 84, 84) uint8, output `q` (B, 9) float32, any B; the action is the
argmax. The script then flies validation forests, half of the drones at random, and holds the
export against torch on 1,000 of the observations; last it times a single decision in both, on one
thread. A control step lasts 100 ms. What it times is this machine's processor, not a Jetson.
onnxruntime 1.17, which a Jetson has, reads opset 20 and IR version 9 at most. The export has less.

What a stereo camera must deliver to the disparity pilot, ten times a second:

    size     84x84 pixels of one byte; the four last frames, the oldest first, 0.1 s apart
    view     90 degrees wide and high: cut the middle square out of a wider frame. The lens looks
             level and straight ahead, from 2 m above the ground, at 5 m/s: turn the frame back by
             the drone's roll and pitch first
    value    510 / depth, cut at 255 and rounded down; depth in m along the lens's axis. A pair with
             focal length f px and baseline b m that measures d px has depth f * b / d. So write
             510 * d / (f * b)
    near     2 m: all that is nearer is 255
    far      0 for the sky, and for all that is farther than the pair can tell
    holes    the value to their left. Not 0: that says that the way is free (results/README.md has
             what both cost)
"""

import argparse
import json
import logging
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import count
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from numpy import ndarray

from deepflight import VALIDATION, load_weights, save
from dqn import InputError, QNetwork
from env import VecForest, World

ROOT, SIZE = Path(__file__).parents[2], 1000
WARMUP, CALLS = 50, 1000  # decisions before and in a timing


def export(q: QNetwork, path: Path, metadata: dict[str, str]) -> None:
    """Write the network as one ONNX file, its weights inside."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, we do not
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch warns of itself
        program = torch.onnx.export(
            q.eval(), (torch.zeros(2, 4, 84, 84, dtype=torch.uint8),), dynamo=True,
            opset_version=18, verbose=False, input_names=["observation"], output_names=["q"],
            dynamic_shapes=({0: torch.export.Dim("batch")},),
        )  # fmt: skip
    program.model.ir_version = 9  # the newest that onnxruntime 1.17 reads, on a Jetson
    program.model.metadata_props.update(metadata)
    save(path, program.model_proto.SerializeToString())


def session(path: Path) -> onnxruntime.InferenceSession:
    """onnxruntime on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def observations(q: QNetwork, world: World, size: int) -> ndarray:
    """What eight drones see (size, 4, 84, 84) uint8; half follow the network, half are random."""
    envs, rng, seen = VecForest(world, 8, count(VALIDATION.start)), np.random.default_rng(0), []
    while len(seen) < size:
        s = envs.reset_done()  # (8, 4, 84, 84)
        seen += [*s]
        random, best = rng.integers(world.num_actions, size=8), q.values(s, ()).argmax(1)  # (8,)
        envs.step(np.where(np.arange(8) % 2, random, best))
    return np.stack(seen[:size])


def parity(q: QNetwork, run: onnxruntime.InferenceSession, s: ndarray) -> dict[str, float]:
    """Largest difference over an observation's largest value, and the share of equal actions."""
    ours = q.values(s, ())  # (N, 9)
    theirs = run.run(None, {"observation": s})[0]  # (N, 9)
    error = np.abs(theirs - ours).max(1) / np.abs(ours).max(1)  # (N,)
    same = theirs.argmax(1) == ours.argmax(1)  # (N,)
    return {"relative error": float(error.max()), "same action": float(same.mean())}


def latency(decide: Callable[[ndarray], object], s: ndarray) -> dict[str, float]:
    """Median and 99th percentile of one decision, ms; s (N, 4, 84, 84)."""
    times = []
    for i in range(WARMUP + CALLS):
        one = s[i % len(s)][None]  # (1, 4, 84, 84)
        start = time.perf_counter()
        decide(one)
        times.append(1000 * (time.perf_counter() - start))
    p50, p99 = np.percentile(times[WARMUP:], [50, 99])
    return {"p50": float(p50), "p99": float(p99)}


def main(argv: Sequence[str] | None = None) -> int:
    """Export, compare, time. Trouble comes with one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="export_onnx", usage=argparse.SUPPRESS)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--weights", type=Path, help="default: weights/dqn.pt")
    which.add_argument("--beacon", action="store_true", help="the shipped ones that see a beacon")
    cameras = ("grey", "disparity")
    which.add_argument("--camera", choices=cameras, default="grey", help="what a pixel says")
    parser.add_argument("--out", type=Path, help="default: beside --weights, for others runs/")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    shipped = "dqn-beacon" if args.beacon else "dqn"
    shipped = "imitation-disparity" if args.camera == "disparity" else shipped
    weights = args.weights or ROOT / f"weights/{shipped}.pt"
    beside = weights.with_suffix(".onnx") if args.weights else Path("runs", f"{shipped}.onnx")
    path = args.out or beside
    try:
        q, world, pilot = load_weights(weights)
        if path.suffix != ".onnx":  # so that a slip replaces no weights
            raise InputError(f"--out is {path}, but must end in .onnx")
        if path.exists() and not args.out:
            raise InputError(f"{path} exists: to replace it, name it by --out")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()  # so that a folder is an error too
        what = {"pilot": pilot, "run": "/".join(weights.resolve().parts[-2:])}
        what |= {"camera": world.camera, "beacon": json.dumps(world.beacon)}
        export(q, path, what | {"world": json.dumps(asdict(world))})
    except (InputError, OSError) as error:
        print(f"export_onnx: {error}", file=sys.stderr)
        return 2
    print(f"wrote {path}, {path.stat().st_size / 1e6:.1f} MB", flush=True)
    run, s = session(path), observations(q, world, SIZE)
    report: dict[str, object] = {**parity(q, run, s)}
    report["onnxruntime, ms"] = latency(lambda one: run.run(None, {"observation": one}), s)
    report["torch, ms"] = latency(lambda one: q.values(one, ()), s)
    print(json.dumps(report, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
