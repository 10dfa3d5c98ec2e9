"""The README's numbers are those of the committed results, so that neither can go stale."""

import csv
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import deepflight
from extras import ablate

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
FLAT = README.replace("\n", " ")
FIGURES = {  # of eval's JSON -> label in the README, factor, digits
    "over_random": ("flight time over random", 100, 0),
    "crossed": ("crossed (arrived, or left by the far edge)", 100, 1),
    "goal": ("arrived", 100, 1),
    "crash": ("crashed", 100, 1),
    "progress": ("mean progress", 1, 1),
}


def report(name: str) -> dict:
    """What `eval --json results/NAME.json` wrote."""
    return json.loads((ROOT / f"results/{name}.json").read_text())


@pytest.mark.parametrize("figure", FIGURES)
def test_each_row_of_the_headline_table_is_what_eval_wrote(figure: str) -> None:
    label, factor, digits = FIGURES[figure]
    unit = " m" if figure == "progress" else " %"
    row = f"| {label} |"
    for name, pilot in (("paper", "dqn"), ("beacon", "dqn"), ("pilots", "laser"), ("mnih", "dqn")):
        x = {
            k: f"{factor * v:.{digits}f}" for k, v in report(name)["pilots"][pilot][figure].items()
        }
        sign = "+" if figure == "over_random" else ""
        row += f" {sign}{x['value']}{unit} [{x['low']}, {x['high']}] |"
    assert row in README


@pytest.mark.parametrize(
    ("name", "forests"), [("paper", 1000), ("beacon", 1000), ("pilots", 1000), ("mnih", 500)]
)
def test_headline_numbers_come_from_forests_that_no_training_has_seen(
    name: str, forests: int
) -> None:
    assert report(name)["forests"] == forests
    assert report(name)["first_seed"] == 3 * 10**9


def test_the_first_table_is_what_eval_prints(capsys: pytest.CaptureFixture) -> None:
    shown = report("eval")
    deepflight.print_table(shown["pilots"])
    table = capsys.readouterr().out
    assert table in README
    head = f"{shown['forests']} forests from seed {shown['first_seed']}; the random pilot flies"
    assert head in README


def test_what_the_readme_says_of_veering_is_what_was_measured() -> None:
    measured = json.loads((ROOT / "results/veer.json").read_text())["pilots"]["dqn"]
    for name, factor, digits in (
        ("one side free", 1, 3),
        ("towards middle", 1, 3),
        ("edge time", 100, 1),
    ):
        x = {k: f"{factor * v:.{digits}f}" for k, v in measured[name].items()}
        unit = "%" if name == "edge time" else "rad/s"
        assert f"{x['value']} {unit} [{x['low']}, {x['high']}]" in FLAT


def test_the_readme_counts_how_the_headline_flights_ended() -> None:
    ends = Counter(f["edge"] or f["outcome"] for f in report("paper")["pilots"]["dqn"]["flights"])
    counts = (
        "of 1,000 flights {far} left by the far edge, {side} by a side, {back} by the back; {goal} "
    )
    counts += "arrived, {crash} crashed and {time} ran out of time"
    assert counts.format_map(ends) in FLAT
    flights = report("paper")["pilots"]["dqn"]["flights"]
    sides = [f["progress"] > 80 for f in flights if f["edge"] == "side"]
    assert f"{np.mean([f['progress'] > 80 for f in flights]):.0%}".replace("%", " %") in FLAT
    assert f"of the {len(sides)} that did, two thirds" in FLAT
    now, before = (report(x)["pilots"]["dqn"]["return"]["value"] for x in ("paper", "before/paper"))
    assert f"{now:.1f} on the headline forests where the recipe before had {before:.1f}" in FLAT
    assert np.mean(sides) == pytest.approx(2 / 3, abs=0.05)


def test_the_papers_settings_rise_and_fall_when_the_readme_says() -> None:
    rows = list(csv.DictReader((ROOT / "results/mnih/log.csv").open()))
    over = {int(row["step"]): float(row["test_over_random"]) for row in rows}
    best = max(rows, key=lambda row: (float(row["test_crossed"]), float(row["test_progress"])))
    passed = next(step for step, x in over.items() if x > 1.8)
    fell = next(step for step, x in over.items() if step > passed and x < 0.2)
    assert max(over) == 1_400_000 and max(x for step, x in over.items() if step > fell) < 0.2
    for step in (passed, fell, int(best["step"])):
        assert f"step {step:,}" in FLAT


def test_the_five_seeds_figures_are_those_of_their_logs_and_flights() -> None:
    flown = [report(f"before/seeds/{seed}")["pilots"]["dqn"] for seed in range(5)]
    figures = [f"{100 * pilot['over_random']['value']:+.0f}" for pilot in flown]
    assert f"{', '.join(figures[:4])} and {figures[4]} %" in FLAT
    for seed in range(5):
        rows = list(csv.DictReader((ROOT / f"results/before/seeds/{seed}.csv").open()))
        passed = (int(row["step"]) for row in rows if float(row["test_over_random"]) > 1.8)
        assert next(passed) in (10_000, 15_000)


def test_the_trainings_before_flew_as_the_readme_says() -> None:
    for name, forests, label in (
        ("paper", 1000, "paper's world, seed 0"),
        ("paper-1", 500, "paper's world, seed 1"),
        ("beacon", 500, "with the beacon, seed 0"),
        ("beacon-1", 500, "with the beacon, seed 1"),
    ):
        flown = report(f"before/{name}")
        assert (flown["forests"], flown["first_seed"]) == (forests, 3 * 10**9)
        row = f"| {label} | {forests:,} |"
        for key in ("over_random", "crossed", "goal", "crash"):
            digits, sign = (0, "+") if key == "over_random" else (1, "")
            shown = flown["pilots"]["dqn"][key]
            x = {k: f"{100 * v:.{digits}f}" for k, v in shown.items()}
            row += f" {sign}{x['value']} % [{x['low']}, {x['high']}] |"
        assert row in README


def test_the_readme_says_how_blind_the_papers_settings_became() -> None:
    dead = json.loads((ROOT / "results/dead.json").read_text())["networks"]
    best, last = dead["results/mnih/best.pt"], dead["results/mnih/last.pt"]
    first, ours = (x["layer 1"].split()[0] for x in (best, dead["weights/paper.pt"]))
    assert f"In the first layer {first} of 32 did already" in FLAT
    assert f"and {ours} of 32 do in ours" in FLAT
    assert last["layer 3"] == "64 of 64" and last["actions"] == "1 of 9"
    rows = list(csv.DictReader((ROOT / "results/mnih/log.csv").open()))
    late = [row["test_steps"] for row in rows if int(row["step"]) >= 760_000]
    assert (len(late), len(set(late))) == (33, 9)


def test_the_clock_in_the_readme_is_the_measured_one() -> None:
    clock = json.loads((ROOT / "results/clock.json").read_text())
    assert f"passes +180 % after {clock['median']:.0f} s" in FLAT
    assert "and 10,000 steps, with each of seeds 0 to 4" in FLAT
    assert {seed["step"] for seed in clock["seeds"].values()} == {10_000}
    minutes = clock["mnih, to the figure"] / 60
    assert f"the paper's settings after some {minutes:.0f} minutes" in FLAT


def test_each_ratio_of_the_benchmark_is_in_the_readme() -> None:
    for name, figure in json.loads((ROOT / "results/bench.json").read_text())["figures"].items():
        assert f"| {name} | {figure:.2f} |" in README


def test_what_the_readme_says_of_the_compass_is_what_was_measured() -> None:
    x = json.loads((ROOT / "results/compass.json").read_text())
    for said in (
        f"to {x['rows in the middle, degrees off']:.0f} degrees (chance is 45)",
        f"it faces ({x['heading in the middle, degrees off']:.0f}; chance is 90)",
        f"for a side in {x['the far edge taken for side, %']:.0f} % of cases (chance is 50)",
        f"for the far edge in {x['the far edge taken for far, %']:.0f} % (25)",
        f"the back it knows in {x['the back taken for back, %']:.0f} %",
        f"crosses {x['the laser pilot, straight on: crossed, %']:.1f} % of 500 forests",
        f"and {x['the laser pilot, by compass: crossed, %']:.1f} % with a compass",
        f"{x['the laser pilot, along the rows: crossed, %']:.1f} % if it turns back along the rows",
    ):
        assert said in FLAT


def test_the_beacon_pilot_and_the_laser_are_compared_forest_by_forest() -> None:
    camera, laser = (
        np.array([f["outcome"] == "goal" for f in report(name)["pilots"][pilot]["flights"]])
        for name, pilot in (("beacon", "dqn"), ("pilots", "laser"))
    )
    difference = 100 * (camera.astype(float) - laser)  # (F,) points
    mean, half = difference.mean(), 1.96 * difference.std() / np.sqrt(len(difference))
    said = f"arrives in {-mean:.1f} [{-mean - half:.1f}, {-mean + half:.1f}] percentage points"
    assert f"{said} fewer of them" in FLAT


def test_the_table_of_ablations_is_that_of_their_logs() -> None:
    for row in ablate.table():
        assert row in README


def test_the_atlas_says_what_the_readme_says() -> None:
    atlas = json.loads((ROOT / "results/atlas.json").read_text())
    dense, speed = atlas["densities"].index(2.0), atlas["speeds"].index(5.0)
    camera, laser = (100 * atlas["crossed"][x][dense][speed] for x in ("camera, beacon", "laser"))
    assert f"crosses {camera:.0f} % at 5 m/s, the laser {laser:.0f} %" in FLAT
    crashes = [flight for flight in atlas["worst"] if flight["outcome"] == "crash"]
    assert len(crashes) < len(atlas["worst"])  # so these are all of the crashes
    late = sum(flight["progress"] > 90 - 12 for flight in crashes)
    assert f"it crashed in {len(crashes)}, {late} of them in the last 12 m" in FLAT
    careless = sum(flight["cause"] == "careless" for flight in crashes)
    assert f"and {careless} of them not helpless: it had seen the trunk" in FLAT
    beacon = [f for f in report("beacon")["pilots"]["dqn"]["flights"] if f["outcome"] == "crash"]
    late = sum(flight["progress"] > 90 - 12 for flight in beacon)
    assert f"Of its {len(beacon)} crashes in the 1,000 headline forests, {late} lie there" in FLAT
    assert f"--first-seed {atlas['worst'][0]['seed']}" in FLAT
