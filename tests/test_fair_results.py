"""The results page against what made comparisons unfair before: each check is shown to find it.

The figures of all runs are in the repository, each with its whole configuration. Every function here lists what is
wrong; its test holds that to be nothing, and then puts the former fault back.
"""

import copy
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from benchmark_modules import BENCHMARKS, benchmark_modules

from edge_depth_nerf.compare.configuration import flattened, literal_form
from edge_depth_nerf.compare.methods import GRID, METHODS, WITHOUT_EXTRAS, Method, MethodName
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.search import grids
from edge_depth_nerf.compare.specification import OF_A_RUN
from edge_depth_nerf.plugin.config import make_specifications, read_method_file

ROOT = Path(__file__).resolve().parent.parent
LOSS, SOURCE = "pipeline.model.depth_loss", "pipeline.datamanager.depth_source"
EXPOSURE = "pipeline.model.exposure"
PRIOR = "pipeline.datamanager.prior."
KERNEL = PRIOR + "integration.kernel"
SEARCHED = {LOSS + "_mult", "pipeline.model.depth_sigma", PRIOR + "sigma_mode", PRIOR + "sigma_constant_m"}
"""λ and σ, which each method has from its own search."""
CHOICES = {
    "tune_street": "λ, σ and some defaults",
    "tune_parking": "defaults",
    "tune_turn": "defaults",
    "street": "defaults",
    "parking": "defaults",
    "turn": "defaults",
    "turn_few": "defaults",
    "kitti360_half": "learning rates and Adam's decay",
    "kitti360_full": "learning rates and Adam's decay",
    "kitti_0005_full": "was found on this drive",
    **dict.fromkeys(
        ("street_101", "parking_102", "turn_103", "roundabout_104"), "what confirms a prior beyond LiDAR's field"
    ),
}
"""Drives that took part in a choice, and in which (docs/ablation.md)."""
RUNS_OF = {
    "unseen": ("unseen", "grid"),
    "unseen: parts": ("unseen", "grid", "real_drive", "real_drive_cells"),
    "detail": ("detail", "detail_real"),
    "real": ("real_drive", "real_drive_seconds", "real_drive_full"),
    **dict.fromkeys(("real: scans", "real: kitti_0005", "real: scans of kitti_0005"), ("real_scans",)),
    "unseen: search": ("unseen_search",),
}
"""Whose runs a generated part of a page is made of, by its name or by what stands before the colon."""


@pytest.fixture(scope="module")
def unseen() -> Iterator[ModuleType]:
    with benchmark_modules() as load:
        yield load("quality.unseen")


@pytest.fixture(scope="module")
def kept(unseen) -> dict[str, list[RunResult]]:
    names = {name for files in RUNS_OF.values() for name in files} | {"grid_search"}
    return {name: unseen.results_of(BENCHMARKS / "quality" / f"{name}.json.xz").runs for name in names}


def changed(one: RunResult, other: RunResult) -> set[str]:
    """The fields of the configuration in which two runs differ, but for those of any run."""
    ours, theirs = one.content["configuration"], other.content["configuration"]
    return {name for name in {*ours, *theirs} - {*OF_A_RUN} if ours.get(name) != theirs.get(name)}


def with_fields(runs: list[RunResult], method: MethodName, fields: Mapping[str, object]) -> list[RunResult]:
    """The runs, those of one method as if they had been trained with other values of some fields."""
    found = [copy.deepcopy(run) if run.method == method else run for run in runs]
    for run in found:
        if run.method == method:
            assert fields.keys() <= run.content["configuration"].keys()
            run.content["configuration"] |= {name: str(value) for name, value in fields.items()}
    return found


# --- the drives of the tables -----------------------------------------------------------------------------------------
def drives_of_choices(section: str, runs: dict[str, list[RunResult]]) -> set[str]:
    parts = re.findall(r"<!-- (.+?) -->", section)
    names = [name for name in parts if name != "end"]
    files = {file for name in names for file in RUNS_OF.get(name, RUNS_OF.get(name.partition(":")[0], ()))}
    assert all(name in RUNS_OF or name.partition(":")[0] in RUNS_OF for name in names), names
    return {run.scene for file in files for run in runs[file]} & {*CHOICES}


def undisclosed(page: str, runs: dict[str, list[RunResult]]) -> set[str]:
    """Drives that took part in a choice and have figures in a section that does not say which choice."""
    sections = [" ".join(section.split()) for section in re.split("^## ", page, flags=re.MULTILINE)]
    return {name for each in sections for name in drives_of_choices(each, runs) if CHOICES[name] not in each}


def test_what_was_chosen_on_a_drive_stands_beside_its_figures(kept):
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert drives_of_choices(text, kept) == {"kitti360_half", "kitti360_full", "kitti_0005_full"}
    assert undisclosed(text, kept) == set()
    # the page opened with the real drive, and had tables of the search
    former = text + "## Figures\n<!-- real: table -->\n<!-- end -->\n"
    assert undisclosed(former, kept) == {"kitti360_half", "kitti360_full"}
    assert undisclosed(text + "## Search\n<!-- unseen: search -->", kept) == {"tune_street"}


def test_drives_of_the_tables_are_those_that_were_written_down(unseen, kept):
    names = {f"{kind}_{seed}" for kind, seed in unseen.DRIVES.items()}
    large = {f"{name}_{unseen.LARGE_PX}" for name in names}
    assert {run.scene for run in kept["grid"]} == names
    assert {run.scene for run in kept["unseen"]} == names | large
    assert {run.scene for run in kept["detail"]} == names


def test_the_claims_are_of_the_default_pipeline(unseen, kept):
    """All results were of simulated maps, and no row of the default pipeline, whose own network makes them."""
    claims = [run for run in kept["unseen"] if run.folder.parts[0] == "claims"]
    assert len({(run.scene, run.specification["scene_sha256"]) for run in claims}) == len(unseen.DRIVES) == 4
    rows = {(run.method, run.scene, run.seed) for run in claims}
    methods, _, seeds = ({key[index] for key in rows} for index in range(3))
    assert seeds == {0, 1, 2} and len(rows) == 4 * 4 * 3
    assert methods == {"nerfacto", "ds-nerf-integrated-extras", "edge-paper", "edge"}
    results = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    commands = [line for line in results.splitlines() if line.startswith("    edge-depth-nerf process")]
    assert commands and not any("--mono" in results.partition(line)[2].partition("\n\n")[0] for line in commands)


# --- one difference at a time -----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Pair:
    """Two rows of a table, and the fields that they may differ in."""

    one: MethodName
    other: MethodName
    fields: frozenset[str]


TABLES_3_AND_4 = (
    Pair("edge-paper", "edge-paper-lidar", frozenset({SOURCE})),
    Pair("edge-paper", "edge-paper-mono", frozenset({SOURCE})),
    Pair("edge-paper", "edge-paper-gaussian", frozenset({KERNEL})),
    Pair("edge", "edge-gaussian", frozenset({KERNEL})),
    Pair("edge", "edge-lidar", frozenset({SOURCE, *SEARCHED})),
    Pair("edge", "edge-mono", frozenset({SOURCE, *SEARCHED})),
)


FIELDS = {"loss": {LOSS}, "prior": {SOURCE}, "extras": {*WITHOUT_EXTRAS}}


def of_cells() -> list[Pair]:
    """Cells of the grid that differ in loss, prior or extras alone."""
    found = []
    for one, other in combinations(GRID, 2):
        different = [name for name in FIELDS if getattr(one, name) != getattr(other, name)]
        if len(different) == 1 and None not in (one.prior, other.prior):
            found.append(Pair(GRID[one], GRID[other], frozenset(FIELDS[different[0]] | SEARCHED)))
    return found


def unfair(runs: list[RunResult], pair: Pair) -> set[str]:
    """The fields beyond those of the pair in which its rows differ, on any drive that has both."""
    names = (pair.one, pair.other)
    ones, others = ({(run.scene, run.seed): run for run in runs if run.method == name} for name in names)
    both = ones.keys() & others.keys()
    assert both, pair
    return {name for key in both for name in changed(ones[key], others[key]) - pair.fields}


def first_seeds(kept: dict[str, list[RunResult]]) -> list[RunResult]:
    """Runs of 1,000 steps: the grid, and what is trained beside it."""
    return [*kept["grid"], *(run for run in kept["unseen"] if run.folder.parts[0] == "tables")]


@pytest.mark.parametrize("pair", TABLES_3_AND_4, ids=lambda pair: f"{pair.one} {pair.other}")
def test_rows_of_tables_3_and_4_differ_in_one_thing(pair, kept):
    runs = first_seeds(kept)
    assert unfair(runs, pair) == set()
    # Table 4 had a constant σ for the Gaussian alone; Table 3 changed alignment, σ and sky with the source
    former = {
        f"{PRIOR}align": "none",
        "pipeline.model.sky_loss_mult": 0.5,
        **({} if pair.fields & SEARCHED else {f"{PRIOR}sigma_constant_m": 7.0}),
    }
    found = unfair(with_fields(runs, pair.other, former), pair)
    assert found >= {*former} - ({f"{PRIOR}align"} if "paper" in pair.other else set())


def test_cells_of_the_grid_differ_in_one_thing(kept):
    """Extras came with the edge loss alone: rows with another loss and extras did not exist."""
    trained = {run.method for run in kept["grid"]}
    pairs = [pair for pair in of_cells() if {pair.one, pair.other} <= trained]
    assert len(pairs) >= 25
    for pair in pairs:
        assert unfair(kept["grid"], pair) == set(), pair
    for loss in ("urban-nerf", "ds-nerf", "edge"):
        for prior in ("lidar", "integrated"):
            assert {GRID[Method(loss, prior, extras)] for extras in (False, True)} <= trained
    # as it was: the row with extras goes without them
    former = with_fields(kept["grid"], "ds-nerf-integrated-extras", WITHOUT_EXTRAS)
    pair = next(pair for pair in pairs if {pair.one, pair.other} == {"ds-nerf-integrated-extras", "edge"})
    assert unfair(former, pair) == {*WITHOUT_EXTRAS}


FORMS_OF_URBAN_NERF = Pair("urban-nerf", "urban-nerf-los", frozenset({LOSS, *SEARCHED}))
EXPECTED, *OF_SIGHT = (f"pipeline.model.urban.{name}" for name in ("expected", "near", "empty"))


def under_one_weight(runs: list[RunResult]) -> set[MethodName]:
    """Methods with UrbanNeRF's line of sight whose squared metres weigh as much as its other terms."""
    return {
        run.method
        for run in runs
        if run.method.startswith("urban-nerf-los")
        and float(run.content["configuration"][EXPECTED])
        >= min(float(run.content["configuration"][name]) for name in OF_SIGHT)
    }


def test_urban_nerf_is_compared_in_both_forms(kept):
    """nerfstudio's form alone was a rival: squared metres under the one weight of all its terms."""
    runs = first_seeds(kept)
    assert unfair(runs, FORMS_OF_URBAN_NERF) == set()
    assert under_one_weight(runs) == set()
    assert under_one_weight(with_fields(runs, "urban-nerf-los", {EXPECTED: 1.0})) == {"urban-nerf-los"}


def other_exposures(runs: list[RunResult]) -> set[MethodName]:
    """Methods whose exposure model is not that of ours."""
    ours = {run.content["configuration"][EXPOSURE] for run in runs if run.method == "edge"}
    return {run.method for run in runs if run.content["configuration"][EXPOSURE] not in ours}


def test_all_rows_have_one_exposure_model(kept):
    runs = [*kept["grid"], *kept["unseen"], *kept["detail"]]
    assert other_exposures(runs) == set()
    assert other_exposures(with_fields(runs, "edge-paper", {EXPOSURE: "embedding"})) == {"edge-paper"}


# --- the searches -----------------------------------------------------------------------------------------------------
def of_another_length(runs: list[RunResult]) -> set[MethodName]:
    """Methods whose search is not that of ours: the same drives, seeds, steps, λ and σ."""
    shapes: dict[MethodName, set[tuple[object, ...]]] = {}
    for run in runs:
        specified = (run.specification[name] for name in ("scene", "scene_sha256", "seed", "weight", "sigma_m"))
        shapes.setdefault(run.method, set()).add((*specified, run.content["steps"]))
    return {method for method, shape in shapes.items() if shape != shapes["edge"]}


def without_a_search(
    runs: list[RunResult], searches: list[RunResult], same_as: dict[MethodName, MethodName]
) -> set[MethodName]:
    """Methods of the tables whose λ and σ are not those that a kept search found, for them or for what they are of."""
    best = {grid.method: grid.best for grid in grids(Results(searches))}
    found = set()
    for run in runs:
        setting = (run.specification["weight"], run.specification["sigma_m"])
        if METHODS[run.method].sigma_field and setting != best.get(same_as.get(run.method, run.method)):
            found.add(run.method)
    return found


def test_all_methods_have_equal_searches_that_are_kept(unseen, kept):
    runs = [*kept["grid"], *kept["unseen"], *kept["detail"]]
    searches = [*kept["grid_search"], *kept["unseen_search"]]
    assert of_another_length(searches) == set()
    assert without_a_search(runs, searches, unseen.SETTINGS_OF) == set()
    # the rivals' searches had other lengths …
    shorter = [run for run in searches if not (run.method == "ds-nerf" and run.specification["sigma_m"] == "own")]
    assert of_another_length(shorter) == {"ds-nerf"}
    longer = copy.deepcopy(searches)
    for run in longer:
        if run.method == "urban-nerf":
            run.content["steps"] = 300
    assert of_another_length(longer) == {"urban-nerf"}
    # … and were not kept
    lost = [run for run in searches if run.method != "ds-nerf-integrated-extras"]
    assert without_a_search(runs, lost, unseen.SETTINGS_OF) == {"ds-nerf-integrated-extras"}


# --- what is shipped is what is compared ------------------------------------------------------------------------------
CALLED_BEFORE = {
    "pipeline.model.losses.edge.gaussian": "pipeline.model.edge_gaussian",
    "pipeline.model.losses.edge.divide_by_norm": "pipeline.model.edge_divide_by_norm",
}
"""What kept runs call some fields."""


def unlike_compared(preset: dict[str, object], runs: list[RunResult]) -> set[str]:
    """Fields of the literal form in which the preset `paper` is not what the tables call as published."""
    found = set()
    for run in runs:
        for name in literal_form() if run.method == "edge-paper" else ():
            # a run has values as Python writes them
            kept = run.content["configuration"][CALLED_BEFORE.get(name, name)]
            if kept not in (repr(preset[name]), str(preset[name])):
                found.add(name)
    return found


def test_the_preset_paper_is_the_method_of_the_tables(kept):
    """λ and σ, too: the preset had λ = 1e-5, with one σ̂ for a frame."""
    assert "edge-paper" in {run.method for run in kept["unseen"]}
    preset = flattened(make_specifications(read_method_file())["edge-depth-nerf-paper"].config)
    assert unlike_compared(preset, kept["unseen"]) == set()
    former = {**preset, LOSS + "_mult": 1e-5, PRIOR + "sigma_mode": "combined"}
    assert unlike_compared(former, kept["unseen"]) == {LOSS + "_mult", PRIOR + "sigma_mode"}


# --- what the pages say in words --------------------------------------------------------------------------------------
TRUE, RECORDED, BESIDE = "truth_masked_psnr", "masked_psnr", "shifted_1m_masked_psnr"


def gains_db(
    runs: list[RunResult],
    one: MethodName,
    other: MethodName,
    others: list[RunResult] | None = None,
    name: str = TRUE,
) -> list[float]:
    """Differences in PSNR for the drives and seeds that both have."""
    psnr, theirs = (
        {(run.scene, run.seed): run.figures[name] for run in each if run.method == method}
        for each, method in ((runs, one), (others or runs, other))
    )
    return [psnr[key] - theirs[key] for key in psnr.keys() & theirs.keys()]


def gain_db(*compared: Any, name: str = TRUE) -> float:
    """Their mean."""
    differences = gains_db(*compared, name=name)
    assert len(differences) >= 3
    return sum(differences) / len(differences)


def abs_rel(runs: list[RunResult], method: MethodName, name: str = "lidar_abs_rel") -> list[float]:
    return [run.figures[name] for run in runs if run.method == method]


def lower_abs_rel(runs: list[RunResult], one: MethodName, other: MethodName) -> float:
    """By which share a method's mean AbsRel is below another's, %."""
    mine, theirs = ([run.figures["truth_abs_rel"] for run in runs if run.method == method] for method in (one, other))
    return 100 * (1 - (sum(mine) / len(mine)) / (sum(theirs) / len(theirs)))


def missing_figures(text: str, wanted: dict[str, list[str]]) -> list[str]:
    """Figures that the bullet of a page that begins so does not have; the bullet itself, if there is none."""
    bullets = re.findall(r"^- \*\*(.+?)\*\*(.*?)(?=^- |^$)", text, re.MULTILINE | re.DOTALL)
    found = {title.strip(" .").lower(): " ".join(words.split()) for title, words in bullets}
    return [
        f"{title}: {figure}"
        for title, figures in wanted.items()
        for figure in (figures if title in found else ["bullet"])
        if not re.search(rf"(?<![\d.]){re.escape(figure)}(?!\d)", found.get(title, ""))
    ]


def test_the_first_figures_of_the_pages_are_those_of_the_runs(kept):
    claims, seconds, large, larger = (
        [run for run in kept["unseen"] if run.folder.parts[0] == name]
        for name in ("claims", "seconds", "large", "large_seconds")
    )
    real, longer, full = (kept[name] for name in ("real_drive", "real_drive_seconds", "real_drive_full"))
    rival, without = "ds-nerf-integrated-extras", "urban-nerf-integrated"
    over = {name: gain_db(real, "edge", name, name=RECORDED) for name in ("nerfacto", "ds-nerf", "urban-nerf")}
    assert over["ds-nerf"] < over["urban-nerf"] < over["nerfacto"]
    off = {name: 100 * sum(abs_rel(real, name)) / 3 for name in ("edge", "nerfacto")}
    in_car_park = [run for run in claims if run.scene.startswith("parking")]
    wanted = {
        "pictures": [f"{over['nerfacto']:.2f} dB", f"{over['ds-nerf']:.2f} dB"],
        "distances": [f"{off['edge']:.1f} %", f"{off['nerfacto']:.0f} %"],
        "equal time": [f"{gain_db(real, 'edge', 'ds-nerf', longer, name=RECORDED):.2f} dB"],
        "not better": [f"{gain_db(in_car_park, 'nerfacto', 'edge', name=BESIDE):.2f} dB worse"],
    }
    second = [run for run in kept["real_scans"] if run.scene == "kitti_0005_full"]
    wanted["not better"] += [f"{100 * sum(abs_rel(second, name)):.1f} %" for name in ("edge", "ds-nerf", "edge-sharp")]
    wanted["pictures"].append(f"{gain_db(claims, 'edge', 'nerfacto'):.2f} dB")
    wanted["equal time"].append(f"{gain_db(claims, 'edge', without, seconds):.2f} dB")
    results, readme = ((ROOT / name).read_text(encoding="utf-8") for name in ("docs/results.md", "README.md"))
    assert missing_figures(results, wanted) == []
    # another figure is found, and so is a bullet that went
    assert missing_figures(results.replace(wanted["pictures"][0], "9.99 dB", 1), wanted) == ["pictures: 2.50 dB"]
    assert missing_figures(results, {"the weather": ["1"]}) == ["the weather: bullet"]
    said = [
        f"gains {gain_db(full, 'edge', 'ds-nerf', name=RECORDED):.2f} dB over the best rival",
        f"{gain_db(large, 'edge', 'nerfacto'):.2f} dB over nerfacto",
        f"{gain_db(large, 'edge', without, larger):.2f} dB over the UrbanNeRF loss on our prior at equal time",
        f"AbsRel is {lower_abs_rel(claims, 'edge', rival):.0f} % lower than with the DS-NeRF loss",
        f"no better pictures than nerfacto ({gain_db(claims, 'edge-paper', 'nerfacto'):+.2f} dB",
    ]
    text = " ".join(results.split())
    assert [words for words in said if words not in text] == []
    # what holds with each seed
    for runs in (real, full):
        assert all(min(gains_db(runs, "edge", name, name=RECORDED)) > 0 for name in (*over, "edge-paper"))
    assert all(max(abs_rel(full, "edge")) < min(abs_rel(full, name)) for name in (*over, "edge-paper"))
    assert min(abs_rel(real, "edge")) > max(abs_rel(real, "ds-nerf"))
    in_readme = [
        f"gain {over['nerfacto']:.1f} dB PSNR",
        f"gain {gain_db(real, 'edge', 'ds-nerf', longer, name=RECORDED):.1f} dB over the best other depth loss",
        f"wrong by {off['edge']:.1f} % on average, nerfacto's by {off['nerfacto']:.0f} %",
        "Learning rates, the same for all methods, were chosen partly on this street.",
    ]
    assert [words for words in in_readme if words not in " ".join(readme.split())] == []
