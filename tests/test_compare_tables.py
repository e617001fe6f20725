"""Tables by hand, of made-up runs."""

import math
import re
import statistics
from typing import Any

import numpy as np
import pytest
from comparisons import fake
from rich.console import Console
from scenes import write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_json
from edge_depth_nerf.compare import tables
from edge_depth_nerf.compare.plots import draw_plots
from edge_depth_nerf.compare.report import _of_drive
from edge_depth_nerf.compare.results import Results, RunResult, check_fair
from edge_depth_nerf.report.tables import Cell, MadeTable, Row, latex_of_tables, page_of_tables, show_tables

PSNR_OF = {
    ("street", "nerfacto"): (20.0, 21.0, 22.5),
    ("turn", "nerfacto"): (24.0, 23.0, 25.0),
    ("street", "edge"): (23.0, 24.5, 24.0),
    ("turn", "edge"): (25.0, 26.0, 27.5),
    ("street", "ds-nerf"): (22.0, 22.0, 22.0),
    ("turn", "ds-nerf"): (28.0, 25.0, 25.0),
}


@pytest.fixture
def results():
    runs = [fake(*of, seed, psnr) for of, figures in PSNR_OF.items() for seed, psnr in enumerate(figures)]
    return Results(runs, {"preset": "lite", "tuned": {}}, {"nerfstudio": "1.1.5"}, 2)


def test_held_out_scans_have_a_table_and_a_plot(tmp_path):
    runs = [
        fake("street", "nerfacto", 0, scan_median_m=0.5, scan_within_30_cm=0.25, scan_foliage_far_25=0.125),
        fake("street", "edge", 0, scan_median_m=0.1, scan_within_30_cm=0.875, scan_foliage_far_25=0.25),
        fake("street", "ds-nerf", 0),
    ]
    results = Results(runs, {"preset": "lite", "tuned": {}}, {}, 2)
    made = table(results, "Held-out scans, street")
    assert made.groups[0][1] == ["median m ↓", "within 30 cm ↑", "foliage: 25 % too far ↓"] and not made.on_terminal
    assert [[cell.text() for cell in row.cells] for row in made.rows] == [
        ["0.500", "25.0%", "12.5%"],
        ["–", "–", "–"],
        ["0.100", "87.5%", "25.0%"],
    ]
    for run, share in zip(runs, (0.2, 0.8), strict=False):
        run.content["scan_within"] = [{"error_m": 0.1, "share": share / 2}, {"error_m": 1.0, "share": share}]
    plots = [plot for plot in draw_plots(tmp_path, results) if plot.title == "Errors of held-out scans"]
    assert len(plots) == 1 and (tmp_path / "error_of_scans.svg").read_bytes() == plots[0].light
    for colour in ("#888888", "#d62828"):
        assert f"stroke: {colour}".encode() in plots[0].light
    without = tables.make_tables(Results([runs[2]], results.options, {}, 2))
    assert without and not [made for made in without if "scans" in made.title]


TO_CLEAN = "PSNR to clean ↑"
RIVALS = "Rivals, drives of KITTI-360's kind"


def table(results, title):
    return next(made for made in tables.make_tables(results) if made.title == title)


def test_where_the_weights_come_from(results):
    results.options |= {"tuned_on": "/scenes/tuning"}
    for run in results.runs:
        run.specification["weight"] = 0.1 if run.method == "ds-nerf" else None
    made = table(results, "λ and σ")
    assert [row.cells[2].text() for row in made.rows] == ["–", "searched", "default"]
    assert "Searched on tuning." in made.notes and "flatter" not in made.caption
    results.options["tuned_on"] = "/scenes/street"
    made = table(results, "λ and σ")
    assert "Searched on street." in made.notes and "flatter" in made.caption
    results.options["tuned_on"] = 7  # a file written by hand
    assert "Searched on 7." in table(results, "λ and σ").notes
    results.options["tuned_on"] = ["/scenes/tuning", "/scenes/turn"]
    made = table(results, "λ and σ")
    assert "Searched on tuning and turn." in made.notes and "flatter" in made.caption


def test_tables_are_numbered_and_those_for_a_terminal_come_first(results):
    made = tables.make_tables(results)
    # runs of earlier versions have no figures of edges
    assert not [each for each in made if each.title.startswith("Edges")]
    assert [each.label for each in made] == [str(number) for number in range(1, len(made) + 1)]
    assert [each.title for each in made if each.on_terminal] == [each.title for each in made[:4]]
    assert [each.heading for each in made[:2]] == [f"Table 1. {RIVALS}", "Table 2. Pictures and geometry, average"]


def test_the_papers_figures_are_shown_with_its_preset_alone(results):
    def said() -> str:
        return page_of_tables("Comparison", [], tables.make_tables(results))

    assert "paper" not in said() and len(table(results, RIVALS).headings()) == 7
    results.options["preset"] = "paper"
    assert "(the paper's Table 1)" in said() and "averages do not follow" in said() and "+0.65" in said()


def test_the_best_is_bold_everywhere(results, capsys):
    made = table(results, RIVALS)
    show_tables([made], Console(force_terminal=True, width=300))
    said, page = capsys.readouterr().out, page_of_tables("Title", [], [made])
    for row in made.rows:
        for cell in row.cells:
            on_terminal = re.search(f"\x1b\\[1m *{re.escape(cell.text())}\x1b\\[0m", said)
            assert not cell.best or (on_terminal and f"**{cell.text()}**" in page)
    assert len(re.findall("\x1b\\[1m *\\d", said)) == page.count("**") // 2 == 6


def test_the_verdict_by_hand(results):
    assert tables.verdict(results).startswith("Ours renders held-out pictures 2.4 dB better than nerfacto (PSNR, ")
    # AbsRel is 1 / PSNR in these runs
    ours, theirs = (
        np.mean([1 / psnr for (_, name), found in PSNR_OF.items() if name == method for psnr in found])
        for method in ("edge", "nerfacto")
    )
    assert f"wrong by {ours:.1%} on average, nerfacto's by {theirs:.1%}." in tables.verdict(results)
    for run in results.runs:
        del run.figures["truth_abs_rel"]
        run.figures["truth_masked_psnr"] *= -1
    assert "2.4 dB worse than nerfacto (PSNR, a measure of quality)." in tables.verdict(results)
    assert tables.verdict(Results([run for run in results.runs if run.method != "nerfacto"])) == ""


def test_rivals_by_hand(results):
    results.options["preset"] = "paper"
    made = table(results, f"{RIVALS} (the paper's Table 1)")
    headings = made.headings()
    assert headings[0] == ("street", TO_CLEAN) and headings[2] == ("turn", TO_CLEAN)
    assert headings[4] == ("average", TO_CLEAN) and headings[-2:] == [("ours ahead", "dB"), ("ours ahead", "paper, dB")]
    assert [row.title for row in made.rows] == ["nerfacto", "DS-NeRF loss", "ours"]
    nerfacto, ds_nerf, ours = made.rows
    # street, nerfacto: mean of 20, 21, 22.5 = 21.1667; deviation sqrt((1.3611 + 0.0278 + 1.7778) / 2) = 1.2583
    assert nerfacto.cells[0].text() == "21.17 ± 1.26"
    # average by seed: (20 + 24) / 2, (21 + 23) / 2, (22.5 + 25) / 2 = 22, 22, 23.75
    assert nerfacto.cells[4].text() == "22.58 ± 1.01"
    # ours by seed: 24, 25.25, 25.75; ahead by 2, 3.25, 2
    assert nerfacto.cells[-2].text() == f"{7.25 / 3:+.2f} ± {statistics.stdev([2, 3.25, 2]):.2f}"
    assert nerfacto.cells[-1].text() == "+0.65" and ds_nerf.cells[-1].text() == "+0.44"
    assert ours.cells[-1].text() == ours.cells[-2].text() == "–"
    assert [row.cells[0].best for row in made.rows] == [False, False, True]
    assert [row.cells[2].best for row in made.rows] == [False, False, True]  # 24, 26, 26.17
    assert "averages do not follow" in made.caption


def test_rivals_have_other_losses_with_our_prior_and_extras(results):
    more = ("ds-nerf-integrated-extras", "edge-paper", "edge-plain", "edge-gaussian")
    results.runs += [fake("street", method, 0, 23.0) for method in more]
    made = table(Results(results.runs, results.options, results.versions, 2), RIVALS)
    titles = [row.title for row in made.rows]
    assert titles[:2] == ["nerfacto", "DS-NeRF loss"] and titles[-2:] == ["as published", "ours"]
    assert titles[2:-2] == ["DS-NeRF loss, integrated, with extras"]


def test_one_seed_has_no_spread_and_one_drive_no_average(results):
    results.runs = [run for run in results.runs if run.seed == 1 and run.scene == "turn"]
    made = table(results, RIVALS)
    assert made.rows[0].cells[0].text() == "23.00"
    assert {group for group, _ in made.headings()} == {"turn", "ours ahead"}


def test_what_a_drive_or_a_run_lacks(results):
    results.runs = [run for run in results.runs if (run.scene, run.method, run.seed) != ("turn", "nerfacto", 2)]
    nerfacto = table(results, RIVALS).rows[0]
    assert nerfacto.cells[4].text() == "22.00 ± 0.00"
    assert nerfacto.cells[-1].text() == f"{5.25 / 2:+.2f} ± {statistics.stdev([2, 3.25]):.2f}"
    # without truth everywhere figures are against the pictures
    results.runs[0].figures["masked_psnr"] = 17.0
    del results.runs[0].figures["truth_masked_psnr"]
    assert tables.psnr_metric(results).name == "masked_psnr"


def test_the_papers_tables_are_of_their_methods(results):
    results.options["preset"] = "paper"
    assert "the paper's Table 2" not in page_of_tables("Comparison", [], tables.make_tables(results))
    more = (("edge-lidar", 23.5), ("edge-mono", 22.0), ("edge-gaussian", 23.004))
    results.runs += [fake("street", method, 0, psnr) for method, psnr in more]
    results.runs += [fake("garage", method, 0, 30.0) for method in ("nerfacto", "ds-nerf", "edge")]
    for run in results.runs[-3:]:
        run.content["source"] = "jbnu-depth360"
    results = Results(results.runs, results.options, results.versions, 2)
    jbnu = table(results, "Rivals, drives of JBNU-Depth360 (the paper's Table 2)")
    assert {group for group, _ in jbnu.headings()} == {"garage", "ours ahead"}
    assert [row.cells[-1].text() for row in jbnu.rows] == ["+0.12", "+0.04", "–"]
    assert "garage" not in {group for group, _ in table(results, f"{RIVALS} (the paper's Table 1)").headings()}
    third = table(results, "Source of depth (the paper's Table 3)")
    assert [row.title for row in third.rows] == ["LiDAR alone", "monocular alone", "ours"]
    assert "row of DS-NeRF" in third.caption
    fourth = table(results, "Kernel of the integration (the paper's Table 4)")
    column = fourth.headings().index(("street", TO_CLEAN))
    assert [row.cells[column].text() for row in fourth.rows] == ["23.00", "23.83 ± 0.76"]


CURVE = [
    {"step": 10.0, "seconds": 1.0, "psnr": 10.0},
    {"step": 20.0, "seconds": 3.0, "psnr": 16.0},
    {"step": 40.0, "seconds": 7.0, "psnr": 18.0},
]


def test_psnr_at_a_time_and_steps_to_a_psnr():
    at = {0.5: 10.0, 1.0: 10.0, 2.0: 13.0, 3.0: 16.0, 6.0: 17.5, 9.0: 18.0}
    assert {seconds: tables.psnr_at(CURVE, seconds, "psnr", "seconds") for seconds in at} == pytest.approx(at)
    steps = {9.0: 10, 13.0: 15, 16.0: 20, 17.5: 35}
    assert {psnr: tables.steps_to(CURVE, psnr, "psnr") for psnr in steps} == pytest.approx(steps)
    assert tables.steps_to(CURVE, 18.1, "psnr") == math.inf


def test_time_to_the_psnr_of_nerfacto(results):
    made = table(results, "Time, street")
    ours = made.rows[-1]
    # by seed: nerfacto ends at 20, 21, 22.5; ours has 11.5 at 50 steps and 23 at 100, and so on
    expected = [50 + 50 * (end - own / 2) / (own / 2) for end, own in ((20, 23), (21, 24.5), (22.5, 24))]
    assert ours.cells[-1].text() == f"{np.mean(expected):.0f} ± {np.std(expected, ddof=1):.0f}"


def test_a_run_that_never_gets_there_leaves_no_mean(results):
    last = next(run for run in results.runs if (run.scene, run.method, run.seed) == ("street", "edge", 2))
    for point in last.curve:
        point["truth_psnr"] = 22.4
    for label in ("Time, street", "Time, average"):
        assert table(results, label).rows[-1].cells[-1].text() == "never"
    assert table(results, "Time, turn").rows[-1].cells[-1].text() != "never"


def test_latex_and_markdown_hold_the_same_cells(results):
    made = tables.make_tables(results)
    lines = tables.introduction(results)
    markdown, latex = page_of_tables("Comparison", lines, made), latex_of_tables(lines, made)
    assert "| nerfacto | 21.17 ± 1.26 |" in markdown
    assert r"nerfacto & 21.17 $\pm$ 1.26 &" in latex
    assert latex.count(r"\toprule") == latex.count(r"\bottomrule") == latex.count(r"\end{table}") == len(made)
    body = "\n".join(line for line in latex.splitlines() if not line.startswith("%"))
    assert body.isascii() and "\\usepackage" not in body
    for rows in body.split(r"\begin{tabular}")[1:]:
        columns = len(rows[: rows.index("\n")].strip("{}"))
        cells = [line for line in rows.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
        assert {line.count(" & ") + 1 for line in cells} == {columns}


def test_a_name_of_a_drive_does_not_break_its_table():
    made = MadeTable("1", "Rivals", [("loop|2 x^2~y", ["PSNR"])], [Row("nerfacto", [Cell(20.0, None, ".2f")])])
    assert r"| | loop\|2 x^2~y PSNR |" in page_of_tables("Comparison", [], [made])
    assert r"loop|2 x\^{}2\textasciitilde{}y" in latex_of_tables([], [made])


def test_tables_say_whose_the_monocular_maps_are(results):
    """Maps that the generator made of the truth are not those of the default pipeline."""
    assert "Monocular maps" not in " ".join(tables.introduction(results))
    for run in results.runs:
        run.content["mono_trained_on"] = "scene" if run.scene == "turn" else "elsewhere"
    line = "Monocular maps: of a network trained on the drive (turn); made elsewhere (street)."
    assert line in tables.introduction(results)


def test_runs_that_differ_in_unnamed_fields_are_refused(results):
    check_fair(results)
    results.runs[0].content["configuration"]["machine.device_type"] = "'cuda'"
    check_fair(results)
    results.runs[-1].content["configuration"]["b"] = "2"
    with pytest.raises(InputError, match=r"its b is 2, that of .* is None.*another version"):
        check_fair(results)
    results.runs[-1].content["named"] = ["b"]
    with pytest.raises(InputError, match=r"ds-nerf_seed-2: its b"):  # the same method with another seed lacks it
        check_fair(results)
    for run in results.runs:
        if run.method == "ds-nerf":
            run.content["named"], run.content["configuration"]["b"] = ["b"], "2"
    check_fair(results)
    # what the first method names does not excuse two others that do not
    first = results.runs[0].method
    assert len({run.method for run in results.runs} - {first, "ds-nerf"}) == 1
    for run in results.runs:
        run.content["named"] = ["c"] if run.method == first else []
        run.content["configuration"].update(b="2", c="3" if run.method == "ds-nerf" else "1")
    with pytest.raises(InputError, match="its c is "):
        check_fair(results)


def test_edges_on_the_path_beside_it_and_from_a_held_out_camera():
    more: dict[str, Any] = {"truth_edge_recall": 0.8, "truth_depth_edge_recall": 0.7, "shifted_1m_edge_recall": 0.6}
    more |= {"shifted_0.5m_edge_recall": 0.75, "shifted_0.5m_truth_depth_edge_recall": 0.5}
    more |= {"shifted_0.5m_masked_psnr": 19, "shifted_3m_edge_recall": 0.25}
    more |= {"camera_truth_affine_masked_psnr": 18.5, "camera_truth_edge_recall": 0.45}
    runs = [fake("street", method, 0, 20.0, **more) for method in ("nerfacto", "edge")]
    made = table(Results(runs, {"preset": "lite", "tuned": {}}, {}, 2), "Edges, and views beside the path, street")
    assert made.headings() == [
        *((TO_CLEAN, "0 m"), (TO_CLEAN, "0.5 m")),
        *(("edges ↑", "0 m"), ("edges ↑", "0.5 m"), ("edges ↑", "1 m"), ("edges ↑", "3 m")),
        *(("depth edges ↑", "0 m"), ("depth edges ↑", "0.5 m")),
        *(("held-out cameras", "PSNR, fitted ↑"), ("held-out cameras", "edges ↑")),
    ]
    expected = ["20.00", "19.00", "0.800", "0.750", "0.600", "0.250", "0.700", "0.500", "18.50", "0.450"]
    assert [cell.text() for cell in made.rows[-1].cells] == expected
    assert "Held-out cameras: training saw no picture" in made.caption and "the ground truth" in made.caption


def test_an_export_beside_the_scene_is_named(tmp_path):
    scene = write_scene(tmp_path / "street")
    for name in ("street_points", "other_points"):
        (tmp_path / name).mkdir()
        write_json(tmp_path / name / "export_figures.json", {"text": f"12 points of {name}"})
    run = RunResult(tmp_path, {"scene": str(scene), "scene_sha256": "1f"}, {})
    found = {name: said for name, said in _of_drive("street", run).entries.items() if "Exported" in name}
    assert found == {"Exported: street_points": "12 points of street_points"}
