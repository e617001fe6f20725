"""The benchmark's tables: what README and docs/speed.md say is what its results hold."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results.json"


@pytest.fixture
def report(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import speed_report  # pyright: ignore[reportMissingImports]

    yield speed_report
    sys.modules.pop("speed_report")


@pytest.mark.parametrize("page", ["README.md", "docs/speed.md"])
def test_the_pages_have_the_tables_of_the_results(report, page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert report.OPEN.format("summary") in text
    assert report.with_tables(text, json.loads(RESULTS.read_text())) == text


def test_a_ratio_is_made_of_the_seconds(report):
    """The tables' ratios are the file's; these must follow from its seconds."""
    results = json.loads(RESULTS.read_text())
    for preset in ("lite", "full"):
        reference = results[preset]["nerfacto"]
        for found in results[preset].values():
            for ratio, seconds in (("step_ratio", "step_s"), ("render_ratio", "render_s")):
                pairs = zip(reference[seconds], found[seconds], strict=True)
                assert found[ratio] == pytest.approx([host / own for host, own in pairs])


def test_tables_of_a_run_that_has_not_all_parts(report, tmp_path):
    page = "before <!-- speed: rest --> old <!-- end --> after"
    results = {"start_up": {"help_s": [0.1, 0.3, 0.2], "plugin_adds_s": [0.5]}}
    made = report.with_tables(page, results)
    assert "old" not in made and made.startswith("before <!-- speed: rest -->\n| ") and made.endswith(" after")
    assert "| `edge-depth-nerf --help` | 0.20 s |" in made
    for make in report.TABLES.values():
        assert make({}).count("\n") == 1
    report.draw({}, tmp_path / "curves.svg")
    assert ElementTree.parse(tmp_path / "curves.svg").getroot().tag.endswith("svg")
