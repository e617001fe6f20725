"""`edge-depth-nerf compare`: checks, runs what is missing side by side, then writes tables, pictures and the page."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.bounds import finite, shown
from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, read_json_object, write_json, write_png, write_text
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.base.pictures import DISTANCE, resize, side_by_side, with_colour_bar
from edge_depth_nerf.compare.grid import grid_lines, grid_tables
from edge_depth_nerf.compare.methods import GRID, METHODS, Setting, default_methods
from edge_depth_nerf.compare.options import CompareOptions, MethodName
from edge_depth_nerf.compare.plots import draw_plots
from edge_depth_nerf.compare.report import first_runs, make_report
from edge_depth_nerf.compare.results import Results, check_fair, read_results, write_rows
from edge_depth_nerf.compare.search import TUNED, grids, show_search, write_search
from edge_depth_nerf.compare.specification import FIGURES, SPECIFICATION, VIEWS, RunSpecification
from edge_depth_nerf.compare.tables import as_latex, as_markdown, fields_table, make_tables, page_of_tables
from edge_depth_nerf.jobs.runs import command_line, viewer_command
from edge_depth_nerf.jobs.tasks import Task, do_tasks, this_machine
from edge_depth_nerf.report.build import Report, write_report
from edge_depth_nerf.report.compared_views import compared_views
from edge_depth_nerf.report.tables import MadeTable
from edge_depth_nerf.report.views import REPORT
from edge_depth_nerf.scene.format import DEPTH_KEY, LAYERS, layers_of, read_transforms

RECORD = "compare.json"
RUNS = "runs"
SEARCH, COMPARISON = "search", "comparison"
GRID_PAGE = "grid.md"
"""The two folders of a grid, and its page."""
LOG = "run.log"
WITHOUT_DETAIL = {"detail": False}
"""What files of versions before `--detail` do not name."""
VIEWS_SHOWN = 3
MAX_SETTING = 1e6
"""No λ or σ is larger."""
LEAST_WIDTH_PX, MOST_WIDTH_PX = 220, 350
"""Of each picture in comparison_SCENE.png."""


def compare(options: CompareOptions, console: Console | None = None) -> Results:
    """Run or finish a comparison, a search with `--search`, or both with `--grid`.

    Returns:
        All that the output folder holds; of a grid what was judged.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).

    """
    console = console or Console()
    if options.grid:
        return compare_grid(options, console)
    with finished_runs(options, console) as results:
        if options.search:
            write_search(options.output, results)
            show_search(options.output, results, console)
        else:
            page = write_comparison(options.output, results, console)
            write_report(options.output / REPORT, page)
            show_tables(page.tables, console)
            _show_places(options.output, results, console)
    return results


def compare_grid(options: CompareOptions, console: Console) -> Results:
    """Search λ and σ of each cell on the tuning drives, compare the cells with what was found, and say what came out.

    Search and comparison are those of `compare`, in two folders of the output folder.

    Returns:
        The comparison.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).

    """
    options.check()
    check_is_folder(options.output)
    cells = options.methods or tuple(GRID.values())
    others = [name for name in cells if METHODS[name].cell is None]
    if others:
        raise InputError(
            f"--grid --methods {' '.join(others)}: expected cells of the grid, {', '.join(GRID.values())}."
        )
    with_loss = tuple(name for name in cells if METHODS[name].sigma_field is not None)
    if not with_loss:
        raise InputError(
            f"--grid --methods {' '.join(cells)}: none of them has a loss on the prior; expected one at least."
        )
    search, comparison = options.output / SEARCH, options.output / COMPARISON
    if options.output.is_dir() and any(options.output.iterdir()) and not search.is_dir():
        raise InputError(f"{options.output}: contains other files. Choose a new or empty folder for --output.")
    # what is to be judged is looked at before a search of hours
    for scene in options.scenes:
        check_scene(scene, cells, options.preset)
    searched = compare(
        replace(
            options,
            grid=False,
            search=True,
            detail=False,
            scenes=options.tuning,
            tuning=(),
            steps=options.search_steps or options.steps,
            search_steps=None,
            output=search,
            methods=with_loss,
            seeds=options.seeds[:1],
        ),
        console,
    )
    judged = replace(
        options,
        grid=False,
        tuning=(),
        search_steps=None,
        lambdas=(),
        sigmas_m=(),
        output=comparison,
        methods=cells,
        tuned=search / TUNED,
    )
    results = compare(judged, console)
    tables = grid_tables(results, grids(searched))
    write_text(options.output / GRID_PAGE, page_of_tables("Grid", grid_lines(results, searched), tables))
    show_tables(tables, console)
    say(console, f"What prior, loss, extras and the whole are worth: {options.output / GRID_PAGE}")
    return results


@contextmanager
def finished_runs(options: CompareOptions, console: Console) -> Iterator[Results]:
    """Train and judge what is missing, and hold the output folder while all that is in it is written up.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).

    """
    options.check()
    check_is_folder(options.output)
    tuned = {} if options.tuned is None else read_tuned(options.tuned)
    # who asks for something else need not wait for the one who writes there
    _record(options, tuned)
    with only_writer(options.output, console):
        runs = _opened_runs(options, tuned)
        do_runs([run for run in runs if not run.finished], options, console)
        yield read_comparison(options.output)


def _methods(options: CompareOptions) -> Sequence[MethodName]:
    """The methods that are asked for."""
    return options.methods or default_methods(options.preset, with_loss=options.search)


def _opened_runs(options: CompareOptions, tuned: dict[str, Setting]) -> list[Run]:
    """Check the scenes, and begin the folders of all runs that are asked for."""
    methods = _methods(options)
    scenes = {scene.resolve().name: scene.resolve() for scene in options.scenes}
    if len(scenes) < len(options.scenes):
        raise InputError(
            f"scenes {', '.join(map(str, options.scenes))}: two folders have the same name, which the tables use. "
            "Rename one, or give each scene once."
        )
    digests = {name: check_scene(folder, methods, options.preset) for name, folder in scenes.items()}
    of_layers = {name: layers_digest(folder) for name, folder in scenes.items()}
    open_output(options, tuned)

    specifications = [
        RunSpecification(
            scene=str(scenes[scene]),
            scene_sha256=digests[scene],
            preset=options.preset,
            method=name,
            seed=seed,
            steps=options.steps,
            weight=setting.weight,
            sigma_m=setting.sigma_m,
            implementation=options.rivals_implementation if METHODS[name].rival else "same",
            whole_views=not options.search,
            detail=options.detail and not options.search,
            layers_sha256=of_layers[scene],
        )
        # the first seeds of all drives come first: tables of an unfinished comparison are of whole rows
        for seed in options.seeds
        for scene in scenes
        for name in methods
        for setting in _settings(options, name, tuned)
    ]
    runs = [Run(specification, options.output / RUNS) for specification in specifications]
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
    write_text(output / "tables.md", as_markdown(results, written))
    write_text(output / "tables.tex", as_latex(results, written))
    with console.status("Plots and pictures"):
        plots = draw_plots(output, results)
        for scene in results.scenes():
            _draw_comparison(output, results, scene)
    return make_report(results, tables, plots, console)


def _settings(options: CompareOptions, name: MethodName, tuned: dict[str, Setting]) -> Iterable[Setting]:
    if options.search:
        return [Setting(weight, sigma_m) for weight in options.lambdas for sigma_m in options.sigmas_m]
    return [tuned.get(name, Setting())]


def layers_digest(folder: Path) -> str:
    """SHA-256 of all files that a scene has beside its pictures: masks, maps, and what they are judged by.

    Other maps may have the names of those before, and then transforms.json does not change.

    Raises:
        FileNotFoundError: one of them is missing.

    """
    keys = [layer.key for name, layer in LAYERS.items() if name != "image"]
    transforms = folder / "transforms.json"
    frames = read_transforms(transforms)["frames"]
    digest = hashlib.sha256()
    for name in sorted(
        {frame[key] for frame in frames for key in (*keys, DEPTH_KEY) if isinstance(frame.get(key), str)}
    ):
        path = folder / name
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file, but {transforms} names it. Process the drive again.")
        digest.update(f"{name}\n".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def check_scene(folder: Path, methods: Sequence[MethodName], preset: str) -> str:
    """Make sure that every method can be trained on a scene; give the SHA-256 of its transforms.json.

    Raises:
        FileNotFoundError: there is no scene.
        InputError: it has no split, or lacks the maps that a method needs.

    """
    path = folder / "transforms.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file. compare takes scene folders; `edge-depth-nerf process` makes one from a raw drive."
        )
    meta = read_transforms(path)
    frames, held_out = meta["frames"], meta.get("test_filenames") or []
    if not held_out or set(held_out) & set(meta.get("train_filenames", [])):
        raise InputError(
            f"{path}: found {len(held_out)} pictures under test_filenames that are not training pictures; expected "
            "at least one for evaluation. Process the drive with --holdout-every 2 or more."
        )
    has = layers_of(frames[0])
    for name in methods:
        missing = [source for source in METHODS[name].needs if source not in has]
        if missing:
            remedy = {
                "lidar": "process the drive with LiDAR",
                "mono": "make them by `edge-depth-nerf estimate-depth`",
            }
            remedies = " and ".join(remedy[source] for source in missing).capitalize()
            raise InputError(
                f"{path}: has no {' and no '.join(LAYERS[source].words for source in missing)}, which the method "
                f"{name} (preset {preset}) needs. {remedies}, or choose other --methods."
            )
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_tuned(path: Path) -> dict[str, Setting]:
    """Read λ and σ by method: {"methods": {"ds-nerf": {"lambda": 0.01, "sigma_m": 0.5}}}.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it does not have that form.

    """
    content = read_json_object(path)
    methods = content.get("methods")
    form = 'expected {"methods": {"ds-nerf": {"lambda": 0.01, "sigma_m": 0.5}}}, with sigma_m metres or "own"'
    if not isinstance(methods, dict):
        raise InputError(f"{path}: has no methods; {form}.")
    found = {}
    for name, entry in methods.items():
        if name not in get_args(MethodName) or METHODS[name].sigma_field is None:
            raise InputError(f"{path}: {shown(name)} is no method with λ and σ; {form}.")
        weight, sigma_m = (entry.get("lambda"), entry.get("sigma_m")) if isinstance(entry, dict) else (None, None)
        weight, own = _setting(weight), sigma_m == "own"
        sigma = _setting(sigma_m)
        if weight is None or (sigma is None and not own):
            raise InputError(f"{path}: {name}: found {shown(entry)}; {form}.")
        found[name] = Setting(weight, "own" if own else sigma)
    return found


def _setting(value: Any) -> float | None:
    """A λ or σ; None if it cannot be one."""
    found = finite(value)
    return found if found is not None and 0 < found < MAX_SETTING else None


def open_output(options: CompareOptions, tuned: dict[str, Setting]) -> None:
    """Begin the output folder, or make sure that it was begun with what all its runs share.

    Raises:
        InputError: it holds another comparison, or something else.

    """
    path, command = options.output / RECORD, command_line(["edge-depth-nerf", "compare"], options)
    record = _record(options, tuned)
    commands = record.get("commands", [])
    wanted = {**record, "commands": commands if command in commands else [*commands, command]}
    if not path.is_file() or read_json_object(path) != wanted:
        write_json(path, wanted)


def _tuned_on(path: Path) -> Any:
    """The scenes that tuned values were searched on; files of a search of one drive have them as `scene`."""
    content = read_json_object(path)
    return content.get("scenes", content.get("scene"))


def _record(options: CompareOptions, tuned: dict[str, Setting]) -> dict[str, Any]:
    """What the output folder's record is to hold of what all its runs share, beside the commands so far.

    What is tuned binds methods that have a run; others may be tuned later, or again.

    Raises:
        InputError: the folder holds another comparison, or something else.

    """
    asked = _methods(options)
    settings = {name: {"lambda": tuned[name].weight, "sigma_m": tuned[name].sigma_m} for name in asked if name in tuned}
    record = {
        "kind": "search" if options.search else "comparison",
        "preset": options.preset,
        "steps": options.steps,
        "rivals_implementation": options.rivals_implementation,
        "detail": options.detail,
        "tuned": settings,
        "tuned_on": _tuned_on(options.tuned) if options.tuned is not None and settings else None,
    }
    path = options.output / RECORD
    if path.is_file():
        found = {**WITHOUT_DETAIL, **read_json_object(path)}
        before: dict[str, Any] = found.get("tuned", {})
        begun = {name for name in asked if any(options.output.glob(f"{RUNS}/*/{name}_seed-*"))}
        of_others = {name: setting for name, setting in before.items() if name not in asked}
        bound = {**of_others, **{name: setting for name, setting in before.items() if name in begun}}
        found["tuned"] = {**bound, **{name: setting for name, setting in settings.items() if name not in begun}}
        record["tuned"] = {**of_others, **settings}
        if not bound:
            found["tuned_on"] = record["tuned_on"]
        elif not settings:
            record["tuned_on"] = found["tuned_on"]
        different = [name for name in record if record[name] != found.get(name)]
        if different:
            name = different[0]
            raise InputError(
                f"{path}: this folder contains a comparison with {name} {found.get(name)}, not {record[name]}. Choose "
                "another --output."
            )
        return found
    if options.output.is_dir() and any(options.output.iterdir()):
        raise InputError(f"{options.output}: contains other files. Choose a new or empty folder for --output.")
    return record


class Run:
    """A training with its judgement, in a folder of its own."""

    def __init__(self, specification: RunSpecification, runs: Path) -> None:
        self.specification = specification
        run = specification
        scene = Path(run.scene).name
        setting = ""
        if not run.whole_views and run.weight is not None:
            setting = f"_lambda-{run.weight:g}_sigma-{run.sigma_m}"
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
        path, wanted = self.folder / SPECIFICATION, self.specification.to_dict()
        if path.is_file():
            unknown = {"layers_sha256": wanted["layers_sha256"]}
            found = {**WITHOUT_DETAIL, **unknown, **read_json_object(path)}
            different = [name for name in wanted if wanted[name] != found.get(name)]
            if different:
                name = different[0]
                raise InputError(
                    f"{path}: this run was started with {name} {found.get(name)}, not {wanted[name]}. Choose another "
                    f"--output, or remove {self.folder}."
                )
            return
        write_json(path, wanted)

    @property
    def task(self) -> Task:
        """What trains and judges it, or does what is left of that."""
        arguments = ("-m", "edge_depth_nerf.compare.worker", str(self.folder.absolute()))
        return Task(self.title, arguments, self.log.absolute(), self.folder.absolute() / FIGURES, trains=True)


def do_runs(runs: Sequence[Run], options: CompareOptions, console: Console) -> None:
    """Do runs side by side; the first that fails stops all, and what they have done so far is kept.

    Raises:
        InputError: a run failed; its log is named. Or the cluster cannot be used.

    """
    tasks = [run.task for run in runs]
    if not tasks:
        return
    with ExitStack() as stack:
        if options.cluster is None:
            place = stack.enter_context(this_machine(options.jobs, len(tasks), console))
        else:
            from edge_depth_nerf.jobs.cluster import on_cluster  # imports Dask

            scenes = sorted({Path(run.specification.scene) for run in runs})
            place = stack.enter_context(on_cluster(options.cluster, tasks, scenes, console))
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


def show_tables(tables: Sequence[MadeTable], console: Console) -> None:
    """Print the tables that fit a terminal."""
    for made in tables:
        if not made.on_terminal:
            continue
        table = Table("", title=f"Table {made.label}. {made.title}", caption=made.caption)
        for group, heading in made.headings():
            table.add_column(f"{group}\n{heading}" if group else heading, justify="right")
        for row in made.rows:
            table.add_row(row.title, *(cell.text() for cell in row.cells))
        console.print(table)


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
