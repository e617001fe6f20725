import email
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import edge_depth_nerf

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    """Folder of the sdist and of the wheel that is made from it, built apart: a build leaves folders behind."""
    sources = tmp_path_factory.mktemp("sources") / "project"
    ignored = (".venv", ".git", ".*_cache", ".cache", ".hypothesis", "outputs", "build", "dist", "*.egg-info")
    shutil.copytree(ROOT, sources, ignore=shutil.ignore_patterns(*ignored), symlinks=True)
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(sources / "dist"), str(sources)]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return sources / "dist"


@pytest.fixture(scope="module")
def wheel(dist, tmp_path_factory) -> Path:
    """Folder in which it is unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as archive:
        archive.extractall(folder)
    return folder


def test_the_sdist_is_the_repository(dist):
    """With tests, pages, the sample drive and the licence: what is in it can be worked on."""
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = {
        str(path.relative_to(ROOT))
        for folder in ("edge_depth_nerf", "tests", "docs", "benchmarks", "data", ".github", ".ci")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not {".cache", "__pycache__"} & set(path.parts) and path.suffix != ".pyc"
    }
    expected |= {"LICENSE", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "MANIFEST.in", "Makefile"}
    expected |= {"pyproject.toml", "mkdocs.yml", "constraints.txt", "nerfstudio_method.toml", ".gitignore"}
    assert "tests/conftest.py" in expected
    assert not expected - names
    assert not [
        name for name in names if "__pycache__" in name or "/.cache" in name or name.startswith((".venv", "outputs"))
    ]


def test_the_wheel_says_what_it_is(wheel):
    folder = wheel / f"edge_depth_nerf-{edge_depth_nerf.__version__}.dist-info"
    about = email.message_from_bytes((folder / "METADATA").read_bytes())
    assert (folder / "licenses/LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert about["Version"] == edge_depth_nerf.__version__
    assert about["License-Expression"] == "Apache-2.0"
    # the README's badges say the same
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "python-3.10_--_3.12" in readme and about["Requires-Python"].split(",") == ["<3.13", ">=3.10"]
    assert "licence-Apache--2.0" in readme
    declared = (folder / "entry_points.txt").read_text()
    assert "edge-depth-nerf-lite = edge_depth_nerf.plugin.config:edge_depth_nerf_lite" in declared
    assert "fisheye-depth-data = edge_depth_nerf.plugin.dataparser_config:fisheye_depth_data" in declared


def test_the_wheel_holds_the_whole_package_and_nothing_else(wheel):
    def files_of(folder: Path) -> set[Path]:
        found = {path.relative_to(folder) for path in folder.glob("edge_depth_nerf/**/*") if path.is_file()}
        return {path for path in found if "__pycache__" not in path.parts}

    files = files_of(ROOT)
    # with all that is not code: the methods, and what report.html is made of
    assert {Path("edge_depth_nerf", name) for name in ("nerfstudio_method.toml", "report/template.html.j2")} < files
    assert files == files_of(wheel) and len([*wheel.iterdir()]) == 2  # with what it says of itself
    assert [path for path in files if (ROOT / path).read_bytes() != (wheel / path).read_bytes()] == []


@pytest.mark.slow
def test_the_wheel_works_without_the_sources(wheel, tmp_path):
    """Put first, it is what is imported, and its methods' file is found in it."""
    code = (
        f"import sys; sys.path.insert(0, {str(wheel)!r}); sys.argv = ['edge-depth-nerf', '--help']; "
        "import edge_depth_nerf.entry as entry; from importlib import resources; "
        f"assert entry.__file__.startswith({str(wheel)!r}), entry.__file__; "
        "assert resources.files('edge_depth_nerf').joinpath('nerfstudio_method.toml').is_file(); entry.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0 and "camera-path" in done.stdout, done.stderr


PAGES = sorted(
    str(page.relative_to(ROOT)) for pattern in ("*.md", "data/*.md", "docs/*.md") for page in ROOT.glob(pattern)
)


@pytest.mark.parametrize("page", PAGES)
def test_pages_link_to_what_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "@@" not in text
    links = re.findall(r"\]\((?!http)([^)#]+)\)", text)
    assert page != "README.md" or len(links) > 3
    for link in links:
        # the site's own page of pictures, which `make docs` writes
        assert link == "slider.html" or ((ROOT / page).parent / link).exists(), link


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == edge_depth_nerf.__version__
    assert citation["license"] == "Apache-2.0"
    paper = citation["references"][0]
    assert paper["title"] in (ROOT / "README.md").read_text(encoding="utf-8").replace("\n", " ")
    assert (paper["volume"], paper["issue"], paper["start"]) == (24, 21, 6790)


def test_the_changelog_knows_this_version():
    """As a release of its own, or as the one that comes next."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## \[{re.escape(edge_depth_nerf.__version__)}\]", text, re.MULTILINE) or re.search(
        rf"^## \[Unreleased\]\n\nWill be {re.escape(edge_depth_nerf.__version__)}\b", text, re.MULTILINE
    )


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="pip takes torch for CUDA there alone"
)
def test_setup_asks_for_space_before_it_begins(tmp_path):
    setup = ["make", "setup", f"PYTHON={sys.executable}", f"VENV={tmp_path / 'new' / 'venv'}"]
    done = subprocess.run([*setup, "PACKAGES_GB=1e6"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    needed = re.search(r"installing needs ([\d.]+) GB on the disk of (\S+), and ([\d.]+) GB are free", done.stderr)
    assert needed, done.stdout + done.stderr
    assert float(needed[1]) >= 1e6 and needed[2] == str(tmp_path) and float(needed[3]) < 1e6
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_call_what_exists(path):
    workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
    # YAML 1.1 reads the key `on` as true
    assert {"name", "jobs", "permissions", True} <= set(workflow)
    called = []
    for job in workflow["jobs"].values():
        assert job["runs-on"] and job["timeout-minutes"]
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)
            assert re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step.get("uses", "actions/checkout@v4"))
            called += re.findall(r"\bmake (?:--\S+ )?([a-z-]+)", step.get("run", ""))
    assert called and set(called) <= make_targets()


def test_the_workflows_cover_every_python():
    ci = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    supported = re.findall(r"Programming Language :: Python :: (3\.\d+)", text)
    assert ci["jobs"]["tests"]["strategy"]["matrix"]["python"] == supported
    assert {"lint", "tests", "other-systems", "docs", "distribution", "audit"} == set(ci["jobs"])
    assert ci["jobs"]["other-systems"]["strategy"]["matrix"]["system"] == ["windows-latest", "macos-latest"]


@pytest.mark.parametrize("name", ["ci", "release"])
def test_the_site_is_kept(name):
    jobs = yaml.safe_load((ROOT / f".github/workflows/{name}.yml").read_text(encoding="utf-8"))["jobs"]
    (steps,) = (
        job["steps"] for job in jobs.values() if any("make docs" in step.get("run", "") for step in job["steps"])
    )
    kept = [step["with"] for step in steps if step.get("uses", "").startswith("actions/upload-artifact")]
    assert {"name": "site", "path": "site/", "if-no-files-found": "error"} in kept


def test_a_release_has_its_notes():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (version, date), *_ = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    command = ["make", "--no-print-directory", "notes", f"VERSION={version}"]
    notes = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert notes.strip() and f"## [{version}] - {date}\n{notes}" in changelog and "\n## " not in notes
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (str(citation["version"]), str(citation["date-released"])) == (version, date)


@pytest.mark.parametrize("name", ["bug", "question", "feature"])
def test_issue_forms(name):
    form = yaml.safe_load((ROOT / f".github/ISSUE_TEMPLATE/{name}.yml").read_text(encoding="utf-8"))
    assert form["name"] and form["description"]
    ids = [field["id"] for field in form["body"]]
    assert len(set(ids)) == len(ids) and all(field["attributes"]["label"] for field in form["body"])


def test_contributing_names_what_exists():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"(?:`|^    )make ([a-z-]+)", text, re.MULTILINE))
    assert {"setup", "test", "lint"} < named and named <= make_targets()
    for name in re.findall(r"`([\w./]+\.(?:py|toml|txt|cff)|[\w]+/)`", text):
        folders = (ROOT, ROOT / "edge_depth_nerf", ROOT / "tests")
        assert name == "rig.toml" or any((folder / name).exists() for folder in folders), name


def test_the_constraints_suit_every_python_that_is_allowed():
    """Of what is installed: Debian 12 has Python 3.11.2, which a version for 3.11.5 and later does not suit."""
    read = 0
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        pinned = Requirement(line)
        try:
            installed = distribution(pinned.name)
        except PackageNotFoundError:
            continue
        if "Requires-Python" not in installed.metadata or not pinned.specifier.contains(installed.version):
            continue
        needs = installed.metadata["Requires-Python"]
        read += 1
        for python in ("3.10.0", "3.11.0", "3.12.0"):
            environment = {"python_version": python.rpartition(".")[0], "python_full_version": python}
            if pinned.marker is None or pinned.marker.evaluate(environment):
                assert SpecifierSet(needs).contains(python), f"{line}: needs Python {needs}, not {python}"
    assert read > 50
