"""The page of the cockpit, in a Chromium: what one sees and does there is what the core says.

Skipped where Debian's packages chromium and chromium-driver are missing.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("selenium", reason="extras/requirements.txt is not installed")

import torch
from selenium.webdriver import ActionChains, Chrome, Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from deepflight import dqn_pilot, load_weights
from dqn import QNetwork
from env import Drone, World, fly, refly
from extras.cockpit.episodes import ROOT
from extras.experiments.cockpit_pictures import (
    CHROMIUM,
    DRIVER,
    browsing,
    serving,
    until,
    value,
    visit,
)
from extras.lessons.demonstrations import DemoConfig, read_demos
from render import draw_frame

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
    """No test may leave a line on the console, or an episode to be saved."""
    chromium.get_log("browser")
    yield chromium
    chromium.execute_script("sessionStorage.clear()")
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
    """Fly forest 1 by hand to its end, with some turns; the episode's record."""
    visit(browser, host, seed=SEED)
    browser.execute_script("document.getElementById('speed').value = '5'")
    press(browser, Keys.ARROW_LEFT)
    until(browser, "over() && done.size")
    return value(browser, "episode.record")


def test_it_loads_and_says_how_to_begin(browser: Chrome, host: str) -> None:
    visit(browser, host)
    assert "to take off" in text(browser, "hint")
    assert value(browser, "document.querySelectorAll('#trunks circle').length") == 150
    unnamed = """[...document.querySelectorAll("button, select, input, [role=img]")].filter((x) =>
        !(x.textContent.trim() || x.ariaLabel || x.closest("label"))).map((x) => x.outerHTML)"""
    assert value(browser, unnamed) == []


def test_the_network_flies_to_the_end_that_eval_finds(browser: Chrome, host: str) -> None:
    q = load_weights(ROOT / "weights/dqn.pt")[0]
    (episode,) = fly(dqn_pilot(q), [SEED], World())
    visit(browser, host, seed=SEED)
    browser.execute_script("document.getElementById('speed').value = '5'")
    button(browser, "pilots", "network")
    until(browser, "episode && over() && t === end() && !playing")
    assert value(browser, "episode.record") == episode
    rows = [row.split() for row in text(browser, "table").splitlines()]
    assert ["steps", str(episode["steps"])] in rows
    assert ["return", f"{episode['return']:.1f}"] in rows


def test_the_arrow_keys_turn_the_drone(browser: Chrome, host: str) -> None:
    for arrow, side in ((Keys.ARROW_LEFT, 1), (Keys.ARROW_RIGHT, -1), ("a", 1), ("d", -1)):
        visit(browser, host, seed=SEED)
        press(browser, arrow)
        until(browser, "end() >= 2")
        press(browser, Keys.SPACE)
        first = value(browser, "episode.moments[1].pose")
        assert first[2] == pytest.approx(side * 0.1 * 0.7 / 4)
        drone = Drone(World())
        drone.reset(SEED)
        drone.step(4 + side)
        assert first == [*drone.pose]


def test_holding_a_key_turns_harder(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    hand = ActionChains(browser).key_down(Keys.ARROW_LEFT)
    hand.perform()
    until(browser, "end() >= 6")
    ActionChains(browser).key_up(Keys.ARROW_LEFT).perform()
    press(browser, Keys.SPACE)
    assert value(browser, "episode.actions").startswith("567888")


def test_a_key_that_is_released_elsewhere_is_released(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    ActionChains(browser).key_down(Keys.ARROW_LEFT).perform()
    until(browser, "end() >= 2")
    click(browser, "seed")
    ActionChains(browser).key_up(Keys.ARROW_LEFT).perform()
    assert value(browser, "stick.held") == {"left": 0}
    ActionChains(browser).key_down("d").perform()  # goes into the field
    browser.execute_script("document.activeElement.blur()")
    press(browser, "r")
    until(browser, "end() === 0 && ghost")
    press(browser, Keys.SPACE)
    until(browser, "end() >= 2")
    assert value(browser, "episode.actions").startswith("44")
    ActionChains(browser).key_up("d").perform()


def test_a_question_waits_for_the_step_that_is_underway(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    slow = "extend = (x => async (...a) => (await new Promise(f => setTimeout(f, 300)), x(...a)))"
    browser.execute_script(f"{slow}(extend)")
    for question, answer in (("why(149)", "That is in none of"), ("whatIf(8)", "The dashed path")):
        press(browser, Keys.ARROW_LEFT)
        until(browser, "underway")
        value(browser, question)
        assert text(browser, "hint").startswith(answer)


def test_keys_play_pause_step_and_change_the_forest(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=10)
    press(browser, ".", ".", ",")
    assert value(browser, "t") == 11
    press(browser, Keys.SPACE)
    until(browser, "t > 13")
    press(browser, Keys.SPACE)
    assert value(browser, "playing") is False
    press(browser, "n")
    until(browser, "episode.record.seed === 2")


def test_fast_hands_break_nothing(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    keys = [Keys.ARROW_LEFT, Keys.ARROW_RIGHT, Keys.SPACE, ".", ",", "r", "n", "w"]
    for i in np.random.default_rng(0).integers(len(keys), size=300):
        press(browser, keys[i])
    press(browser, "r")
    visit(browser, host, seed=SEED, pilot="straight", t=0)
    assert value(browser, "episode.record") == fly_again(value(browser, "episode.record"))


def fly_again(record: dict) -> dict:
    drone = Drone(World())
    drone.reset(record["seed"])
    for action in record["actions"]:
        drone.step(int(action))
    return drone.episode()


def test_a_click_on_a_trunk_takes_it_out_of_the_decision(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=30)
    click(browser, "why")
    until(browser, "reasons")
    strongest = "[...reasons.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight))[0]"
    trunk = value(browser, f"{strongest}.trunk")
    circle = browser.find_elements(By.CSS_SELECTOR, "#trunks circle")[trunk]
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "removed")
    poses = [drone.pose for drone in refly(value(browser, "episode.record"), World())]
    forest = np.delete(np.array(value(browser, "episode.trunks")), trunk, 0)
    s = np.array([draw_frame(pose, forest, World()) for pose in poses[27:31]])
    q = load_weights(ROOT / "weights/dqn.pt")[0]
    with torch.no_grad():
        values = q(torch.from_numpy(s)[None])[0].tolist()
    assert value(browser, "removed.q") == pytest.approx(values, abs=1e-4)
    bars = browser.find_elements(By.CSS_SELECTOR, "#bars .after")
    shown = [float(bar.text.replace("\N{MINUS SIGN}", "-")) for bar in reversed(bars)]
    assert shown == pytest.approx(values, abs=0.051)
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "reasons && !removed")
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "removed")
    press(browser, Keys.ESCAPE)
    assert value(browser, "[reasons, removed]") == [None, None]
    assert not any(bar.text for bar in bars)


def test_what_if_flies_both_ways(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=20)
    browser.find_elements(By.CSS_SELECTOR, "#bars button")[0].click()  # the sharpest left turn
    until(browser, "ghost")
    actions = value(browser, "ghost.actions")
    assert actions[:25] == value(browser, "episode.actions")[:20] + "88888"
    assert value(browser, "ghost.record") == fly_again(value(browser, "ghost.record"))
    assert len(value(browser, "ghost.moments")) == len(actions) + 1


def test_escape_brings_the_plain_ghost_back(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, actions="4444")
    value(browser, "whatIf(8)")
    assert text(browser, "hint").startswith("The dashed path turns left (+.70 rad/s) at ")
    press(browser, Keys.ESCAPE)
    assert value(browser, "ghost.label") == "network"
    assert "dashed" not in text(browser, "hint")
    value(browser, "whatIf(8)")
    value(browser, "whatIf(8)")  # the same bar again
    assert value(browser, "ghost.label") == "network"


def saves(seed: int, actions: str, q: QNetwork) -> bool:
    """Whether the network crosses if it goes on after these actions; they may not crash."""
    rest, pilot = iter([[int(action)] for action in actions]), dqn_pilot(q)
    (episode,) = fly(lambda s, envs: next(rest, None) or pilot(s, envs), [seed], World())
    return episode["outcome"] in ("goal", "far")


def test_it_went_wrong_at_the_last_moment_with_a_way_out(browser: Chrome, host: str) -> None:
    q = load_weights(ROOT / "weights/dqn.pt")[0]
    visit(browser, host, seed=SEED, pilot="straight", t=0)
    actions, end = value(browser, "episode.actions"), value(browser, "end()")
    click(browser, "wrong")
    until(browser, "ghost && ghost.whole")
    ways = [(end - 5 * i, turn) for i in range(1, 11) for turn in "840" if end >= 5 * i]
    t, turn = next((t, turn) for t, turn in ways if saves(SEED, actions[:t] + 5 * turn, q))
    assert value(browser, "t") == t
    assert value(browser, "ghost.actions")[: t + 5] == actions[:t] + 5 * turn
    assert value(browser, "ghost.record") == fly_again(value(browser, "ghost.record"))
    assert value(browser, "crossed(ghost)") is True
    assert f"Of each half second, the last way out was at {t / 10} s." in text(browser, "hint")
    assert {"0": "turns right", "8": "turns left"}.get(turn, "") in text(browser, "hint")


def test_an_episode_that_crossed_did_not_go_wrong(browser: Chrome, host: str) -> None:
    q = load_weights(ROOT / "weights/dqn.pt")[0]
    good = next(seed for seed in range(1, 50) if saves(seed, "", q))
    visit(browser, host, seed=good, pilot="network", t=0)
    click(browser, "wrong")
    assert text(browser, "hint").startswith("Nothing went wrong: ")
    visit(browser, host, seed=7, actions="44")
    click(browser, "wrong")
    assert text(browser, "hint").startswith("This episode is not over.")


def test_where_nothing_saves_it_the_greatest_q_falls_most(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="straight", t=0)
    browser.execute_script("window.otherwise = async () => episode")  # each way ends as badly
    best = np.max([moment["q"] for moment in value(browser, "episode.moments")[:-1]], 1)
    value(browser, "wentWrong()")
    assert value(browser, "t") == int(np.argmax(best[:-1] - best[1:]))
    assert "the greatest Q falls most" in text(browser, "hint")


def test_any_other_action_ends_the_search(browser: Chrome, host: str) -> None:
    for key in (Keys.SPACE, Keys.ESCAPE, ",", "w", Keys.ARROW_LEFT):
        visit(browser, host, seed=SEED, pilot="straight", t=20)
        browser.execute_script("window.search = wentWrong()")
        assert text(browser, "hint").startswith("The network tries")
        press(browser, key)
        value(browser, "search")
        assert value(browser, "ghost === plain")
        assert "way out" not in text(browser, "hint")


def test_the_line_on_top_is_about_the_last_action(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    press(browser, Keys.ARROW_LEFT)
    until(browser, "end() >= 2")
    assert text(browser, "hint") == "Hold ← or → to turn harder. Space pauses."
    press(browser, Keys.SPACE)
    assert text(browser, "hint").startswith("You have the controls")
    value(browser, "why(149)")
    assert text(browser, "hint").startswith("That is in none of the four frames")
    click(browser, "why")
    assert text(browser, "hint").startswith("You have the controls")


def test_a_bad_number_of_a_forest_is_refused_in_words(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    for number in ("1" * 19, "-1", "1.5", "x", ""):
        field = browser.find_element(By.ID, "seed")
        field.clear()
        field.send_keys(number, Keys.ENTER)
        until(browser, "$('seed').value === '1'")
        assert text(browser, "hint") == "The forest is a whole number of at most 18 digits."


def test_taking_over_keeps_the_way_so_far(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=20)
    before = value(browser, "episode.actions")
    click(browser, "take")
    until(browser, "byHand() && end() === 20 && ghost")
    press(browser, ".")
    until(browser, "end() === 21")
    assert value(browser, "episode.actions") == before[:20] + "4"


def test_taking_over_at_the_end_leaves_a_moment_to_fly(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=1000)
    before = value(browser, "episode.actions")
    click(browser, "take")
    until(browser, "byHand() && ghost")
    assert value(browser, "[episode.actions, over(), done.size]") == [before[:-1], False, 0]


def test_the_address_restores_episode_and_moment(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    browser.execute_script("stepTo(7)")
    click(browser, "share")
    shared = browser.current_url
    visit(browser, host, world="beacon", seed=5)
    browser.get(shared)
    until(browser, f"episode && ghost && episode.record.seed === {SEED}")
    assert value(browser, "episode.record") == record
    assert value(browser, "[t, chosen.pilot, chosen.world, chosen.weights]") == [
        7, "you", "plain", "dqn"
    ]  # fmt: skip


def test_a_bad_address_gets_a_line_and_an_episode(browser: Chrome, host: str) -> None:
    browser.get("about:blank")
    browser.get(f"http://{host}/#world=moon&weights=x&seed=-1&actions=99&t=-3.5")
    until(browser, "episode && ghost")
    assert text(browser, "hint") == "The forest is a whole number of at most 18 digits."
    browser.get("about:blank")
    browser.get(f"http://{host}/#world=moon&weights=x&seed=1&actions=99&t=-3.5")
    until(browser, "episode && ghost")
    assert text(browser, "hint").startswith("actions is '99'")
    refused = "400 (Bad Request)"  # the browser itself writes these
    assert all(refused in entry["message"] for entry in browser.get_log("browser"))


def saved(browser: Chrome) -> Path:
    """What a click on Save writes."""
    file = browser.downloads / "episodes.json"
    file.unlink(missing_ok=True)
    click(browser, "save")
    WebDriverWait(browser, 30).until(lambda _: file.exists())
    return file


def demonstrated(browser: Chrome) -> list[tuple[int, str]]:
    """Seeds and actions of the episodes that a click on Save writes, as a training reads them."""
    demos = read_demos(DemoConfig(demos=str(saved(browser)), demo_pilot="you"))
    return [(episode["seed"], episode["actions"]) for episode in demos]


def test_saved_episodes_are_whole_and_a_training_reads_them(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    assert demonstrated(browser) == [(SEED, record["actions"])]
    assert "lessons.demonstrations train --demos FILE --demo-pilot you" in text(browser, "hint")
    pilots = {"you": {"episodes": [record]}}
    assert json.loads(saved(browser).read_text()) == {
        "beacon": False, "camera": "grey", "pilots": pilots
    }  # fmt: skip


def test_a_reload_keeps_every_episode_by_hand(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    visit(browser, host, seed=SEED + 1, pilot="network", t=0)
    assert demonstrated(browser) == [(SEED, record["actions"])]


def test_an_episode_by_hand_that_comes_back_is_saved_once(browser: Chrome, host: str) -> None:
    record = steered(browser, host)
    visit(browser, host, seed=SEED, actions=record["actions"], t=3)
    assert demonstrated(browser) == [(SEED, record["actions"])]
    value(browser, "choose({}, episode.actions)")
    assert len(demonstrated(browser)) == 1
    value(browser, "choose({ seed: '2000000000', pilot: 'straight' })")
    value(browser, "choose({ pilot: 'you' }, episode.actions)")
    value(browser, "choose({ world: 'beacon', weights: '' })")
    click(browser, "save")
    assert text(browser, "hint").startswith("There is no episode to save.")
    assert "Left out: " in text(browser, "hint")


def test_only_what_was_learned_from_rewards_is_called_q(browser: Chrome, host: str) -> None:
    label = "document.querySelector('#bars button').ariaLabel"
    visit(browser, host, seed=SEED, pilot="network", t=0)
    assert ": Q " in value(browser, label)
    assert "Q: the return" in browser.find_element(By.ID, "mind").text
    visit(browser, host, seed=SEED, pilot="network", weights="imitation", t=0)
    click(browser, "why")
    until(browser, "reasons")
    assert ": score " in value(browser, label)
    page = browser.find_element(By.TAG_NAME, "main").text
    assert "Scores: what the expert" in page
    assert ": this score is" in page
    assert " Q" not in page


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_is_no_wider_than_the_window_and_the_time_line_stays_in_it(
    host: str, width: int
) -> None:
    with browsing(width, 844) as narrow:
        visit(narrow, host)
        assert value(narrow, "document.documentElement.scrollWidth") <= width
        size = {"width": width, "height": 500, "deviceScaleFactor": 1, "mobile": False}
        narrow.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        bottom = "document.querySelector('footer').getBoundingClientRect().bottom"
        assert value(narrow, f"{bottom} <= innerHeight")
