"""Tasks on real clusters of separate processes: killed workers, failing tasks, GPUs, what a worker must have."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from comparisons import fake
from drives import SEQUENCE, RoomDrive, write_room_drive
from rich.console import Console
from scenes import write_scene
from waiting import until

from edge_depth_nerf import cli
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.compare import command as comparing
from edge_depth_nerf.compare.command import compare
from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.compare.specification import FIGURES
from edge_depth_nerf.jobs import cluster
from edge_depth_nerf.jobs.cluster import on_cluster
from edge_depth_nerf.jobs.cluster_address import check_address
from edge_depth_nerf.jobs.tasks import Task, do_tasks, own_command, this_machine
from edge_depth_nerf.mono import many
from edge_depth_nerf.mono.estimate import estimate_depth
from edge_depth_nerf.mono.many import estimate_on_cluster
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.process.command import process, process_drive
from edge_depth_nerf.process.options import Kitti360Options

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")

QUIET = Console(quiet=True)
STEPS = """
import sys, time
from pathlib import Path
from edge_depth_nerf.jobs.runs import end_with_parent
end_with_parent()
kept, made, pause = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])
done = len(kept.read_text().split()) if kept.exists() else 0
for step in range(done, 4):
    print(f"work done: {step / 4}", flush=True)
    time.sleep(pause)
    with kept.open("a") as file:
        file.write(f"{step} ")
made.touch()
"""
"""A training in little: four steps, each kept."""


def steps(folder: Path, name: str, pause: float = 0.01, code: str = STEPS, trains: bool = False) -> Task:
    kept, made = folder / f"{name}.kept", folder / f"{name}.made"
    arguments = ("-c", code, str(kept), str(made), str(pause))
    return Task(name, arguments, folder / "logs" / f"{name}.log", made, trains)


def child_of_worker(word: str) -> psutil.Process | None:
    for child in psutil.Process().children(recursive=True):
        try:
            if any(word in part for part in child.cmdline()) and child.status() != psutil.STATUS_ZOMBIE:
                return child
        except psutil.NoSuchProcess:
            pass
    return None


def kill_worker_of(word: str, happened: Callable[[], Any]) -> threading.Thread:
    def kill() -> None:
        until(happened)
        child = until(lambda: child_of_worker(word))
        os.kill(child.ppid(), signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    return thread


# ---- what is given -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("given", ["", "10.0.0.1:8786", "http://10.0.0.1:8786", "here"])
def test_an_address_is_local_or_a_schedulers(given: str) -> None:
    with pytest.raises(InputError, match=r"--cluster .*expected local, or the address"):
        check_address(given)
    for fine in (None, "local", "tcp://a:1", "tls://a:1"):
        check_address(fine)


def test_without_dask_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install '\.\[cluster\]'"):
        with on_cluster("local", [steps(tmp_path, "a")], [], QUIET):
            pass


def test_nobody_at_an_address_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9: no scheduler answers.*dask scheduler"):
        with on_cluster("tcp://127.0.0.1:9", [steps(tmp_path, "a")], [], QUIET):
            pass
    assert not any(tmp_path.iterdir())


# ---- processes on this machine -------------------------------------------------------------------------------------
def test_jobs_without_a_cluster_go_side_by_side(tmp_path: Path) -> None:
    """Each waits for what the other begins."""
    waits = (
        "end = time.monotonic() + 60\nwhile len(list(kept.parent.glob('*.kept'))) < 2: assert time.monotonic() < end\n"
    )
    tasks = [steps(tmp_path, name, code=STEPS + waits) for name in "ab"]
    with this_machine(2, len(tasks), QUIET) as place:
        do_tasks(tasks, place, QUIET)
    assert all((tmp_path / f"{name}.kept").read_text() == "0 1 2 3 " for name in "ab")


@pytest.mark.slow
def test_a_task_that_fails_is_not_done_again_and_names_its_log(tmp_path: Path) -> None:
    wrong = steps(tmp_path, "wrong", code="import sys; print('calib.txt: is empty'); sys.exit(2)")
    others = [steps(tmp_path, name, 60.0) for name in "abcd"]
    tasks = [*others[:1], wrong, *others[1:]]
    with on_cluster("local", tasks, [], QUIET) as place:
        with pytest.raises(InputError, match=r"status 2\. .*logs/wrong\.log\. The last line is: calib\.txt: is empty"):
            do_tasks(tasks, place, QUIET)
        until(lambda: child_of_worker(".kept") is None, 5.0)
    assert (tmp_path / "logs/wrong.log").read_text().count("$ ") == 1
    assert not (tmp_path / "logs/d.log").exists()


@pytest.mark.slow
def test_ctrl_c_ends_what_runs(tmp_path: Path) -> None:
    tasks = [steps(tmp_path, name, 60.0) for name in "abc"]

    def interrupt() -> None:
        until(lambda: child_of_worker(".kept"))
        os.kill(os.getpid(), signal.SIGINT)

    with on_cluster("local", tasks, [], QUIET) as place:
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            do_tasks(tasks, place, QUIET)
        until(lambda: child_of_worker(".kept") is None, 5.0)
    assert not (tmp_path / "logs/c.log").exists()


@pytest.mark.slow
def test_workers_are_not_lost_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task, console = steps(tmp_path, "a", 60.0), Console(file=io.StringIO(), width=200)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    kill_worker_of("a.kept", lambda: True)
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        on_cluster("local", [task], [], console) as place,
    ):
        # one task has all cores
        assert f"threads of each: {dask.system.cpu_count()}" in console.file.getvalue()  # pyrefly: ignore
        with pytest.raises(InputError, match=r"a: 1 worker was lost.*logs/a\.log"):
            do_tasks([task], place, QUIET)


@pytest.mark.slow
def test_the_local_cluster_is_closed_to_others(tmp_path: Path) -> None:
    """Other users of the machine reach the loopback, too: without the keys they get no answer."""

    def listening() -> set[tuple[str, int]]:
        return {
            (connection.laddr.ip, connection.laddr.port)
            for each in (psutil.Process(), *psutil.Process().children(recursive=True))
            for connection in each.net_connections("tcp")
            if connection.status == psutil.CONN_LISTEN
        }

    # other tests of the same process may have left something
    before = listening()
    with on_cluster("local", [steps(tmp_path, "a")], [], QUIET) as place:
        address = place._client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert {ip for ip, _ in listening() - before} == {"127.0.0.1"}
        for form in (address, address.replace("tls", "tcp")):
            with pytest.raises((OSError, TimeoutError, TypeError)):
                distributed.Client(form, timeout=1, set_as_default=False)


# ---- a scheduler by hand -----------------------------------------------------------------------------------------
@contextmanager
def scheduler(tmp_path: Path) -> Iterator[tuple[str, Callable[..., None]]]:
    """A scheduler as docs/cluster.md starts one; its address, and what starts a worker."""
    started: list[subprocess.Popen] = []

    def start(*words: str, **environment: str) -> None:
        call = [sys.executable, "-m", "dask", *words]
        with (tmp_path / "dask.log").open("a") as log:
            output = {"stdout": log, "stderr": subprocess.STDOUT}
            started.append(subprocess.Popen(call, env={**os.environ, **environment}, cwd=tmp_path, **output))

    file = tmp_path / "scheduler.json"
    where = ("--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0")
    start("scheduler", "--port", "0", "--scheduler-file", str(file), *where)
    try:
        until(lambda: file.exists() and file.read_text().endswith("}"))
        address = json.loads(file.read_text())["address"]
        yield address, lambda *words, **environment: start("worker", address, *where, *words, **environment)
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait()


@pytest.mark.slow
def test_a_training_has_a_gpu_for_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import os, sys; print('parent', os.getppid());" + STEPS.replace("import sys, time", "import time")
    tasks = [steps(tmp_path, f"train{number}", 0.1, code, trains=True) for number in range(3)]
    tasks += [steps(tmp_path, f"map{number}", 0.1, code) for number in range(3)]
    with scheduler(tmp_path) as (address, start_worker):
        monkeypatch.setattr(cluster, "WAIT_FOR_WORKERS_S", 0.5)
        with pytest.raises(InputError, match=r"no worker after 0\.5 s.*--nthreads 1.*GPU=1"):
            with on_cluster(address, tasks, [], QUIET):
                pass
        monkeypatch.undo()
        start_worker("--nthreads", "1", "--resources", "GPU=1", "--name", "with")
        start_worker("--nthreads", "1", "--name", "without")
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            console = Console(file=io.StringIO(), width=200)
            with on_cluster(address, tasks, [tmp_path], console) as place:
                do_tasks(tasks, place, console)
            assert "2 workers on 1 machine, 1 with a GPU" in console.file.getvalue()  # pyrefly: ignore
            with_gpu = {
                worker["name"] == "with": client.run(os.getpid, workers=[address])[address]
                for address, worker in client.scheduler_info()["workers"].items()
            }
            parents = {task.title: int((task.log.read_text().split("parent ")[1]).split()[0]) for task in tasks}
            assert {parents[f"train{number}"] for number in range(3)} == {with_gpu[True]}
            assert with_gpu[False] in {parents[f"map{number}"] for number in range(3)}

            # the same cluster, with a worker that is not as it must be
            def refused(pattern: str) -> None:
                with pytest.raises(InputError, match=pattern), on_cluster(address, tasks, [tmp_path], QUIET):
                    pass

            with pytest.raises(InputError, match=r"worker \S+ \(tcp://.*\): does not have /nowhere/at/all.*shared"):
                with on_cluster(address, tasks, [Path("/nowhere/at/all")], QUIET):
                    pass
            other = tmp_path / "other" / "torch-9.9.dist-info"
            other.mkdir(parents=True)
            (other / "METADATA").write_text("Metadata-Version: 2.1\nName: torch\nVersion: 9.9\n")
            path = os.pathsep.join([str(other.parent), os.environ.get("PYTHONPATH", "")])
            start_worker("--nthreads", "1", PYTHONPATH=path)
            client.wait_for_workers(3, timeout=60)
            refused(r"worker \S+ \(tcp://.*\): has torch 9\.9, this machine 2\..*machines need the same version")
            workers = {name: {**worker, "nthreads": 3} for name, worker in client.scheduler_info()["workers"].items()}
            with pytest.raises(InputError, match=r"has 3 threads.*--nthreads 1"):
                cluster._look_at(client, workers, [], [], tmp_path)


# ---- the commands ------------------------------------------------------------------------------------------------
def files_of(folder: Path) -> dict[str, bytes]:
    """All files but those that tell of the folder's own name or time."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".log" and ".cache" not in path.parts
    }


def test_a_command_line_gives_the_options_back(tmp_path: Path) -> None:
    chosen: dict[str, Any] = {"first": 7, "frames": 3, "cameras": (), "holdout_cameras": ("image_03",)}
    chosen |= {"raw_lidar": True, "ego_mask": Path("masks"), "theta_max_deg": 92.5}
    options = Kitti360Options(output=Path("scenes/000"), root=tmp_path, sequence=SEQUENCE, **chosen)
    _, module, ends_with_parent, *words = own_command(("process", "kitti360"), options)
    assert (module, ends_with_parent) == ("edge_depth_nerf", "--end-with-parent")
    command = cli.parse(words)
    assert isinstance(command, cli.Process)
    here = Path.cwd()
    assert command.options == replace(options, output=here / "scenes/000", ego_mask=here / "masks")
    estimating = EstimateDepthOptions((Path("a"), tmp_path), train_steps=3, predict=False)
    _, _, _, *words = own_command(("estimate-depth",), estimating)
    assert cli.parse(words) == replace(estimating, scenes=(here / "a", tmp_path))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    drive = write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=7, beams=800, size=32)
    # a frame without pose, one without sweep
    poses = drive.poses_file().read_text().splitlines()
    drive.poses_file().write_text("\n".join([*poses[:3], *poses[4:]]) + "\n")
    drive.sweep(0).unlink()
    return drive


def options_of(room: RoomDrive, output: Path, **changes: Any) -> Kitti360Options:
    given: dict[str, Any] = {"root": room.root, "sequence": SEQUENCE, "output": output, "sweeps": 1, "find_ego": False}
    given |= {"refine_poses": False, "motion": False, "estimate_depth": False}
    return Kitti360Options(**{**given, **changes})


@pytest.mark.slow
def test_a_drive_is_cut_as_by_hand(room: RoomDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Five frames of seven can be used: 1, 2, 4 to 6."""
    by_hand = {"000": (1, 4), "001": (5, 2)}
    for name, (first, frames) in by_hand.items():
        process(options_of(room, tmp_path / "hand" / name, first=first, frames=frames), QUIET)
    cut = process_drive(options_of(room, tmp_path / "here", frames_per_scene=3), QUIET)
    assert [path.name for path in cut] == list(by_hand)
    console = Console(file=io.StringIO(), width=200)
    process_drive(options_of(room, tmp_path / "there", frames_per_scene=3, cluster="local"), console)
    assert "5 usable frames, split into 2 scenes" in console.file.getvalue()  # pyrefly: ignore[missing-attribute]
    wanted = files_of(tmp_path / "hand")
    assert len([name for name in wanted if name.endswith(".png") and "/images/" in name]) == 2 * 5
    assert files_of(tmp_path / "here") == wanted and files_of(tmp_path / "there") == wanted
    frames = [
        (frame["file_path"], name)
        for name in by_hand
        for frame in read_json(tmp_path / "there" / name / "transforms.json")["frames"]
    ]
    scenes_of = {number: {name for path, name in frames if f"{number:010d}" in path} for number in range(7)}
    assert {number for number, scenes in scenes_of.items() if scenes} == {1, 2, 4, 5, 6}
    assert all(len(scenes) <= 1 for scenes in scenes_of.values())
    with pytest.raises(InputError, match="is a scene; --frames-per-scene would write other scenes into it"):
        process_drive(options_of(room, tmp_path / "here" / "000", frames_per_scene=3), QUIET)

    # the scenes' maps: of one network, trained by one task; each task does its words, as the scenes' did above
    did: list[str] = []

    def do(_: Any, tasks: Sequence[Task], *__: Any) -> None:
        for task in tasks:
            assert task.arguments[:3] == ("-m", "edge_depth_nerf", "--end-with-parent")
            cli.run(cli.parse([*task.arguments[3:]]))
            assert task.makes.is_file()
            did.append(task.title)

    monkeypatch.setattr(many, "_do", do)

    def weights(folder: Path) -> bytes:
        return (folder / "000" / "mono_network.safetensors").read_bytes()

    scenes = {where: tuple(tmp_path / where / name for name in by_hand) for where in ("here", "there")}
    estimate_depth(EstimateDepthOptions(scenes["here"], train_steps=2), QUIET)
    estimate_on_cluster(EstimateDepthOptions(scenes["there"], train_steps=2, cluster="local"), QUIET)
    assert weights(tmp_path / "there") == weights(tmp_path / "here")
    here, there = files_of(tmp_path / "here"), files_of(tmp_path / "there")
    assert len([name for name in there if "/mono/" in name]) == 2 * 5
    assert there == here
    assert did == ["depth network", *(f"maps of {path}" for path in scenes["there"])]


@pytest.mark.slow
def test_a_comparison_goes_on_when_a_worker_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The training is made up; test_compare_worker.py resumes one for real."""

    def task(run: comparing.Run) -> Task:
        made_up, figures = run.folder / "made_up.json", run.folder / FIGURES
        write_json(made_up, {**fake("sample", "edge", 0).content, "run": asdict(run.specification)})
        code = STEPS.replace("made.touch()", f"Path({str(made_up)!r}).rename({str(figures)!r})")
        return replace(steps(run.folder, "edge", 0.3, code, trains=True), title=run.title, log=run.log, makes=figures)

    write_scene(tmp_path / "sample")
    output = tmp_path / "out"
    asked = CompareOptions(scenes=(tmp_path / "sample",), output=output, methods=("edge",), steps=2, cluster="local")
    monkeypatch.setattr(comparing.Run, "task", property(task))
    monkeypatch.setattr(comparing, "draw_plots", lambda *_: [])
    folder = output / "runs" / "sample" / "edge_seed-0"
    killer = kill_worker_of(str(folder), (folder / "edge.kept").exists)
    console = Console(file=io.StringIO(), width=200)
    results = compare(asked, console)
    killer.join()
    assert "sample edge seed 0: worker lost" in console.file.getvalue()  # pyrefly: ignore[missing-attribute]
    assert [run.method for run in results.runs] == ["edge"]
    assert (folder / "run.log").read_text().count("$ ") == 2 and (folder / "edge.kept").read_text() == "0 1 2 3 "
    # what is done is done: the same tables come from the same command without a cluster
    tables = (output / "tables.md").read_text()
    compare(replace(asked, cluster=None), QUIET)
    assert (output / "tables.md").read_text() == tables and "| ours |" in tables
