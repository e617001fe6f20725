"""Tables of figures, for the page, the terminal, Markdown and LaTeX.

A cell is a mean over seeds with its sample standard deviation.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table
from rich.text import Text


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
    def heading(self) -> str:
        """The title, after its number if it has one."""
        return f"Table {self.label}. {self.title}" if self.label else self.title

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
            best = max(texts, key=lambda text: sign * float(text.rstrip("%")))
            for cell in cells:
                cell.best = cell.text().split(" ")[0] == best


def show_tables(tables: Sequence[MadeTable], console: Console) -> None:
    """Print the tables that fit a terminal."""
    for made in tables:
        if not made.on_terminal:
            continue
        table = Table("", title=made.heading, caption=made.caption)
        for group, heading in made.headings():
            table.add_column(f"{group}\n{heading}" if group else heading, justify="right")
        for row in made.rows:
            table.add_row(row.title, *(Text(cell.text(), "bold" * cell.best) for cell in row.cells))
        console.print(table)


def page_of_tables(title: str, lines: Sequence[str], tables: Sequence[MadeTable]) -> str:
    """Give a title, paragraphs and tables as Markdown."""
    parts = [f"# {title}", *lines]
    for table in tables:
        headings = [f"{group} {heading}".strip().replace("|", r"\|") for group, heading in table.headings()]
        lines = [f"| | {' | '.join(headings)} |", "|---|" + "---|" * len(headings)]
        for row in table.rows:
            cells = [f"**{cell.text()}**" if cell.best else cell.text() for cell in row.cells]
            lines.append(f"| {row.title} | {' | '.join(cells)} |")
        parts += [f"## {table.heading}", "\n".join(lines), *([table.caption] if table.notes else [])]
    return "\n\n".join(parts) + "\n"


_LATEX = {
    "\\": r"\textbackslash{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
    "^": r"\^{}",
    "~": r"\textasciitilde{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "±": r"$\pm$",
    "δ": r"$\delta$",
    "λ": r"$\lambda$",
    "σ": r"$\sigma$",
    "<": "$<$",
    ">": "$>$",
    "–": "--",
    "≥": r"$\geq$",
}


def latex_text(text: str) -> str:
    """Text as LaTeX takes it."""
    return "".join(_LATEX.get(char, char) for char in text)


def latex_of_tables(lines: Sequence[str], tables: Sequence[MadeTable]) -> str:
    """Give lines of comment and tables as LaTeX; no package beyond booktabs."""
    parts = ["% \\usepackage{booktabs}", *(f"% {line}" for line in lines)]
    for table in tables:
        columns = sum(len(headings) for _, headings in table.groups)
        lines = [r"\begin{table}", r"\centering", rf"\caption{{{latex_text(f'{table.title}. {table.caption}')}}}"]
        lines += [rf"\begin{{tabular}}{{l{'r' * columns}}}", r"\toprule"]
        if any(group for group, _ in table.groups):
            spans, rules, first = [], [], 2
            for group, headings in table.groups:
                spans.append(rf"\multicolumn{{{len(headings)}}}{{c}}{{{latex_text(group)}}}")
                rules.append(rf"\cmidrule(lr){{{first}-{first + len(headings) - 1}}}")
                first += len(headings)
            lines += [" & " + " & ".join(spans) + r" \\", "".join(rules)]
        lines += [" & " + " & ".join(latex_text(heading) for _, heading in table.headings()) + r" \\", r"\midrule"]
        for row in table.rows:
            cells = [latex_text(cell.text()) for cell in row.cells]
            bold = [rf"\textbf{{{text}}}" if cell.best else text for text, cell in zip(cells, row.cells, strict=True)]
            lines.append(f"{latex_text(row.title)} & {' & '.join(bold)} \\\\")
        lines += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
        parts.append(f"% {table.heading}\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"
