"""The benchmarks' tables: the figures in the pages are those of the result files."""

from __future__ import annotations

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
from comparisons import fake, write_rendered
from scenes import write_scene
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_image, read_json, write_json
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.report.compared_views import compared_views

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "speed" / "results.json"
QUALITY = ROOT / "benchmarks" / "quality"
FIRST, SECOND = "kitti360_half", "kitti_0005_full"
"""The real drives."""
UNSEEN_PARTS = {
    "unseen: methods": "Methods",
    "unseen: usual": "Methods as usual",
    "unseen: drives": "Drives",
    "unseen: parts": "Parts",
}
"""Parts of docs/results.md, and the headings that `quality/unseen.py` writes them under."""


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


def test_the_real_drives_table_by_hand(benchmark_module):
    real = benchmark_module("quality.real_drive")
    psnr = {"nerfacto": (19.0, 19.2), "ds-nerf": (20.0, 20.4), "edge": (20.5, 20.3)}
    seconds = {"nerfacto": 90.0, "ds-nerf": 100.0, "edge": 120.0}
    results = Results(
        [
            fake("kitti360_half", method, seed, masked_psnr=value, lidar_abs_rel=0.25, cpu_seconds=seconds[method])
            for method, values in psnr.items()
            for seed, value in enumerate(values)
        ]
    )
    header, _, *rows = real.table(results, "kitti360_half")
    assert header == "| method | masked PSNR | SSIM | AbsRel | δ |"
    assert [row.split(" | ")[0] for row in rows] == ["| nerfacto", "| DS-NeRF loss", "| ours"]
    # a spread of 0 is left out
    assert rows[-1] == "| ours | 20.40 ± 0.14 | – | 0.250 | – |"
    # DS-NeRF's loss is the better rival; ours' 120 s are a fifth more than its 100 s
    assert real.best_rival(results, "kitti360_half") == ("ds-nerf", 120)
    assert real.best_rival(results, "another") is None
    longer = Results([run for run in results.runs if run.method == "ds-nerf"])
    page = real.page(results, {"kitti360_half": longer}).rstrip().splitlines()
    assert page[-2] == "| DS-NeRF loss, as many seconds as ours | 20.20 ± 0.28 | – | 0.250 | – | 100 |"
    assert page[-1].startswith("| ours |") and page[-1].endswith("| 120 |")
    scanned = fake("kitti_0005_full", "edge", 0, scan_median_m=0.123, scan_within_30_cm=0.876, scan_abs_rel=0.05)
    page = real.page(Results([*results.runs, scanned]), {}).rstrip().splitlines()
    assert page[-5:-3] == ["## kitti_0005_full: held-out scans", ""]
    assert page[-1] == "| ours | 12.3 | 87.6 | 0.050 | – |" and page[-3].count("|") == page[-1].count("|")


def test_drives_are_named_by_folder_and_size(benchmark_module, tmp_path):
    real = benchmark_module("quality.real_drive")
    named = real.Drive.named("data/kitti360_drive@2"), real.Drive.named("kitti_0005"), real.Drive.named("a/b@3")
    assert [each.name for each in named] == ["kitti360_half", "kitti_0005_full", "b_3"]
    assert named[0].folder == Path("data/kitti360_drive") and [each.downscale for each in named] == [2, 1, 3]
    methods = read_json(real.write_tuned(tmp_path / "tuned.json"))["methods"]
    assert methods["ds-nerf-integrated-extras"] == methods["ds-nerf"] != methods["edge"] == methods["edge-plain"]
    assert {*real.TABLE, *real.CELLS} - {"nerfacto"} <= methods.keys()


def test_the_real_drives_picture_begins_with_what_was_recorded(benchmark_module, tmp_path):
    scene, runs = write_scene(tmp_path / "scene", frames=20), []
    for method, gain in (("nerfacto", 0.5), ("ds-nerf", 0.7), ("edge", 0.9)):
        run = fake("scene", method, 0)
        run.folder, run.specification["scene"] = tmp_path / method, str(scene)
        write_rendered(scene, run.folder / "views", gain)
        runs.append(run)
    draw = benchmark_module("quality.real_drive").draw_views
    draw(Results(runs), "scene", tmp_path / "views.png")
    view = list(compared_views(scene, {}))[1]
    height, width = view.mask.shape
    drawn = read_image(tmp_path / "views.png")
    assert drawn.shape == (28 + 4 * (height + 70 + 14), 2 * (width + 14), 3)
    rows = [drawn[28 + 37 + row * (height + 84) :][:height, 7 : 7 + width] for row in range(4)]
    assert (rows[0] == view.rgb).all()
    assert [int(row[view.mask].mean()) for row in rows[1:]] == pytest.approx(
        [view.rgb[view.mask].mean() * gain for gain in (0.5, 0.7, 0.9)], abs=2
    )
    draw(Results(runs[:2]), "scene", tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_the_real_drives_tables_are_those_of_its_runs(benchmark_module, kept, pages):
    compared, longer, full = (kept(f"real_drive{part}") for part in ("", "_seconds", "_full"))
    made = benchmark_module("quality.real_drive").page(Results([*compared.runs, *full.runs]), {"kitti360_half": longer})
    assert_page_has(pages, "docs/results.md", {"real: table": "kitti360_half", "real: full": "kitti360_full"}, made)
    scans = {f"real: scans{of}": f"{name}: held-out scans" for of, name in (("", FIRST), (" of kitti_0005", SECOND))}
    made = benchmark_module("quality.real_drive").page(kept("real_scans"), {})
    assert_page_has(pages, "docs/results.md", {**scans, "real: kitti_0005": SECOND}, made)


def test_the_pages_table_of_motion_is_that_of_its_runs(benchmark_module, kept, pages):
    reach = benchmark_module("quality.reach")
    rows = list(reach.table(kept("reach"), reach.DRIVES))
    assert len(rows) == 2 + 4 and "–" not in "".join(rows)
    text = (ROOT / "docs/motion.md").read_text(encoding="utf-8")
    assert "<!-- reach -->" in text and pages.with_part(text, "reach", "\n".join(rows)) == text


def test_the_pages_unseen_drives_are_those_of_its_runs(benchmark_module, kept, pages):
    """That all were trained alike, and with what their searches found, is for test_fair_results.py."""
    unseen, grid, runs = benchmark_module("quality.unseen"), kept("grid"), kept("unseen").runs
    parts = {folder: Results([run for run in runs if run.folder.parts[0] == folder]) for folder in unseen.FOLDERS}
    assert set(parts["claims"].methods()) == {*unseen.claimed(grid)}
    assert parts["seconds"].methods() == [unseen.without_extras(grid)]
    real = Results([run for name in ("real_drive", "real_drive_cells") for run in kept(name).runs])
    assert_page_has(pages, "docs/results.md", UNSEEN_PARTS, unseen.page(parts, grid, real))
    assert not set(kept("unseen_search").scenes()) & {run.scene for run in runs}


def test_the_pages_detail_is_that_of_its_runs(benchmark_module, pages):
    detail = benchmark_module("quality.detail")
    table, text = detail.table(), (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert f"<!-- {detail.PART} -->" in text and pages.with_part(text, detail.PART, table) == text
    assert table.count("\n") == 2 + 4 - 1
    for file in detail.KEPT:
        for run in detail.results_of(file).runs:
            assert run.specification["detail"] is True and "detail_masked_psnr" in run.figures


def test_detail_helps_what_has_right_distances_as_its_page_says(benchmark_module):
    detail = benchmark_module("quality.detail")
    rendered, real = (detail.results_of(file).runs for file in detail.KEPT)

    def gains(runs, name: str) -> dict[str, float]:
        found: dict[str, list[float]] = {}
        for run in runs:
            found.setdefault(run.method, []).append(run.figures[f"detail_{name}"] - run.figures[name])
        return {method: sum(each) / len(each) for method, each in found.items()}

    assert min(run.figures[f"detail_{detail.TRUE}"] - run.figures[detail.TRUE] for run in rendered) > 0
    # nerfacto's distances on the real drive are wrong by half
    recorded = gains(real, detail.RECORDED)
    assert abs(recorded.pop("nerfacto")) < 0.05 and min(recorded.values()) > 0.5
    assert min(gains(rendered, "shifted_1m_masked_psnr").values()) > 0.2


def test_the_page_of_unseen_drives_by_hand(benchmark_module, pages, tmp_path):
    unseen = benchmark_module("quality.unseen")
    drives = ("street_1", "parking_2", "turn_3", "roundabout_4")
    rival, with_extras = "urban-nerf-integrated", "ds-nerf-integrated-extras"

    def of_drives(psnr: dict[str, float], seed: int = 0, steps: int = 1000, **more: float) -> list[RunResult]:
        return [
            fake(scene, method, seed, each, steps, shifted_1m_masked_psnr=each - 2, **{"truth_delta_1_25": 0.9, **more})
            for method, each in psnr.items()
            for scene in drives
        ]

    # ours takes 90 s for what the rival does in 60: 3,000 steps in the seconds of 2,000, and a little more
    grid = Results(
        [
            *of_drives({"edge": 26.0}, seconds=90.0),
            *of_drives({"edge-lidar": 24.5, "edge-plain": 25.5, with_extras: 25.0}, seconds=85.0),
            *of_drives({rival: 24.0}, seconds=60.0),
            *of_drives({"nerfacto": 22.0, "urban-nerf": 23.0, "ds-nerf": 23.5}, seconds=50.0),
        ]
    )
    # the runs of the grid say which rivals are the best
    assert unseen.claimed(grid) == ("nerfacto", with_extras, "edge-paper", "edge")
    assert unseen.without_extras(grid) == rival
    assert unseen.steps_in_our_seconds(grid) == 3000
    grid.runs[0].curve[-1]["cpu_seconds"] += 0.1
    assert unseen.steps_in_our_seconds(grid) == 3050
    psnr = {"nerfacto": 22.0, with_extras: 25.0, "edge-paper": 23.0, "edge": 26.0}
    claims = Results(
        [run for seed in (0, 1) for run in of_drives({name: each + seed for name, each in psnr.items()}, seed, 2000)]
    )
    beside = {"edge-mono": 23.0, "edge-gaussian": 23.0, "urban-nerf-los": 22.5, "edge-paper": 23.0}
    parts = {
        "claims": claims,
        "seconds": Results(of_drives({rival: 24.0}, steps=3050, truth_delta_1_25=0.8)),
        "tables": Results(of_drives({**beside, **dict.fromkeys(unseen.LITERAL, 22.0)})),
        "large": Results(of_drives({"nerfacto": 20.0, "edge": 23.0})),
    }
    recorded = {"edge": 21.0, "edge-lidar": 20.75, "edge-plain": 20.0, with_extras: 21.0}
    real = Results([fake("real", method, 0, masked_psnr=each) for method, each in recorded.items()])
    made = unseen.page(parts, grid, real)
    headings = [line.removeprefix("## ") for line in made.splitlines() if line.startswith("## ")]
    assert headings == ["Methods", "Methods as usual", "Drives", "Parts"]
    short = pages.under(made, "Methods").strip().splitlines()
    assert short[0] == "| method | PSNR to clean | AbsRel | δ | PSNR 1 m beside | processor seconds |"
    # means over drives, and the standard deviation of these over seeds unless it is 0
    assert "| nerfacto | 22.50 ± 0.71 | 0.044 ± 0.001 | 0.900 | 20.50 ± 0.71 | 10 |" in short
    assert "| UrbanNeRF loss on our prior | 24.00 | 0.042 | 0.800 | 22.00 | 10 |" in short
    usual = pages.under(made, "Methods as usual").strip().splitlines()
    assert usual[2] == "| nerfacto | 22.00 | 0.045 | 0.900 | 20.00 | 50 |"
    assert usual[-1] == "| ours | 26.00 | 0.038 | 0.900 | 24.00 | 90 |" and len(usual) == 2 + 6
    # of ours, the rival's seeds alone
    assert pages.under(made, "Drives").strip().splitlines()[-1] == "| mean | +4.00 | +4.00 | +2.00 | +1.00 | +3.00 |"
    found = pages.under(made, "Parts").strip().splitlines()
    assert found[2] == "| prior of LiDAR and pictures | LiDAR alone | +1.50 | 0.94 | +0.25 | +1.00 |"
    assert found[4] == "| edge-aware kernel | spatial Gaussian | +3.00 | 0.88 | – | +1.00 |"

    # every method that is trained has what a kept search found for it
    kept = read_json(unseen.write_kept(tmp_path / "kept.json"))["methods"]
    trained = {*unseen.CELLS, *unseen.BESIDE_THE_GRID, *unseen.claimed(grid), *unseen.LARGE}
    assert trained - {*kept} == {"nerfacto", "nerfacto-integrated-extras"}
    assert kept["edge-gaussian"] == kept["edge"] == {"lambda": 0.03, "sigma_m": "own"}


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


def test_the_scatter_of_ground_truth_is_that_beside_planes(benchmark_module):
    scatter = benchmark_module("quality.kitti_stereo").scatter
    y, x = np.mgrid[:60, :80]
    # inverse distances of a plane are linear in the picture
    plane = 1 / (0.02 + 0.001 * y + 0.0002 * x)
    assert np.nanmax(scatter(plane)) < 1e-9
    noise = np.random.default_rng(0).normal(0, 0.01, plane.shape)
    known = np.where(np.random.default_rng(1).random(plane.shape) < 0.5, plane * (1 + noise), 0)
    found = scatter(known)
    assert np.isnan(found[known == 0]).all()
    # around 60 pixels tell the plane, so its own error adds little
    assert np.nanmedian(found) / 0.6745 == pytest.approx(0.01, rel=0.08)


def test_the_stereo_table_is_of_its_figures(benchmark_module, pages):
    stereo = benchmark_module("quality.kitti_stereo")
    text = (ROOT / "docs" / "prior.md").read_text(encoding="utf-8")
    kept = read_json(stereo.KEPT)
    table = "\n".join(stereo.table(kept))
    assert "<!-- stereo -->" in text and pages.with_part(text, "stereo", table) == text
    # what the page says of it
    for regions in kept.values():
        assert all(2 * methods["network, aligned"]["ours_ahead"] > 65 for methods in regions.values())
        assert regions["near"]["network, aligned"]["ours_ahead"] > 0.9 * 65
