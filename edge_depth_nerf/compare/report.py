"""What report.html shows of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from edge_depth_nerf.base.files import read_json, read_json_object
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.specification import OF_A_RUN, VIEWS
from edge_depth_nerf.compare.tables import fields_table, introduction, verdict
from edge_depth_nerf.jobs.runs import viewer_command
from edge_depth_nerf.report.build import Commands, Facts, Plot, Report
from edge_depth_nerf.report.tables import MadeTable
from edge_depth_nerf.report.views import make_drives
from edge_depth_nerf.scene.format import EXPORT_FIGURES


def make_report(results: Results, tables: Sequence[MadeTable], plots: Sequence[Plot], console: Console) -> Report:
    """Gather what the page shows; its pictures are made here, of the first seed of each method."""
    scenes, methods = results.scenes(), [METHODS[name].title for name in results.methods()]
    first = {scene: runs for scene in scenes if (runs := first_runs(results, scene))}
    drives = {
        scene: (Path(runs[0].specification["scene"]), {METHODS[run.method].title: run.folder / VIEWS for run in runs})
        for scene, runs in first.items()
    }
    configs = [run.config for runs in first.values() for run in runs if run.config]
    return Report(
        title=f"Comparison on {' and '.join(scenes) if len(scenes) < 3 else f'{len(scenes)} drives'}",
        lead=f"{', '.join(methods)}: trained with the same configuration except for "
        "each method's own fields, and evaluated alike on held-out views.",
        verdict=verdict(results),
        methods=methods,
        drives=make_drives(drives, console),
        notes=introduction(results),
        tables=tables,
        plots=plots,
        facts=[
            _shared(results),
            Facts("Versions", results.versions),
            *(_of_drive(scene, runs[0]) for scene, runs in first.items()),
            _configuration(results),
        ],
        settings=[fields_table(results)],
        commands=[
            Commands("What made this", results.options.get("commands", [])),
            Commands("View the trained scenes", [viewer_command(path) for path in configs]),
        ],
    )


def first_runs(results: Results, scene: str) -> list[RunResult]:
    """Of each method on a drive the run of the first seed that can be looked at, in the tables' order."""
    runs = [run for run in results.runs if run.scene == scene and run.to_look_at]
    found = [[run for run in runs if run.method == name] for name in results.methods()]
    return [min(runs, key=lambda run: run.seed) for runs in found if runs]


def _shared(results: Results) -> Facts:
    options, run = results.options, results.runs[0]
    entries = {
        "Preset": options["preset"],
        "Steps of each run": f"{run.content['steps']:,}",
        "Seeds": ", ".join(map(str, results.seeds())),
        "nerfacto, UrbanNeRF and DS-NeRF": "in the same kernels as ours",
        "Trained on": ", ".join(sorted({str(each.content["device"]) for each in results.runs})),
        "Cores of the machine": str(results.cores),
    }
    return Facts("Comparison", entries)


def _of_drive(scene: str, run: RunResult) -> Facts:
    folder = Path(run.specification["scene"])
    meta = read_json(folder / "transforms.json")
    source = meta.get("source", {})
    sizes = dict.fromkeys(f"{frame['w']} × {frame['h']}" for frame in meta["frames"] if "w" in frame)
    entries = {
        "Scene folder": str(folder),
        "SHA-256 of transforms.json": run.specification["scene_sha256"],
        "Source": source.get("kind", "a nerfstudio scene"),
        "Pictures trained on": str(len(meta["train_filenames"])),
        "Pictures held out": str(len(meta["test_filenames"])),
        "Size": f"{', '.join(sizes)} px" if sizes else "",
        "Sweeps around each picture": str(2 * source["sweeps"] + 1) if "sweeps" in source else "",
    }
    for path in sorted(folder.parent.glob(f"{folder.name}_*/{EXPORT_FIGURES}")):
        entries[f"Exported: {path.parent.name}"] = str(read_json_object(path, "text")["text"])
    return Facts(f"Drive {scene}", {name: value for name, value in entries.items() if value})


def _configuration(results: Results) -> Facts:
    different = {row.title for row in fields_table(results).rows}
    shared: Mapping[str, str] = results.runs[0].content["configuration"]
    entries = {name: value.strip("'") for name, value in sorted(shared.items()) if name not in {*different, *OF_A_RUN}}
    return Facts(f"The common configuration ({len(entries)} fields)", entries, folded=True)
