"""Tables and curves of what `benchmarks.speed.run` measured; a part that is missing is left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.pages import with_part
from edge_depth_nerf.base.files import write_atomically


def times(values: Sequence[float]) -> str:
    """A ratio: median and range."""
    return f"{median(values):.1f} ({min(values):.1f}-{max(values):.1f})"


def rows_of(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is text."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def summary(results: dict[str, Any]) -> str:
    """The summary: one line for each thing that is faster."""
    rows = []
    for row in results.get("encoding", []):
        low, ratio, high = row["ratio_quartiles"]
        size = f"{row['levels']} levels, 2^{row['rows'].bit_length() - 1} rows, {row['points']:,} points"
        taken = f"{row['torch_ms']:.0f} ms", f"{row['fused_ms']:.1f} ms"
        rows.append([f"hash grid, {size}", *taken, f"{ratio:.1f} ({low:.1f}-{high:.1f})"])
    for preset in ("lite", "full"):
        if preset not in results:
            continue
        host, ours = results[preset]["nerfacto"], results[preset]["ours"]
        steps = [f"{median(each['step_s']) * 1e3:,.0f} ms" for each in (host, ours)]
        rows.append([f"training step, {preset}", *steps, times(ours["step_ratio"])])
        views = [f"{median(each['render_s']):.2f} s" for each in (host, ours)]
        height, width = ours["rendered_px"]
        rows.append([f"rendering {width} × {height} px, {preset}", *views, times(ours["render_ratio"])])
    if "memory" in results:
        host, ours = results["memory"]["nerfstudio"], results["memory"]["ours"]
        most, least = host["computed_mb"] / 1024, ours["anonymous_mb"] / 1024
        sizes = f"{most:.1f} GB (computed)", f"{least:.2f} GB"
        rows.append(["memory, 300 pictures of 1400 px", *sizes, f"{most / least:.0f}"])
    return rows_of(["", "nerfstudio, torch", "ours", "ratio"], rows)


def trainers(results: dict[str, Any]) -> str:
    """All four trainers of both presets."""
    rows = []
    for preset in ("lite", "full"):
        for name, found in results.get(preset, {}).items():
            steps = times([1e3 * each for each in found["step_s"]]), times(found["step_ratio"])
            views = f"{median(found['render_s']):.2f}", times(found["render_ratio"])
            rows.append([f"{preset}: {name}", f"{found['rays_per_second']:,.0f}", *steps, *views])
    return rows_of(["", "rays/s", "ms a step", "× nerfacto", "s a view", "× nerfacto"], rows)


GROWTH = {"rays": "rays a batch", "samples": "samples a ray, × lite's", "image_size": "width and height, px"}


def growth(results: dict[str, Any]) -> str:
    """Steps that grow."""
    rows = []
    for part, label in GROWTH.items():
        for found in results.get(part, []):
            host, ours = found["nerfacto"], found["ours"]
            steps = [f"{median(each['step_s']) * 1e3:,.0f}" for each in (host, ours)]
            rows.append([f"{label}: {found['value']:g}", *steps, times(ours["step_ratio"])])
    return rows_of(["", "nerfacto, ms a step", "ours, ms a step", "ratio"], rows)


def data(results: dict[str, Any]) -> str:
    """First batches, batches and memory of training data."""
    rows = []
    for part, label in (("frames", "{} pictures of 350 px"), ("image_size", "40 pictures of {} px")):
        for found in results.get(part, []):
            host, ours = found["data"]["nerfacto"], found["data"]["ours"]
            rows.append(
                [
                    label.format(found["value"]),
                    *(f"{each['first_batch_s']:.1f}" for each in (host, ours)),
                    *(f"{each['batch_s'] * 1e3:.2f}" for each in (host, ours)),
                    f"{ours['cold_batch_s'] * 1e3:.2f}",
                    *(f"{each['anonymous_mb'] - each['begun_mb']:,.0f}" for each in (host, ours)),
                ]
            )
    if "memory" in results:
        host, ours = results["memory"]["nerfstudio"], results["memory"]["ours"]
        rows.append(
            [
                *("300 pictures of 1400 px", "–", f"{ours['first_batch_s']:.0f}"),
                *("–", f"{ours['batch_s'] * 1e3:.2f}", f"{ours['cold_batch_s'] * 1e3:.2f}"),
                f"{host['computed_mb']:,.0f} (computed)",
                f"{ours['anonymous_mb'] - ours['begun_mb']:,.0f}",
            ]
        )
    return rows_of(
        [
            *("", "nerfstudio, first batch, s", "ours, first batch, s", "nerfstudio, a batch, ms", "ours, a batch, ms"),
            *("… from a cold disk, ms", "nerfstudio, MB", "ours, MB"),
        ],
        rows,
    )


def rest(results: dict[str, Any]) -> str:
    """Start-up and preparation."""
    rows = []
    if "start_up" in results:
        found = results["start_up"]
        rows.append(["`edge-depth-nerf --help`", f"{median(found['help_s']):.2f} s"])
        rows.append(["what the plugin adds to any `ns-*` command", f"{median(found['plugin_adds_s']):.2f} s"])
    for row in results.get("preparation", []):
        cores = "1 core" if row["cores"] == 1 else f"{row['cores']} cores"
        what = f"`process`, {row['pictures']} pictures of 1400 px, {cores}"
        rows.append([what, f"{row['s']:.1f} s, at most {row['peak_mb'] / 1024:.2f} GB"])
        rows.append([f"prior of a picture of 1400 px, {cores}", f"{row['integration_s']:.2f} s"])
    return rows_of(["", "measured"], rows)


def commits(results: dict[str, Any]) -> str:
    """Which commit and machine each part is of."""
    same: dict[tuple[str, str, str], list[str]] = {}
    for part, of in results.get("of", {}).items():
        same.setdefault((of["commit"], of["processor"], of["torch"]), []).append(part)
    rows = [[", ".join(names), *of] for of, names in same.items()]
    return rows_of(["parts", "commit", "processor", "torch"], rows)


TABLES = {"commits": commits, "summary": summary, "trainers": trainers, "growth": growth, "data": data, "rest": rest}


def with_tables(page: str, results: dict[str, Any]) -> str:
    """A page with its tables made anew."""
    for name, make in TABLES.items():
        page = with_part(page, f"speed: {name}", make(results))
    return page


def write_tables(results: dict[str, Any], pages: Sequence[Path]) -> None:
    """Put the tables into pages that have a place for them."""
    for path in pages:
        path.write_text(with_tables(path.read_text(encoding="utf-8"), results), encoding="utf-8")


def draw(results: dict[str, Any], path: Path) -> None:
    """Curves of what grows."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "speed"})
    colours = {"nerfacto": "#b0562f", "ours": "#1f6f8b"}
    figure, axes = plt.subplots(1, 4, figsize=(12, 3), layout="constrained")
    panels = [(part, GROWTH[part], "ms a step", step_ms) for part in GROWTH]
    panels.append(("frames", "pictures of 350 px", "memory of training data, MB", data_mb))
    for axis, (part, across, up, value_of) in zip(axes, panels, strict=True):
        rows = results.get(part, [])
        if not rows:
            axis.set_axis_off()
            continue
        for name, colour in colours.items():
            axis.plot([row["value"] for row in rows], [value_of(row, name) for row in rows], "o-", color=colour, ms=4)
        axis.set(xscale="log", yscale="log", xlabel=across, ylabel=up)
        ticks = [row["value"] for row in rows]
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
        axis.grid(color="#dddddd", lw=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    if results.get("rays"):
        axes[0].legend(["nerfacto, torch", "ours"], frameon=False)
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="svg", metadata={"Date": None}))
    plt.close(figure)


def step_ms(row: dict[str, Any], name: str) -> float:
    return 1e3 * median(row[name]["step_s"])


def data_mb(row: dict[str, Any], name: str) -> float:
    found = row["data"][name]
    return max(1.0, found["anonymous_mb"] - found["begun_mb"])
