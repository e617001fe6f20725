"""The benchmarks' tables: the figures in the pages are those of the result files."""

from __future__ import annotations

import dataclasses
import json
import lzma
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmark_modules import benchmark_modules
from comparisons import fake
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.compare.grid import grid_tables
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.search import grids
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.report.tables import page_of_tables

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "speed" / "results.json"
QUALITY = ROOT / "benchmarks" / "quality"
GRID_PARTS = {
    "grid: prior": "Table G1",
    "grid: loss": "Table G2",
    "grid: extras": "Table G3",
    "grid: whole": "Table G4",
    "grid: cells": "Table G5",
}
"""Parts of docs/results.md, and the headings of grid.md that they stand under."""
UNSEEN_PARTS = {
    "unseen: pictures": "Claims: pictures",
    "unseen: geometry": "Claims: geometry",
    "unseen: seconds": "Equal seconds",
    "unseen: sources": "Sources",
    "unseen: kernels": "Kernels: pictures",
    "unseen: kernels in depth": "Kernels: geometry",
    "unseen: literal sources": "As published, sources",
    "unseen: literal kernels": "As published, kernels",
    "unseen: literal geometry": "As published, geometry",
    "unseen: large": "700 px",
    "unseen: large pictures": "All drives at 700 px",
    "unseen: large seconds": "Equal seconds at 700 px",
    "unseen: sight": "Line of sight",
    "unseen: simulated": "Simulated maps: pictures",
    "unseen: simulated in depth": "Simulated maps: geometry",
    "unseen: settings": "λ and σ",
}
"""The same of `quality/unseen.py`."""


@pytest.fixture
def benchmark_module():
    """Import a module of benchmarks/ by its name."""
    with benchmark_modules() as load:
        yield load


@pytest.fixture
def report(benchmark_module):
    return benchmark_module("speed.report")


@pytest.fixture
def kept(benchmark_module):
    """Gives the runs of a result file of benchmarks/quality/."""
    module = benchmark_module("kept_runs")
    return lambda name: module.results_of(QUALITY / f"{name}.json.xz")


@pytest.fixture
def pages(benchmark_module) -> ModuleType:
    return benchmark_module("pages")


def assert_page_has(pages: ModuleType, page: str, parts: Mapping[str, str], made: str) -> None:
    """Each part of a page is what stands under a heading of a generated page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    for name, heading in parts.items():
        assert f"<!-- {name} -->" in text
        assert pages.with_part(text, name, pages.under(made, heading)) == text, name


def test_the_page_has_the_tables_of_the_results(report):
    text = (ROOT / "docs/speed.md").read_text(encoding="utf-8")
    assert all(f"<!-- speed: {name} -->" in text for name in report.TABLES)
    assert report.with_tables(text, json.loads(RESULTS.read_text())) == text


def test_the_pages_figures_are_of_todays_sizes(benchmark_module):
    """A preset that changes its sizes needs the page's figures anew: python -m benchmarks.speed.run."""
    measured, speed = json.loads(RESULTS.read_text()), benchmark_module("speed.turns")
    assert set(measured["sizes"]) == {"lite", "full"} == set(speed.PRESETS)
    for preset, sizes in measured["sizes"].items():
        assert sizes == json.loads(json.dumps(speed.sizes_of(preset)))
    assert measured["of"].keys() == measured["seconds"].keys() == measured.keys() - {"of", "seconds", "sizes"}
    page = (ROOT / "docs/speed.md").read_text(encoding="utf-8")
    assert all(f"commit {of['commit']} " in page for of in measured["of"].values())


def test_a_ratio_is_made_of_the_seconds(report):
    """The tables' ratios are the file's; these must follow from its seconds."""
    results = json.loads(RESULTS.read_text())
    assert min(len(results[preset]) for preset in ("lite", "full")) > 1
    for preset in ("lite", "full"):
        reference = results[preset]["nerfacto"]
        for found in results[preset].values():
            for ratio, seconds in (("step_ratio", "step_s"), ("render_ratio", "render_s")):
                pairs = zip(reference[seconds], found[seconds], strict=True)
                assert found[ratio] == pytest.approx([host / own for host, own in pairs])


def test_tables_of_a_run_that_has_not_all_parts(report):
    page = "before <!-- speed: preparation --> old <!-- end --> after"
    results = {"preparation": [{"cores": 2, "s": 47.4, "peak_mb": 2048, "integration_s": 0.094}]}
    made = report.with_tables(page, results)
    assert "old" not in made and made.startswith("before <!-- speed: preparation -->\n| ") and made.endswith(" after")
    assert "| 2 cores | 47 s | 2.00 GB | 0.09 s |" in made
    for make in report.TABLES.values():
        assert make({}).count("\n") == 1


def test_a_part_of_a_page_is_replaced_and_nothing_else(pages, tmp_path, monkeypatch):
    page, written = tmp_path / "page.md", tmp_path / "tables.md"
    page.write_text("# Page\n<!-- a -->\nold\n<!-- end -->\nbetween\n<!-- b -->\nstays\n<!-- end -->\n")
    written.write_text("# Comparison\n\nwords\n\n## Table 1\n\n| # |\n\n## Table 2\n\n| no |\n")
    monkeypatch.setattr(sys, "argv", ["pages.py", str(page), f"a={written}#Table 1"])
    for _ in range(2):  # the second time nothing changes
        pages.main()
        assert page.read_text() == (
            "# Page\n<!-- a -->\n| # |\n<!-- end -->\nbetween\n<!-- b -->\nstays\n<!-- end -->\n"
        )
    written.write_text("# Comparison\n\n## Table 1\n\n| # |\n\n## Table 5, street\n\n| ## 5 |\n\n## Table 6\n")
    monkeypatch.setattr(sys, "argv", ["pages.py", str(page), f"b={written}#Table 5"])
    pages.main()
    assert page.read_text().endswith("between\n<!-- b -->\n| ## 5 |\n<!-- end -->\n")
    for wrong in (f"c={written}#Table 1", f"b={written}#Table 7"):
        monkeypatch.setattr(sys, "argv", ["pages.py", str(page), wrong])
        with pytest.raises(SystemExit):
            pages.main()


def test_kept_runs_have_their_figures_and_no_paths_of_this_machine(benchmark_module, tmp_path):
    kept = benchmark_module("kept_runs")
    run = {"scene": str(tmp_path / "here" / "street"), "scene_sha256": "abc", "method": "edge", "seed": 1}
    configuration = {"output_dir": str(tmp_path), "pipeline.model.near_m": "0.05"}
    figures = {"run": run, "configuration": configuration, "curve": [1.5]}
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        write_json(folder / "runs/street/edge_seed-1/figures.json", figures)
    file = tmp_path / "kept.json.xz"
    assert kept.keep(file, folders[0]) == 1
    assert str(tmp_path) not in lzma.decompress(file.read_bytes()).decode()
    (found,) = kept.results_of(file).runs
    assert found.folder == Path("street/edge_seed-1") and found.specification == {**run, "scene": "street"}
    wanted = {"run": found.specification, "configuration": {"pipeline.model.near_m": "0.05"}, "curve": [1.5]}
    assert found.content == wanted
    # those of several comparisons are told apart
    assert kept.keep(file, *folders) == 2
    names = [run.folder.as_posix() for run in kept.results_of(file).runs]
    assert names == ["one/street/edge_seed-1", "other/street/edge_seed-1"]


def test_the_real_drives_table_and_margins(benchmark_module, tmp_path):
    real = benchmark_module("quality.real_drive")
    psnr = {"nerfacto": (19.0, 19.2), "ds-nerf": (20.0, 20.4), "edge": (20.5, 20.3)}
    seconds = {"nerfacto": 90.0, "ds-nerf": 100.0, "edge": 120.0}
    runs = [
        fake("drive", method, seed, masked_psnr=value, lidar_abs_rel=1 / value, cpu_seconds=seconds[method])
        for method, values in psnr.items()
        for seed, value in enumerate(values)
    ]
    results = Results(runs)
    header, _, *rows = real.table(results, "drive", real.COLUMNS)
    assert header.startswith("| method | PSNR |") and [row.split(" | ")[0] for row in rows] == [
        "| nerfacto",
        "| DS-NeRF loss",
        "| ours",
    ]
    assert "20.40 ± 0.14" in rows[-1] and "| – |" in rows[-1] and rows[-1].endswith("| 100 | 120 |")
    # DS-NeRF's loss is the better rival; ours' 120 s are a fifth more than its 100 s
    assert real.best_rival(results, "drive") == ("ds-nerf", 120)
    assert real.best_rival(results, "another") is None
    longer = Results([run for run in runs if run.method == "ds-nerf"])
    half = [
        fake("kitti360_half", method, seed, masked_psnr=value, cpu_seconds=seconds[method])
        for method, of_seeds in psnr.items()
        for seed, value in enumerate(of_seeds)
    ]
    page = real.page(Results(half), {"half": longer}, Results([]))
    assert page.count("\n## ") == 3 and page.rstrip().splitlines()[-1].startswith("| DS-NeRF loss | 20.20 ± 0.28 |")
    cells = Results([fake("kitti360_half", "ds-nerf-extras", 0, masked_psnr=20.3, cpu_seconds=110.0)])
    assert [line.split(" | ")[:2] for line in real.cells_table(Results(half), cells, "kitti360_half")][2:] == [
        ["| no depth loss, without extras", "19.00"],
        ["| DS-NeRF loss, LiDAR, without extras", "20.00"],
        ["| edge loss, integrated, with extras", "20.50"],
        ["| DS-NeRF loss, LiDAR, with extras", "20.30"],
    ]
    found = list(real.margins(results, "drive"))
    # by seed: 20.5 against 20.0, 20.3 against 20.4; AbsRel likewise, less is better
    assert found[0] == "* PSNR: +0.20 on average, ahead with 1 of 2 seeds."
    assert found[1].startswith("* AbsRel: +0.000") and "ahead with 1 of 2" in found[1]
    curves = [
        dataclasses.replace(run, content={**run.content, "lambda": weight})
        for weight in (0.1, 0.01)
        for run in [
            fake("kitti360_half", "edge", 0, masked_psnr=20 + weight, lidar_abs_rel=0.02),
            fake("kitti360_half", "ds-nerf", 0, masked_psnr=19.0, lidar_abs_rel=0.03),
        ]
    ]
    alone = dataclasses.replace(curves[-1], content={**curves[-1].content, "lambda": 0.3})
    assert list(real.lambda_table([*curves, alone]))[-1] == "| 0.3 | 19.00, 0.0300 | – |"
    assert list(real.lambda_table(curves))[2:] == [
        "| 0.01 | 19.00, 0.0300 | 20.01, 0.0200 |",
        "| 0.1 | 19.00, 0.0300 | 20.10, 0.0200 |",
    ]
    real.draw_lambdas(curves, tmp_path / "lambda.svg")
    assert (tmp_path / "lambda.svg").stat().st_size > 5000


def test_the_real_drives_tables_are_those_of_its_runs(benchmark_module, kept, pages):
    compared, longer, cells, full, curves = (
        kept(f"real_drive{part}") for part in ("", "_seconds", "_cells", "_full", "_lambda")
    )
    runs = Results([*compared.runs, *full.runs])
    made = benchmark_module("quality.real_drive").page(runs, {"half": longer}, cells, curves.runs)
    parts = {
        "real: table": "kitti360_half",
        "real: seconds": "The best rival after as many processor seconds as ours: kitti360_half",
        "real: margins": "Ours against the best rival after as many steps: kitti360_half",
        "real: cells": "One change at a time: kitti360_half",
        "real: full": "kitti360_full",
        "real: lambda": "PSNR and AbsRel over λ: kitti360_half",
    }
    assert_page_has(pages, "docs/real_drive.md", parts, made)


def test_the_pages_table_of_motion_is_that_of_its_runs(benchmark_module, kept, pages):
    reach = benchmark_module("quality.reach")
    rows = list(reach.table(kept("reach"), reach.DRIVES))
    assert len(rows) == 2 + 4 and "–" not in "".join(rows)
    text = (ROOT / "docs/motion.md").read_text(encoding="utf-8")
    assert "<!-- reach -->" in text and pages.with_part(text, "reach", "\n".join(rows)) == text


def test_the_pages_grid_is_that_of_its_runs(kept, pages):
    results, searches = kept("grid"), grids(kept("grid_search"))
    assert {len(search.psnr) for search in searches} == {16}
    # nothing that a table shows was chosen on the drives it shows
    assert not set(results.scenes()) & {"tune_street"}
    assert_page_has(pages, "docs/results.md", GRID_PARTS, page_of_tables("Grid", [], grid_tables(results, searches)))


def test_the_pages_unseen_drives_are_those_of_its_runs(benchmark_module, kept, pages):
    """That all were trained alike, and with what their searches found, is for test_fair_results.py."""
    unseen, grid, runs = benchmark_module("quality.unseen"), kept("grid"), kept("unseen").runs
    parts = {folder: Results([run for run in runs if run.folder.parts[0] == folder]) for folder in unseen.FOLDERS}
    assert set(parts["claims"].methods()) == {*unseen.claimed(grid)}
    assert parts["seconds"].methods() == [unseen.without_extras(grid)]
    made = unseen.page(parts, grid)
    assert_page_has(pages, "docs/results.md", UNSEEN_PARTS, made)
    assert_page_has(pages, "README.md", {"unseen: short": "Claims: short"}, made)
    assert not set(kept("unseen_search").scenes()) & {run.scene for run in runs}


def test_the_pages_detail_is_that_of_its_runs(benchmark_module, pages):
    detail = benchmark_module("quality.detail")
    tables = detail.tables()
    for name, page in (("pictures", "results"), ("beside", "results"), ("real", "real_drive")):
        part = f"detail_{name}" if page == "real_drive" else f"detail: {name}"
        text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
        assert f"<!-- {part} -->" in text and pages.with_part(text, part, tables[part]) == text
        assert tables[part].count("\n") == 2 + 2 * 4 - 1, part
    for file in detail.KEPT:
        for run in detail.results_of(file).runs:
            assert run.specification["detail"] is True and "detail_masked_psnr" in run.figures


def test_what_the_pages_say_of_detail_follows_from_its_runs(benchmark_module):
    detail = benchmark_module("quality.detail")
    rendered, real = (detail.results_of(file).runs for file in detail.KEPT)

    def mean(runs, method: str, name: str, steps: int | None = None) -> float:
        found = [run for run in runs if run.method == method and steps in (None, run.content["steps"])]
        return sum(run.figures[name] for run in found) / len(found)

    def gain(runs, method: str, name: str, steps: int | None = None) -> str:
        return f"{mean(runs, method, f'detail_{name}', steps) - mean(runs, method, name, steps):.2f}"

    def lead(runs, name: str, method: str, steps: int | None = None) -> str:
        return f"{mean(runs, 'edge', name) - mean(runs, method, name, steps):.2f}"

    true, recorded, longer, best = detail.TRUE, detail.RECORDED, "urban-nerf-integrated", "ds-nerf-integrated-extras"
    both = (true, f"detail_{true}")
    gains = sorted(run.figures[both[1]] - run.figures[true] for run in rendered)
    of = {method: gain(rendered, method, true) for method in (*detail.CLAIMS, longer)}
    others = sorted(value for method, value in of.items() if method != "edge")
    over = {method: [lead(rendered, name, method) for name in both] for method in ("nerfacto", best, longer)}
    alone = mean(rendered, "edge", both[1]) - mean(rendered, longer, true)
    pairs = {(run.scene, run.seed): run for run in rendered if run.method == best}
    ahead = [
        sum(run.figures[name] > pairs[run.scene, run.seed].figures[name] for run in rendered if run.method == "edge")
        for name in both
    ]
    beside = sorted(gain(rendered, method, "shifted_1m_masked_psnr") for method in of)
    steps = [gain(real, "ds-nerf", recorded, count) for count in (1000, 1330)]
    seconds = [lead(real, name, "ds-nerf", 1330) for name in (f"detail_{recorded}", recorded)]
    assert abs(float(gain(real, "nerfacto", recorded))) < 0.05
    said = {
        "docs/results.md": [
            f"with each seed: {gains[0]:.2f} to {gains[-1]:.2f} dB.",
            f"Ours gains {of['edge']} dB, nerfacto {of['nerfacto']} dB, the others {of[best]} and {of[longer]} dB",
            f"[gains {of['edge']} dB]",
            f"{others[0]} to {others[-1]} dB with the other methods",
            "over nerfacto {} dB without and {} dB with detail".format(*over["nerfacto"]),
            "{} and {} dB (ahead in {} and in {} of {} pairs)".format(*over[best], *ahead, len(pairs)),
            "at equal seconds of training, {} and {} dB".format(*over[longer]),
            f"and this rival has none, it is {alone:.2f} dB",
            f"gain {beside[0]} to {beside[-1]} dB",
        ],
        "docs/real_drive.md": [
            f"Ours gains {gain(real, 'edge', recorded)} dB, the DS-NeRF loss {steps[0]} dB ({steps[1]} dB",
            f"by {seconds[0]} dB with detail and by {seconds[1]} dB without",
        ],
        "README.md": [f"gains {of['edge']} dB"],
        "CHANGELOG.md": [f"{gains[0]:.2f} to {gains[-1]:.2f} dB on rendered drives"],
    }
    for page, sentences in said.items():
        text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert [words for words in sentences if words not in text] == [], page


def test_the_page_of_unseen_drives_by_hand(benchmark_module, pages, tmp_path):
    unseen = benchmark_module("quality.unseen")
    drives = ("street", "turn")
    rival, with_extras = "urban-nerf-integrated", "ds-nerf-integrated-extras"
    # ours takes 90 s for what the rival does in 60: 3,000 steps in the seconds of 2,000, and a little more
    grid = Results(
        [
            fake(scene, method, 0, psnr, seconds=seconds)
            for scene in drives
            for method, psnr, seconds in (
                ("edge", 26.0, 90.0),
                ("edge-lidar", 24.5, 80.0),
                (with_extras, 25.0, 85.0),
                (rival, 24.0, 60.0),
                ("nerfacto", 22.0, 50.0),
            )
        ]
    )
    # the runs of the grid say which rivals are the best
    assert unseen.claimed(grid) == ("nerfacto", with_extras, "edge-paper", "edge")
    assert unseen.without_extras(grid) == rival
    assert unseen.steps_in_our_seconds(grid) == 3000
    grid.runs[0].curve[-1]["cpu_seconds"] += 0.1
    assert unseen.steps_in_our_seconds(grid) == 3050
    claims = Results(
        [
            fake(scene, method, seed, psnr + seed, 2000, truth_delta_1_25=0.9)
            for method, psnr in (("nerfacto", 22.0), (with_extras, 25.0), ("edge-paper", 23.0), ("edge", 26.0))
            for seed in (0, 1)
            for scene in drives
        ]
    )
    longer = Results([fake(scene, rival, 0, 24.0, 3050, truth_delta_1_25=0.8) for scene in drives])
    beside = Results([fake(scene, name, 0, 23.0) for scene in drives for name in ("edge-mono", "edge-gaussian")])
    nothing = Results([])
    parts = {**dict.fromkeys(unseen.FOLDERS, nothing), "claims": claims, "seconds": longer, "tables": beside}
    made = unseen.page(parts, grid)
    headings = [line.removeprefix("## ") for line in made.splitlines() if line.startswith("## ")]
    assert headings == [
        "Claims: pictures",
        "Claims: short",
        "Claims: geometry",
        "Claims: time",
        "Equal seconds",
        "Sources",
        "Kernels: pictures",
        "Kernels: geometry",
        "λ and σ",
    ]
    short = pages.under(made, "Claims: short").strip().splitlines()
    assert short[0] == "| method | PSNR | SSIM | AbsRel | δ | steps | processor seconds |"
    # means over drives, and the standard deviation of these over seeds
    assert "| nerfacto | 22.50 ± 0.71 | 0.562 ± 0.018 | 0.0445 ± 0.0014 | 0.900 ± 0.000 | 2,000 | 10 |" in short
    seconds = pages.under(made, "Equal seconds").strip().splitlines()
    # of ours, the rival's seeds alone
    assert seconds[2] == (
        "| UrbanNeRF loss, integrated, without extras | street | 24.00 | 0.600 | 0.0417 | 0.800 | 3,050 | 10 |"
    )
    assert seconds[3] == "| ours | street | 26.00 | 0.650 | 0.0385 | 0.900 | 2,000 | 10 |"
    assert [line.split(" | ")[1] for line in seconds[4:]] == ["turn", "turn", "average", "average"]
    assert "| LiDAR alone | 24.50 |" in pages.under(made, "Sources")
    assert "| monocular alone | 23.00 |" in pages.under(made, "Sources")
    assert "| spatial Gaussian | 23.00 |" in pages.under(made, "Kernels: pictures")

    # every method that is trained has what a kept search found for it
    kept = read_json(unseen.write_kept(tmp_path / "kept.json"))["methods"]
    trained = {*unseen.CELLS, *unseen.BESIDE_THE_GRID, *unseen.claimed(grid), *unseen.LARGE}
    assert trained - {*kept} == {"nerfacto", "nerfacto-integrated-extras"}
    assert kept["edge-gaussian"] == kept["edge"] == {"lambda": 0.03, "sigma_m": "own"}


def test_disturbed_poses_are_off_by_as_much_as_is_said(benchmark_module):
    poses = benchmark_module("quality.poses")
    true = np.tile(np.eye(4), (3000, 1, 1))
    true[:, 0, 3] = np.arange(3000)
    path = Trajectory(np.arange(3000.0), true)
    recording = Recording(cameras=(), pictures=(), sweeps=(), trajectory=path, source={})
    other = poses.disturbed(recording, shift_m=0.03, turn_deg=0.1)
    found = other.trajectory.vehicle_to_world
    shift_m = found[:, :3, 3] - true[:, :3, 3]
    assert np.sqrt((shift_m**2).sum(-1).mean()) == pytest.approx(0.03, rel=0.05)
    cosine = np.clip((np.trace(found[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)
    assert np.degrees(np.sqrt((np.arccos(cosine) ** 2).mean())) == pytest.approx(0.1, rel=0.05)


def test_poses_that_are_turned_over_others_differ_by_their_scale_alone(benchmark_module):
    poses = benchmark_module("quality.poses")
    points = np.random.default_rng(0).normal(size=(20, 3))
    turn = Rotation.from_rotvec((0.1, -0.4, 2.0))
    laid, goal = poses.turned_over(points, 3 * turn.apply(points) + (5, 6, 7))
    assert 3 * laid == pytest.approx(goal)


def test_every_file_of_the_benchmarks_stands_in_their_readme():
    readme = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    named = [name for line in readme.splitlines() for name in re.findall(r"^\| `([^`]+)`", line)]
    folder = ROOT / "benchmarks"
    files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    kept = {name for name in files if "__pycache__" not in name} - {"README.md", "__init__.py"}
    assert sorted(named) == sorted(kept)
