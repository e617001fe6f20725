import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of the sources, built apart from them: a build leaves folders behind."""
    sources = tmp_path_factory.mktemp("sources") / "project"
    shutil.copytree(ROOT, sources, ignore=shutil.ignore_patterns(".*", "outputs", "build", "dist", "*.egg-info"))
    build = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(sources / "dist"),
        str(sources),
    ]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next((sources / "dist").glob("*.whl"))


def test_the_wheel_holds_the_whole_package(wheel):
    files = {str(path.relative_to(ROOT)) for path in (ROOT / "edge_depth_nerf").rglob("*.py")}
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        method_file = archive.read("edge_depth_nerf/nerfstudio_method.toml")
    assert files <= names
    assert method_file == (ROOT / "edge_depth_nerf" / "nerfstudio_method.toml").read_bytes()
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "data/"))]


def test_the_wheel_works_without_the_sources(wheel, tmp_path):
    """Unpacked elsewhere and put first, it is what is imported, and its methods are made from its own file."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
        points = next(name for name in archive.namelist() if name.endswith("entry_points.txt"))
        declared = archive.read(points).decode()
    assert "edge-depth-nerf-lite = edge_depth_nerf.config:edge_depth_nerf_lite" in declared
    assert "fisheye-depth-data = edge_depth_nerf.dataparser_config:fisheye_depth_data" in declared
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import edge_depth_nerf.config as c, edge_depth_nerf; "
        f"assert edge_depth_nerf.__file__.startswith({str(tmp_path)!r}), edge_depth_nerf.__file__; "
        "assert c.edge_depth_nerf_lite.config.pipeline.model.num_levels == 8"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr


PAGES = ["README.md", "data/README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]


@pytest.mark.parametrize("page", PAGES)
def test_pages_link_to_what_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "@@" not in text
    links = re.findall(r"\]\((?!http)([^)#]+)\)", text)
    assert page != "README.md" or len(links) > 3
    for link in links:
        assert ((ROOT / page).parent / link).exists(), link
