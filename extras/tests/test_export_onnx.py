"""The exported network is the trained one, says which, and replaces no other file unasked."""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from deepflight import load_weights
from dqn import QNetwork
from env import World
from extras.bridges.export_onnx import ROOT, SIZE, export, main, observations, parity, session


def test_on_a_thousand_observations_the_export_gives_torch_s_values_and_actions(
    tmp_path: Path,
) -> None:
    q, world, _ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx", {})
    report = parity(q, session(tmp_path / "dqn.onnx"), observations(q, world, SIZE))
    assert report["relative error"] <= 1e-4
    assert report["same action"] >= 0.999


def test_onnxruntime_1_17_can_read_the_export(tmp_path: Path) -> None:
    export(QNetwork(9), tmp_path / "new.onnx", {})
    model = onnx.load(tmp_path / "new.onnx")
    assert model.ir_version <= 9
    assert [x.version for x in model.opset_import if not x.domain] <= [20]


def test_parity_sees_another_network(tmp_path: Path) -> None:
    q, *_ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx", {})
    with torch.no_grad():
        q.head[2].bias[0] += 1
    s = np.random.default_rng(0).integers(256, size=(3, 4, 84, 84), dtype=np.uint8)
    assert parity(q, session(tmp_path / "dqn.onnx"), s)["relative error"] > 1e-4


def test_any_batch_will_do(tmp_path: Path) -> None:
    q, world, _ = load_weights(ROOT / "weights/dqn.pt")
    export(q, tmp_path / "dqn.onnx", {})
    run = session(tmp_path / "dqn.onnx")
    for size in (1, 7):
        s = observations(q, world, size)
        values = run.run(None, {"observation": s})[0]  # (size, 9)
        assert np.array_equal(values.argmax(1), q.values(s, ()).argmax(1))


def test_two_runs_make_two_files_that_say_what_they_are(tmp_path: Path) -> None:
    for run, weights in (("a", "dqn"), ("b", "imitation-disparity")):
        (tmp_path / run).mkdir()
        shutil.copy(ROOT / f"weights/{weights}.pt", tmp_path / run / "best.pt")
        assert main(["--weights", str(tmp_path / run / "best.pt")]) == 0
    told = []
    for run in "ab":
        properties = onnx.load(tmp_path / run / "best.onnx").metadata_props
        told.append({each.key: each.value for each in properties})
        assert session(tmp_path / run / "best.onnx").get_modelmeta().custom_metadata_map == told[-1]
    assert [each["run"] for each in told] == ["a/best.pt", "b/best.pt"]
    assert [each["pilot"] for each in told] == ["dqn", "imitation"]
    assert [each["camera"] for each in told] == ["grey", "disparity"]
    assert {each["beacon"] for each in told} == {"false"}
    world = json.loads(told[0]["world"])
    assert (world["speed"], world["dt"]) == (World.speed, World.dt)


def test_a_file_that_exists_is_replaced_only_if_it_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights, out = tmp_path / "best.pt", tmp_path / "best.onnx"
    shutil.copy(ROOT / "weights/dqn-beacon.pt", weights)
    out.write_text("mine")
    assert main(["--weights", str(weights)]) == 2
    assert out.read_text() == "mine"
    assert (
        capsys.readouterr().err == f"export_onnx: {out} exists: to replace it, name it by --out\n"
    )
    assert main(["--weights", str(weights), "--out", str(tmp_path)]) == 2
    assert main(["--weights", str(weights), "--out", str(out)]) == 0
    assert ("beacon", "true") in {(p.key, p.value) for p in onnx.load(out).metadata_props}


@pytest.mark.parametrize(
    ("words", "why"),
    [("--weights none.pt", "No such file"), ("--weights README.md", "another kind of file"),
     ("--weights weights/drqn.pt", "another network"), ("--out weights/dqn.pt", "end in .onnx"),
     ("--out README.md/x.onnx", "README.md"), ("--camera red", "'red'"), ("--beacon 1", "1")],
)  # fmt: skip
def test_a_bad_command_line_gets_one_line_and_writes_nothing(
    words: str, why: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    try:
        code = main(words.split())
    except SystemExit as error:
        code = error.code
    out, err = capsys.readouterr()
    assert code == 2 and out == ""
    assert err.startswith("export_onnx: ") and err.count("\n") == 1 and why in err
