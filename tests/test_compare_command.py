"""What a comparison refuses, and what its folder keeps; nothing is trained."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from comparisons import QUIET, options
from scenes import write_scene
from waiting import until

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json, write_distance_png, write_json
from edge_depth_nerf.compare import command
from edge_depth_nerf.compare.options import SearchOptions


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenes": ()}, "at least one scene"),
        ({"steps": 0}, "--steps 0"),
        ({"jobs": 0}, "--jobs 0"),
        ({"seeds": ()}, "--seeds"),
        ({"seeds": (1, 1)}, "--seeds 1 1: expected each once"),
        ({"methods": ("edge", "edge")}, "--methods edge edge"),
        ({"preset": "paper", "methods": ("edge-paper",)}, "expected edge, edge-lidar, .* of the literal method"),
        *(
            ({"preset": "paper", "methods": ("nerfacto", name)}, f"--preset paper --methods {name}: expected")
            for name in ("ds-nerf-extras", "ds-nerf-integrated-extras", "edge-plain", "edge-sharp")
        ),
        ({"jobs": 2, "cluster": "local"}, "--jobs with --cluster"),
        ({"methods": ("edge-lidr",)}, "edge-lidr: no such method. Is edge-lidar meant"),
        # a name leaves out what is usual
        ({"methods": ("ds-nerf-lidar",)}, "ds-nerf-lidar: no such method. Is ds-nerf"),
    ],
)
def test_options_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        replace(options(Path("a")), **changes).check()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lambdas": ()}, "--lambdas"),
        ({"lambdas": (1.0, 2.0, 3.0, -4.0)}, "positive"),
        ({"lambdas": (1.0, 2.0, 3.0, 3.0)}, "--lambdas .* each once"),
        ({"sigmas_m": ("own", 1.0)}, "at least 3"),
        ({"methods": ("edge", "nerfacto")}, "--methods nerfacto: expected methods with a depth loss"),
    ],
)
def test_a_search_that_cannot_be(changes, message):
    values: dict[str, Any] = {"lambdas": (1.0, 2.0, 3.0, 4.0), "sigmas_m": ("own", 1.0, 2.0)}
    fine = SearchOptions(scenes=(Path("a"),), output=Path("out"), **values)
    fine.check()
    with pytest.raises(InputError, match=message):
        replace(fine, **changes).check()


def test_input_is_checked_before_anything_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "do_runs", lambda *_: pytest.fail("started"))

    def refused(error, message, *scenes, **changes):
        output = changes.pop("output", tmp_path / "out")
        with pytest.raises(error, match=message):
            command.compare(options(*scenes, output=output, **changes), QUIET)
        assert changes.get("left", False) or not (tmp_path / "out").exists()

    refused(FileNotFoundError, "transforms.json: no such file", tmp_path / "nothing")
    scene, twin = write_scene(tmp_path / "a" / "x"), write_scene(tmp_path / "b" / "x")
    refused(InputError, "folders have the same name", scene, twin)
    bare = write_scene(tmp_path / "bare", lidar=False)
    refused(InputError, r"no LiDAR maps, which the method .*needs", bare, preset="paper")
    refused(InputError, r"no LiDAR maps", bare, methods=("ds-nerf",))
    without = write_scene(tmp_path / "c", mono=False)
    refused(InputError, r"no monocular maps.*estimate-depth", without, methods=("edge",))
    lacking = write_scene(tmp_path / "e")
    (lacking / "mono/0003.png").unlink()
    refused(InputError, r"mono/0003\.png: no such file, but .*transforms\.json names it", lacking)
    all_trained = write_scene(tmp_path / "d", split=False)
    refused(InputError, "found 0 pictures under test_filenames", all_trained)
    tuned = tmp_path / "tuned.json"
    refused(FileNotFoundError, "no such file", scene, tuned=tuned)
    for content in ([], {"methods": {"nerfacto": {"lambda": 1, "sigma_m": 1}}}, {"methods": {"edge": {"lambda": 0.1}}}):
        write_json(tuned, content)
        refused(InputError, r"tuned.json: (.*expected \{|does not contain a JSON object)", scene, tuned=tuned)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    refused(InputError, "contains other files", scene, output=tmp_path / "full")


class Stop(Exception):
    """Instead of a training."""


@pytest.fixture
def begin(tmp_path, monkeypatch):
    """Gives what begins the runs of methods, and does not do them."""

    def stop(*_):
        raise Stop

    monkeypatch.setattr(command, "do_runs", stop)
    scene = write_scene(tmp_path / "x")

    def begin(*methods: str, **changes: object) -> None:
        with pytest.raises(Stop):
            command.compare(options(scene, output=tmp_path / "out", steps=5, methods=methods, **changes), QUIET)

    return begin


def test_a_folder_keeps_what_its_runs_share(tmp_path, monkeypatch, begin):
    scene, output = tmp_path / "x", tmp_path / "out"
    first = options(scene, output=output, steps=5, methods=("nerfacto",))
    begin("nerfacto")
    assert read_json(output / "runs" / "x" / "nerfacto_seed-0" / "run.json")["steps"] == 5
    # these come to what is there
    begin("edge")
    begin("nerfacto", seeds=(0, 1))
    begin("nerfacto")
    begun = f"edge-depth-nerf compare {scene} --output {output} --methods"
    assert read_json(output / "compare.json")["commands"] == [
        f"{begun} nerfacto --steps 5",
        f"{begun} edge --steps 5",
        f"{begun} nerfacto --steps 5 --seeds 0 1",
    ]
    change: dict[str, Any]
    for change, message in (
        ({"preset": "full"}, "preset lite, not full"),
        ({"detail": True}, "detail False, not True"),
    ):
        with pytest.raises(InputError, match=message):
            command.compare(replace(first, **change), QUIET)  # pyrefly: ignore[bad-argument-type]
    distances = sorted((scene / "mono").iterdir())[0]
    before = distances.read_bytes()
    write_distance_png(distances, read_distance_png(distances) * 1.1)  # maps of another network under the same names
    with pytest.raises(InputError, match="started with layers_sha256"):
        command.compare(first, QUIET)
    distances.write_bytes(before)
    # what versions without --detail and without digests of maps began
    for file in (output / "compare.json", output / "runs" / "x" / "nerfacto_seed-0" / "run.json"):
        later = ("detail", "layers_sha256")
        write_json(file, {name: value for name, value in read_json(file).items() if name not in later})
    begin("nerfacto")
    with monkeypatch.context() as patched:
        # said at once, not after whoever writes there
        patched.setattr(command, "only_writer", lambda *_: pytest.fail("waits for the folder"))
        with pytest.raises(InputError, match="steps 5, not 6"):
            command.compare(replace(first, steps=6), QUIET)
    meta = read_json(scene / "transforms.json")
    write_json(scene / "transforms.json", {**meta, "processed": "anew"})
    with pytest.raises(InputError, match="started with scene_sha256"):
        command.compare(first, QUIET)


def tuned_values(path: Path, scene: object = "tuning", **tuned: float | str) -> Path:
    methods = {name.replace("_", "-"): {"lambda": 0.1, "sigma_m": sigma_m} for name, sigma_m in tuned.items()}
    write_json(path, {"scene": scene, "methods": methods})
    return path


def test_methods_may_be_tuned_after_others(tmp_path, begin):
    path = tmp_path / "tuned.json"
    begin("ds-nerf", tuned=tuned_values(path, ds_nerf=0.5))
    begin("edge", tuned=tuned_values(path, ds_nerf=0.5, edge=0.7))
    begin("nerfacto", tuned=path)
    run = read_json(tmp_path / "out" / "runs" / "x" / "edge_seed-0" / "run.json")
    assert (run["weight"], run["sigma_m"]) == (0.1, 0.7)
    for tuned in ({"ds_nerf": 0.5, "edge": 0.2}, {"ds_nerf": 0.5}):  # another value; one that is gone
        with pytest.raises(InputError, match=r"edge_seed-0/run.json: .* started with λ 0.1 and σ 0.7, not"):
            begin("edge", tuned=tuned_values(path, **tuned))
    begin("edge-lidar")  # trained with the default
    with pytest.raises(InputError, match=r"started with its own λ and σ, not λ 0\.1 and σ own"):
        begin("edge-lidar", tuned=tuned_values(path, edge_lidar="own"))


def test_a_tuned_method_joins_methods_with_their_defaults(tmp_path, begin):
    """As the quick start adds one to the comparison of `demo`, with a file that has values for all."""
    path = tuned_values(tmp_path / "tuned.json", ds_nerf=0.5, edge="own")
    begin("nerfacto", "edge")
    begin("ds-nerf", tuned=path)
    record = tmp_path / "out" / "compare.json"
    assert read_json(record)["tuned_on"] == ["tuning"]
    begin("nerfacto", "edge")  # goes on with what needs no file
    assert read_json(record)["tuned_on"] == ["tuning"]
    for methods, changes in ((("edge",), {"tuned": path}), (("ds-nerf",), {})):
        with pytest.raises(InputError, match="this run was started with"):
            begin(*methods, **changes)
    begin("edge-mono", tuned=tuned_values(path, ["another", "tuning"], edge_mono=0.2))
    assert read_json(record)["tuned_on"] == ["tuning", "another"]


def test_a_run_that_fails_names_its_log(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    with pytest.raises(InputError, match=r"status 1.*nerfacto_seed-0/run\.log"):
        command.compare(options(scene, output=output, steps=5, methods=("nerfacto", "edge"), jobs=1), QUIET)
    assert not (output / "runs" / "x" / "edge_seed-0" / "run.log").exists()  # nothing more was begun


CHILD = """
import os, sys, time
from pathlib import Path
from edge_depth_nerf.jobs.runs import end_with_parent
end_with_parent()
Path(sys.argv[1]).write_text(str(os.getpid()))
time.sleep(600)
"""
PARENT = """
import sys
from pathlib import Path
from edge_depth_nerf.jobs.runs import LoggedCommands
LoggedCommands().call([sys.executable, "-c", sys.argv[1], sys.argv[2]], Path(sys.argv[2] + ".log"), 1, print)
"""


def test_a_program_ends_with_the_one_that_started_it(tmp_path):
    pid = tmp_path / "pid"

    def is_gone():
        done = subprocess.run(["ps", "-o", "stat=", "-p", pid.read_text()], capture_output=True, text=True, check=False)
        return done.stdout.strip() in ("", "Z")

    with subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(pid)]) as parent:
        until(lambda: pid.is_file() and pid.read_text())
        assert not is_gone()
        parent.kill()
    until(is_gone)
