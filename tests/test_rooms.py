"""Rooms stay small, are named in the guide, and import nothing by string."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "edge_depth_nerf"

MOST_LINES = {
    "edge_depth_nerf": 685,
    "edge_depth_nerf/base": 1_590,
    "edge_depth_nerf/cameras": 1_370,
    "edge_depth_nerf/compare": 2_880,
    "edge_depth_nerf/demo": 340,
    "edge_depth_nerf/export": 975,
    "edge_depth_nerf/films": 1_845,
    "edge_depth_nerf/inspecting": 1_395,
    "edge_depth_nerf/jobs": 780,
    "edge_depth_nerf/kernels": 3_745,
    "edge_depth_nerf/lidar": 1_770,
    "edge_depth_nerf/masks": 1_185,
    "edge_depth_nerf/method": 3_145,
    "edge_depth_nerf/mono": 3_865,
    "edge_depth_nerf/plugin": 5_075,
    "edge_depth_nerf/plugin/fused": 685,
    "edge_depth_nerf/poses": 760,
    "edge_depth_nerf/process": 5_710,
    "edge_depth_nerf/process/bags": 1_760,
    "edge_depth_nerf/process/colmap": 1_655,
    "edge_depth_nerf/process/kitti": 365,
    "edge_depth_nerf/process/kitti360": 550,
    "edge_depth_nerf/report": 750,
    "edge_depth_nerf/scene": 2_135,
    "edge_depth_nerf/stereo": 900,
    "edge_depth_nerf/synthetic": 3_455,
    "tests": 36_295,
    "benchmarks": 140,
    "benchmarks/quality": 1_190,
    "benchmarks/robustness": 665,
    "benchmarks/speed": 1_980,
}
"""Lines of Python that the modules of each folder may have together, without those of its subfolders."""

BY_STRING = {"import_module", "__import__", "EntryPoint", "spec_from_file_location", "run_module", "run_path"}
"""What imports a module that import-linter cannot see."""
MAY_IMPORT_BY_STRING = {"process/converters.py", "method/depth_losses.py"}
"""The one's table names converters of its own room, the other loads losses that users register."""


def lines_of(folder: Path) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.glob("*.py"))


@pytest.mark.parametrize("room", MOST_LINES)
def test_a_room_keeps_to_its_budget_of_lines(room: str) -> None:
    lines, most = lines_of(ROOT / room), MOST_LINES[room]
    assert lines <= most, (
        f"{room} has {lines} lines, and its budget is {most}. Take something out of it, or raise the budget in "
        "MOST_LINES and say in the commit what the lines are for."
    )


def test_every_room_has_a_budget() -> None:
    every = [ROOT / "tests", *(folder for top in (PACKAGE, ROOT / "benchmarks") for folder in [top, *top.rglob("*")])]
    assert {str(path.relative_to(ROOT)) for path in every if path.is_dir() and lines_of(path)} == set(MOST_LINES)


def test_the_guide_names_every_room() -> None:
    table = re.findall(r"^\| (`.*?) \|", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = sorted(re.findall(r"`(\w+)/`", " ".join(table)))
    assert named == sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def by_string(source: str) -> set[str]:
    """What a module calls, or imports to call, of `BY_STRING`."""
    found = set()
    for node in ast.walk(ast.parse(source)) if any(name in source for name in BY_STRING) else ():
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= {alias.name.rpartition(".")[2] for alias in node.names}
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.Name):
            found.add(node.id)
    return found & BY_STRING


def test_nothing_is_imported_by_string() -> None:
    """Such an import may go up, or in a circle, and import-linter would not see it."""
    modules = {path.relative_to(PACKAGE).as_posix(): path for path in PACKAGE.rglob("*.py")}
    found = {name for name, path in modules.items() if by_string(path.read_text(encoding="utf-8"))}
    assert found == MAY_IMPORT_BY_STRING


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import importlib\nimportlib.import_module(name)", True),
        ("from importlib import import_module as load", True),
        ("def f():\n return __import__('a.b')", True),
        ("from importlib import util\nutil.spec_from_file_location(name, path)", True),
        ("import importlib.metadata\nfrom importlib.resources import files\nfrom a import b", False),
    ],
)
def test_imports_by_string_are_seen(source: str, found: bool) -> None:
    assert bool(by_string(source)) == found
