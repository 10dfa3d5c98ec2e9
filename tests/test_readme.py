"""Both pages' numbers are those of the committed results, so that neither can go stale."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import deepflight
from dqn import DQNConfig

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
FLAT = " ".join(README.split())
RESULTS = (ROOT / "results/README.md").read_text()
LONG = " ".join(RESULTS.split())
FIGURES = {  # of eval's JSON -> label in the table, factor, digits
    "over_random": ("longer than random, %", 100, 0),
    "crossed": ("crossed, %", 100, 1),
    "goal": ("arrived, %", 100, 1),
    "crash": ("crashed, %", 100, 1),
    "return": ("total reward", 1, 1),
}


HEADLINES = ("paper", "beacon", "disparity", "scratch", "beacon-scratch", "pilots")


def report(name: str) -> dict:
    """What `eval --json results/NAME.json` or a script of extras wrote."""
    return json.loads((ROOT / f"results/{name}.json").read_text())


def shown(figure: dict[str, float], factor: float, digits: int, unit: str = "") -> str:
    """A figure and its interval as the pages write them."""
    x = {key: f"{factor * value:.{digits}f}" for key, value in figure.items()}
    return f"{x['value']}{unit} [{x['low']}, {x['high']}]"


def flights(name: str) -> list[dict]:
    """The network's 1,000 headline flights."""
    return report(name)["pilots"]["dqn"]["flights"]


def test_the_front_page_is_one_page() -> None:
    assert len(README.split()) <= 1400
    assert README.count("\n") <= 130
    assert max(map(len, README.splitlines())) <= 80


@pytest.mark.parametrize("figure", FIGURES)
def test_each_row_of_the_headline_table_is_what_eval_wrote(figure: str) -> None:
    label, factor, digits = FIGURES[figure]

    def row(*columns: tuple[str, str]) -> str:
        figures = [report(name)["pilots"][pilot][figure] for name, pilot in columns]
        return " | ".join(["", label, *(shown(x, factor, digits) for x in figures), ""]).strip()

    scratch, taught = ("scratch", "dqn"), (("paper", "dqn"), ("beacon", "dqn"))
    assert row(scratch, *taught) in README
    more = ("disparity", "dqn"), ("pilots", "laser")
    assert row(scratch, ("beacon-scratch", "dqn"), *taught, *more) in RESULTS


@pytest.mark.parametrize("name", HEADLINES)
def test_headline_numbers_come_from_forests_that_no_training_has_seen(name: str) -> None:
    assert (report(name)["forests"], report(name)["first_seed"]) == (1000, 3 * 10**9)


def test_the_first_table_is_what_eval_prints(capsys: pytest.CaptureFixture) -> None:
    figures = report("eval")
    deepflight.print_table(figures["pilots"])
    table = capsys.readouterr().out
    assert table in README
    assert (
        f"{figures['forests']} forests from seed {figures['first_seed']}; 95 % intervals in [ ]"
        in README
    )


def test_the_pages_count_how_the_headline_flights_ended() -> None:
    paper, beacon = (
        Counter(f["edge"] or f["outcome"] for f in flights(x)) for x in ("paper", "beacon")
    )
    late = np.mean([f["progress"] > 80 for f in flights("paper")])
    said = "{side} left by a side, {back} by the back, {crash} crashed, and {time} ran out of time."
    said = said.format_map(paper)
    assert f"Of its 1,000 flights {said} It fails late: {late:.0%}"[:-1] + " % of all" in FLAT
    crossed = report("paper")["pilots"]["dqn"]["crossed"]["value"]
    few = report("eval")["pilots"]["dqn"]["crossed"]["value"]
    assert f"Its {100 * few:.0f} is luck" in FLAT
    assert f"of 1,000 it crosses {100 * crossed:.0f} %." in FLAT
    assert f"With the beacon {1000 - beacon['goal']} flights did not arrive" in FLAT
    assert f"and {beacon['crash']} of these crashed" in FLAT
    counts = "{far} left by the far edge, {side} by a side, {back} by the back; {goal} arrived, "
    counts += "{crash} crashed, {time} ran out of time"
    assert counts.format_map(paper) in LONG


def test_the_beacon_pilot_and_the_laser_are_compared_forest_by_forest() -> None:
    laser = report("pilots")["pilots"]["laser"]["flights"]
    camera, laser = (
        np.array([f["outcome"] == "goal" for f in x]) for x in (flights("beacon"), laser)
    )
    difference = 100 * (laser.astype(float) - camera)  # (F,) points
    mean, half = difference.mean(), 1.96 * difference.std() / np.sqrt(len(difference))
    said = f"{mean:.1f} [{mean - half:.1f}, {mean + half:.1f}] percentage points fewer"
    assert f"the beacon pilot arrives in {said}" in LONG
    steps = report("pilots")["pilots"]["random"]["steps"]["value"]
    assert f"The random pilot's mean flight, the bar, is {steps:.1f} steps" in LONG


def test_what_is_said_of_veering_is_what_was_measured() -> None:
    measured = report("veer")["pilots"]["dqn"]
    for name in ("towards clutter", "one side free", "towards middle"):
        assert f"{shown(measured[name], 1, 3)} rad/s" in LONG
    assert f"It spends {shown(measured['edge time'], 100, 1, ' %')} of its time" in LONG


def test_what_is_said_of_the_compass_is_what_was_measured() -> None:
    x = report("compass")
    for said in (
        f"to {x['rows in the middle, degrees off']:.0f} degrees (chance is 45)",
        f"it faces ({x['heading in the middle, degrees off']:.0f} degrees; chance is 90)",
        f"for a side in {x['the far edge taken for side, %']:.0f} % of cases (chance is 50)",
        f"for the far edge in {x['the far edge taken for far, %']:.0f} % (25)",
        f"crosses {x['the laser pilot, straight on: crossed, %']:.1f} % of 500 forests if it flies",
        f"{x['the laser pilot, along the rows: crossed, %']:.1f} % if it turns back along the",
        f"and {x['the laser pilot, by compass: crossed, %']:.1f} % with a compass",
    ):
        assert said in LONG


def test_the_atlas_says_what_the_pages_say() -> None:
    atlas = report("atlas")
    dense, speed = atlas["densities"].index(2.0), atlas["speeds"].index(5.0)
    camera, laser = (100 * atlas["crossed"][x][dense][speed] for x in ("camera, beacon", "laser"))
    assert f"crosses {camera:.0f} % at 5 m/s, and the laser {laser:.0f} %." in LONG
    crashes = [flight for flight in atlas["worst"] if flight["outcome"] == "crash"]
    assert len(crashes) < len(atlas["worst"])  # so these are all of the crashes
    late = sum(flight["progress"] > 90 - 12 for flight in crashes)
    assert f"crashed in {len(crashes)}, {late} of them in the last 12 m" in LONG
    careless = sum(flight["cause"] == "careless" for flight in crashes)
    assert f"In {careless} of them it was not helpless" in LONG
    assert f"--first-seed {atlas['worst'][0]['seed']}" in RESULTS


def test_each_row_of_the_transfer_table_is_what_the_looks_did() -> None:
    table = report("transfer")

    def cell(pilot: str, look: str) -> str:
        if look not in table[pilot]:
            return ""
        x, change = table[pilot][look], table[pilot][look]["change"]["crossed"]
        crossed, crash, longer = (
            100 * x[key]["value"] for key in ("crossed", "crash", "over_random")
        )
        ends = f" [{100 * change['low']:+.1f}, {100 * change['high']:+.1f}]" * (look != "plain")
        return f"{crossed:.1f}{ends} / {crash:.1f} / {longer:.0f}"

    for look in {look: 0 for looks in table.values() for look in looks}:
        row = " | ".join([look, *(cell(pilot, look) for pilot in table)])
        assert f"| {row} |" in RESULTS


def test_the_clock_on_the_pages_is_the_measured_one() -> None:
    rewards, taught = (report("clock")[name] for name in ("from rewards", "taught"))
    steps, later = (max(s["step"] for s in x["seeds"].values()) for x in (rewards, taught))
    assert f"After {steps:,} of its" in FLAT
    assert f"or {rewards['median']:.0f} seconds, it flies over" in FLAT
    assert f"after {rewards['median']:.0f} s and at most {steps:,} steps" in LONG
    assert f"After {later:,} steps, or {taught['median']:.0f} seconds, half of its" in FLAT
    assert f"after {taught['median']:.0f} s and at most {later:,} steps" in LONG


def test_the_minutes_of_a_training_are_those_of_its_log() -> None:
    for name, said in (
        ("paper", "With `--threads 1` it made the shipped pilot in {} minutes."),
        ("beacon", "It took {} minutes for 400,000 steps"),
        ("disparity", "made `weights/disparity.pt` in {} minutes"),
    ):
        *_, seconds = (ROOT / f"results/{name}/log.csv").read_text().splitlines()[-1].split(",")
        assert said.format(round(float(seconds) / 60)) in FLAT + LONG
    assert f"10,000 of its {DQNConfig.steps:,} steps" in FLAT


def test_the_flights_at_three_control_rates_are_what_was_measured() -> None:
    x = report("clock_rate")
    steps, over = (
        [x[rate][pilot][key]["value"] for rate in ("10", "30", "50")]
        for pilot, key in (("random", "steps"), ("laser", "over_random"))
    )
    said = "lasts {:.1f} steps here at 10 Hz, {:.1f} at 30 Hz and {:.1f} at 50 Hz"
    assert said.format(*steps) in LONG
    assert "is {:+.0%} at 10 Hz, {:+.0%} at 30 Hz and {:+.0%} at 50 Hz".format(*over) in (
        LONG.replace(" %", "%")
    )


def test_each_training_of_the_ladder_is_on_the_long_page() -> None:
    def cell(seed: dict) -> str:
        x = {key: figure["value"] for key, figure in seed["best"].items()}
        return f"{100 * x['over_random']:.0f} / {x['return']:.0f} / {100 * x['crossed']:.0f}"

    for label, seeds in report("ladder").items():
        cells = [cell(seeds[seed]) if seed in seeds else "" for seed in "012"]
        assert " ".join(f"| {label} | {' | '.join(cells)} |".split()) in LONG


def test_each_way_to_be_taught_is_on_the_long_page() -> None:
    def cell(figures: dict) -> str:
        x = {key: figure["value"] for key, figure in figures.items()}
        said = f"{100 * x['over_random']:.0f} / {x['return']:.0f} / {100 * x['crossed']:.0f}"
        return f"{said} / {100 * x['crash']:.1f}"

    for label, seeds in report("demonstrations").items():
        cells = [cell(seeds[seed]) if seed in seeds else "" for seed in "01"]
        assert " ".join(f"| {label} | {' | '.join(cells)} |".split()) in LONG


def test_what_mnihs_settings_give_is_what_was_measured() -> None:
    for name in ("best", "last"):
        flown = report(f"ladder/0-0/{name}")
        assert (flown["forests"], flown["first_seed"]) == (500, 3 * 10**9)
        x = flown["pilots"]["dqn"]
        for key, factor, digits in (("over_random", 100, 0), ("return", 1, 1), ("crossed", 100, 1)):
            assert shown(x[key], factor, digits) in LONG


def test_each_ratio_of_the_benchmark_is_on_the_long_page() -> None:
    for name, figure in report("bench")["figures"].items():
        assert f"| {name} | {figure:.2f} |" in RESULTS
