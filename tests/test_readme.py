"""The pages: every table in them is what the committed results say."""

import re
from pathlib import Path

import pytest

from extras.experiments import tables

README = (tables.ROOT / "README.md").read_text()
RESULTS = (tables.ROOT / "results/README.md").read_text()


def test_the_front_page_shows_the_table_that_eval_printed() -> None:
    assert f"```\n{tables.front()}\n```" in README


@pytest.mark.parametrize(
    ("columns", "page"),
    [(tables.FRONT, README), (tables.FULL, RESULTS)],
    ids=["front", "full"],
)
def test_a_table_of_results_is_generated_from_the_committed_episodes(
    columns: dict, page: str
) -> None:
    assert tables.markdown(columns) in page


def test_the_ratios_of_speed_are_those_that_the_bench_wrote() -> None:
    for name, value in tables.read("bench")["ratios"].items():
        peer = name.rsplit(" / ")[1] if name.startswith("environment") else name
        (row,) = (line for line in RESULTS.splitlines() if line.startswith(f"| {peer} |"))
        assert f" {value:.2f} |" in row


@pytest.mark.parametrize("name", ["dqn", "dqn-1", "dqn-2", "dqn-beacon", "imitation"])
def test_the_headline_numbers_are_of_the_first_thousand_test_forests(name: str) -> None:
    report = tables.read(name)
    assert (report["first_seed"], report["forests"]) == (4 * 10**9, 1000)


def test_the_lessons_table_is_generated_from_the_committed_episodes() -> None:
    assert tables.lessons() in (tables.ROOT / "extras/lessons/README.md").read_text()


def test_every_file_that_the_pages_link_to_exists() -> None:
    for page in ("README.md", "results/README.md", "extras/README.md", "extras/lessons/README.md"):
        path = tables.ROOT / page
        for link in re.findall(r"\]\(([^):#]+)\)", path.read_text()):
            assert (path.parent / link).exists(), (page, link)


def test_the_pages_are_short() -> None:
    assert len(RESULTS.split()) <= 3000
    assert len(README.split()) <= 950
    assert README.count("\n") <= 110


def test_every_weights_file_that_is_shipped_is_named_after_its_pilot() -> None:
    for path in Path(tables.ROOT / "weights").glob("*.pt"):
        saved = tables.deepflight.load(path, "pilot", "beacon", "camera")
        suffix = "-beacon" * saved["beacon"] + "-disparity" * (saved["camera"] == "disparity")
        assert path.stem == saved["pilot"] + suffix
