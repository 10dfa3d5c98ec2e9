"""The cockpit says what env.py, render.py and dqn.py say, and no request breaks it."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest
import torch

from deepflight import Config, dqn_pilot, load_weights, measure, save, save_weights
from dqn import QNetwork
from env import Pilot, World, fly, refly, straight_pilot
from extras.cockpit.__main__ import LARGEST, Server
from extras.cockpit.episodes import ROOT, Hangar
from extras.lessons.expert import laser_pilot
from render import draw_frame

HOMES = {"plain": "dqn", "beacon": "dqn-beacon"}
SEED, FIRST = 1, {"world": "plain", "weights": "dqn", "seed": "1"}


@contextmanager
def running(hangar: Hangar) -> Iterator[Server]:
    server = Server(0, hangar)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running(Hangar()) as server:
        yield server


def shipped(world: str) -> tuple[QNetwork, World]:
    return load_weights(ROOT / f"weights/{HOMES[world]}.pt")[:2]


def request(server: Server, path: str, body: str | bytes | None, **headers: str) -> tuple[int, str]:
    """GET if there is no body, else POST."""
    link = HTTPConnection("127.0.0.1", server.server_port)
    link.request("GET" if body is None else "POST", path, body, headers)
    answer = link.getresponse()
    code, text = answer.status, answer.read().decode()
    link.close()
    return code, text


def ask(server: Server, path: str, **content: str) -> dict:
    code, text = request(server, path, json.dumps(content))
    assert code == 200, text
    return json.loads(text)


def flown(server: Server, actions: str = "", pilot: str = "network", **more: str) -> dict:
    counts = {"more": "1000", "since": "0"} | FIRST | more
    return ask(server, "/fly", actions=actions, pilot=pilot, **counts)


@pytest.mark.parametrize("world", HOMES)
@pytest.mark.parametrize("name", ["network", "laser", "straight"])
def test_each_pilot_flies_as_in_eval(server: Server, world: str, name: str) -> None:
    q, w = shipped(world)
    pilots: dict[str, Pilot] = {"laser": laser_pilot(0.99), "straight": straight_pilot}
    (episode,) = fly(pilots.get(name) or dqn_pilot(q), [SEED], w)
    answer = flown(server, pilot=name, world=world, weights=HOMES[world])
    assert answer["record"] == episode
    assert answer["moments"][-1]["return"] == episode["return"]


def test_the_random_pilot_flies_the_same_episode_each_time_that_it_is_asked(
    server: Server,
) -> None:
    whole = flown(server, pilot="random")
    actions = whole["record"]["actions"]
    assert len(set(actions)) > 3
    rest = flown(server, actions[:5], "random", since="5")
    assert rest["record"] == whole["record"]
    assert rest["moments"] == whole["moments"][5:]


def test_q_and_frames_are_those_of_the_network_and_the_camera(server: Server) -> None:
    answer, (q, w) = flown(server), shipped("plain")
    steps, total = refly(answer["record"], w), 0.0
    for moment, drone in zip(answer["moments"], steps, strict=True):
        s = drone.observation  # (4, 84, 84)
        values = q.values(s[None], ())[0].tolist()
        assert moment["q"] == pytest.approx(values, abs=1e-4)
        assert b64decode(moment["frame"]) == s[-1].tobytes()
        assert (moment["pose"], moment["d_obs"]) == ([*drone.pose], drone.d_obs)
        total += moment["reward"]
        assert total == pytest.approx(drone.episode_return) == pytest.approx(moment["return"])


@pytest.mark.parametrize("world", HOMES)
@pytest.mark.parametrize("time", [0, 2, 20])
def test_removal_is_what_one_gets_by_drawing_every_frame_again(
    server: Server, world: str, time: int
) -> None:
    more, (q, w) = FIRST | {"world": world, "weights": HOMES[world]}, shipped(world)
    whole = flown(server, **more)
    answer = ask(server, "/why", actions=whole["record"]["actions"], time=str(time), **more)
    poses = [whole["moments"][max(time - k, 0)]["pose"] for k in (3, 2, 1, 0)]
    before = [drone.observation for drone in refly(whole["record"], w)][time]  # (4, 84, 84)
    trunks, found = np.array(whole["trunks"]), {}
    for i in range(-1 if w.beacon else 0, len(trunks)):
        left = trunks if i < 0 else np.delete(trunks, i, 0)
        scene = w if i >= 0 else replace(w, beacon=False)
        s = np.array([draw_frame(pose, left, scene) for pose in poses])
        if (s != before).any():
            with torch.no_grad():
                found[i] = (q(torch.from_numpy(s)[None])[0].tolist(), s[-1].tobytes())
    assert {x["trunk"] for x in answer["without"]} == found.keys()
    assert len(found) > 10
    for x in answer["without"]:
        values, newest = found[x["trunk"]]
        assert x["q"] == pytest.approx(values, abs=1e-4)
        assert b64decode(x["frame"]) == newest
        before, a = answer["before"], answer["chosen"]
        lost = (before[a] - np.mean(before)) - (values[a] - np.mean(values))
        assert x["weight"] == pytest.approx(lost, abs=1e-3)
    weights = [abs(x["weight"]) for x in answer["without"]]
    assert weights == sorted(weights, reverse=True)
    assert answer["chosen"] == int(np.argmax(answer["before"]))


def test_a_reason_says_where_its_trunk_stands(server: Server) -> None:
    answer = flown(server, "44", more="0")
    x, y, heading = answer["moments"][2]["pose"]
    for reason in ask(server, "/why", actions="44", time="2", **FIRST)["without"]:
        dx, dy = np.subtract(answer["trunks"][reason["trunk"]], (x, y))
        left = dy * np.cos(heading) - dx * np.sin(heading)
        side = f"{abs(left):.1f} m {'left' if left > 0 else 'right'}"
        assert reason["name"] == f"{np.hypot(dx, dy):.0f} m off, {side}"


@pytest.mark.parametrize("world", HOMES)
@pytest.mark.parametrize("time", [0, 2, 20])
def test_a_look_inside_is_what_the_first_layer_makes_of_the_four_frames(
    server: Server, world: str, time: int
) -> None:
    more, (q, w) = FIRST | {"world": world, "weights": HOMES[world]}, shipped(world)
    record = flown(server, **more)["record"]
    answer = ask(server, "/look", actions=record["actions"], time=str(time), **more)
    s = [drone.observation for drone in refly(record, w)][time]  # (4, 84, 84)
    maps = torch.relu(q.conv[0](torch.from_numpy(s / 255.0).float())).detach().numpy()
    shown = [np.frombuffer(b64decode(x), np.uint8).reshape(20, 20) for x in answer["maps"]]
    assert len(shown) == 32
    assert np.allclose(shown, 255 * maps / maps.max(), atol=0.51)


def test_the_next_step_goes_on_with_one_of_the_last_eight_episodes() -> None:
    hangar = Hangar()
    recording = hangar.find(FIRST | {"actions": "44"})
    assert hangar.find(FIRST | {"actions": "445"}) is recording
    assert len(recording.moments) == 4
    assert hangar.find(FIRST | {"actions": "446"}) is not recording, "other actions"
    for seed in range(10, 17):
        hangar.find(FIRST | {"actions": "", "seed": str(seed)})
    assert hangar.find(FIRST | {"actions": "445"}) is not recording, "seven others came after"
    assert len(hangar.recordings) == 8


def test_an_address_restores_the_episode_whenever_it_is_asked(server: Server) -> None:
    once = flown(server, "44332", more="0")
    for seed in range(9):  # they push it out of memory
        flown(server, "", more="0", seed=str(seed + 100))
    assert flown(server, "44332", more="0") == once


def test_weights_are_those_of_two_folders_and_each_has_its_world(tmp_path: Path) -> None:
    for file in ("weights/a.pt", "runs/mine/best.pt", "weights/flat.pt", "elsewhere/c.pt"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        kind = "disparity" if "flat" in file else "grey"
        save_weights(tmp_path / file, QNetwork(9), Config(beacon="mine" in file, camera=kind))
    (tmp_path / "weights/broken.pt").write_bytes(b"PK")
    options = Hangar(tmp_path).options({})
    names = {world: values["weights"] for world, values in options["worlds"].items()}
    assert names == {"plain": {"a": "dqn"}, "beacon": {"runs/mine": "dqn"},
                     "disparity": {"flat": "dqn"}}  # fmt: skip
    assert Hangar(tmp_path / "runs").options({})["worlds"]["disparity"]["weights"] == {}


def offered(hangar: Hangar) -> tuple[str, list[str]]:
    """The world to begin in, and its weights in their order."""
    options = hangar.options({})
    return options["world"], list(options["worlds"][options["world"]]["weights"])


def test_given_weights_are_the_first_of_their_world_under_a_name_of_their_own(
    tmp_path: Path,
) -> None:
    for file in ("weights/a.pt", "weights/b.pt", "elsewhere/b.pt", "elsewhere/z.pt",
                 "elsewhere/v1.5/best.pt"):  # fmt: skip
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        save_weights(tmp_path / file, QNetwork(9), Config(beacon="weights" not in file))
    save_weights(tmp_path / "weights/c.pt", QNetwork(9), Config(beacon=True))
    away = tmp_path.resolve() / "elsewhere"
    assert offered(Hangar(tmp_path)) == ("plain", ["a", "b"])
    assert offered(Hangar(tmp_path, weights=f"{away}/z.pt")) == ("beacon", ["z", "c"])
    assert offered(Hangar(tmp_path, weights=f"{away}/v1.5")) == ("beacon", ["v1.5", "c"])
    assert offered(Hangar(tmp_path, weights=f"{away}/b.pt")) == ("beacon", [f"{away}/b.pt", "c"])
    assert offered(Hangar(tmp_path, weights=f"{tmp_path}/weights/b.pt")) == ("plain", ["b", "a"])
    hangar = Hangar(tmp_path, weights=f"{away}/z.pt")
    (away / "z.pt").unlink()
    assert offered(hangar) == ("beacon", ["c"])


def test_trainings_of_another_folder_have_their_path_for_a_name(
    root: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    runs = tmp_path_factory.mktemp("foreign").resolve() / "runs"
    keep_training(runs / "mine", {5_000: network_episodes()[:2]})
    save_weights(runs / "mine/best.pt", QNetwork(9), Config())
    hangar, name = Hangar(root, runs=str(runs)), f"{runs}/mine"
    assert {x["name"]: x["weights"] for x in hangar.trainings({})} == {"runs/mine": "", name: name}
    assert offered(hangar) == ("plain", [name])
    assert hangar.training({"name": name, "since": "0"})["others"] == 3
    assert hangar.training({"name": "runs/mine", "since": "0"})["count"] == 2


def test_the_page_learns_which_weights_imitate(server: Server) -> None:
    worlds = ask(server, "/options")["worlds"]
    named = {name: pilot for world in worlds.values() for name, pilot in world["weights"].items()}
    for name in ("dqn", "dqn-beacon", "imitation", "imitation-beacon", "imitation-disparity"):
        assert named[name] == name.split("-")[0]


def keep_training(folder: Path, flown: dict[int, list[dict]], **settings: object) -> None:
    """Write what a training keeps: flown holds the episodes of each validation, by its step."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(asdict(Config(**settings))))
    rows = [
        {"step": step, "seconds": 0.012 * step}
        | {f"validation_{key}": float(x.mean()) for key, x in measure(episodes).items()}
        for step, episodes in flown.items()
    ]
    lines = [rows[0].keys(), *(row.values() for row in rows)]
    save(folder / "log.csv", "".join(",".join(map(str, x)) + "\n" for x in lines).encode())
    lines = [{"step": step} | episode for step, episodes in flown.items() for episode in episodes]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    save(folder / "validation.jsonl", text.encode())


def network_episodes() -> list[dict]:
    """A thousand that the shipped network flew: they end in many ways."""
    report = json.loads((ROOT / "results/dqn.json").read_text())
    return report["pilots"]["dqn"]["episodes"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A training with the default settings, beside committed ones, and foreign folders."""
    some = network_episodes()
    keep_training(tmp_path / "runs/mine", {5_000: some[:6], 10_000: some[6:12]}, seed=7, threads=2)
    logs = shutil.ignore_patterns("*.jsonl")
    for name in ("dqn", "dqn-1", "dqn-2", "dqn-beacon"):
        shutil.copytree(ROOT / "results" / name, tmp_path / "results" / name, ignore=logs)
    (tmp_path / "weights").mkdir()
    save_weights(tmp_path / "weights/dqn-9.pt", QNetwork(9), Config(beacon=True))
    return tmp_path


def test_trainings_are_listed_with_their_worlds_and_final_networks(root: Path) -> None:
    some = {5_000: network_episodes()[:2]}
    keep_training(root / "results/dqn-9", some, beacon=True)
    keep_training(root / "results/ladder/3-0", some)
    keep_training(root / "runs/odd", some, beacon=True, camera="disparity")
    save_weights(root / "runs/mine/best.pt", QNetwork(9), Config())
    for name, text in {"none": "", "list": "[1]", "half": '{"beacon": fal', "keys": "{}"}.items():
        keep_training(root / "runs" / name, some)
        (root / "runs" / name / "config.json").write_text(text)
    (root / "runs/bare").mkdir()
    assert Hangar(root).trainings({}) == [
        {"name": "runs/mine", "world": "plain", "weights": "runs/mine"},
        {"name": "results/ladder/3-0", "world": "plain", "weights": ""},
        {"name": "results/dqn-9", "world": "beacon", "weights": "dqn-9"},
    ]
    assert Hangar(root / "elsewhere").trainings({}) == []


def test_a_training_that_runs_comes_first_then_the_shipped_one_then_the_longest(
    root: Path,
) -> None:
    some = network_episodes()
    keep_training(root / "results/dqn", {5_000: some[:2]})
    keep_training(root / "runs/long", {step: some[:2] for step in (5_000, 10_000, 15_000)})
    keep_training(root / "runs/zero", {5_000: some[:2]})
    for old in ("mine", "long", "zero"):
        os.utime(root / "runs" / old / "log.csv", (0, 0))
    names = ["results/dqn", "runs/long", "runs/mine", "runs/zero"]
    assert [x["name"] for x in Hangar(root).trainings({})] == names
    os.utime(root / "runs/zero/log.csv")
    names = ["runs/zero", "results/dqn", "runs/long", "runs/mine"]
    assert [x["name"] for x in Hangar(root).trainings({})] == names


def test_a_training_is_told_from_any_validation_on(root: Path) -> None:
    some, hangar = network_episodes(), Hangar(root)
    whole = hangar.training({"name": "runs/mine", "since": "0"})
    keys = ("seed", "actions", "outcome", "return", "steps")
    told = [[{key: x[key] for key in keys} for x in some[i : i + 6]] for i in (0, 6)]
    assert [row["episodes"] for row in whole["validations"]] == told
    first = whole["validations"][0]
    assert (first["step"], first["minutes"]) == (5_000, 1.0)
    for key in ("return", "steps", "crossed", "crash"):
        assert first[key] == measure(some[:6])[key].mean()
    rest = hangar.training({"name": "runs/mine", "since": "1"})
    assert rest == whole | {"validations": whole["validations"][1:]}
    flown = {5_000: some[:6], 10_000: some[6:12], 15_000: some[12:18]}
    keep_training(root / "runs/mine", flown, seed=7)
    more = hangar.training({"name": "runs/mine", "since": "2"})
    assert (more["count"], [x["step"] for x in more["validations"]]) == (3, [15_000])


def test_a_log_that_is_ahead_of_its_episodes_waits_for_them(root: Path) -> None:
    log = root / "runs/mine/log.csv"
    *_, last = rows = log.read_text().splitlines()
    log.write_text("\n".join([*rows, last.replace("10000", "15000")]) + "\n")
    assert Hangar(root).training({"name": "runs/mine", "since": "0"})["count"] == 2


def test_the_band_is_that_of_committed_trainings_that_differ_in_the_seed_alone(root: Path) -> None:
    answer = Hangar(root).training({"name": "runs/mine", "since": "0"})
    tables = []
    for name in ("dqn", "dqn-1", "dqn-2"):
        with (ROOT / "results" / name / "log.csv").open() as file:
            tables.append(list(csv.DictReader(file)))
    assert answer["others"] == len(tables)
    assert [x["step"] for x in answer["band"]] == [[5_000 * i] * 2 for i in range(1, 41)]
    for i, told in enumerate(answer["band"]):
        for key in ("return", "steps", "crossed", "crash"):
            values = [float(table[i][f"validation_{key}"]) for table in tables]
            assert told[key] == [min(values), max(values)]
    shutil.copy(root / "runs/mine/validation.jsonl", root / "results/dqn-1")
    assert Hangar(root).training({"name": "results/dqn-1", "since": "0"})["others"] == 2
    keep_training(root / "runs/mine", {5_000: network_episodes()[:6]}, gamma=0.9)
    assert Hangar(root).training({"name": "runs/mine", "since": "0"})["band"] == []


FLOWN, LOG = "validation.jsonl", "log.csv"
BREAKS = {
    "half a line": (FLOWN, lambda text: text[:-40]),
    "no JSON": (FLOWN, lambda text: "hello\n"),
    "no episode": (FLOWN, lambda text: "[]\n"),
    "no such action": (FLOWN, lambda text: text.replace('"actions": "4', '"actions": "x')),
    "no such end": (FLOWN, lambda text: text.replace('"outcome": "', '"outcome": "un')),
    "no number": (FLOWN, lambda text: text.replace('"return": ', '"return": NaN, "x":')),
    "no text": (FLOWN, lambda text: text.replace("{", "\udcff{")),
    "half a row": (LOG, lambda text: text[: len(text) - 60]),
    "no columns": (LOG, lambda text: "a,b\n1,2\n"),
    "a folder": (LOG, None),
}


@pytest.mark.parametrize("case", BREAKS)
def test_a_broken_training_is_a_line(root: Path, case: str, capfd: pytest.CaptureFixture) -> None:
    name, change = BREAKS[case]
    file = root / "runs/mine" / name
    text = file.read_text()
    file.unlink()
    if change:
        file.write_text(change(text), errors="surrogateescape")
    else:
        file.mkdir()
    with running(Hangar(root)) as server:
        code, text = request(server, "/training", '{"name": "runs/mine", "since": "0"}')
        assert (code, text.count("\n")) == (400, 1), text
        assert "runs/mine" in text or case == "no number"
        assert ask(server, "/options")["worlds"]["beacon"]["weights"] == {"dqn-9": "dqn"}
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("header", ["Host", "Origin"])
def test_other_sites_are_refused(server: Server, header: str) -> None:
    port = server.server_port
    foreign = ("evil.example", f"evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "null", "")
    for name in foreign:
        value = name if header == "Host" or name in ("null", "") else f"http://{name}"
        code, text = request(server, "/", None, **{header: value})
        assert (code, text.count("\n")) == (403, 1), value
    origin = {"Origin": f"http://localhost:{port}", "Host": f"localhost:{port}"}
    assert request(server, "/options", "{}", **origin)[0] == 200


def test_a_browser_leaves_port_80_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not every machine lets one listen there, so the server only believes that it does."""
    monkeypatch.setattr(Server, "server_bind", lambda self: setattr(self, "server_port", 80))
    monkeypatch.setattr(Server, "server_activate", lambda self: None)
    server = Server(80, Hangar())
    server.server_close()
    assert server.ours == ["http://127.0.0.1", "http://localhost"]


def test_only_this_machine_can_connect(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"


BAD = {
    "world": ["", "moon", "plain\n", 1, None, []],
    "weights": ["", "../weights/dqn", "/etc/passwd", "dqn.pt", "a" * 400, 7],
    "seed": ["-1", "1.0", "", "1" * 19, "\u0663", 1, None, " 1"],
    "actions": ["9", "4" * 1001, "4 4", "\uff14", ["4"], 44, "4" * 400],
    "pilot": ["you", "", "dqn", None],
    "more": ["-1", "10000", 5, "x"],
    "since": ["-0", "1e9", None],
}


def test_malformed_requests_get_a_line_and_it_goes_on_serving(
    server: Server, capfd: pytest.CaptureFixture
) -> None:
    before = flown(server)
    for path, body, code in (
        ("/nowhere", "{}", 404), ("/../env.py", None, 404), ("/cockpit.js?x", None, 404),
        ("/fly", "", 400), ("/fly", "null", 400), ("/fly", "[1, 2", 400), ("/why", "{}", 400),
        ("/fly", b"\xff\xfe", 400), ("/options", '{"a": "b"}', 400), ("/fly", "1" * LARGEST, 400),
    ):  # fmt: skip
        got, text = request(server, path, body)
        assert (got, text.count("\n")) == (code, 1), (path, body)
    assert flown(server) == before
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("key", BAD)
def test_each_malformed_value_gets_400_and_a_line(server: Server, key: str) -> None:
    good = FIRST | {"actions": "44", "pilot": "laser", "more": "0", "since": "0"}
    assert request(server, "/fly", json.dumps(good))[0] == 200
    for value in BAD[key]:
        code, text = request(server, "/fly", json.dumps(good | {key: value}))
        assert (code, text.count("\n")) == (400, 1), value
        assert text.isascii()


def test_a_training_is_found_by_its_name_alone(root: Path) -> None:
    with running(Hangar(root)) as server:
        for name in (
            "runs/../runs/mine",
            "../root/runs/mine",
            "mine",
            str(root / "runs/mine"),
            "",
            1,
        ):
            body = json.dumps({"name": name, "since": "0"})
            code, text = request(server, "/training", body)
            assert (code, text.count("\n")) == (400, 1), name
        for body in ('{"name": "runs/mine", "since": "-1"}', '{"name": "runs/mine"}', "[]"):
            assert request(server, "/training", body)[0] == 400
        assert request(server, "/trainings", '{"a": "b"}')[0] == 400


def test_a_moment_after_the_episode_gets_400(server: Server) -> None:
    for path in ("/why", "/look"):
        code, text = request(server, path, json.dumps(FIRST | {"actions": "44", "time": "3"}))
        assert (code, text) == (400, "time is 3, and the episode has 2 steps\n")


def cockpit(*flags: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "extras.cockpit", *flags]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # A child inherits an ignored signal, as under nohup. Here it must hear Ctrl-C.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(command, cwd=ROOT, **pipes)
    finally:
        signal.signal(signal.SIGINT, handler)


def test_ctrl_c_ends_it_in_a_line() -> None:
    process = cockpit("--port", "0")
    assert "http://127.0.0.1:" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.communicate() == ("", "\nthe cockpit is closed\n")
    assert process.returncode == 130


def test_bad_input_is_a_line(server: Server, tmp_path: Path) -> None:
    taken = str(server.server_port)
    (tmp_path / "bare").mkdir()
    save_weights(tmp_path / "odd.pt", QNetwork(9), Config(beacon=True, camera="disparity"))
    paths = [["--runs", "gone"], ["--runs", "README.md"], ["--weights", "gone.pt"],
             ["--weights", "README.md"], ["--weights", str(tmp_path / "bare")],
             ["--weights", str(tmp_path / "odd.pt")]]  # fmt: skip
    for flags in (["--port", taken], ["--port", "70000"], ["--port", "x"], ["--what"], *paths):
        process = cockpit(*flags)
        output, error = process.communicate()
        assert (process.returncode, output, error.count("\n")) == (2, "", 1), error
        assert flags not in paths or flags[1] in error


def test_it_starts_as_a_script_from_any_directory(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "extras/cockpit"), "--port", "70000"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("extras.cockpit: port 70000")
