"""What processor seconds of training buy: PSNR of held-out and of trained-on pixels, by the kept runs.

    python -m benchmarks.speed.curves

Reads the kept runs of the real drive (`real_drive.json.xz`, `real_drive_seconds.json.xz`) and of the unseen rendered
drives (`unseen.json.xz`) and writes the table of docs/speed.md, after a fifth, half and all of ours' seconds, and
docs/speed_curves.svg. All methods run in the same kernels on the CPU. The best rival without extras is there twice: for
as many steps as ours, and for as many as ours' seconds allow, its learning rates falling over these. A method that ends
before ours keeps its last PSNR.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.kept_runs import results_of
from benchmarks.pages import with_part
from edge_depth_nerf.base.files import write_atomically, write_text
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.plots import style_of
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.tables import curve_metric, psnr_at

HERE = Path(__file__).resolve().parent
PAGE, DRAWN = (HERE.parents[1] / "docs" / name for name in ("speed.md", "speed_curves.svg"))
KEPT = HERE.parent / "quality"
PART = "speed: curves"
SHARES = {"a fifth": 0.2, "half": 0.5, "all": 1.0}
"""Of ours' processor seconds."""
CLOCK = "cpu_seconds"
LENGTHENED = ", in ours' seconds"


@dataclass(frozen=True)
class Drives:
    """Runs of a kind of drives: of as many steps each, and the best rival's of as many seconds as ours."""

    title: str
    runs: Results
    longer: Results

    def rows(self) -> dict[str, list[RunResult]]:
        """The runs of each row of the table, by its title; ours comes last."""
        found = {
            METHODS[name].title: [run for run in self.runs.runs if run.method == name] for name in self.runs.methods()
        }
        ours = found.pop(METHODS["edge"].title)
        lengthened = {
            METHODS[name].title + LENGTHENED: [run for run in self.longer.runs if run.method == name]
            for name in self.longer.methods()
        }
        return {**found, **lengthened, METHODS["edge"].title: ours}


def kept(folder: Path = KEPT) -> list[Drives]:
    """The kept runs."""
    unseen = results_of(folder / "unseen.json.xz").runs
    of_part = {part: [run for run in unseen if run.folder.parts[0] == part] for part in ("claims", "seconds")}
    return [
        Drives(
            "real drive",
            results_of(folder / "real_drive.json.xz"),
            results_of(folder / "real_drive_seconds.json.xz"),
        ),
        Drives("rendered drives", Results(of_part["claims"]), Results(of_part["seconds"])),
    ]


def our_seconds(drives: Drives) -> dict[str, float]:
    """Processor seconds of ours by drive, mean over seeds."""
    ours = [run for run in drives.runs.runs if run.method == "edge"]
    return {
        scene: statistics.fmean(run.curve[-1][CLOCK] for run in ours if run.scene == scene)
        for scene in drives.runs.scenes()
    }


def mean_at(runs: Sequence[RunResult], seconds: Mapping[str, float], share: float, metric: str) -> float:
    """Mean PSNR of runs after a share of their drives' seconds."""
    return statistics.fmean(psnr_at(run.curve, share * seconds[run.scene], metric, CLOCK) for run in runs)


def table(of_drives: Sequence[Drives]) -> Iterator[str]:
    """All methods after shares of ours' seconds, as Markdown: held out, trained on."""
    yield (
        "| | "
        + " | ".join(f"{share} of ours' seconds: {what}" for share in SHARES for what in ("held out", "trained on"))
        + " |"
    )
    yield "|---" * (1 + 2 * len(SHARES)) + "|"
    for drives in of_drives:
        seconds, name = our_seconds(drives), curve_metric(drives.runs)
        for title, runs in drives.rows().items():
            # runs of versions before 0.1 did not look at trained-on pixels
            cells = [
                f"{mean_at(runs, seconds, share, metric):.2f}" if metric in runs[0].curve[-1] else "–"
                for share in SHARES.values()
                for metric in (name, f"trained_{name}")
            ]
            yield f"| {drives.title}: {title} | " + " | ".join(cells) + " |"


def draw(of_drives: Sequence[Drives], path: Path) -> None:
    """Curves of held-out and trained-on pixels over processor seconds, means over drives and seeds."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "curves"})
    figure, axes = plt.subplots(len(of_drives), 2, figsize=(10, 3.2 * len(of_drives)), layout="constrained")
    for row, drives in zip(axes, of_drives, strict=True):
        name = curve_metric(drives.runs)
        for axis, metric, what in zip(row, (name, f"trained_{name}"), ("held-out", "trained-on"), strict=True):
            if metric not in drives.runs.runs[0].curve[-1]:
                axis.set_axis_off()
                continue
            for title, runs in drives.rows().items():
                colour, _, _, marker = style_of(runs[0].method)
                x, y = (
                    [
                        statistics.fmean(values)
                        for values in zip(*([p[key] for p in run.curve] for run in runs), strict=True)
                    ]
                    for key in (CLOCK, metric)
                )
                line = "-" if runs[0].method == "edge" else ":" if title.endswith(LENGTHENED) else "--"
                axis.plot(x, y, line, color=colour, marker=marker, markersize=3, linewidth=1.4, label=title)
            axis.set(xlabel="processor seconds", ylabel=f"PSNR of {what} pixels, dB", title=drives.title)
            axis.grid(color="#dddddd", lw=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        row[0].legend(frameon=False, fontsize=7)
    write_atomically(path, lambda temporary: figure.savefig(temporary, format="svg", metadata={"Date": None}))
    plt.close(figure)


def main() -> None:
    drives = kept()
    write_text(PAGE, with_part(PAGE.read_text(encoding="utf-8"), PART, "\n".join(table(drives))))
    draw(drives, DRAWN)


if __name__ == "__main__":
    main()
