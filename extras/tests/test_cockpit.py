"""The cockpit says what env.py, render.py and dqn.py say, and no request breaks it."""

import json
import signal
import subprocess
import sys
import threading
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest
import torch

from deepflight import Config, dqn_pilot, load_weights, save_weights
from dqn import QNetwork
from env import Pilot, World, fly, refly, straight_pilot
from extras.cockpit.__main__ import LARGEST, Server
from extras.cockpit.episodes import ROOT, Hangar
from extras.lessons.expert import laser_pilot
from render import draw_frame

HOMES = {"plain": "dqn", "beacon": "dqn-beacon"}
SEED, FIRST = 1, {"world": "plain", "weights": "dqn", "seed": "1"}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    server = Server(0, Hangar())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


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
    assert answer["chosen"] == int(np.argmax(answer["before"]))


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


def test_the_page_learns_which_weights_imitate(server: Server) -> None:
    worlds = ask(server, "/options")["worlds"]
    named = {name: pilot for world in worlds.values() for name, pilot in world["weights"].items()}
    for name in ("dqn", "dqn-beacon", "imitation", "imitation-beacon", "imitation-disparity"):
        assert named[name] == name.split("-")[0]


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


def test_a_moment_after_the_episode_gets_400(server: Server) -> None:
    code, text = request(server, "/why", json.dumps(FIRST | {"actions": "44", "time": "3"}))
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


def test_bad_input_is_a_line(server: Server) -> None:
    taken = str(server.server_port)
    for flags in (["--port", taken], ["--port", "70000"], ["--port", "x"], ["--what"]):
        process = cockpit(*flags)
        output, error = process.communicate()
        assert (process.returncode, output, error.count("\n")) == (2, "", 1), error
