"""Is my curve normal? A training beside the committed ones with the same settings.

    extras/.venv/bin/python -m extras.experiments.compare runs/001

Looks for the logs in results/ whose settings are those of the run, seed and threads apart. Draws
the run over the band between their least and greatest values, in compare.png in the run's folder,
and says in a line a panel where the run stands at its last validation. Curves are means over five
validations, because one of 48 forests varies much.
"""

import argparse
import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from dqn import InputError

ROOT = Path(__file__).parents[2]
FREE = ("seed", "threads")  # settings that may differ
PANELS = {  # column of log.csv -> title, factor
    "validation_steps": ("steps of an episode", 1),
    "validation_return": ("return by the paper's reward", 1),
    "validation_crossed": ("crossed, %", 100),
}
POINTS = 5  # validations in a mean


def settings(folder: Path) -> dict[str, object]:
    """A training's settings, without those that may differ."""
    found = json.loads((folder / "config.json").read_text())
    return {key: value for key, value in found.items() if key not in FREE}


def curve(folder: Path, column: str) -> tuple[np.ndarray, np.ndarray]:
    """A column of a log (T,) at the steps (T,), each a mean over the last validations."""
    with (folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    step, y = (np.array([float(row[key]) for row in rows]) for key in ("step", column))
    return step, np.array([y[max(i - POINTS, 0) : i].mean() for i in range(1, len(y) + 1)])


def peers(folder: Path) -> list[Path]:
    """The committed trainings with the run's settings. InputError if there is none."""
    mine = settings(folder)
    found = [path.parent for path in (ROOT / "results").rglob("config.json")]
    same = [other for other in found if settings(other) == mine]
    if same:
        return sorted(same)
    nearest = min(found, key=lambda x: len(settings(x).items() ^ mine.items()))
    other = sorted(key for key, value in settings(nearest).items() if mine.get(key) != value)
    raise InputError(f"no committed training has these settings; {nearest} differs in {other}")


def compare(folder: Path, out: Path) -> None:
    """Draw three panels, and print a line for each."""
    others = peers(folder)
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for panel, (column, (title, factor)) in zip(axes, PANELS.items(), strict=True):
        step, y = curve(folder, column)
        curves = [np.interp(step, *curve(other, column)) for other in others]  # (T,) each
        low, high = np.min(curves, 0), np.max(curves, 0)  # (T,), (T,)
        panel.fill_between(step, factor * low, factor * high, alpha=0.3, label="committed seeds")
        panel.plot(step, factor * y, "C1", label=str(folder))
        panel.set(title=title, xlabel="control steps")
        panel.grid(alpha=0.3)
        place = "below" if y[-1] < low[-1] else "above" if y[-1] > high[-1] else "within"
        ends = f"{factor * low[-1]:.1f} to {factor * high[-1]:.1f}"
        print(f"{title}: {factor * y[-1]:.1f} at step {step[-1]:,.0f}, {place} {ends}")
    axes[0].legend()
    figure.savefig(out, dpi=100)
    print(f"wrote {out}; {len(others)} committed trainings have these settings")


def main(argv: Sequence[str] | None = None) -> int:
    """Compare. Bad input is one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="compare", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of a training, such as runs/001")
    folder = parser.parse_args(argv).folder
    try:
        compare(folder, folder / "compare.png")
    except (InputError, OSError) as error:
        print(f"compare: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
