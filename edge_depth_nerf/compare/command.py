"""`edge-depth-nerf compare`, and what `search` and `grid` share with it: checks, and runs side by side."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.bounds import finite, shown
from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, read_json_object, sha256_of, write_json, write_png, write_text
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.base.pictures import DISTANCE, resize, side_by_side, with_colour_bar
from edge_depth_nerf.compare.methods import METHODS, MethodName, Setting, default_methods
from edge_depth_nerf.compare.options import CompareOptions, SearchOptions, TrainingOptions
from edge_depth_nerf.compare.plots import draw_plots
from edge_depth_nerf.compare.report import first_runs, make_report
from edge_depth_nerf.compare.results import Results, check_fair, read_results, write_rows
from edge_depth_nerf.compare.specification import FIGURES, SPECIFICATION, VIEWS, RunSpecification
from edge_depth_nerf.compare.tables import fields_table, introduction, listed, make_tables
from edge_depth_nerf.jobs.runs import command_line, viewer_command
from edge_depth_nerf.jobs.tasks import Task, do_tasks, this_machine
from edge_depth_nerf.report.build import Report, write_report
from edge_depth_nerf.report.compared_views import compared_views
from edge_depth_nerf.report.tables import latex_of_tables, page_of_tables, show_tables
from edge_depth_nerf.report.views import REPORT
from edge_depth_nerf.scene.format import LAYERS, TRANSFORMS
from edge_depth_nerf.scene.reader import SceneFolder, read_scene

RECORD = "compare.json"
RUNS = "runs"
LOG = "run.log"
VIEWS_SHOWN = 3
MAX_SETTING = 1e6
"""No λ or σ is larger."""
LEAST_WIDTH_PX, MOST_WIDTH_PX = 220, 350
"""Of each picture in comparison_SCENE.png."""


def compare(options: CompareOptions, console: Console | None = None) -> Results:
    """Run or finish a comparison; give all that the output folder holds.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).
    """
    console = console or Console()
    with finished_runs(options, console) as results:
        page = write_comparison(options.output, results, console)
        write_report(options.output / REPORT, page)
        show_tables(page.tables, console)
        _show_places(options.output, results, console)
    return results


@contextmanager
def finished_runs(options: CompareOptions | SearchOptions, console: Console) -> Iterator[Results]:
    """Train and evaluate what is missing, and hold the output folder while all that is in it is written up.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).
    """
    options.check()
    check_is_folder(options.output)
    tuned = read_tuned(options.tuned) if isinstance(options, CompareOptions) and options.tuned else {}
    # who asks for something else need not wait for the one who writes there
    _record(options, tuned)
    with only_writer(options.output, console):
        runs = _opened_runs(options, tuned)
        do_runs([run for run in runs if not run.finished], options, console)
        yield read_comparison(options.output)


def _methods(options: TrainingOptions) -> Sequence[MethodName]:
    """The methods that are asked for."""
    return options.methods or default_methods(options.preset, with_loss=isinstance(options, SearchOptions))


def _opened_runs(options: CompareOptions | SearchOptions, tuned: Mapping[MethodName, Setting]) -> list[Run]:
    """Check the scenes, write down what all runs share, and begin the folders of those that are asked for."""
    methods = _methods(options)
    scenes = {scene.resolve().name: scene.resolve() for scene in options.scenes}
    if len(scenes) < len(options.scenes):
        raise InputError(
            f"scenes {', '.join(map(str, options.scenes))}: two folders have the same name, which the tables use. "
            "Rename one, or give each scene once."
        )
    read = [check_scene(folder, methods, options.preset) for folder in scenes.values()]
    digests = {scene.folder.name: (sha256_of(scene.path), layers_digest(scene)) for scene in read}
    word = "search" if isinstance(options, SearchOptions) else "compare"
    path, command = options.output / RECORD, command_line(["edge-depth-nerf", word], options)
    record = _record(options, tuned)
    wanted = {**record, "commands": [*dict.fromkeys([*record.get("commands", []), command])]}
    if not path.is_file() or read_json_object(path) != wanted:
        write_json(path, wanted)
    compared, tried = (options, []) if isinstance(options, CompareOptions) else (None, options.tried)
    runs = [
        Run(
            RunSpecification(
                scene=str(scenes[scene]),
                scene_sha256=digests[scene][0],
                preset=options.preset,
                method=name,
                seed=seed,
                steps=options.steps,
                weight=setting.weight,
                sigma_m=setting.sigma_m,
                whole_views=compared is not None,
                detail=compared is not None and compared.detail,
                layers_sha256=digests[scene][1],
            ),
            options.output / RUNS,
        )
        # the first seeds of all drives come first: tables of an unfinished comparison are of whole rows
        for seed in options.seeds
        for scene in scenes
        for name in methods
        for setting in tried or [tuned.get(name, Setting())]
    ]
    for run in runs:
        run.open()
    return runs


def read_comparison(output: Path) -> Results:
    """Read what the output folder of a comparison or of a search holds.

    Raises:
        InputError: runs differ in what they should share, or a file is broken.
    """
    results = read_results(output / RUNS)
    results.options = read_json_object(output / RECORD)
    if results.options.get("kind") != "search":
        check_fair(results)
    results.versions = {name: version(name) for name in ("edge-depth-nerf", "nerfstudio", "torch", "numpy")}
    results.versions["python"] = platform.python_version()
    results.cores = os.cpu_count() or 1
    return results


def write_comparison(output: Path, results: Results, console: Console) -> Report:
    """Write tables, figures, plots and pictures of a comparison; give what its page shows."""
    tables = make_tables(results)
    write_rows(output, results)
    written = [*tables, fields_table(results)]
    write_text(output / "tables.md", page_of_tables("Comparison", introduction(results), written))
    write_text(output / "tables.tex", latex_of_tables(introduction(results), written))
    with console.status("Plots and pictures"):
        plots = draw_plots(output, results)
        for scene in results.scenes():
            _draw_comparison(output, results, scene)
    return make_report(results, tables, plots, console)


def layers_digest(scene: SceneFolder) -> str:
    """SHA-256 of all files that a scene has beside its pictures: masks, maps, and what they are evaluated by.

    Other maps may have the names of those before, and then transforms.json does not change.
    """
    maps = [(layer, path) for each in scene.pictures for layer, path in each.files.items()]
    digest = hashlib.sha256()
    for name in sorted({path.relative_to(scene.folder).as_posix() for layer, path in maps if layer != "image"}):
        digest.update(f"{name}\n".encode())
        digest.update(bytes.fromhex(sha256_of(scene.folder / name)))
    return digest.hexdigest()


REMEDIES = {"lidar": "process the drive with LiDAR", "mono": "make them by `edge-depth-nerf estimate-depth`"}


def check_scene(folder: Path, methods: Sequence[MethodName], preset: str) -> SceneFolder:
    """Make sure that every method can be trained on a scene; give it.

    Raises:
        FileNotFoundError: there is no scene.
        InputError: it is broken, has no split, or lacks the maps that a method needs.
    """
    path = folder / TRANSFORMS
    scene = read_scene(path)
    held_out = scene.meta.get("test_filenames") or []
    if not held_out or set(held_out) & set(scene.meta.get("train_filenames", [])):
        raise InputError(
            f"{path}: found {len(held_out)} pictures under test_filenames that are not training pictures; expected "
            "at least one for evaluation. Process the drive with --holdout-every 2 or more."
        )
    for name in methods:
        missing = [source for source in METHODS[name].needs if not scene.has(source)]
        if missing:
            remedies = " and ".join(REMEDIES[source] for source in missing).capitalize()
            raise InputError(
                f"{path}: has no {' and no '.join(LAYERS[source].words for source in missing)}, which the method "
                f"{name} (preset {preset}) needs. {remedies}, or choose other --methods."
            )
    return scene


def read_tuned(path: Path) -> dict[MethodName, Setting]:
    """Read λ and σ by method: {"methods": {"ds-nerf": {"lambda": 0.01, "sigma_m": 0.5}}}.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it does not have that form.
    """
    methods = read_json_object(path).get("methods")
    form = 'expected {"methods": {"ds-nerf": {"lambda": 0.01, "sigma_m": 0.5}}}, with sigma_m metres or "own"'
    if not isinstance(methods, dict):
        raise InputError(f"{path}: has no methods; {form}.")
    found = {}
    for name, entry in methods.items():
        if name not in METHODS or METHODS[name].loss == "none":
            raise InputError(f"{path}: {shown(name)} is no method with λ and σ; {form}.")
        weight, sigma_m = (entry.get("lambda"), entry.get("sigma_m")) if isinstance(entry, dict) else (None, None)
        weight, sigma = _setting(weight), "own" if sigma_m == "own" else _setting(sigma_m)
        if weight is None or sigma is None:
            raise InputError(f"{path}: {name}: found {shown(entry)}; {form}.")
        found[name] = Setting(weight, sigma)
    return found


def _setting(value: Any) -> float | None:
    """A λ or σ; None if it cannot be one."""
    found = finite(value)
    return found if found is not None and 0 < found < MAX_SETTING else None


def _record(options: CompareOptions | SearchOptions, tuned: Mapping[MethodName, Setting]) -> dict[str, Any]:
    """What the output folder's record is to hold of what all its runs share, beside the commands so far.

    Raises:
        InputError: the folder holds something else, another comparison, or runs of a method with another λ or σ.
    """
    compared = options if isinstance(options, CompareOptions) else None
    record: dict[str, Any] = {
        "kind": "comparison" if compared else "search",
        "preset": options.preset,
        "steps": options.steps,
        "detail": compared is not None and compared.detail,
    }
    path = options.output / RECORD
    if not path.is_file() and options.output.is_dir() and any(options.output.iterdir()):
        raise InputError(f"{options.output}: contains other files. Choose a new or empty folder for --output.")
    found = _same(path, record, "this folder contains a comparison with", "") if path.is_file() else record
    for name in _methods(options) if compared else ():
        setting = tuned.get(name, Setting())
        for begun in sorted(options.output.glob(f"{RUNS}/*/{name}_seed-*/{SPECIFICATION}")):
            run = read_json_object(begun)
            there = Setting(run.get("weight"), run.get("sigma_m"))
            if there != setting:
                raise InputError(f"{begun}: this run was started with {there}, not {setting}. Choose another --output.")
    if compared and compared.tuned and {*tuned} & {*_methods(options)}:
        content = read_json_object(compared.tuned)
        # files of a search of one drive have it as `scene`
        scenes = [*listed(found.get("tuned_on")), *listed(content.get("scenes", content.get("scene")))]
        found["tuned_on"] = [*dict.fromkeys(scenes)]
    return found


def _same(path: Path, wanted: Mapping[str, Any], words: str, remedy: str) -> dict[str, Any]:
    """Give what a file holds, if it agrees with what is wanted.

    Raises:
        InputError: it holds another value; one that an earlier version did not write is not known to differ.
    """
    found = {**wanted, **read_json_object(path)}
    for name, value in wanted.items():
        if value != found[name]:
            raise InputError(f"{path}: {words} {name} {found[name]}, not {value}. Choose another --output{remedy}.")
    return found


class Run:
    """A training with its evaluation, in a folder of its own."""

    def __init__(self, specification: RunSpecification, runs: Path) -> None:
        self.specification = run = specification
        scene = Path(run.scene).name
        searched = not run.whole_views and run.weight is not None
        setting = f"_lambda-{run.weight:g}_sigma-{run.sigma_m}" if searched else ""
        self.title = f"{scene} {run.method}{setting.replace('_', ' ')} seed {run.seed}"
        self.folder = runs / scene / f"{run.method}{setting}_seed-{run.seed}"
        self.log = self.folder / LOG

    @property
    def finished(self) -> bool:
        """Whether its figures are there."""
        return (self.folder / FIGURES).is_file()

    def open(self) -> None:
        """Write what is to be trained, or make sure that what was begun is the same.

        Raises:
            InputError: the folder holds the run of another scene or of other settings.
        """
        path, wanted = self.folder / SPECIFICATION, asdict(self.specification)
        if not path.is_file():
            write_json(path, wanted)
            return
        _same(path, wanted, "this run was started with", f", or remove {self.folder}")

    @property
    def task(self) -> Task:
        """What trains and evaluates it, or does what is left of that."""
        arguments = ("-m", "edge_depth_nerf.compare.worker", str(self.folder.absolute()))
        return Task(self.title, arguments, self.log.absolute(), self.folder.absolute() / FIGURES, trains=True)


def do_runs(runs: Sequence[Run], options: TrainingOptions, console: Console) -> None:
    """Do runs side by side; the first that fails stops all, and what they have done so far is kept.

    Raises:
        InputError: a run failed; its log is named. Or the cluster cannot be used.
    """
    tasks = [run.task for run in runs]
    if not tasks:
        return
    if options.cluster is None:
        opened = this_machine(options.jobs, len(tasks), console)
    else:
        from edge_depth_nerf.jobs.cluster import on_cluster  # imports Dask

        scenes = sorted({Path(run.specification.scene) for run in runs})
        opened = on_cluster(options.cluster, tasks, scenes, console)
    with opened as place:
        do_tasks(tasks, place, console)


def picture_name(scene: str) -> str:
    """Name the picture of a drive in the output folder."""
    return f"comparison_{scene}.png"


def _draw_comparison(output: Path, results: Results, scene: str) -> None:
    """Draw some held-out views, a row of colours and one of distances each: ground truth, then first seeds."""
    chosen = first_runs(results, scene)
    if not chosen:
        return
    views_of = {METHODS[run.method].title: run.folder / VIEWS for run in chosen}
    views = compared_views(Path(chosen[0].specification["scene"]), views_of, VIEWS_SHOWN)
    rows = [[_shown(picture) for picture in row] for view in views for row in view.rows()]
    sheet = side_by_side(rows, ["ground truth", *views_of])
    write_png(output / picture_name(scene), with_colour_bar(sheet, DISTANCE))


def _shown(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture in a size in which many stand side by side, with legible titles."""
    height, width = picture.shape[:2]
    shown = min(max(width, LEAST_WIDTH_PX), MOST_WIDTH_PX)
    return resize(picture, (shown, round(height * shown / width)))


def _show_places(output: Path, results: Results, console: Console) -> None:
    say(console, f"Open in a browser: {output / REPORT}")
    say(console, f"Tables: {output / 'tables.md'}, {output / 'tables.tex'}; all figures: {output / 'results.csv'}")
    there = [(scene, runs) for scene in results.scenes() if (runs := first_runs(results, scene))]
    for scene, runs in there[:1]:
        more = "" if len(results.runs) == len(runs) else f" (on {scene}; see {REPORT} for the others)"
        say(console, f"View the trained scenes{more}:")
        for run in runs:
            if run.config:
                say(console, f"  {viewer_command(run.config)}")
