"""The pages: what they tell users to type exists and runs, what is generated is current, the site needs no network."""

import dataclasses
import importlib.metadata
import importlib.util
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import data_sets
import numpy as np
import pytest
import torch
import tyro
import yaml
from host_commands import in_one_process
from html_page import Page
from scenes import copy_sample_drive

from edge_depth_nerf import cli
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, write_json
from edge_depth_nerf.entry import DEBUG_OPTION
from edge_depth_nerf.method.depth_losses import Level
from edge_depth_nerf.process import build
from edge_depth_nerf.process.lidar_checks import LidarCheck

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
OTHER_PAGES = ("README.md", "CONTRIBUTING.md", "data/README.md", "benchmarks/README.md")
PAGES = sorted(str(path.relative_to(ROOT)) for path in (*(ROOT / name for name in OTHER_PAGES), *DOCS.glob("*.md")))
RUN = "<!-- run -->"
"""The block after this comment is run, not only parsed."""
PROGRAM = r"edge-depth-nerf|ns-[a-z]+|python|make"


def load(name: str) -> Any:
    path = DOCS / f"{name}.py"
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification and specification.loader
    module = importlib.util.module_from_spec(specification)
    sys.modules[path.stem] = module  # dataclasses look themselves up there
    specification.loader.exec_module(module)
    return module


# ---- what the pages say ----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Block:
    """Code of a page that is not of another language."""

    page: str
    text: str
    is_run: bool


def blocks(page: str, text: str) -> Iterator[Block]:
    fenced: list[str] | None = None
    language, indented, is_run = "", [], False
    for line in [*text.splitlines(), "end"]:
        fence = re.match(r"\s*```[\s{.]*(\w*)", line)
        if fence:
            if fenced is None:
                fenced, language = [], fence[1]
            else:
                if language in ("", "bash", "sh", "shell", "console"):
                    yield Block(page, "\n".join(fenced), is_run)
                fenced, is_run = None, False
        elif fenced is not None:
            fenced.append(line)
        elif line.startswith("    ") or (indented and not line.strip() and indented[-1]):
            indented.append(line[4:])
        else:
            if any(indented):
                yield Block(page, "\n".join(indented), is_run)
                is_run = False
            indented = []
            is_run = (is_run and not line.strip()) or line.strip() == RUN
    assert fenced is None, f"{page}: a fence is not closed"


def calls(block: Block) -> Iterator[list[str]]:
    """The words of each call of a program; a loop's variable has its first value."""
    text = block.text.replace("\\\n", " ")
    for name, value in re.findall(r"\bfor (\w+) in (\S+)", text):
        text = text.replace(f"${name}", value)
    for line in text.splitlines():
        if not re.match(rf"\s*({PROGRAM})( |$)", line):
            continue
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in lexer:
            if set(word) <= set("|&;"):
                yield words
                words = []
            else:
                words.append(word)
        yield words


ALL_BLOCKS = [block for page in PAGES for block in blocks(page, (ROOT / page).read_text(encoding="utf-8"))]
ALL_CALLS = [
    (block, words) for block in ALL_BLOCKS for words in calls(block) if words and re.fullmatch(PROGRAM, words[0])
]
PARSED = {
    " ".join(words): words
    for block, words in ALL_CALLS
    # of a method that is registered in the block itself; it has to be run
    if not re.search("NERFSTUDIO_METHOD_CONFIGS|EDGE_DEPTH_NERF_LOSSES", block.text) or not words[0].startswith("ns-")
}


class NotAccepted(AssertionError):
    """A parser refused a command."""


def parse(words: list[str]) -> None:
    program, *arguments = words
    try:
        if program == "edge-depth-nerf":
            command = tyro.cli(cli.Command, prog=program, args=arguments)
            options = command.options if isinstance(command, cli.Process) else command
            check = getattr(options, "check", None)
            if check is not None:
                check()
        else:
            parse_by_host(program, arguments)
    except SystemExit as ended:
        if ended.code:
            raise NotAccepted(" ".join(words)) from ended


def parse_by_host(program: str, arguments: list[str]) -> None:
    """nerfstudio's entry point, whose main functions do nothing."""
    (point,) = importlib.metadata.entry_points(group="console_scripts", name=program)
    entry = point.load()
    module = sys.modules[entry.__module__]
    if program == "ns-train":
        patched = [mock.patch.object(module, "main")]
    else:
        classes = [value for value in vars(module).values() if isinstance(value, type) and "main" in vars(value)]
        patched = [mock.patch.object(cls, "main", autospec=True) for cls in classes]
    with mock.patch.object(sys, "argv", [program, *arguments]):
        mains = [patch.start() for patch in patched]
        try:
            entry()
            assert sum(main.call_count for main in mains) == 1
        finally:
            mock.patch.stopall()


@pytest.mark.usefixtures("unchecked_types")  # nerfstudio's own defaults are not of their types
@pytest.mark.parametrize("words", PARSED.values(), ids=PARSED)
def test_commands_are_understood(words):
    program = words[0]
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert {word for word in words[1:] if "=" not in word} <= set(targets)
    elif program == "python":
        name = f"{words[2].replace('.', '/')}.py" if words[1] == "-m" else words[1]
        assert (ROOT / name).is_file()
    else:
        parse(words)


@pytest.mark.usefixtures("unchecked_types")
@pytest.mark.parametrize(
    "command",
    [
        "edge-depth-nerf process kitti360 --root A --sequence B --output C --sweps 3",
        "edge-depth-nerf camera-path --load-config A --kind lane-shfit",
        "ns-train edge-depth-nerf --data A --pipeline.model.depth-loss nothing",
        "ns-train edge-depth-nerf --data A fisheye-depth-data --metre-per-unit 3",
        "ns-render camera-path --load-config A --camera-path-filename B --output-pth C",
    ],
)
def test_options_that_do_not_exist_are_noticed(command):
    with pytest.raises(NotAccepted):
        parse(command.split())


def test_the_pages_are_read():
    """Were blocks or calls overlooked, the tests above would pass for nothing."""
    by_page = {page: [words for block, words in ALL_CALLS if block.page == page] for page in PAGES}
    assert ["ns-train", "edge-depth-nerf-lite", "--data", "scenes/drive"] in by_page["README.md"]
    assert {"make", "edge-depth-nerf", "ns-train"} <= {words[0] for words in by_page["README.md"]}
    for page in ("docs/quick_start.md", "docs/kitti360.md"):
        programs = {words[0] for words in by_page[page]}
        assert {"edge-depth-nerf", "ns-train", "ns-eval", "ns-viewer"} <= programs, page
    loop = "for scene in street turn; do\n    edge-depth-nerf synthesize --scene $scene\ndone"
    assert list(calls(Block("a page", loop, is_run=False))) == [["edge-depth-nerf", "synthesize", "--scene", "street"]]
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        found = len(re.findall(r"^ +(?:edge-depth-nerf|ns-[a-z]+) ", text, re.MULTILINE))
        assert sum(words[0].startswith(("edge-depth-nerf", "ns-")) for words in by_page[page]) == found, page
        assert sum(block.is_run for block in ALL_BLOCKS if block.page == page) == text.splitlines().count(RUN), page


def dotted_names(config: Any, place: str = "") -> Iterator[str]:
    """Names of a configuration's options, as nerfstudio's commands have them."""
    if dataclasses.is_dataclass(config):
        shown = [entry.name for entry in dataclasses.fields(config) if "conf.Suppress[" not in str(entry.type)]
        children = {name: getattr(config, name, None) for name in shown}
    else:
        children = config if isinstance(config, dict) else {}
    for name, child in children.items():
        dotted = f"{place}{name}".replace("_", "-")
        yield dotted
        yield from dotted_names(child, f"{dotted}.")


@pytest.fixture(scope="module")
def known_options() -> set[str]:
    """Every option of our commands, of our methods and of nerfstudio's commands."""
    from nerfstudio.configs.base_config import ViewerConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from nerfstudio.scripts import eval as host_eval
    from nerfstudio.scripts import render

    from edge_depth_nerf.plugin.config import edge_depth_nerf
    from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig

    names = set(dotted_names(edge_depth_nerf.config))
    names |= {f"viewer.{name}" for name in dotted_names(ViewerConfig())}
    names |= {*dotted_names(FisheyeDepthDataParserConfig()), *dotted_names(NerfstudioDataParserConfig())}
    own = [cls for _, cls in load("make_options").commands()]
    for cls in (*own, *vars(render).values(), host_eval.ComputePSNR):
        if isinstance(cls, type) and dataclasses.is_dataclass(cls):
            shown = [entry.name for entry in dataclasses.fields(cls) if "conf.Suppress[" not in str(entry.type)]
            entries = [name.replace("_", "-") for name in shown]
            names |= {*entries, *(f"no-{name}" for name in entries)}
    # of ns-export, which cannot be imported where open3d misses libusb
    return {f"--{name}" for name in names} | {"--help", "--normal-method", "--save-world-frame", DEBUG_OPTION}


@pytest.mark.parametrize("page", PAGES)
def test_options_named_in_the_text_exist(page, known_options):
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    spans = [
        span
        for span in re.findall(r"`([^`]+)`", text)
        if not re.match(r"(pip|hf|python|pytest|apt-get|git|ssh|dask) ", span)
    ]
    named = {name for span in spans for name in re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", span)}
    # of pip
    assert not named - known_options - {"--force-reinstall"}


# ---- what is generated -----------------------------------------------------------------------------------------
def test_the_page_of_options_is_current():
    assert (DOCS / "options.md").read_text(encoding="utf-8") == load("make_options").page(), (
        "run python docs/make_options.py"
    )


def test_the_page_of_options_has_them_all(capsys, monkeypatch):
    """Against the commands' own help, which is made in another way."""
    monkeypatch.setenv("COLUMNS", "300")
    text = (DOCS / "options.md").read_text(encoding="utf-8")
    every = [words for words, _ in load("make_options").commands()]
    assert {("synthesize",), ("process", "rig"), ("inspect",), ("camera-path",)} < set(every)
    for words in every:
        with pytest.raises(SystemExit):
            tyro.cli(cli.Command, prog="edge-depth-nerf", args=[*words, "--help"])
        named = set(re.findall(r"(?<![\w-])--[a-z][\w-]+", capsys.readouterr().out)) - {"--help"}
        assert len(named) > 1 or words == ("doctor",)
        assert not [name for name in named if f"`{name}`" not in text], words
    assert "| `--pipeline.model.depth-loss-mult` | number; `0.01`; paper: `0.003` |" in text
    assert "datamanager.prior" not in text and "auto-scale-poses" not in text  # what tyro hides


@pytest.mark.slow
def test_the_pictures_are_current(tmp_path):
    figures = load("make_pictures").make_pictures(tmp_path)
    # Eq. 7 at the edge: what the page says of it
    text = (DOCS / "method.md").read_text(encoding="utf-8")
    for metres in figures.values():
        assert f"{metres:.2f} m" in text
    assert abs(figures["edge-aware"] / figures["truth"] - 1) < 0.02
    assert abs(figures["spatial-gaussian"] / figures["truth"] - 1) > 0.2
    for name in ("method_maps.png", "method_kernel.png"):
        made, committed = (read_image(folder / name).astype(float) for folder in (tmp_path, DOCS))
        assert made.shape == committed.shape, name
        # another OpenCV may draw text a shade differently; the last matplotlib for Python 3.10 places it elsewhere
        assert sys.version_info < (3, 11) or np.abs(made - committed).mean() < 1, name
    assert (tmp_path / "method_ray.svg").stat().st_size > 5000
    committed = [path for path in DOCS.iterdir() if path.name.startswith("method_")]
    assert {path.name for path in committed} == {path.name for path in tmp_path.iterdir()}
    assert sum(path.stat().st_size for path in committed) < 1 << 20


def test_the_chart_is_of_the_table(tmp_path):
    module = load("make_chart")
    page = module.PAGE.read_text(encoding="utf-8")
    assert f"({module.FILE})" in page
    found = module.results(page)
    assert [one.title for one in found][-1] == "ours" and len(found) == 6
    committed = (DOCS / module.FILE).read_text(encoding="utf-8")
    part = page.partition(f"<!-- {module.TABLE} -->")[2].partition("<!-- end -->")[0]
    figures = re.findall(r"^\| [^|]+ \| (\d\d\.\d\d) ± ", part, re.MULTILINE)
    assert len(figures) == 6 and not [psnr for psnr in figures if f">{psnr}<" not in committed]
    module.draw(found, tmp_path / module.FILE)
    made = (tmp_path / module.FILE).read_text(encoding="utf-8")
    texts = [re.findall(r"<text[^>]*>([^<]+)</text>", svg) for svg in (made, committed)]
    assert texts[0] == texts[1], "run python docs/make_chart.py"
    with pytest.raises(InputError, match="has no rows"):
        module.results(page.replace(f"<!-- {module.TABLE} -->", ""))


def test_the_pictures_do_not_depend_on_what_trainings_left(sample_drive, tmp_path, monkeypatch):
    """A calibration in .cache does not stand in for one that the repository's sample drive lacks."""
    module, scene = load("make_pictures"), copy_sample_drive(tmp_path / "sample_drive")
    shipped = scene / "mono_trust.json"
    (scene / ".cache").mkdir()
    shutil.copy(shipped, scene / ".cache" / f"mono_trust_{read_json(shipped)['made_of']}.json")
    shipped.unlink()
    monkeypatch.setattr(module, "SAMPLE", scene)
    with pytest.raises(InputError, match="was not made of the maps beside it"):
        module.make_pictures(tmp_path)
    # it would have been taken: a stale one has the same effect
    shutil.copy(sample_drive / "mono_trust.json", shipped)
    stale = {**read_json(shipped), "made_of": "0"}
    del stale["sha256"]
    write_json(shipped, stale)
    assert module.ShownScene(module.read_scene(scene)).calibration is not None
    with pytest.raises(InputError, match="was not made of the maps beside it"):
        module.make_pictures(tmp_path)


def test_the_kernel_picture_is_of_eq_7(sample_drive):
    """The two averages again, Eq. 5 to 7 written out."""
    module = load("make_pictures")
    scene = module.ShownScene(module.read_scene(sample_drive))
    picture = next(each for each in scene.scene.pictures if each.frame == module.FRAME and each.camera == module.CAMERA)
    maps = scene.maps(picture)
    mono = module.aligned(scene, maps).astype(float)
    i, j = module.find_edge(module.aligned(scene, maps), maps, 4)
    _, figures = module.draw_kernel(scene, maps)
    for name, has_depth_factor in (("spatial-gaussian", False), ("edge-aware", True)):
        above = below = 0.0
        for k in range(-4, 5):
            for l in range(-4, 5):
                d, d_hat = float(maps.lidar_m[i + k, j + l]), mono[i + k, j + l]
                g = np.exp(-(k * k + l * l) / 18) * np.exp(-has_depth_factor * (mono[i, j] - d_hat) ** 2 / 2)
                weight = g * (0.7 if d > 0 else 0.3)
                above, below = above + weight * (d if d > 0 else d_hat), below + weight
        np.testing.assert_allclose(figures[name], above / below, rtol=1e-4)


# ---- the site --------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    pytest.importorskip("material", reason="pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def loads_of(page: Page) -> list[str]:
    """What a page loads."""
    found = []
    for tag, values in page.tags:
        if tag == "link":
            found += [values["href"]] if values.get("rel") not in ("canonical", "prev", "next") else []
        elif tag != "a":
            found += [values[name] for name in ("src", "srcset", "data", "poster") if values.get(name)]
    return found


@cache
def page_of(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def is_elsewhere(reference: str) -> bool:
    return bool(re.match(r"\s*([a-z]+:)?//", reference))


LOADED_ELSEWHERE = r"(url\(|@import)\s*['\"]?\s*(https?:)?//"
"""In a style."""


def test_the_site_needs_no_network(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        found = page_of(page)
        # the slider page contains all that it shows
        assert len(loads_of(found)) > 3 or page.name == "slider.html", page
        assert not [each for each in loads_of(found) if is_elsewhere(each)], page
        styles = [*found.texts.get("style", []), *(values.get("style", "") for _, values in found.tags)]
        assert not re.search(LOADED_ELSEWHERE, " ".join(styles)), page
        # Material fetches its program for diagrams where there are any
        assert "mermaid" not in page.read_text(encoding="utf-8"), page
    for style in site.rglob("*.css"):
        assert not re.search(LOADED_ELSEWHERE, style.read_text(encoding="utf-8")), style


def test_what_loads_elsewhere_is_noticed(tmp_path):
    page = tmp_path / "page.html"
    page.write_text(
        '<script src="//x.org/a.js"></script><link rel=stylesheet href="https://x.org/a.css"><img src="a.png">'
    )
    assert [is_elsewhere(each) for each in loads_of(page_of(page))] == [True, True, False]


def test_links_and_pictures_of_the_site_are_there(site):
    # the links of 404.html are from the server's root
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    assert len(pages) > 10
    for page in pages:
        found = page_of(page)
        links = [values.get("href", "") for tag, values in found.tags if tag == "a"]
        local = [each for each in (*loads_of(found), *links) if not re.match(r"([a-z]+:|//|#|$)", each)]
        assert local, page
        for reference in local:
            target = page.parent / reference.partition("#")[0].partition("?")[0]
            assert target.exists(), f"{page.name}: {reference}"


def test_pages_opened_as_files_are_searched(site, browser):
    page = browser.new_context(offline=True).new_page()
    failed: list[str] = []
    page.on("requestfailed", lambda request: failed.append(request.url))
    page.goto((site / "data/index.html").as_uri())  # which lies deeper than what is found
    page.get_by_placeholder("Search").first.click()
    page.keyboard.type("epipolar")
    page.locator(".md-search-result__item a").first.click()
    page.wait_for_url(re.compile(r"\.html\?h="))
    assert "epipolar" in page.locator("article").inner_text()
    assert failed == []


def test_the_slider_page_shows_both_methods_without_a_network(site, browser):
    text = (site / "slider.html").read_text(encoding="utf-8")
    assert len(text) < 3_000_000 and not (site / "slider").exists()
    assert 'href="slider.html"' in (site / "results.html").read_text(encoding="utf-8")
    page = browser.new_context(offline=True).new_page()
    page.goto((site / "slider.html").as_uri())
    assert page.locator(".stage .tag").all_inner_texts() == ["nerfacto", "ours"]
    assert page.locator(".stage img.over").evaluate("image => image.naturalWidth") > 100
    page.get_by_role("link", name="Results").click()
    page.wait_for_url(re.compile(r"/results\.html$"))


def test_every_page_is_in_the_navigation():
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def pages(entries) -> Iterator[str]:
        for entry in entries:
            for value in entry.values():
                yield from [value] if isinstance(value, str) else pages(value)

    named = list(pages(config["nav"]))
    assert len(set(named)) == len(named)
    assert {path.name for path in DOCS.glob("*.md")} <= set(named)
    assert config["theme"]["font"] is False and config["strict"] is True


def test_included_code_is_shown(site):
    text = re.sub(r"<[^>]+>", "", (site / "extending.html").read_text(encoding="utf-8"))
    for name in ("new_data_set", "new_loss", "new_network"):
        assert f"examples/{name}.py" not in text.replace(f"docs/examples/{name}.py", ""), name
    assert "class RatioLoss" in text and "def read_drive" in text and "def predict" in text


def test_the_home_page_is_the_readme(site):
    text = re.sub(r"<[^>]+>|\s+", " ", (site / "index.html").read_text(encoding="utf-8"))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    bullets = [line.removeprefix("- ") for line in readme.splitlines() if line.startswith("- ") and "](" not in line]
    assert len(bullets) >= 3 and all(bullet in text for bullet in bullets)
    assert "img.shields.io" in readme and "img.shields.io" not in (site / "index.html").read_text(encoding="utf-8")


# ---- the examples ----------------------------------------------------------------------------------------------
SMALL = (
    *("--timestamp", "DATE", "--max-num-iterations", "3"),
    *("--pipeline.model.num-levels", "4", "--pipeline.model.log2-hashmap-size", "12"),
    *("--pipeline.model.num-nerf-samples-per-ray", "12", "--pipeline.model.num-proposal-samples-per-ray", "16", "12"),
)
"""Trainings end after three steps, and their pictures are rendered soon."""
WITH_VIEWER, WITHOUT_VIEWER = ("--viewer.quit-on-train-completion", "True"), ("--vis", "tensorboard")
TWO_STEPS = """
import sys
from pathlib import Path
from new_loss import RatioLoss
from trainings import trainer_of
from edge_depth_nerf.method import depth_losses
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

def refuse(*_, **__):
    raise AssertionError("Eq. 4 was computed")

depth_losses.EdgeLoss.__call__ = depth_losses.edge_loss = refuse
calls, loss_of = [], RatioLoss.__call__
RatioLoss.__call__ = lambda loss, level: calls.append(loss.delta) or loss_of(loss, level)
for implementation in ("fused", "torch"):
    changes = {"model__implementation": implementation, "model__depth_loss": "ratio", "losses__ratio": RatioLoss(0.2)}
    trainer = trainer_of(Path("data/sample_drive"), Path("two_steps") / implementation, **changes)
    before = [each.clone() for each in trainer.pipeline.model.field.parameters()]
    for step in range(2):
        calls.clear()
        _, losses, _ = trainer.train_iteration(step)
        print(implementation, sorted(losses), calls, float(losses["ratio_loss"]) > 0)
    changed = [not (a == b).all() for a, b in zip(before, trainer.pipeline.model.field.parameters())]
    assert any(changed)
"""


@pytest.fixture(scope="module")
def typed(tmp_path_factory) -> tuple[Path, Callable[[str], str]]:
    """A folder in which the marked blocks of two pages were run in order, and what gives all that those of one said.

    It has what they use of the repository. All programs run in one process.
    """
    folder = tmp_path_factory.mktemp("typed")
    copy_sample_drive(folder / "data/sample_drive")
    shutil.copytree(DOCS / "examples", folder / "docs" / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    commands: dict[str, list[str]] = {}
    variables: dict[str, str] = {}
    for page in ("docs/quick_start.md", "docs/extending.md"):
        marked = [block for block in ALL_BLOCKS if block.page == page and block.is_run]
        lines = [line for block in marked for line in block.text.splitlines()]
        copies = [line for line in lines if line.startswith(("cp ", "mkdir "))]
        subprocess.run(["bash", "-ec", "\n".join(copies)], cwd=folder, check=True)
        exported = [word.partition("=") for line in lines if line.startswith("export ") for word in line.split()[1:]]
        variables |= {name: value for name, _, value in exported}
        of_page = [*itertools.chain(*map(calls, marked))]
        assert len(of_page) == 5
        commands |= {f"{Path(page).stem} {number} {words[0]}": words for number, words in enumerate(of_page)}
    for name, words in commands.items():
        viewer = WITH_VIEWER if name.startswith("quick_start") else WITHOUT_VIEWER
        words[2:2] = (*SMALL, *viewer) if words[0] == "ns-train" else []
        words += ["--frames", "1"] if words[1] == "inspect" else []
    (folder / "two_steps.py").write_text(TWO_STEPS)
    commands["two_steps"] = ["python", "two_steps.py"]
    (folder / "logs").mkdir()
    ended_well = in_one_process(commands, folder / "logs", cwd=folder, variables=variables)
    return folder, lambda name: "\n".join(ended_well(each) for each in commands if each.startswith(name))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is missing (Debian: apt-get install ffmpeg)")
def test_the_quick_start_as_it_is_typed(typed):
    folder, said = typed
    assert said("quick_start")
    # by the calibration that the drive brings, which was not made again
    cache = folder / "data/sample_drive/.cache"
    assert list(cache.iterdir()) and not list(cache.glob("mono_trust_*"))
    assert list((folder / "data/sample_drive_inspection").glob("image_0*.png"))
    assert np.isfinite(read_json(folder / "figures.json")["results"]["masked_psnr"])
    film = cv2.VideoCapture(str(folder / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) >= 11
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (192, 108)


@pytest.mark.slow
def test_the_examples_as_they_are_typed(typed):
    clone, said = typed
    (config,) = (clone / "outputs/ratio/edge-depth-nerf-lite").glob("*/config.yml")
    assert "depth_loss: ratio" in config.read_text() and "delta: 0.2" in config.read_text()
    # the flat road: every map is there, and of the road it is right
    meta = read_json(clone / "scenes/flat_road/transforms.json")
    assert meta["mono"]["trained_on"] == "elsewhere"
    assert len(list((clone / "maps").rglob("*.npy"))) == len(meta["frames"]) == 24
    assert "mean relative error" in said("extending")
    # the scene's maps are the network's, not those that it had
    for frame in meta["frames"]:
        picture = Path(frame["file_path"])
        mono_m = read_distance_png(clone / "scenes/flat_road" / frame["mono_file_path"])
        predicted_m = np.load(clone / "maps" / picture.parent.name / f"{picture.stem}.npy")
        near = (mono_m > 0) & (predicted_m < 40)
        assert near.mean() > 0.1
        np.testing.assert_allclose(mono_m[near], predicted_m[near], atol=0.003)
    # a method of its own, of which the option is kept
    (config,) = (clone / "outputs/radar_drive/radar").glob("*/config.yml")
    assert "depth_source: radar" in config.read_text()
    frames = read_json(clone / "radar_drive/transforms.json")["frames"]
    maps = [read_distance_png(clone / "radar_drive" / frame["radar_file_path"]) for frame in frames]
    assert len(maps) == 24 and all(0 < (distance_m > 0).mean() < 0.1 for distance_m in maps)


def test_a_new_source_of_depth_reaches_the_prior(tmp_path, monkeypatch):
    """One line in the table of layers: written, read, kept by its key, and the prior is made of it alone."""
    from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
    from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
    from edge_depth_nerf.scene import format as scene_format

    monkeypatch.setitem(scene_format.LAYERS, "radar", None)  # taken out again at the end
    module = load("examples/new_depth_source")
    scene = tmp_path / "scene"
    copy_sample_drive(scene)
    module.main(scene)
    read = module.read_scene(scene)
    picture = read.pictures[0]
    lidar_m, radar_m = read.lidar_m(picture), read.distance_m(picture, "radar")
    assert radar_m is not None
    seen = radar_m > 0
    assert 0.05 < seen.sum() / (lidar_m > 0).sum() < 0.2
    assert np.abs(radar_m - lidar_m)[seen].max() < module.STEP_M / 2 + 0.01
    parser = FisheyeDepthDataParserConfig(data=scene)
    config = FisheyeDepthDataManagerConfig(dataparser=parser, depth_source="radar", train_num_rays_per_batch=4096)
    data = config.setup(test_mode="val")
    share = data.train_pixel_sampler.table.share_with_prior
    usable = [read.usable(each) & (read.distance_m(each, "radar") > 0) for each in data.train_dataset.pictures]
    masks = [read.usable(each) for each in data.train_dataset.pictures]
    assert share == pytest.approx(sum(map(np.sum, usable)) / sum(map(np.sum, masks)))
    _, batch = data.next_train(0)
    at = batch["prior_distance_m"][:, 0] > 0
    assert at.any()
    maps = torch.stack([torch.from_numpy(read.distance_m(each, "radar")) for each in data.train_dataset.pictures])
    image, row, column = batch["indices"][at].T
    torch.testing.assert_close(batch["prior_distance_m"][at, 0], maps[image, row, column], atol=0.01, rtol=0)
    with pytest.raises(InputError, match="expected one of auto, integrated, lidar, mono, motion, radar, none"):
        FisheyeDepthDataManagerConfig(dataparser=parser, depth_source="sonar").setup(test_mode="val")


def test_the_example_of_a_loss():
    loss_of = load("examples/new_loss").RatioLoss(delta=0.1)
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(5, 7, generator=generator, dtype=torch.float64).requires_grad_()
    edges = (torch.rand(5, 8, generator=generator, dtype=torch.float64) * 10).sort(dim=1).values
    prior = torch.tensor([3.0, 0, 8, 20, 0.5], dtype=torch.float64)
    level = Level(weights, edges[:, :-1], edges[:, 1:], prior, torch.ones_like(prior))
    loss = loss_of(level)
    midpoints = (edges[:, 1:] + edges[:, :-1]).numpy() / 2
    ratio = np.log((weights.detach().numpy() * midpoints).sum(1) + 1e-3) - np.log(np.where(prior > 0, prior, 1))
    huber = np.where(np.abs(ratio) < 0.1, ratio**2 / 2, 0.1 * (np.abs(ratio) - 0.05))
    np.testing.assert_allclose(loss.detach().numpy(), np.where(prior > 0, huber, 0))
    loss.sum().backward()
    assert weights.grad is not None and (weights.grad[1] == 0).all() and (weights.grad[0] != 0).all()


@pytest.mark.slow
def test_the_program_trains_with_the_example_of_a_loss(typed):
    """Registered by the environment, its function is called, its key is among the losses, and Eq. 4 is not computed."""
    names = "['distortion_loss', 'interlevel_loss', 'ratio_loss', 'rgb_loss', 'sky_loss', 'surface_loss']"
    found = [line for line in typed[1]("two_steps").splitlines() if line.startswith(("fused", "torch"))]
    assert found == [f"{kind} {names} [0.2, 0.2, 0.2] True" for kind in ("fused", "fused", "torch", "torch")]


def test_the_example_of_a_network(sample_drive):
    """On the road, distances are those of a plane below the camera."""
    module = load("examples/new_network")
    scene = load("make_pictures").read_scene(sample_drive)
    picture = scene.pictures[0]
    predicted = module.predict(read_image(picture.files["image"]), picture)
    rays, valid = picture.lens.unproject(picture.lens.pixel_centres())
    # OpenCV's axes to nerfstudio's, then to the world
    down = -(rays.numpy() * [1, -1, -1] @ picture.rotation.T)[..., 2]
    steep = valid.numpy() & (down > 0.1)
    assert steep.sum() > 1000
    np.testing.assert_allclose((predicted * down)[steep], module.CAMERA_HEIGHT_M, rtol=1e-4)
    assert (predicted[valid.numpy() & (down < 0)] == module.HORIZON_M).all()


def test_the_example_of_a_data_set(tmp_path, monkeypatch):
    """A car that drives through an empty hall, askew, so that each wall shows whether points are de-skewed."""
    # its pictures are noise, with which LiDAR cannot be compared
    monkeypatch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
    frames = 4
    module = load("examples/new_data_set")
    root = tmp_path / "drive"
    (root / "pictures").mkdir(parents=True)
    (root / "scans").mkdir()
    heading = 0.6
    ahead = np.array([np.cos(heading), np.sin(heading), 0])
    to_world = np.stack((ahead, [-ahead[1], ahead[0], 0], [0, 0, 1]), 1)
    along = np.arange(frames)[:, None] * 0.8 * ahead
    np.savetxt(root / "poses.txt", np.column_stack((along[:, :2], np.full(frames, heading))))

    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.radians(np.linspace(-24, 4, 48)))
    beams = data_sets.beams(azimuth, elevation)
    # clockwise, a turn in 0.1 s, ahead in its middle: the car goes 0.8 m meanwhile
    turned = -(((azimuth + np.pi) % (2 * np.pi)) - np.pi) / (2 * np.pi)
    generator = np.random.default_rng(0)
    for frame, place in enumerate(along):
        origins = place + 0.8 * turned.reshape(-1, 1) * ahead + [0, 0, 1.8]
        points = beams * data_sets.reach(origins, beams @ to_world.T)[:, None]
        np.save(root / f"scans/{frame:06d}.npy", points.astype(np.float32))
        picture = generator.integers(0, 255, (96, 128, 3), dtype=np.uint8)
        cv2.imwrite(str(root / f"pictures/{frame:06d}.png"), picture)
    options = module.MyDriveOptions(root=root, output=tmp_path / "scene", find_ego=False, sweeps=1, first=1, frames=2)
    # which its pictures are of no use for
    options = dataclasses.replace(options, refine_poses=False)
    module.convert(options)

    meta = read_json(tmp_path / "scene/transforms.json")
    assert len(meta["frames"]) == 2
    rays, _ = module.LENS.unproject(module.LENS.pixel_centres())
    directions = rays.numpy() @ module.CAMERA_TO_VEHICLE[:3, :3].T @ to_world.T
    for frame in meta["frames"]:
        lidar = read_distance_png(tmp_path / "scene" / frame["lidar_file_path"])
        origin = along[int(Path(frame["file_path"]).stem)] + to_world @ module.CAMERA_TO_VEHICLE[:3, 3]
        true = data_sets.reach(origin, directions)
        found = (lidar > 0) & np.isfinite(true)
        assert found.sum() > 300
        # a pixel holds the nearest of the returns that fall into it
        assert np.median(np.abs(lidar[found] / true[found] - 1)) < 0.006
    shutil.rmtree(root / "scans")
    with pytest.raises(module.InputError, match=r"scans/000000\.npy: no such file"):
        module.read_drive(options)
