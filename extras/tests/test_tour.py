"""The notebook runs from top to bottom, and shows what it showed when it was kept."""

from pathlib import Path

import pytest

pytest.importorskip("nbclient", reason="extras/requirements.txt is not installed")

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

TOUR = Path(__file__).parents[1] / "lessons/tour.ipynb"


def shown(cell: NotebookNode) -> list[str]:
    """What a cell printed, and what kinds of pictures it drew."""
    return [out.get("text") or ", ".join(sorted(out["data"])) for out in cell.get("outputs", [])]


def test_the_tour_runs_and_shows_what_it_keeps() -> None:
    kept, fresh = (nbformat.read(TOUR, as_version=4) for _ in range(2))
    assert len(kept.cells) == 20
    NotebookClient(fresh, timeout=60, resources={"metadata": {"path": TOUR.parent}}).execute()
    assert [shown(cell) for cell in fresh.cells] == [shown(cell) for cell in kept.cells]
    assert sum("image/png" in text for cell in kept.cells for text in shown(cell)) == 8
