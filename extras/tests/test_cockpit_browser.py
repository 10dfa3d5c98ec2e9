"""The page of the cockpit, in a Chromium: what one sees and does there is what the core says.

Skipped where Debian's packages chromium and chromium-driver are missing.
"""

import json
import math
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("selenium", reason="extras/requirements.txt is not installed")

import torch
from selenium.webdriver import ActionChains, Chrome, Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from deepflight import dqn_pilot, read_flights
from dqn import load_weights
from env import ForestEnv, World, fly, refly
from extras.cockpit.flights import ROOT
from extras.experiments.cockpit_pictures import (
    CHROMIUM,
    DRIVER,
    browsing,
    serving,
    until,
    value,
    visit,
)
from render import camera

if not (CHROMIUM.exists() and DRIVER.exists()):
    pytest.skip("needs Debian's packages chromium and chromium-driver", allow_module_level=True)

SEED = 1


@pytest.fixture(scope="module")
def host() -> Iterator[str]:
    with serving() as host:
        yield host


@pytest.fixture(scope="module")
def chromium() -> Iterator[Chrome]:
    with browsing() as browser:
        yield browser


@pytest.fixture
def browser(chromium: Chrome) -> Iterator[Chrome]:
    """No test may leave a line on the console."""
    chromium.get_log("browser")
    yield chromium
    assert [entry["message"] for entry in chromium.get_log("browser")] == []


def press(browser: Chrome, *keys: str) -> None:
    ActionChains(browser).send_keys(*keys).perform()


def click(browser: Chrome, name: str) -> None:
    browser.find_element(By.ID, name).click()


def text(browser: Chrome, name: str) -> str:
    return browser.find_element(By.ID, name).text


def button(browser: Chrome, group: str, name: str) -> None:
    """Click the button of that name in a group."""
    (found,) = (
        x for x in browser.find_elements(By.CSS_SELECTOR, f"#{group} button") if x.text == name
    )
    found.click()


def steered(browser: Chrome, host: str) -> dict:
    """Fly forest 1 by hand to its end, with some turns; the flight's record."""
    visit(browser, host, seed=SEED)
    browser.execute_script("document.getElementById('speed').value = '5'")
    landed = value(browser, "landed.length")
    press(browser, Keys.ARROW_LEFT)
    until(browser, f"landed.length > {landed}")
    return value(browser, "flight.record")


def test_it_loads_and_says_how_to_begin(browser: Chrome, host: str) -> None:
    visit(browser, host)
    assert "to take off" in text(browser, "hint")
    assert value(browser, "document.querySelectorAll('#trunks circle').length") == 150
    unnamed = """[...document.querySelectorAll("button, select, input, [role=img]")].filter((x) =>
        !(x.textContent.trim() || x.ariaLabel || x.closest("label"))).map((x) => x.outerHTML)"""
    assert value(browser, unnamed) == []


def test_the_network_flies_to_the_end_that_eval_finds(browser: Chrome, host: str) -> None:
    q = load_weights(ROOT / "weights/paper.pt", 9, beacon=False, camera="grey")
    (flight,) = fly(dqn_pilot(q), [SEED], World())
    visit(browser, host, seed=SEED)
    browser.execute_script("document.getElementById('speed').value = '5'")
    button(browser, "pilots", "network")
    until(browser, "flight && over() && t === end() && !playing")
    assert value(browser, "flight.record") == flight
    rows = [row.split() for row in text(browser, "table").splitlines()]
    assert ["steps", str(flight["steps"])] in rows
    assert ["total", "reward", f"{flight['return']:.1f}"] in rows


def test_the_arrow_keys_turn_the_drone(browser: Chrome, host: str) -> None:
    for arrow, side in ((Keys.ARROW_LEFT, 1), (Keys.ARROW_RIGHT, -1), ("a", 1), ("d", -1)):
        visit(browser, host, seed=SEED)
        press(browser, arrow)
        until(browser, "end() >= 2")
        press(browser, Keys.SPACE)
        first = value(browser, "flight.moments[1].pose")
        assert first[2] == pytest.approx(side * 0.1 * 0.7 / 4)
        env = ForestEnv(World(), blind=True)
        env.reset(seed=SEED)
        env.step(4 + side)
        assert first == [*env.pose]


def test_holding_a_key_turns_harder(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    hand = ActionChains(browser).key_down(Keys.ARROW_LEFT)
    hand.perform()
    until(browser, "end() >= 6")
    ActionChains(browser).key_up(Keys.ARROW_LEFT).perform()
    press(browser, Keys.SPACE)
    assert value(browser, "flight.actions").startswith("567888")


def test_keys_play_pause_step_and_change_the_forest(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=10)
    press(browser, ".", ".", ",")
    assert value(browser, "t") == 11
    press(browser, Keys.SPACE)
    until(browser, "t > 13")
    press(browser, Keys.SPACE)
    assert value(browser, "playing") is False
    press(browser, "n")
    until(browser, "flight.record.seed === 2")


def test_fast_hands_break_nothing(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    keys = [Keys.ARROW_LEFT, Keys.ARROW_RIGHT, Keys.SPACE, ".", ",", "r", "n", "w"]
    for i in np.random.default_rng(0).integers(len(keys), size=300):
        press(browser, keys[i])
    press(browser, "r")
    visit(browser, host, seed=SEED, pilot="straight", t=0)
    assert value(browser, "flight.record") == fly_again(value(browser, "flight.record"))


def fly_again(record: dict) -> dict:
    env = ForestEnv(World(), blind=True)
    env.reset(seed=record["seed"])
    for action in record["actions"]:
        env.step(int(action))
    return env.flight()


def test_a_click_on_a_trunk_takes_it_out_of_the_decision(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=30)
    click(browser, "why")
    until(browser, "reasons")
    strongest = "[...reasons.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight))[0]"
    trunk = value(browser, f"{strongest}.trunk")
    circle = browser.find_elements(By.CSS_SELECTOR, "#trunks circle")[trunk]
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "removed")
    steps = list(refly(SEED, value(browser, "flight.actions"), World()))
    forest = np.delete(np.array(value(browser, "flight.trunks")), trunk, 0)
    poses = np.array([info["pose"] for *_, info in steps[27:31]])
    s = camera(poses, [forest] * 4, World())
    q = load_weights(ROOT / "weights/paper.pt", 9, beacon=False, camera="grey")
    with torch.no_grad():
        values = q(torch.from_numpy(s)[None])[0].tolist()
    assert value(browser, "removed.q") == pytest.approx(values, abs=1e-4)
    bars = browser.find_elements(By.CSS_SELECTOR, "#bars .after")
    shown = [float(bar.text.replace("\N{MINUS SIGN}", "-")) for bar in reversed(bars)]
    assert shown == pytest.approx(values, abs=0.051)


def test_what_if_flies_both_ways(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=20)
    browser.find_elements(By.CSS_SELECTOR, "#bars button")[0].click()  # the sharpest left turn
    until(browser, "ghost")
    actions = value(browser, "ghost.actions")
    assert actions[:25] == value(browser, "flight.actions")[:20] + "88888"
    assert value(browser, "ghost.record") == fly_again(value(browser, "ghost.record"))
    assert len(value(browser, "ghost.moments")) == len(actions) + 1


def test_where_it_went_wrong_is_where_the_greatest_q_falls_most(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, weights="scratch", pilot="network", t=0)
    click(browser, "wrong")
    best = np.max([moment["q"] for moment in value(browser, "flight.moments")[:-1]], 1)
    assert value(browser, "t") == int(np.argmax(best[:-1] - best[1:]))


def test_taking_over_keeps_the_way_so_far(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=20)
    before = value(browser, "flight.actions")
    click(browser, "take")
    until(browser, "byHand() && end() === 20 && ghost")
    press(browser, ".")
    until(browser, "end() === 21")
    assert value(browser, "flight.actions") == before[:20] + "4"


def test_the_address_restores_flight_and_moment(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    browser.execute_script("stepTo(7)")
    click(browser, "share")
    shared = browser.current_url
    visit(browser, host, world="beacon", seed=5)
    browser.get(shared)
    until(browser, f"flight && ghost && flight.record.seed === {SEED}")
    assert value(browser, "flight.record") == record
    assert value(browser, "[t, chosen.pilot, chosen.world, chosen.weights]") == [
        7, "you", "plain", "paper"
    ]  # fmt: skip


def test_a_bad_address_gets_a_line_and_a_flight(browser: Chrome, host: str) -> None:
    browser.get("about:blank")
    browser.get(f"http://{host}/#world=moon&weights=x&seed=-1&actions=99&t=-3.5")
    until(browser, "flight && ghost")
    assert text(browser, "hint").startswith("seed is '-1'")
    refused = "400 (Bad Request)"  # the browser itself writes these
    assert all(refused in entry["message"] for entry in browser.get_log("browser"))


def test_saved_flights_train(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    click(browser, "save")
    file = browser.downloads / "flights.json"
    WebDriverWait(browser, 30).until(lambda _: file.exists())
    flown = read_flights(file, False)[-1]
    assert (flown["seed"], flown["actions"]) == (record["seed"], record["actions"])
    report = json.loads(file.read_text())
    assert report["program"] == "Deep Flight"
    assert math.isclose(report["pilots"]["you"]["flights"][-1]["return"], record["return"])


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_is_no_wider_than_the_window(host: str, width: int) -> None:
    with browsing(width, 844) as narrow:
        visit(narrow, host)
        assert value(narrow, "document.documentElement.scrollWidth") <= width
