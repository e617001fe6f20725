"""report.html: its pictures by formula, its text escaped, nothing loaded, and the page in a real browser."""

import base64
import hashlib
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import tyro
from comparisons import write_rendered
from html_page import Page
from rich.console import Console
from scenes import transforms, write_scene

from edge_depth_nerf import cli
from edge_depth_nerf.base.files import write_json
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.base.pictures import NO_VALUE_RGB, colour_distance, distance_of_colours
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import CompareOptions, SearchOptions
from edge_depth_nerf.compare.plots import Lines, plot_lines, style_of
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.jobs.runs import command_line
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.report import views
from edge_depth_nerf.report.build import Commands, Facts, Plot, Report, write_report
from edge_depth_nerf.report.compared_views import BY_VIEW, DISTANCE_KEYS, ComparedView, held_out_frames
from edge_depth_nerf.report.points import show_points
from edge_depth_nerf.report.tables import Cell, MadeTable, Row
from edge_depth_nerf.report.views import KINDS, ShownDrive, ShownView, encode, make_drives, show_view, spread
from edge_depth_nerf.scene.reader import read_scene

NASTY = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked=1'> & \"quotes\" {{ 1 }} $x$"


# --- pictures ---------------------------------------------------------------------------------------------------------
def decoded(content: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def test_distances_come_back_from_their_colours():
    generator = np.random.default_rng(0)
    distance = np.exp(generator.uniform(np.log(0.5), np.log(300), (40, 50)))
    distance[0, :5] = [0, np.nan, np.inf, 1, 60]
    coloured = colour_distance(distance)
    found = distance_of_colours(coloured)
    assert (found[0, :3] == 0).all()
    known = np.isfinite(distance) & (distance > 0)
    # half a step of 255 over a factor of 60, and no farther than the scale's ends
    assert np.abs(np.log(found[known] / np.clip(distance[known], 1, 60))).max() < 1.01 * np.log(60) / 255 / 2
    # ns-eval loses the last bit of some
    harmed = np.maximum(coloured.astype(int) - generator.integers(0, 2, coloured.shape), 0).astype(np.uint8)
    assert np.abs(np.log(distance_of_colours(harmed)[known] / found[known])).max() < 0.04


def test_errors_by_formula():
    """Flat patches, so that the encoding does not matter."""
    size = 96
    target = np.full((size, size, 3), 100, np.uint8)
    colours = np.zeros((size, size, 3), np.uint8)
    colours[:, :48], colours[:, 48:] = (130, 100, 100), (100, 100, 100)
    true_m = np.full((size, size), 10, np.float32)
    true_m[48:] = 50  # farther than errors are shown
    rendered_m = np.full((size, size), 13, np.float32)
    rendered_m[:, 48:] = 5
    mask = np.ones((size, size), bool)
    mask[:16] = False
    distances = {"m": colour_distance(rendered_m, mask)}
    view = ComparedView("a.png", target, None, mask, true_m, "truth_distance_file_path", {"m": colours}, distances, {})
    shown = show_view(view, 10**6)
    assert set(shown.truth) == {"colour", "distance"} and set(shown.rendered["m"]) == {kind.key for kind in KINDS}
    truth = decoded(shown.truth["colour"])
    assert np.abs(truth[60, 60] - 100).max() < 6 and np.abs(truth[4, 60] - 35).max() < 6
    error = decoded(shown.rendered["m"]["colour-error"])
    inferno = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_INFERNO)[:, 0, ::-1].astype(int)
    # a third of 30 of 255, on a scale that ends at a quarter
    assert np.abs(error[60, 24] - inferno[round(10 / 255 / 0.25 * 255)]).max() < 14
    assert np.abs(error[60, 72] - inferno[0]).max() < 14
    assert np.abs(error[4, 60] - NO_VALUE_RGB).max() < 14
    distance_error = decoded(shown.rendered["m"]["distance-error"])
    red, blue = distance_error[30, 24], distance_error[30, 72]
    assert red[0] > red[2] + 50 and blue[2] > blue[0] + 100  # 30 % too far, 50 % too near
    assert np.abs(distance_error[70, 24] - NO_VALUE_RGB).max() < 14


FOUND = {"masked_psnr": 20.0, "truth_masked_psnr": 21.0, "masked_flip": 0.125, "detail_masked_ssim": 0.5}


def test_a_view_without_distances_has_no_errors_of_them():
    grey = np.full((20, 20, 3), 90, np.uint8)
    nothing = np.zeros((20, 20), np.float32)
    view = ComparedView("a", grey, None, np.ones((20, 20), bool), nothing, None, {"m": grey}, {"m": grey}, {"m": FOUND})
    shown = show_view(view, 10**6)
    assert set(shown.truth) == {"colour"} and "distance-error" not in shown.rendered["m"]
    assert shown.figures == {"m": {"PSNR to clean ↑": "21.00", "FLIP ↓": "0.125"}}


def test_lidar_points_are_spread_so_that_they_can_be_seen():
    values = np.zeros((30, 40), np.float32)
    values[10, 10], values[10, 14], values[25, 35] = 3, 7, 9
    found, known = spread(values, values > 0, 2.0)
    rows, columns = np.indices(values.shape)
    near = {
        value: np.hypot(rows - row, columns - column) for row, column, value in ((10, 10, 3), (10, 14, 7), (25, 35, 9))
    }
    # OpenCV's distances are good to some percent
    assert all(known[distance <= 1.8].all() for distance in near.values())
    assert not known[np.min(list(near.values()), axis=0) > 2.2].any()
    for value, distance in near.items():
        assert (
            found[(distance < 2) & known & (distance < np.min([d for v, d in near.items() if v != value], 0))] == value
        ).all()
    assert spread(values, values > 0, 0.0)[0] is values
    assert not spread(values * 0, values < 0, 2.0)[1].any()


def test_pictures_are_small():
    noise = np.random.default_rng(0).integers(0, 255, (700, 700, 3), dtype=np.uint8)
    allowance = views.PICTURES_BYTES // views.MOST_PICTURES
    mask, distance_m = np.ones(noise.shape[:2], bool), np.full(noise.shape[:2], 9, np.float32)
    colours = {"m": noise[::-1].copy()}
    view = ComparedView(
        "a", noise, None, mask, distance_m, DISTANCE_KEYS[0], colours, {"m": colour_distance(distance_m)}, {}
    )
    shown = show_view(view, allowance)
    assert (shown.width, shown.height) == (640, 640)
    pictures = [*shown.truth.values(), *shown.rendered["m"].values()]
    assert len(pictures) == 6 and max(map(len, pictures)) <= allowance
    assert len(encode(noise[:300, :300], 10**6)) > 50_000  # where there is room, nothing is lost
    # three drives, eight methods: their views and the true ones, as text
    shown_views = views.views_of_a_drive(3 * 8)
    assert shown_views >= 10 and 3 * shown_views * (8 * 4 + 2) * allowance * 4 / 3 < 24e6
    assert views.views_of_a_drive(2) == 125 and views.views_of_a_drive(1000) == 1


def test_some_views_spread_over_the_drive():
    assert spread_over(10, 3) == [0, 4, 9] and spread_over(2, 6) == [0, 1] and spread_over(5, 1) == [0]
    assert spread_over(5, 256) == [0, 1, 2, 3, 4] and spread_over(1000, 4) == [0, 333, 666, 999]


def test_drives_are_read_from_what_runs_left(tmp_path):
    scene = write_scene(tmp_path / "x")
    write_rendered(scene, tmp_path / "one", 0.9)
    write_rendered(scene, tmp_path / "two", 0.7)
    console = Console(quiet=True)
    (drive,) = make_drives({"x": (scene, {"one": tmp_path / "one", "two": tmp_path / "two"})}, console)
    frames = held_out_frames(scene)
    assert [view.title for view in drive.views] == [frame["file_path"] for frame in frames]
    assert f"All {len(frames)} held-out views" in drive.note and "without noise" in drive.note
    assert drive.points is None and "Warning" not in drive.note
    write_json(scene / "checks.json", {"figures": [], "warnings": ["roof is turned by 180°."]})
    (drive,) = make_drives({"x": (scene, {"one": tmp_path / "one", "two": tmp_path / "two"})}, console)
    assert drive.note.startswith("Warning of `process`: roof is turned by 180°. All ")
    assert drive.views[0].figures == {
        "one": {"masked PSNR ↑": "27.00", "δ<1.25 ↑": "0.900"},
        "two": {"masked PSNR ↑": "21.00", "δ<1.25 ↑": "0.700"},
    }
    (tmp_path / "two" / BY_VIEW).unlink()  # a run of an earlier version
    (drive,) = make_drives({"x": (scene, {"one": tmp_path / "one", "two": tmp_path / "two"})}, console)
    assert drive.views[0].figures == {"one": {}, "two": {}}


def test_views_come_in_the_order_of_the_evaluation(tmp_path):
    """nerfstudio sorts folder by folder; letter by letter, "front-left/" comes before "front/"."""
    scene = write_scene(tmp_path / "x", frames=4, split=False)
    with transforms(scene) as meta:
        wanted = ("front/0000", "front/0001", "front-left/0000", "front-left/0001")
        for frame, name in zip(meta["frames"], wanted, strict=True):
            path = scene / f"images/{name}.png"
            path.parent.mkdir(exist_ok=True)
            (scene / frame["file_path"]).rename(path)
            frame["file_path"] = f"images/{name}.png"
        names = [frame["file_path"] for frame in meta["frames"]]
        meta |= {f"{split}_filenames": names for split in ("train", "val", "test")}
    parser = FisheyeDepthDataParserConfig(data=scene).setup()
    evaluated = [str(path.relative_to(scene)) for path in parser.get_dataparser_outputs("test").image_filenames]
    assert evaluated == names != sorted(names)
    assert [frame["file_path"] for frame in held_out_frames(scene)] == evaluated


# --- points -----------------------------------------------------------------------------------------------------------
def places_and_colours(points: dict[str, Any]) -> list[np.ndarray]:
    """Places in steps, and colours."""
    kinds = {"steps": "<u2", "colours": "u1"}
    return [np.frombuffer(base64.b64decode(points[name]), kind).reshape(-1, 3) for name, kind in kinds.items()]


def test_points_come_back_from_their_steps(tmp_path):
    scene = write_scene(tmp_path, ply_file_path="points.ply")
    generator = np.random.default_rng(0)
    points_m = generator.uniform((-30, -20, -2), (30, 20, 8), (500, 3))
    points_m[:20, 0] += 200  # further from all cameras than is shown
    rgb = generator.integers(0, 256, points_m.shape)
    write_cloud(scene, points_m, rgb)
    found = show_points(read_scene(scene))
    assert found is not None
    steps, colours = places_and_colours(found)
    places_m = np.array(found["low"]) + steps * np.array(found["step"])
    nearest = np.abs(places_m[:, None] - points_m[None]).max(-1)
    assert sorted(nearest.argmin(1)) == list(range(20, 500)) and nearest.min(1).max() < 60 / 65535
    assert np.array_equal(colours, rgb[nearest.argmin(1)])
    assert len(found["training"]) == 8 and len(found["heldOut"]) == 1 and [len(path) for path in found["paths"]] == [9]
    assert found["heldOut"][0] == found["paths"][0][4]
    few = show_points(read_scene(scene), 100)
    assert few is not None and [len(each) for each in places_and_colours(few)] == [100, 100]


def test_points_without_colours_are_coloured_by_height(tmp_path):
    scene = write_scene(tmp_path, ply_file_path="points.ply")
    write_cloud(scene, np.array([[1.0, 0, height] for height in np.linspace(-3, 3, 50)]))
    found = show_points(read_scene(scene))
    assert found is not None
    steps, colours = places_and_colours(found)
    low, high = (colours[steps[:, 2].argsort()[place]].astype(int) for place in (0, -1))
    assert low[2] > low[0] and high[0] > high[2]


def test_a_broken_cloud_costs_the_view_in_3d_alone(tmp_path, capsys):
    scene = write_scene(tmp_path / "x", ply_file_path="points.ply")
    (scene / "points.ply").write_text("no cloud")
    write_rendered(scene, tmp_path / "one", 0.9)
    (drive,) = make_drives({"x": (scene, {"one": tmp_path / "one"})}, Console(width=500))
    assert drive.points is None and drive.views
    assert "report.html does not show the points of this drive." in capsys.readouterr().out


# --- commands ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "options"),
    [
        (("demo",), DemoOptions(output=Path("my folder/it's"), frames=13, scene="turn")),
        (("demo",), DemoOptions(real=Path("my drive"), steps=9)),
        (
            ("compare",),
            CompareOptions(
                scenes=(Path("a b"), Path("c")),
                output=Path("out"),
                methods=("nerfacto", "edge"),
                seeds=(0, 1),
                detail=True,
            ),
        ),
        (
            ("search",),
            SearchOptions(scenes=(Path("a b"),), output=Path("out"), lambdas=(0.1, 1.0), sigmas_m=("own", 0.5)),
        ),
        (
            ("process", "kitti360"),
            Kitti360Options(root=Path("d"), sequence="s", output=Path("o"), raw_lidar=True, find_ego=False, sweeps=0),
        ),
    ],
)
def test_a_command_gives_its_options_again(words, options):
    program, *arguments = shlex.split(command_line(["edge-depth-nerf", *words], options))
    assert program == "edge-depth-nerf"
    found = tyro.cli(cli.Command, prog=program, args=arguments)
    assert (found.options if isinstance(found, cli.Process) else found) == options


# --- the page as text -------------------------------------------------------------------------------------------------
def flat(red: int, green: int, blue: int) -> bytes:
    return encode(np.full((64, 64, 3), (red, green, blue), np.uint8), 10**6)


COLOURS = {"truth": (200, 0, 0), "first": (0, 160, 0), NASTY: (0, 0, 220)}


def shown_view(number: int, distances: bool = True) -> ShownView:
    """Red truth, green and blue methods; each view brighter; each kind with more of another colour."""

    def kinds(name: str) -> dict[Any, bytes]:
        names = [kind.key for kind in KINDS if distances or not kind.key.startswith("distance")]
        red, green, blue = (value // (1 if number else 2) for value in COLOURS[name])
        return {
            key: flat(*(min(value + 30 * place, 255) for value in (red, green, blue)))
            for place, key in enumerate(names)
        }

    truth = {key: content for key, content in kinds("truth").items() if "error" not in key}
    rendered = {name: kinds(name) for name in COLOURS if name != "truth"}
    figures = {
        name: {"PSNR ↑": f"2{number + place}.00", "FLIP ↓": f"0.{number + place}"}
        for place, name in enumerate(rendered)
    }
    return ShownView(f"images/{number}.png", 64, 64, truth, rendered, figures)


def small_plot() -> Plot:
    lines: Lines = {NASTY: {"edge": [([1.5, 3.0], [20.0, 21.0])]}}
    return plot_lines("A plot", lines, "distance, m", [("psnr", "PSNR, dB")])


def write_cloud(folder: Path, points_m: np.ndarray, rgb: np.ndarray | None = None) -> None:
    names = ["float x", "float y", "float z", *([] if rgb is None else ["uchar red", "uchar green", "uchar blue"])]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points_m)}", *(f"property {name}" for name in names)]
    rows = points_m if rgb is None else np.hstack([points_m, rgb])
    lines = [" ".join(f"{value:.6g}" for value in row) for row in rows]
    (folder / "points.ply").write_text("\n".join([*header, "end_header", *lines, ""]))


@pytest.fixture(scope="module")
def cloud(tmp_path_factory) -> dict[str, Any]:
    """A wall of red points ahead of the cameras."""
    scene = write_scene(tmp_path_factory.mktemp("scene"), ply_file_path="points.ply")
    across, up = (axis.ravel() for axis in np.meshgrid(np.linspace(-8, 8, 60), np.linspace(-4, 4, 60)))
    points_m = np.stack([np.full(across.size, 9.0), across, up], -1)
    write_cloud(scene, points_m, np.tile([220, 20, 20], (len(points_m), 1)))
    found = show_points(read_scene(scene))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def report(cloud) -> Report:
    cells = [Cell(20.0 + 0.01 * place, 0.5, best=place == 3) for place in range(12)]
    rows = [Row("first", cells), Row(NASTY, [Cell(None, words=NASTY), *cells[1:]])]
    tables = [
        MadeTable("1", NASTY, [("street", ["PSNR ↑"] * 6), ("turn", ["SSIM ↑"] * 6)], rows, ["A note.", NASTY]),
        MadeTable("5, street", "Detail", [("", ["PSNR ↑"] * 12)], rows, on_terminal=False),
    ]
    return Report(
        title=NASTY,
        lead=NASTY,
        verdict=NASTY,
        methods=["first", NASTY],
        drives=[
            ShownDrive("street", [shown_view(number) for number in range(3)], "3 of 10 views.", cloud),
            ShownDrive(NASTY, [shown_view(5, distances=False)], NASTY),
        ],
        notes=[NASTY],
        tables=tables,
        plots=[small_plot()],
        facts=[
            Facts("Options", {NASTY: NASTY, "a_very_long_name_" * 4: "/a/very/long/path" * 8}),
            Facts("All", {"pipeline.model.a_long_name_of_a_field": "1" * 80}, folded=True),
        ],
        settings=[
            MadeTable("", "Fields", [("", ["first", NASTY])], [Row("pipeline.datamanager.a_long_name", cells[:2])])
        ],
        commands=[Commands("What made this", ["edge-depth-nerf compare --output " + "folder/" * 30, NASTY])],
    )


@pytest.fixture(scope="module")
def written(report, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, report)
    return path


@pytest.fixture(scope="module")
def text(written) -> str:
    return written.read_text(encoding="utf-8")


def test_text_is_escaped(text):
    page = Page(text)
    assert "<script>window.hacked" not in text and "onerror='" not in re.sub(r'"[^"]*"', "", text)
    assert [attributes for tag, attributes in page.tags if tag == "script"] == [
        {"type": "application/json", "id": "data"},
        *[{}] * 3,
    ]
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on") or name == "style"]
    # and it is all there, as text
    assert page.texts["h1"] == [NASTY] and page.texts["title"] == [f"{NASTY} · edge-depth-nerf"]
    assert NASTY in page.texts["td"] and NASTY in page.texts["dd"] and NASTY in page.texts["code"]
    pictures = json.loads(page.texts["script"][0])
    assert pictures["drives"][1]["title"] == NASTY and pictures["drives"][0]["methods"] == ["first", NASTY]
    assert len(pictures["drives"][0]["views"]) == 3


def test_the_page_loads_nothing(text):
    page = Page(text)
    loads = [
        attributes[name]
        for tag, attributes in page.tags
        for name in ("src", "srcset", "href", "data", "poster", "action")
        if name in attributes and not (tag == "a" and attributes[name].startswith("#"))
    ]
    assert loads and all(re.match(r"data:(,$|image/(svg\+xml|webp|png);base64,)", each) for each in loads)
    assert not re.search(r"url\(|@import", page.texts["style"][0])
    assert len(page.texts["script"]) == 4
    for script in page.texts["script"][1:]:
        assert not re.search(r"fetch|XMLHttp|WebSocket|import\(|eval|innerHTML", script)
    # no address but those in the pictures' own namespaces
    assert "http" not in re.sub(r"data:image/[^\"]*", "", text).replace("http-equiv", "")


def test_only_its_own_script_and_style_count(text):
    page = Page(text)
    (policy,) = (entry["content"] for tag, entry in page.tags if tag == "meta" and "http-equiv" in entry)
    parts = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert parts["default-src"] == parts["base-uri"] == parts["form-action"] == "'none'"
    assert parts["img-src"] == "data:"
    for name, contents in (("script-src", page.texts["script"][1:]), ("style-src", page.texts["style"])):
        digests = [base64.b64encode(hashlib.sha256(content.encode()).digest()).decode() for content in contents]
        assert digests and parts[name].split(" ") == [f"'sha256-{digest}'" for digest in digests]


def test_every_method_has_a_line_of_its_own():
    assert len({style_of(name) for name in METHODS}) == len(METHODS)


def test_plots_are_svg_in_two_colours(report):
    (plot,) = report.plots
    for content in (plot.light, plot.dark):
        root = ElementTree.fromstring(content)
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        # references are to itself
        references = [value for each in root.iter() for name, value in each.attrib.items() if name.endswith("href")]
        assert all(value.startswith("#") for value in references)
    assert b"#d62828" in plot.light and b"#d62828" not in plot.dark
    assert plot == small_plot()  # the same bytes again


def test_the_page_is_written_whole_or_not_at_all(report, tmp_path, monkeypatch):
    path = tmp_path / "sub" / "report.html"
    write_report(path, replace(report, drives=[]))
    before = path.read_text(encoding="utf-8")
    assert "<script" not in before and "The pictures need JavaScript" not in before

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        write_report(path, report)
    assert path.read_text(encoding="utf-8") == before
    assert [each.name for each in path.parent.iterdir()] == ["report.html"]


# --- the page in a browser --------------------------------------------------------------------------------------------
@pytest.fixture
def opened(browser, written):
    """Opens the page from disk, without network; in the end there was no error and no request for anything else."""
    contexts, wrong = [], []

    def open_page(width: int = 1280, height: int = 900, **more: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height}, offline=True, **more)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: wrong.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on("dialog", lambda dialog: wrong.append(f"dialog: {dialog.message}"))

        def on_request(request: Any) -> None:
            if request.url != written.as_uri() and not request.url.startswith("data:"):
                wrong.append(f"request: {request.url}")

        page.on("request", on_request)
        page.goto(written.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []


def pixel(page: Any, share: float) -> np.ndarray:
    """The colour of the stage at a share of its width, below its middle, RGB."""
    page.wait_for_function("[...document.querySelectorAll('.stage > img')].every((image) => image.complete)")
    box = page.locator(".stage").bounding_box()
    shot = page.locator(".stage").screenshot()
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return image[int(box["height"] * 0.8), int(box["width"] * share)].astype(int)


def colour_of(rgb: np.ndarray) -> str:
    return ("red", "green", "blue")[int(rgb.argmax())]


def slider(page: Any) -> Any:
    return page.get_by_role("slider")


def test_it_opens_with_the_distances_of_the_first_method_and_the_last(opened):
    page = opened()
    assert page.title().startswith(NASTY[:20])
    assert page.evaluate("window.hacked") is None
    assert colour_of(pixel(page, 0.25)) == "green" and colour_of(pixel(page, 0.75)) == "blue"
    assert slider(page).get_attribute("aria-valuetext").startswith("50 % first, 50 % <")
    assert page.locator(".stage img.over").get_attribute("alt").startswith(f"right: {NASTY}, distance of images/0.png")
    assert page.locator(".verdict").inner_text() == NASTY
    for heading in ("Pictures", "Tables", "Plots", "Settings and versions", "Commands"):
        assert page.get_by_role("heading", name=heading, exact=True).is_visible()
    assert page.get_by_role("table").count() == 3  # with that of the view's figures; one is folded
    page.get_by_text("Tables of single drives").click()
    assert page.get_by_role("table").count() == 4
    assert page.locator(".plot img").evaluate("(image) => image.complete && image.naturalWidth > 300")


def test_the_mouse_slides(opened):
    page = opened()
    box = page.locator(".stage").bounding_box()
    across = lambda share: (box["x"] + share * box["width"], box["y"] + 0.4 * box["height"])  # noqa: E731
    page.mouse.move(*across(0.5))
    page.mouse.down()
    page.mouse.move(*across(0.8), steps=4)
    assert slider(page).input_value() == "80"
    assert colour_of(pixel(page, 0.7)) == "green" and colour_of(pixel(page, 0.9)) == "blue"
    page.mouse.move(box["x"] - 50, box["y"] + 10)  # beyond its edge
    assert slider(page).input_value() == "0" and colour_of(pixel(page, 0.3)) == "blue"
    page.mouse.up()
    page.mouse.move(*across(0.6))
    assert slider(page).input_value() == "0"
    page.mouse.click(*across(0.3))
    assert slider(page).input_value() == "30"
    page.keyboard.press("ArrowLeft")  # it has the focus now
    assert slider(page).input_value() == "29"


def test_a_finger_slides(opened):
    page = opened(360, 740, has_touch=True, is_mobile=True)
    page.locator(".stage").scroll_into_view_if_needed()
    box = page.locator(".stage").bounding_box()
    y = box["y"] + 0.5 * box["height"]
    page.touchscreen.tap(box["x"] + 0.25 * box["width"], y)
    assert slider(page).input_value() == "25"
    session = page.context.new_cdp_session(page)
    for event, share in (("touchStart", 0.25), ("touchMove", 0.4), ("touchMove", 0.75), ("touchEnd", None)):
        points = [] if share is None else [{"x": box["x"] + share * box["width"], "y": y}]
        session.send("Input.dispatchTouchEvent", {"type": event, "touchPoints": points})
    assert slider(page).input_value() == "75"
    assert colour_of(pixel(page, 0.6)) == "green" and colour_of(pixel(page, 0.9)) == "blue"


def tab_to(page: Any, selector: str) -> None:
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
    pytest.fail(f"{selector} is not reached by Tab")


def outline(page: Any, selector: str) -> str:
    return page.evaluate("(selector) => getComputedStyle(document.querySelector(selector)).outlineStyle", selector)


def test_the_keyboard_does_everything(opened):
    page = opened()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert outline(page, ".handle") == "none"
    tab_to(page, "input[name=kind]")
    assert outline(page, "input[name=kind]:focus + span") == "solid"
    page.keyboard.press("ArrowRight")
    assert page.get_by_role("radio", name="Colour error", exact=True).is_checked()
    assert page.locator(".legend").is_visible()
    page.keyboard.press("ArrowLeft")
    tab_to(page, ".wipe")
    assert outline(page, ".handle") == "solid"  # where the focus is can be seen
    for key, value in (("ArrowRight", "51"), ("ArrowLeft", "50"), ("Home", "0"), ("End", "100"), ("PageDown", "90")):
        page.keyboard.press(key)
        assert slider(page).input_value() == value, key
    assert colour_of(pixel(page, 0.8)) == "green"
    tab_to(page, "input[name=view]")
    assert outline(page, "input[name=view]:focus + img") == "solid"
    dark = pixel(page, 0.5)
    page.keyboard.press("ArrowRight")
    assert page.get_by_role("radio", name="2: images/1.png").is_checked()
    assert pixel(page, 0.5)[1] > dark[1] + 50
    page.keyboard.press("ArrowLeft")
    assert np.abs(pixel(page, 0.5) - dark).max() < 4


def test_methods_kinds_and_drives_switch(opened):
    page = opened()
    # an error names what stands beside it
    tags = page.locator(".tag")
    assert tags.all_inner_texts() == ["first", NASTY]
    page.get_by_label("Left", exact=True).select_option(label="ground truth")
    page.get_by_role("radio", name="Distance error").check(force=True)
    assert tags.all_inner_texts() == ["ground truth: distance", f"{NASTY}: distance error"]
    assert page.locator(".scale").evaluate_all("(all) => all.map((each) => each.firstChild.textContent)") == [
        *("Distance", "Distance error")
    ]
    assert page.locator(".ticks").all_inner_texts()[0].endswith("60 m")
    page.get_by_label("Left", exact=True).select_option(label="first")
    assert tags.all_inner_texts() == ["first", NASTY] and page.locator(".legend").count() == 1

    page.get_by_role("radio", name="Distance", exact=True).check(force=True)
    assert colour_of(pixel(page, 0.25)) == "green" and colour_of(pixel(page, 0.75)) == "blue"
    page.get_by_label("Right", exact=True).select_option(label="ground truth")
    assert colour_of(pixel(page, 0.75)) == "red"
    page.get_by_role("radio", name="Colour error").check(force=True)
    # the truth has no error: its colours stand beside it
    assert page.locator(".stage img.over").get_attribute("alt") == "right: ground truth, colour of images/0.png"
    assert page.locator(".stage img.under").get_attribute("alt") == "left: first, colour error of images/0.png"
    assert "percent of the whole range" in page.locator(".explanation").inner_text()
    ticks = page.locator(".ticks span").all_inner_texts()
    assert ticks == ["0", "5", "10", "15", "20", "25 %"]
    page.get_by_role("radio", name="Distance error").check(force=True)
    page.get_by_label("Drive", exact=True).select_option(index=1)
    assert page.locator("input[name=view]").count() == 1
    # no distances are known there
    assert page.get_by_role("radio", name="Distance error").is_disabled()
    assert page.get_by_role("radio", name="Colour", exact=True).is_checked()
    # bold is what is best, be it the left or the right one: the larger PSNR and the smaller FLIP
    assert page.locator(".figures td.best").all_inner_texts() == ["0.5", "26.00"]
    assert page.locator(".drive-note").inner_text() == NASTY
    # sides that the drive has are kept
    assert page.get_by_label("Left", exact=True).locator("option:checked").inner_text() == "first"


def space(page: Any) -> np.ndarray:
    shot = page.locator(".space canvas").screenshot()
    return cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def wait_for_frames(page: Any, count: int) -> None:
    """So many pictures of the view are drawn."""
    page.evaluate(
        "(count) => new Promise((done) => {"
        " const next = () => (count-- ? requestAnimationFrame(next) : done());"
        " next(); })",
        count,
    )


def red(picture: np.ndarray) -> np.ndarray:
    return (picture[..., 0] > 150) & (picture[..., 1:].max(-1) < 80)


def test_points_are_seen_in_3d(opened, cloud):
    page = opened(800, 600)
    canvas = page.locator(".space canvas")
    assert canvas.get_attribute("data-points") is None  # nothing is drawn before it is seen
    canvas.scroll_into_view_if_needed()
    page.locator(".space canvas[data-points]").wait_for()
    assert canvas.get_attribute("data-points") == str(len(places_and_colours(cloud)[0]))
    wait_for_frames(page, 3)
    first = space(page)
    assert red(first).sum() > 500  # the wall

    box = canvas.bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 150, middle[1], steps=5)
    page.mouse.up()
    wait_for_frames(page, 25)  # until the movement has died away
    dragged = space(page)
    assert (red(first) != red(dragged)).sum() > 300
    page.keyboard.press("ArrowLeft")  # it has the focus now
    for _ in range(4):
        page.keyboard.press("+")
    wait_for_frames(page, 3)
    assert (red(dragged) != red(space(page))).sum() > 300
    page.get_by_role("button", name="First view").click()
    wait_for_frames(page, 3)
    assert (red(first) != red(space(page))).sum() < 100

    # another drive has no points
    page.get_by_label("Drive", exact=True).select_option(index=1)
    assert not page.locator("#points").is_visible()


def test_on_a_phone_the_choices_stand_above_the_picture_and_tables_and_plots_fit(opened):
    page = opened(390, 844)
    places = [page.locator(each).bounding_box()["y"] for each in (".choices", ".sides", ".stage", ".thumbnails")]
    assert places == sorted(places)
    tables = page.locator(".tall")
    assert tables.count() == 2 and tables.first.is_visible()
    wide = page.locator(".or-tall .scroll")
    assert wide.count() == 2 and not any(each.is_visible() for each in wide.all())
    listed = tables.first.locator("tbody").first.locator("tr")
    assert listed.all_inner_texts()[:2] == ["street: PSNR ↑", "first\t20.00 ± 0.50"]
    boxes = [each.bounding_box() for each in [tables.first, *page.locator(".plot img").all()]]
    assert len(boxes) == 2 and all(box["x"] >= 0 and box["x"] + box["width"] <= 390 for box in boxes)
    # a plot is slid nowhere, and not shrunk until nobody can read it
    assert page.locator(".plot .scroll").evaluate("(each) => each.scrollWidth <= each.clientWidth")
    assert page.locator(".plot img").evaluate("(image) => image.clientWidth / image.naturalWidth") > 0.7
    page.set_viewport_size({"width": 1280, "height": 900})
    assert not any(each.is_visible() for each in page.locator(".tall").all())
    assert page.locator(".choices").bounding_box()["x"] > page.locator(".stage").bounding_box()["x"] + 400


def test_nothing_is_wider_than_the_window(opened):
    page = opened(900, 740)
    page.evaluate("document.querySelectorAll('details').forEach((each) => (each.open = true))")
    for width in (900, 600, 360, 320):
        page.set_viewport_size({"width": width, "height": 740})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        page.evaluate("window.scrollTo(500, 0)")
        assert page.evaluate("window.scrollX") == 0
        # wide tables are slid by themselves, and the keyboard reaches them
        wide = page.locator(".scroll").first
        assert wide.evaluate("(each) => each.scrollWidth >= each.clientWidth && each.tabIndex === 0")
        assert page.locator(".stage").bounding_box()["width"] > 0.6 * min(width, 640)


def test_it_is_dark_where_the_system_is(opened):
    page = opened(color_scheme="light")

    def look() -> tuple[float, str]:
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        shade = float(np.mean([int(each) for each in re.findall(r"\d+", colour)]))
        return shade, page.evaluate("document.querySelector('.plot img').currentSrc")

    light = look()
    page.emulate_media(color_scheme="dark")
    page.wait_for_function("(light) => document.querySelector('.plot img').currentSrc !== light", arg=light[1])
    dark = look()
    assert light[0] > 220 and dark[0] < 40
    assert light[1] != dark[1]


def test_without_script_all_but_the_pictures_is_there(opened):
    page = opened(java_script_enabled=False)
    assert page.get_by_text("The pictures need JavaScript").is_visible()
    assert not page.locator(".viewer").is_visible()
    assert page.get_by_role("table").count() >= 2
