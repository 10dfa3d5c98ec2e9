"""The cockpit says what env.py, render.py and dqn.py say, and no request breaks it."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from base64 import b64decode
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
import torch
from numpy.random import Generator

import deepflight
from deepflight import dqn_pilot, read_flights
from dqn import QNetwork, load_weights, save_weights
from env import Pilot, World, fly, laser_pilot, refly, straight_pilot
from extras.cockpit.__main__ import HOST, LARGEST, PORT, Server
from extras.cockpit.flights import ROOT, WORLDS, Hangar
from render import camera

HOMES = {"plain": ("paper", World()), "beacon": ("beacon", World(beacon=True))}
SEED, FIRST = 1, {"world": "plain", "weights": "paper", "seed": "1"}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    server = Server(0, Hangar())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def network(world: str) -> QNetwork:
    name, w = HOMES[world]
    return load_weights(ROOT / f"weights/{name}.pt", w.actions, beacon=w.beacon, camera=w.camera)


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
    pilots: dict[str, Pilot] = {"laser": laser_pilot(0.99), "straight": straight_pilot}
    pilot = pilots.get(name) or dqn_pilot(network(world))
    (flight,) = fly(pilot, [SEED], HOMES[world][1])
    answer = flown(server, pilot=name, world=world, weights=HOMES[world][0])
    assert answer["record"] == flight
    assert answer["moments"][-1]["return"] == flight["return"]
    assert answer["moments"][-1]["outcome"] == flight["outcome"] != ""


def test_chance_flies_the_same_flight_each_time_that_it_is_asked(server: Server) -> None:
    whole = flown(server, pilot="random")
    actions = whole["record"]["actions"]
    assert len(set(actions)) > 3
    rest = flown(server, actions[:5], "random", since="5")
    assert rest["record"] == whole["record"]
    assert rest["moments"] == whole["moments"][5:]


def test_q_and_pictures_are_those_of_the_network_and_the_camera(server: Server) -> None:
    answer, q = flown(server), network("plain")
    steps = refly(SEED, answer["record"]["actions"], World())
    for moment, (s, r, *_, info) in zip(answer["moments"], steps, strict=True):
        with torch.no_grad():
            values = q(torch.from_numpy(s)[None])[0].tolist()
        assert moment["q"] == pytest.approx(values, abs=1e-4)
        assert b64decode(moment["frame"]) == s[-1].tobytes()
        assert (moment["reward"], moment["pose"]) == (r, [*info["pose"]])


@pytest.mark.parametrize("world", HOMES)
@pytest.mark.parametrize("time", [0, 2, 40])
def test_removal_is_what_one_gets_by_drawing_every_picture_again(
    server: Server, world: str, time: int
) -> None:
    name, w = HOMES[world]
    more = FIRST | {"world": world, "weights": name}
    actions = flown(server, **more)["record"]["actions"]
    answer = ask(server, "/why", actions=actions, time=str(time), **more)
    steps, q = list(refly(SEED, actions, w))[: time + 1], network(world)
    poses = [steps[max(time - k, 0)][-1]["pose"] for k in (3, 2, 1, 0)]
    trunks, found = np.array(flown(server, **more)["trunks"]), {}
    for i in range(-1 if w.beacon else 0, len(trunks)):
        left = trunks if i < 0 else np.delete(trunks, i, 0)
        pole = (w.length, 0.0) if w.beacon and i >= 0 else None
        s = np.concatenate([camera(np.array([pose]), [left], w, pole) for pose in poses])
        if (s != steps[time][0]).any():
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


def test_the_next_step_goes_on_with_a_flight_of_the_last_eight() -> None:
    hangar = Hangar()
    flight = hangar.find(FIRST | {"actions": "44"})
    assert hangar.find(FIRST | {"actions": "445"}) is flight
    assert len(flight.moments) == 4
    assert hangar.find(FIRST | {"actions": "446"}) is not flight, "another way"
    for seed in range(10, 17):
        hangar.find(FIRST | {"actions": "", "seed": str(seed)})
    assert hangar.find(FIRST | {"actions": "445"}) is not flight, "seven others came after"
    assert len(hangar.flights) == 8


def test_an_address_restores_the_flight_wherever_it_is_asked(server: Server) -> None:
    once = flown(server, "44332", more="0")
    for seed in range(9):  # they push it out of memory
        flown(server, "", more="0", seed=str(seed + 100))
    assert flown(server, "44332", more="0") == once


def test_flights_train(server: Server, tmp_path: Path) -> None:
    flights = [flown(server, pilot=pilot)["record"] for pilot in ("straight", "network")]
    file = tmp_path / "flights.json"
    file.write_text(json.dumps({"beacon": False, "pilots": {"you": {"flights": flights}}}))
    assert read_flights(file, False) == flights


def test_the_address_that_eval_prints_is_one_of_the_page() -> None:
    hangar = Hangar()
    for kind, world in WORLDS.items():
        address = urlsplit(
            deepflight.cockpit(world, ROOT / f"weights/{kind.replace('plain', 'paper')}.pt", 5)
        )
        asked = dict(parse_qsl(address.fragment))
        assert (address.hostname, address.port) == (HOST, PORT)
        hangar.fly(asked | {"actions": "", "more": "1", "since": "0"})


def test_weights_are_those_of_two_folders_and_each_has_its_world(tmp_path: Path) -> None:
    for file in ("weights/a.pt", "runs/mine/best.pt", "weights/flat.pt", "elsewhere/c.pt"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        beacon, kind = "mine" in file, "disparity" if "flat" in file else "grey"
        save_weights(tmp_path / file, QNetwork(9), beacon=beacon, camera=kind)
    (tmp_path / "weights/broken.pt").write_bytes(b"PK")
    options = Hangar(tmp_path).options({})
    names = {world: values["weights"] for world, values in options["worlds"].items()}
    assert names == {"plain": ["a"], "beacon": ["runs/mine"], "disparity": ["flat"]}
    assert Hangar(tmp_path / "runs").options({})["worlds"]["disparity"]["weights"] == []


def test_the_world_of_disparity_flies_once_it_has_weights(tmp_path: Path) -> None:
    (tmp_path / "weights").mkdir()
    save_weights(tmp_path / "weights/disparity.pt", QNetwork(9), beacon=False, camera="disparity")
    flight = {"world": "disparity", "weights": "disparity", "seed": "1", "actions": "4567"}
    hangar = Hangar(tmp_path)
    moments = hangar.find(flight).moments
    for moment, (s, *_) in zip(moments, refly(1, "4567", World(camera="disparity")), strict=True):
        assert b64decode(moment["frame"]) == s[-1].tobytes()
    assert hangar.why(flight | {"time": "4"})["before"] == pytest.approx(moments[4]["q"], abs=1e-4)


@pytest.mark.parametrize("header", ["Host", "Origin"])
@pytest.mark.parametrize("path", ["/", "/fly", "/options"])
def test_other_sites_are_refused(server: Server, header: str, path: str) -> None:
    port = server.server_port
    foreign = ("evil.example", f"evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "null", "")
    for name in foreign:
        value = name if header == "Host" or name in ("null", "") else f"http://{name}"
        code, text = request(server, path, None if path == "/" else "{}", **{header: value})
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
    "world": ["", "moon", "plain\n", 1, None, [], True, "\ud800"],
    "weights": ["", "../weights/paper", "/etc/passwd", "paper.pt", "runs/..", "a" * 400, 7],
    "seed": ["-1", "1.0", "", "1" * 19, "\u0663", 1, None, " 1", "1e3", "NaN"],
    "actions": ["9", "4" * 1001, "4 4", "\uff14", ["4"], 44, None, "4" * 400],
    "pilot": ["you", "", "dqn", None, {}],
    "more": ["-1", "10000", 5, "x"],
    "since": ["-0", "1e9", None],
}
PATHS = (
    "/fly",
    "/why",
    "/options",
    "/etc/passwd",
    "/../env.py",
    "/x//",
    "/cockpit.js?x",
    "/%2e%2e",
)


def garbage(rng: Generator) -> bytes:
    """A malformed request, as the bytes that go over the wire."""
    path, kind = rng.choice(PATHS), rng.integers(5)
    if kind == 0:
        return rng.bytes(int(rng.integers(1, 300))) + b"\r\n\r\n"
    good = FIRST | {"actions": "44", "pilot": "laser", "more": "1", "since": "0"}
    key = rng.choice([*BAD])
    content = good | {key: BAD[key][rng.integers(len(BAD[key]))]}
    if kind == 1:
        del content[rng.choice([*good])]
    body = json.dumps(content).encode()
    if kind == 2:
        body = bytearray(body)
        body[rng.integers(len(body))] = rng.integers(256)
        body = bytes(body[: rng.integers(len(body))])
    if kind == 3:
        body = rng.choice([b"[" * 9000, b"", b"null", b"NaN", b"1" * 9000, b'{"a":' * 2000])
    length = rng.choice([f"{len(body)}", "-1", "x", "", f"{LARGEST + 1}", "9" * 30])
    length = length if kind == 4 else f"{len(body)}"
    method = rng.choice(["POST", "POST", "POST", "GET", "PUT", "\x00", "HEAD"])
    head = f"{method} {path} HTTP/1.1\r\nHost: HOST\r\nContent-Length: {length}\r\n\r\n"
    return head.encode() + body


def exchange(server: Server, sent: bytes) -> bytes:
    """Send bytes, say that no more will come, and read until the server hangs up."""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=60) as link:
        link.sendall(sent.replace(b"HOST", f"127.0.0.1:{server.server_port}".encode()))
        link.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: link.recv(2**16), b""))


def test_a_thousand_malformed_requests_get_a_line_each_and_it_goes_on_serving(
    server: Server, capfd: pytest.CaptureFixture
) -> None:
    rng, before = np.random.default_rng(0), flown(server)
    for i in range(1000):
        answer = exchange(server, sent := garbage(rng))
        head, _, line = answer.partition(b"\r\n\r\n")
        assert head[:12] in (b"HTTP/1.1 400", b"HTTP/1.1 403", b"HTTP/1.1 404"), (i, sent, answer)
        assert line.count(b"\n") == 1, (i, sent, answer)
        assert b"Traceback" not in answer
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


def test_a_moment_after_the_flight_gets_400(server: Server) -> None:
    code, text = request(server, "/why", json.dumps(FIRST | {"actions": "44", "time": "3"}))
    assert (code, text) == (400, "time is 3, and the flight has 2 steps\n")


def cockpit(*flags: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "extras.cockpit", *flags]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=os.environ, **pipes)


def test_ctrl_c_ends_it_in_a_line() -> None:
    process = cockpit("--port", "0")
    assert "http://127.0.0.1:" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.communicate() == ("", "\nthe cockpit is closed\n")
    assert process.returncode == 130


def test_a_taken_port_is_a_line_that_names_a_free_one(server: Server) -> None:
    process = cockpit("--port", str(server.server_port))
    output, error = process.communicate()
    assert (process.returncode, output, error.count("\n")) == (2, "", 1)
    assert f"port {server.server_port} is taken: --port " in error
    with socket.socket() as free:
        free.bind(("127.0.0.1", int(error.split()[-3])))


def test_a_bad_command_line_is_a_line_too() -> None:
    for flags in (["--port", "70000"], ["--port", "-1"], ["--port", "x"], ["--what"]):
        process = cockpit(*flags)
        output, error = process.communicate()
        assert (process.returncode, output, error.count("\n")) == (2, "", 1)
