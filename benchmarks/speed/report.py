"""Tables of what `benchmarks.speed.run` measured; a part that is missing is left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.pages import with_part


def ratios(reference: Sequence[float], own: Sequence[float]) -> list[float]:
    """One's seconds over the other's, round by round."""
    return [host / ours for host, ours in zip(reference, own, strict=True)]


def times(values: Sequence[float]) -> str:
    """A ratio: median and range."""
    return f"{median(values):.1f} ({min(values):.1f}-{max(values):.1f})"


def rows_of(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is text."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def presets(results: dict[str, Any]) -> str:
    """Steps and views of both presets."""
    rows = []
    for preset in ("lite", "full"):
        if preset not in results:
            continue
        both = [results[preset][name] for name in ("nerfacto", "ours")]
        steps = [f"{median(each['step_s']) * 1e3:,.0f} ms" for each in both]
        rows.append([f"a training step, {preset}", *steps, times(ratios(*(each["step_s"] for each in both)))])
        height, width = both[1]["rendered_px"]
        views = [f"{median(each['render_s']):.2f} s" for each in both]
        ratio = times(ratios(*(each["render_s"] for each in both)))
        rows.append([f"rendering {width} × {height} px, {preset}", *views, ratio])
    return rows_of(["", "nerfacto, torch", "ours", "ratio"], rows)


def data(results: dict[str, Any]) -> str:
    """Memory and first batches of training data."""
    rows = []
    for found in results.get("frames", []):
        both = [found["data"][name] for name in ("nerfacto", "ours")]
        memory = (f"{each['anonymous_mb'] - each['begun_mb']:,.0f} MB" for each in both)
        first = (f"{each['first_batch_s']:.1f} s" for each in both)
        rows.append([f"{found['value']:,} of 350 px", *memory, *first])
    if "memory" in results:
        host, ours = results["memory"]["nerfstudio"], results["memory"]["ours"]
        memory = f"{host['computed_mb']:,.0f} MB (computed)", f"{ours['anonymous_mb'] - ours['begun_mb']:,.0f} MB"
        rows.append(["300 of 1400 px", *memory, "–", f"{ours['first_batch_s']:.0f} s"])
    return rows_of(
        ["pictures", "nerfstudio: memory", "ours: memory", "nerfstudio: first batch", "ours: first batch"],
        rows,
    )


def preparation(results: dict[str, Any]) -> str:
    """`process`, and the integration of a prior."""
    rows = []
    for row in results.get("preparation", []):
        cores = "1 core" if row["cores"] == 1 else f"{row['cores']} cores"
        rows.append([cores, f"{row['s']:.0f} s", f"{row['peak_mb'] / 1024:.2f} GB", f"{row['integration_s']:.2f} s"])
    return rows_of(["", "`process`, 12 pictures", "its memory", "the prior of a picture"], rows)


TABLES = {"presets": presets, "data": data, "preparation": preparation}


def with_tables(page: str, results: dict[str, Any]) -> str:
    """A page with its tables made anew."""
    for name, make in TABLES.items():
        page = with_part(page, f"speed: {name}", make(results))
    return page


def write_tables(results: dict[str, Any], pages: Sequence[Path]) -> None:
    """Put the tables into pages that have a place for them."""
    for path in pages:
        path.write_text(with_tables(path.read_text(encoding="utf-8"), results), encoding="utf-8")
