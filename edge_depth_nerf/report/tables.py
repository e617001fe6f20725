"""Tables of figures, for the page, the terminal, Markdown and LaTeX.

A cell is a mean over seeds with its sample standard deviation.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Metric:
    """A column."""

    name: str
    """Its name in the figures of a run."""
    heading: str
    form: str
    best: int = 1
    """1: larger is better; -1: smaller is better; 0: neither."""


@dataclass
class Cell:
    """A figure: mean and spread over seeds."""

    mean: float | None
    spread: float | None = None
    """Sample standard deviation; None for a single seed."""
    form: str = ".2f"
    words: str | None = None
    """A text instead of a figure."""
    best: bool = False
    """Whether it is the best of its column."""

    def text(self) -> str:
        """Return the text of the cell."""
        if self.words is not None:
            return self.words
        if self.mean is None:
            return "–"
        spread = "" if self.spread is None else f" ± {self.spread:{self.form.replace('+', '')}}"
        return f"{self.mean:{self.form}}{spread}"


@dataclass
class Row:
    """A row."""

    title: str
    cells: list[Cell]


@dataclass
class MadeTable:
    """A table with its headings: groups (drives) of columns."""

    label: str
    title: str
    groups: list[tuple[str, list[str]]]
    rows: list[Row]
    notes: list[str] = field(default_factory=list)
    on_terminal: bool = True

    @property
    def caption(self) -> str:
        """All notes in one text."""
        return " ".join(self.notes)

    def headings(self) -> list[tuple[str, str]]:
        """Return the group and heading of each column."""
        return [(group, heading) for group, headings in self.groups for heading in headings]


def mean_and_spread(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Return mean and sample standard deviation; None if there are too few values."""
    if not values:
        return None, None
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None


def mark_best(rows: Sequence[Row], better: Sequence[int]) -> None:
    """Mark the best cells of each column; `better` is 1 if larger is better, -1 if smaller is, and 0 for neither."""
    for column, sign in enumerate(better):
        cells = [row.cells[column] for row in rows if row.cells[column].mean is not None]
        if sign and len(cells) > 1:
            texts = {cell.text().split(" ")[0]: cell for cell in cells}
            best = max(texts, key=lambda text: sign * float(text))
            for cell in cells:
                cell.best = cell.text().split(" ")[0] == best
