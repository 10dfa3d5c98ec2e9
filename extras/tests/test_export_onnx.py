"""The exported network is the trained one: the same values and the same actions."""

from pathlib import Path

import numpy as np
import onnx
import torch

from deepflight import load_weights
from dqn import QNetwork
from extras.bridges.export_onnx import ROOT, SIZE, export, observations, parity, session


def test_on_a_thousand_observations_the_export_gives_torch_s_values_and_actions(
    tmp_path: Path,
) -> None:
    q, world, _ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx")
    report = parity(q, session(tmp_path / "dqn.onnx"), observations(q, world, SIZE))
    assert report["relative error"] <= 1e-4
    assert report["same action"] >= 0.999


def test_onnxruntime_1_17_can_read_the_export(tmp_path: Path) -> None:
    export(QNetwork(9), tmp_path / "new.onnx")
    model = onnx.load(tmp_path / "new.onnx")
    assert model.ir_version <= 9
    assert [x.version for x in model.opset_import if not x.domain] <= [20]


def test_parity_sees_another_network(tmp_path: Path) -> None:
    q, *_ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx")
    with torch.no_grad():
        q.head[2].bias[0] += 1
    s = np.random.default_rng(0).integers(256, size=(3, 4, 84, 84), dtype=np.uint8)
    assert parity(q, session(tmp_path / "dqn.onnx"), s)["relative error"] > 1e-4


def test_any_batch_will_do(tmp_path: Path) -> None:
    q, world, _ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx")
    run = session(tmp_path / "dqn.onnx")
    for size in (1, 7):
        s = observations(q, world, size)
        values = run.run(None, {"observation": s})[0]  # (size, 9)
        assert np.array_equal(values.argmax(1), q.values(s, ()).argmax(1))
