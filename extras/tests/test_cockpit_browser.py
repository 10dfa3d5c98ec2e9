"""The page of the cockpit, in a Chromium: what one sees and does there is what the core says.

Skipped where Debian's packages chromium and chromium-driver are missing.
"""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("selenium", reason="extras/requirements.txt is not installed")

import torch
from selenium.webdriver import ActionChains, Chrome, Keys
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from deepflight import dqn_pilot, load_weights
from dqn import QNetwork
from env import Drone, World, fly, random_pilot, refly
from extras.cockpit.episodes import ROOT, Hangar
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
from extras.tests.test_cockpit import keep_training, network_episodes, running
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
    words = f"after {episode['steps'] / 10} s, return {episode['return']:.1f}"
    assert text(browser, "table") == f"network {ENDS[episode['outcome']]} {words}"


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
    after = "[...document.querySelectorAll('#bars .after')].map((bar) => bar.textContent)"
    shown = [float(x.replace("\N{MINUS SIGN}", "-")) for x in reversed(value(browser, after))]
    assert shown == pytest.approx(values, abs=0.051)
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "reasons && !removed")
    ActionChains(browser).move_to_element(circle).click().perform()
    until(browser, "removed")
    press(browser, Keys.ESCAPE)
    assert not any(value(browser, after))
    assert value(browser, "[!!reasons, removed]") == [True, None]


def seen_inside(browser: Chrome) -> tuple[np.ndarray, np.ndarray]:
    """What each filter finds at the moment on show: on the page, and as torch computes it, where
    the greatest value is 255."""
    until(browser, "!looking && episode.moments[t].maps")
    script = """[...$("maps").children].map((canvas) => {
        const copy = new OffscreenCanvas(20, 20).getContext("2d", { willReadFrequently: true });
        copy.drawImage(canvas, 0, 0);
        return [...copy.getImageData(0, 0, 20, 20).data].filter((_, i) => i % 4 === 0);
    })"""
    shown = np.array(value(browser, script)).reshape(-1, 20, 20)
    record, t = value(browser, "[episode.record, t]")
    frames = [drone.observation for drone in refly(record, World())][t]
    conv = load_weights(ROOT / "weights/dqn.pt")[0].conv[0]
    with torch.no_grad():
        maps = torch.relu(conv(torch.from_numpy(frames / 255.0).float()))
    return shown, (255 * maps / maps.max()).numpy()


def test_a_look_inside_shows_what_the_filters_find_at_each_moment_until_escape(
    browser: Chrome, host: str
) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=30)
    places = """["play", "map", "time", "bars", "look", "why"].map((id) => {
        const { x, y, width, height } = $(id).getBoundingClientRect();
        return [id, x, y, width, height];
    })"""
    before = value(browser, places)
    browser.find_element(By.CSS_SELECTOR, "#look canvas:nth-child(2)").click()
    pictures = []
    for key in ("", ".", ","):
        press(browser, key)
        shown, expected = seen_inside(browser)
        assert np.allclose(shown, expected, atol=0.51)
        pictures.append(shown)
    assert pictures[0].max() == 255
    assert (pictures[0] == pictures[2]).all()
    assert (pictures[0] != pictures[1]).any()
    assert value(browser, places) == before
    press(browser, Keys.SPACE)
    until(browser, "t > 33")
    press(browser, Keys.SPACE)
    shown, expected = seen_inside(browser)
    assert np.allclose(shown, expected, atol=0.51), "it follows while the flight plays"
    press(browser, Keys.ESCAPE)
    assert not browser.find_element(By.ID, "inside").is_displayed()
    browser.execute_script("$('look').focus()")
    for opened in (True, False):
        press(browser, Keys.ENTER)
        assert browser.find_element(By.ID, "inside").is_displayed() is opened


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


def test_each_escape_takes_the_latest_answer_away(browser: Chrome, host: str) -> None:
    ways = {
        "why": "why()", "trunk": "why(reasons.without[0].trunk)", "ghost": "whatIf(8)",
        "inside": "$('look').click()",
    }  # fmt: skip
    shown = """Object.entries({ why: reasons, trunk: removed, ghost: ghost !== plain, inside })
        .filter(([, x]) => x).map(([name]) => name)"""
    for order in ("why trunk ghost inside", "inside ghost why trunk", "ghost why inside trunk"):
        visit(browser, host, seed=SEED, pilot="network", t=30)
        for name in order.split():
            value(browser, ways[name])
        browser.execute_script("draw()")
        left = order.split()
        while left:
            assert sorted(value(browser, shown)) == sorted(left), order
            press(browser, Keys.ESCAPE)
            left.pop()
        assert value(browser, shown) == []


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
    assert text(browser, "hint").startswith("Nothing to save yet")
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


def test_nothing_moves_when_an_answer_or_a_long_line_comes(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=30)
    places = """["play", "map", "time", "bars", "seen", "why"].map((id) => {
        const { x, y, width, height } = $(id).getBoundingClientRect();
        return [id, x, y, width, height];
    })"""
    before = value(browser, places)
    click(browser, "why")
    until(browser, "reasons && document.querySelectorAll('#answer button').length")
    assert value(browser, places) == before
    browser.execute_script("say('a long line '.repeat(60))")
    assert value(browser, places) == before
    browser.execute_script("say('')")
    assert value(browser, places) == before


def test_reasons_are_framed_where_the_frame_changes_without_them(
    browser: Chrome, host: str
) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=30)
    click(browser, "why")
    until(browser, "reasons")
    order = "[...reasons.without].sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight))"
    things = value(browser, f"{order}.map((x) => [x.trunk, x.weight])")[:6]
    drone = list(refly(value(browser, "episode.record"), World()))[-1]
    pose, trunks = value(browser, "episode.moments[t].pose"), drone.trunks
    frames = [draw_frame(pose, np.delete(trunks, i, 0), World()) for i, _ in things]
    changed = [np.argwhere(draw_frame(pose, trunks, World()) != frame) for frame in frames]
    expected = [
        ["for" if weight > 0 else "against", *low[::-1], *(high - low + 1)[::-1]]
        for (_, weight), pixels in zip(things, changed, strict=True)
        if len(pixels)
        for low, high in [(pixels.min(0), pixels.max(0))]
    ]
    marks = browser.find_elements(By.CSS_SELECTOR, "#marks rect")
    names = ("class", "x", "y", "width", "height")
    found = [[mark.get_attribute(name) for name in names] for mark in marks]
    assert found == [[kind, *map(str, box)] for kind, *box in expected]
    assert len(found) > 3


def test_each_meaning_has_a_colour_of_its_own(browser: Chrome, host: str) -> None:
    for scheme in ("light", "dark"):
        media = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": media})
        visit(browser, host, seed=SEED, pilot="network", t=30)
        click(browser, "why")
        until(browser, "reasons")
        value(browser, "whatIf(8)")
        value(browser, "why()")
        colour = "getComputedStyle(document.querySelector('{}')).{}"
        places = {"#path": "stroke", "#ghost-path": "stroke", ".best .own": "fill",
                  "#map .for": "fill", "#map .against": "fill", "#goal": "fill"}  # fmt: skip
        found = [value(browser, colour.format(place, key)) for place, key in places.items()]
        assert len({*found}) == len(found), found
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_shared_link_says_what_plays_it(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED, pilot="network", t=7)
    assert value(browser, "playing") is False
    assert text(browser, "hint").startswith("Press Space or Play")
    press(browser, Keys.SPACE)
    until(browser, "t > 8")


def test_every_choice_says_what_it_is(browser: Chrome, host: str) -> None:
    visit(browser, host, seed=SEED)
    for name in ("pilots", "worlds"):
        for choice in browser.find_elements(By.CSS_SELECTOR, f"#{name} button"):
            assert choice.get_attribute("title"), choice.text


def test_blocked_storage_leaves_the_page_alive(host: str) -> None:
    block = {"profile.default_content_setting_values.cookies": 2}
    with browsing(**block) as blocked:
        assert steered(blocked, host)["outcome"]
        assert "sessionStorage" in value(blocked, "(() => { try { sessionStorage } catch (e) "
                                         "{ return e.message } })()")  # fmt: skip
        assert len(demonstrated(blocked)) == 1


def seen_whole(browser: Chrome, *names: str) -> bool:
    """Whether these stand in the window, above the time line."""
    script = """const bottom = $("play").getBoundingClientRect().top;
        return arguments[0].every((id) => {
            const { top, bottom: low } = $(id).getBoundingClientRect();
            return top >= 0 && low <= bottom;
        });"""
    return browser.execute_script(script, names)


@pytest.mark.parametrize("width", [360, 390])
def test_on_a_phone_frame_map_and_bars_stand_together_and_fingers_steer(
    host: str, width: int
) -> None:
    with browsing(width, 844, mobile=True) as phone:
        visit(phone, host, seed=SEED)
        assert text(phone, "hint").startswith("Press ◀ left or right ▶ to take off.")
        assert seen_whole(phone, "seen", "map", "bars")
        at = value(phone, "(({ x, y }) => ({ x: x + 9, y: y + 9 }))"
                   "($('left').getBoundingClientRect())")  # fmt: skip
        touch = {"type": "touchStart", "touchPoints": [at]}
        phone.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
        until(phone, "end() >= 6")
        phone.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        until(phone, "!stick.held.left")
        assert value(phone, "episode.actions").startswith("567888")
        assert seen_whole(phone, "seen", "map", "bars")
        assert value(phone, "scrollY") == 0


def tap(phone: Chrome, x: float, y: float) -> None:
    touch = {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]}
    phone.execute_cdp_cmd("Input.dispatchTouchEvent", touch)
    phone.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_on_a_phone_a_tap_on_a_frame_opens_the_look_inside_and_another_closes_it(
    host: str,
) -> None:
    with browsing(390, 844, mobile=True) as phone:
        visit(phone, host, seed=SEED)
        frame = phone.find_element(By.CSS_SELECTOR, "#look canvas:last-child").rect
        tap(phone, frame["x"] + 20, frame["y"] + 20)
        until(phone, "!$('inside').hidden")
        shown, expected = seen_inside(phone)
        assert np.allclose(shown, expected, atol=0.51)
        assert seen_whole(phone, "seen", "look", "maps", "bars")
        last = "document.querySelector('#maps canvas:last-child').getBoundingClientRect()"
        edge = "$('place').getBoundingClientRect()"
        assert value(phone, f"{last}.bottom <= {edge}.bottom && {last}.right <= {edge}.right")
        assert value(phone, "document.documentElement.scrollWidth") <= 390
        tap(phone, frame["x"] + 20, frame["y"] + 20)
        until(phone, "$('inside').hidden")


@pytest.mark.parametrize("width", [360, 390, 1280])
def test_the_page_is_no_wider_than_the_window_and_the_time_line_stays_in_it(
    host: str, width: int
) -> None:
    with browsing(width, 844) as narrow:
        visit(narrow, host)
        for name in ("weights", "training"):  # a name may be a whole path
            narrow.execute_script(f"$('{name}').add(new Option('/a/long/path'.repeat(9)))")
        assert value(narrow, "document.documentElement.scrollWidth") <= width
        toggle = "document.body.classList.toggle('learning')"
        narrow.execute_script(toggle)
        assert value(narrow, "document.documentElement.scrollWidth") <= width
        narrow.execute_script(toggle)
        size = {"width": width, "height": 500, "deviceScaleFactor": 1, "mobile": False}
        narrow.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        bottom = "document.querySelector('footer').getBoundingClientRect().bottom"
        assert value(narrow, f"{bottom} <= innerHeight")


# -------------------------------------------------- the view "Learning"

STEPS = (5_000, 10_000, 15_000, 20_000)
ENDS = {"goal": "arrived", "far": "left by the far edge", "side": "left by a side",
        "back": "left by the back", "crash": "hit a trunk", "time": "ran out of time"}  # fmt: skip


def validations(number: int) -> dict[int, list[dict]]:
    """The first at random, the others by the shipped network; 48 episodes each."""
    rng, some = np.random.default_rng(0), network_episodes()
    flown = [fly(random_pilot(rng), range(10**9, 10**9 + 48), World())]
    flown += [some[48 * i : 48 * i + 48] for i in range(number - 1)]
    return dict(zip(STEPS, flown, strict=False))


@pytest.fixture(scope="module")
def flown() -> dict[int, list[dict]]:
    return validations(4)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped network, the logs of three committed trainings, and room for runs."""
    root, logs = tmp_path_factory.mktemp("root"), shutil.ignore_patterns("*.jsonl")
    for name in ("dqn", "dqn-1", "dqn-2"):
        shutil.copytree(ROOT / "results" / name, root / "results" / name, ignore=logs)
    (root / "weights").mkdir()
    shutil.copy(ROOT / "weights/dqn.pt", root / "weights")
    return root


@pytest.fixture
def school(root: Path, flown: dict[int, list[dict]]) -> Iterator[str]:
    """A cockpit with a training of three validations, `runs/mine`, and its own network."""
    keep_training(root / "runs/mine", {step: flown[step] for step in STEPS[:3]})
    shutil.copy(ROOT / "weights/dqn.pt", root / "runs/mine/best.pt")
    with serving(root) as host:
        yield host
    shutil.rmtree(root / "runs")


def study(browser: Chrome, host: str, **place: object) -> None:
    """Open the view at a training and a step, as its address says."""
    place = {"training": "runs/mine"} | place
    browser.get("about:blank")
    browser.get(f"http://{host}/#" + "&".join(f"{key}={x}" for key, x in place.items()))
    until(browser, "learning() && $('all-ways').children.length")


def drawn(browser: Chrome) -> list[list[tuple[float, float]]]:
    """The points of each way on the map, each third and the last; y is upwards."""
    script = "[...$('all-ways').children].map((path) => path.getAttribute('d'))"
    numbers = [[float(x) for x in re.findall(r"-?[\d.]+", d)] for d in value(browser, script)]
    return [[(x, -y) for x, y in zip(d[::2], d[1::2], strict=True)] for d in numbers]


def assert_shows(browser: Chrome, episodes: list[dict]) -> None:
    ways, known = drawn(browser), value(browser, "now().episodes.map((e) => e.way)")
    assert len(ways) == len(episodes) == 48
    for way, line, episode in zip(known, ways, episodes, strict=True):
        poses = np.array([drone.pose[:2] for drone in refly(episode, World())])
        assert np.allclose(way, poses, atol=1e-9)
        third = [*range(0, len(poses) - 1, 3), len(poses) - 1]
        assert np.allclose(line, poses[third], atol=0.0051)


def test_the_button_shows_the_first_validation_of_a_training(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    visit(browser, school, seed=SEED)
    click(browser, "learning")
    until(browser, "$('all-ways').children.length")
    assert_shows(browser, flown[STEPS[0]])
    words = "48 validation episodes after 5,000 steps, 1.0 minutes"
    assert text(browser, "ways-word") == words
    assert not browser.find_element(By.ID, "map").is_displayed()
    click(browser, "flying")
    assert browser.find_element(By.ID, "map").is_displayed()
    assert value(browser, "episode.record.seed") == SEED


def test_keys_range_buttons_and_curves_go_through_the_training(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    study(browser, school, step=STEPS[1])
    assert_shows(browser, flown[STEPS[1]])
    press(browser, Keys.ARROW_LEFT)
    assert_shows(browser, flown[STEPS[0]])
    press(browser, Keys.ARROW_LEFT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert value(browser, "[at, $('time').value]") == [2, "2"]
    click(browser, "back")
    assert value(browser, "at") == 1
    browser.find_element(By.ID, "time").send_keys(Keys.HOME)
    assert value(browser, "at") == 0
    curve = browser.find_element(By.CSS_SELECTOR, "#progress svg").rect
    x, y = curve["x"] + curve["width"] * 15 / 200, curve["y"] + curve["height"] / 2
    point(browser, x, y, click=True)
    assert value(browser, "at") == 2, "the committed trainings have 200,000 steps"


def point(browser: Chrome, x: float, y: float, click: bool = False) -> None:
    builder = ActionBuilder(browser)
    builder.pointer_action.move_to_location(round(x), round(y))
    if click:
        builder.pointer_action.click()
    builder.perform()


def test_the_legend_counts_and_has_the_colours_of_the_ways(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    okabe_ito = ("230, 159, 0", "86, 180, 233", "0, 158, 115", "0, 114, 178", "213, 94, 0",
                 "204, 121, 167")  # fmt: skip
    study(browser, school, step=STEPS[2])
    outcomes = [episode["outcome"] for episode in flown[STEPS[2]]]
    counts = {end: outcomes.count(end) for end in ENDS if end in outcomes}
    legend = browser.find_elements(By.CSS_SELECTOR, "#ends span")
    words = [f"\N{BLACK SQUARE} {ENDS[end]} {n}" for end, n in counts.items()]
    assert [x.text for x in legend] == words
    colour = "(element, key) => getComputedStyle(element)[key]"
    swatches = f"""[...document.querySelectorAll("#ends span")].map((x) =>
        [x.dataset.end, ({colour})(x.firstChild, "color")])"""
    strokes = (
        f"""[...$("all-ways").children].map((x) => [x.dataset.end, ({colour})(x, "stroke")])"""
    )
    legend = dict(value(browser, swatches))
    assert [legend[end] for end, _ in value(browser, strokes)] == [legend[x] for x in outcomes]
    assert {x[4:-1] for x in legend.values()} <= {*okabe_ito}
    assert len({*legend.values()}) == len(counts) > 2


def test_curves_show_the_log_over_the_band_of_committed_trainings(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    study(browser, school, step=STEPS[1])
    rows = browser.find_elements(By.CSS_SELECTOR, "#progress .curve span")
    some = flown[STEPS[1]]
    outcomes = [episode["outcome"] for episode in some]
    numbers = {
        "return": np.mean([episode["return"] for episode in some]),
        "length, steps": np.mean([episode["steps"] for episode in some]),
        "crossed, %": 100 * (outcomes.count("goal") + outcomes.count("far")) / 48,
        "hit a trunk, %": 100 * outcomes.count("crash") / 48,
    }
    shown = [row.text.replace("\N{MINUS SIGN}", "-").split("\n") for row in rows]
    assert shown == [[name, f"{x:.1f}"] for name, x in numbers.items()]
    bands = browser.find_elements(By.CSS_SELECTOR, "#progress .band")
    points = [len(band.get_attribute("d").split("L")) for band in bands]
    assert points == 4 * [2 * 40], "least and greatest at each of 40 steps"
    assert "trainings that differ only in their seed (3)" in text(browser, "band")


def lone(browser: Chrome) -> tuple[int, float, float]:
    """An episode whose way ends far from the others', and where that is in the window."""
    script = """const to = $("ways").getScreenCTM(), ways = now().episodes.map(({ way }) => way);
        const ends = ways.map((way) => way.at(-1));
        const i = ends.findIndex(([x, y], i) => ways.every((way, j) =>
            i === j || way.every((p) => Math.hypot(p[0] - x, p[1] - y) > 2)));
        const { x, y } = new DOMPoint(ends[i][0], -ends[i][1]).matrixTransform(to);
        return [i, x, y];"""
    i, x, y = browser.execute_script(script)
    return i, x, y


def told(episode: dict) -> str:
    """What the page says of an episode."""
    seconds, total = (
        episode["steps"] / 10,
        f"{episode['return']:.1f}".replace("-", "\N{MINUS SIGN}"),
    )
    return f"forest {episode['seed']}: {ENDS[episode['outcome']]} after {seconds} s, return {total}"


def test_pointer_and_keys_name_an_episode(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    study(browser, school, step=STEPS[2])
    i, x, y = lone(browser)
    point(browser, x, y)
    assert text(browser, "named") == told(flown[STEPS[2]][i])
    press(browser, Keys.ARROW_DOWN, Keys.ARROW_DOWN)
    assert text(browser, "named") == told(flown[STEPS[2]][i + 2]), "they go on from there"
    assert value(browser, "document.activeElement.ariaLabel") == told(flown[STEPS[2]][i + 2])
    press(browser, Keys.ARROW_UP, Keys.ARROW_LEFT)
    assert text(browser, "named") == told(flown[STEPS[1]][i + 1]), "the same place, a step before"


def test_enter_flies_the_bold_way_wherever_the_focus_is(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    study(browser, school, step=STEPS[1])
    press(browser, Keys.ARROW_DOWN, Keys.ARROW_DOWN)
    curve = browser.find_element(By.CSS_SELECTOR, "#progress svg").rect
    point(browser, curve["x"] + 2, curve["y"] + curve["height"] / 2, click=True)
    assert value(browser, "[at, document.activeElement.tagName]") == [0, "BODY"]
    assert text(browser, "named") == told(flown[STEPS[0]][1])
    press(browser, Keys.ENTER)
    until(browser, "!learning() && episode")
    assert value(browser, "episode.record") == flown[STEPS[0]][1]


def test_a_choice_gives_the_keys_back_and_begins_at_the_first_validation(
    browser: Chrome, school: str, root: Path, flown: dict[int, list[dict]]
) -> None:
    keep_training(root / "runs/other", {step: flown[step] for step in STEPS[:2]})
    study(browser, school, step=STEPS[1])
    browser.find_element(By.CSS_SELECTOR, "#training option:last-child").click()
    until(browser, "now()?.step === 5000 && training.name === 'runs/other'")
    assert value(browser, "[training.name, at]") == ["runs/other", 0]
    press(browser, Keys.ARROW_RIGHT)
    assert value(browser, "[training.name, at]") == ["runs/other", 1]
    click(browser, "flying")
    until(browser, "!learning() && episode && ghost")
    for name in ("weights", "hold", "speed"):
        browser.find_element(By.ID, name).send_keys(Keys.ARROW_DOWN)
        assert value(browser, "document.activeElement.tagName") == "BODY", name


def test_the_old_flight_is_never_on_show_for_the_new_one(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    visit(browser, school, seed=SEED)
    browser.get(f"http://{school}/#training=runs/mine&step={STEPS[1]}")
    until(browser, "learning() && now()?.step === 10000")
    slow = "extend = (x => async (...a) => (await new Promise(f => setTimeout(f, 500)), x(...a)))"
    browser.execute_script(f"{slow}(extend); flyEpisode(3)")
    until(browser, "chosen.pilot === 'recorded'")
    assert value(browser, "[learning(), episode.record.seed]") == [True, SEED]
    until(browser, "!learning()")
    assert value(browser, "episode.record") == flown[STEPS[1]][3]
    total = value(browser, "clock(end())")
    assert text(browser, "clock").endswith(f"of {total}")


@pytest.mark.parametrize("way", ["click", "Enter"])
def test_a_chosen_episode_is_flown_as_it_was(
    browser: Chrome, school: str, flown: dict[int, list[dict]], way: str
) -> None:
    study(browser, school, step=STEPS[1])
    i, x, y = lone(browser) if way == "click" else (0, 0, 0)
    if way == "click":
        point(browser, x, y, click=True)
    else:
        press(browser, Keys.ARROW_DOWN, Keys.ENTER)
    until(browser, "!learning() && episode && ghost && playing && t > 0")
    assert value(browser, "episode.record") == flown[STEPS[1]][i]
    assert value(browser, "chosen.weights") == "runs/mine"
    assert value(browser, "[$('main-name').textContent, ghost.label]") == [
        "after 10,000 steps", "network"
    ]  # fmt: skip
    q = load_weights(ROOT / "weights/dqn.pt")[0]
    assert [value(browser, "ghost.record")] == fly(
        dqn_pilot(q), [flown[STEPS[1]][i]["seed"]], World()
    )
    press(browser, Keys.SPACE)
    click(browser, "learning")
    until(browser, "learning() && now()?.step === 10000 && $('all-ways').children.length")
    assert value(browser, "training.name") == "runs/mine"


def test_a_recorded_way_without_its_weights_has_no_look_inside(
    browser: Chrome, school: str, root: Path
) -> None:
    for there in (True, False):
        study(browser, school, step=STEPS[1])
        value(browser, "flyEpisode(3)")
        press(browser, Keys.SPACE)
        assert browser.find_element(By.ID, "look").is_enabled() is there
        browser.execute_script("actions.look()")
        assert browser.find_element(By.ID, "inside").is_displayed() is there
        (root / "runs/mine/best.pt").unlink(missing_ok=True)


def test_the_address_restores_training_and_validation_or_the_recorded_episode(
    browser: Chrome, school: str, flown: dict[int, list[dict]]
) -> None:
    study(browser, school, step=STEPS[2])
    press(browser, Keys.ARROW_LEFT)
    click(browser, "share")
    until(browser, "$('hint').textContent.includes('this training at this validation')")
    shared = browser.current_url
    visit(browser, school, seed=5)
    browser.get(shared)
    until(browser, "learning() && now()?.step === 10000")
    value(browser, "flyEpisode(3)")
    press(browser, Keys.SPACE)
    browser.execute_script("stepTo(4)")
    click(browser, "share")
    shared = browser.current_url
    browser.get("about:blank")
    browser.get(shared)
    until(browser, "episode && ghost")
    assert value(browser, "[episode.record, t, $('main-name').textContent]") == [
        flown[STEPS[1]][3], 4, "after 10,000 steps"
    ]  # fmt: skip
    click(browser, "learning")
    until(browser, "learning() && now()?.step === 10000")


def test_in_another_forest_the_network_flies(browser: Chrome, school: str) -> None:
    study(browser, school)
    value(browser, "flyEpisode(3)")
    record = value(browser, "episode.record")
    value(browser, "actions.again()")
    assert value(browser, "[chosen.pilot, episode.record]") == ["recorded", record]
    value(browser, "actions.next()")
    until(browser, "episode && over()")
    assert value(browser, "[chosen.pilot, episode.record.seed]") == ["network", record["seed"] + 1]


def test_a_validation_appears_while_one_looks(
    browser: Chrome, school: str, root: Path, flown: dict[int, list[dict]]
) -> None:
    keep_training(root / "runs/mine", {step: flown[step] for step in STEPS[:2]})
    study(browser, school, step=STEPS[1])
    assert value(browser, "[at, training.validations.length]") == [1, 2]
    keep_training(root / "runs/mine", {step: flown[step] for step in STEPS[:3]})
    WebDriverWait(browser, 3, 0.05).until(lambda _: value(browser, "at === 2"))
    assert_shows(browser, flown[STEPS[2]])
    press(browser, Keys.ARROW_LEFT)
    keep_training(root / "runs/mine", flown)
    WebDriverWait(browser, 3, 0.05).until(
        lambda _: value(browser, "training.validations.length === 4")
    )
    assert value(browser, "[at, $('clock').textContent]") == [1, "2 of 4"]
    keep_training(root / "runs/mine", {STEPS[0]: flown[STEPS[0]]})
    until(browser, "training.validations.length === 1")  # it has begun anew
    assert_shows(browser, flown[STEPS[0]])


def test_a_broken_training_is_a_line_and_the_page_goes_on(
    browser: Chrome, school: str, root: Path, flown: dict[int, list[dict]]
) -> None:
    keep_training(root / "runs/bad", {STEPS[0]: flown[STEPS[0]]})
    keep_training(root / "runs/none", {STEPS[0]: flown[STEPS[0]]})
    (root / "runs/none/config.json").unlink()
    file = root / "runs/bad/validation.jsonl"
    file.write_text(file.read_text()[:-40])
    study(browser, school)
    names = "[...$('training').options].map((option) => option.value)"
    assert value(browser, names) == ["runs/mine", "runs/bad"]
    browser.find_element(By.CSS_SELECTOR, "#training option:last-child").click()
    until(browser, "$('hint').textContent.startsWith('the training runs/bad cannot be read')")
    assert value(browser, "$('all-ways').children.length") == 0
    press(browser, Keys.ARROW_LEFT, Keys.ARROW_DOWN, Keys.ENTER)
    browser.find_element(By.CSS_SELECTOR, "#training option:first-child").click()
    until(browser, "$('all-ways').children.length === 48")
    study(browser, school, training="runs/gone")
    assert text(browser, "hint") == "There is no training runs/gone here."
    refused = "400 (Bad Request)"  # the browser itself writes these
    assert all(refused in entry["message"] for entry in browser.get_log("browser"))


def test_without_a_training_the_view_says_how_to_begin_one(browser: Chrome, root: Path) -> None:
    with serving(root) as host:
        visit(browser, host, seed=SEED)
        click(browser, "learning")
        until(browser, "$('hint').textContent.includes('deepflight.py train')")
        press(browser, Keys.ARROW_LEFT)
        click(browser, "flying")
        assert browser.find_element(By.ID, "map").is_displayed()


def test_a_foreign_folder_s_network_flies_and_its_training_opens(
    browser: Chrome, flown: dict[int, list[dict]], tmp_path: Path
) -> None:
    run = tmp_path.resolve() / "thesis/runs/mine"
    keep_training(run, {step: flown[step] for step in STEPS[:2]}, beacon=True)
    shutil.copy(ROOT / "weights/dqn-beacon.pt", run / "best.pt")
    with running(Hangar(runs=str(run.parent), weights=str(run))) as server:
        host = server.server_address[0] + f":{server.server_port}"
        visit(browser, host)
        assert value(browser, "[chosen.world, chosen.weights]") == ["beacon", "mine"]
        assert value(browser, "$('weights').value") == "mine"
        button(browser, "pilots", "network")
        until(browser, "chosen.pilot === 'network' && episode && over()")
        q, world, _ = load_weights(run)
        assert [value(browser, "episode.record")] == fly(dqn_pilot(q), [1], world)
        click(browser, "learning")
        until(browser, "learning() && $('all-ways').children.length")
        names = "[...$('training').options].map((option) => option.value)"
        place = value(browser, names).index(str(run))
        browser.find_elements(By.CSS_SELECTOR, "#training option")[place].click()
        until(browser, f"training.name === '{run}' && now()?.step === {STEPS[0]}")
        assert_shows(browser, flown[STEPS[0]])
        value(browser, "flyEpisode(3)")
        assert value(browser, "[chosen.weights, episode.record]") == [
            str(run), flown[STEPS[0]][3]
        ]  # fmt: skip
        browser.execute_script("actions.look()")
        assert browser.find_element(By.ID, "inside").is_displayed(), "its weights are here"


def test_a_finger_on_a_phone_flies_an_episode(school: str, flown: dict[int, list[dict]]) -> None:
    with browsing(390, 844, mobile=True) as phone:
        study(phone, school, step=STEPS[1])
        assert value(phone, "document.documentElement.scrollWidth") <= 390
        assert text(phone, "hint").startswith("Tap a way")
        i, x, y = lone(phone)
        tap(phone, x, y)
        until(phone, "!learning() && episode && ghost")
        assert value(phone, "episode.record") == flown[STEPS[1]][i]
