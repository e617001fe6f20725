"""What a comparison refuses, and what its folder keeps; nothing is trained."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from comparisons import QUIET, options
from scenes import write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json, write_distance_png, write_json
from edge_depth_nerf.compare import command
from edge_depth_nerf.compare.options import SearchOptions


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "--steps 0"),
        ({"jobs": 0}, "--jobs 0"),
        ({"seeds": ()}, "--seeds"),
        ({"seeds": (1, 1)}, "--seeds 1 1: expected each once"),
        ({"methods": ("edge", "edge")}, "--methods edge edge"),
        ({"preset": "paper", "methods": ("edge-paper",)}, "expected edge, edge-lidar, .* of the literal method"),
        ({"jobs": 2, "cluster": "local"}, "--jobs with --cluster"),
        ({"methods": ("edge-lidr",)}, "edge-lidr: no such method. Is edge-lidar meant"),
        # a name leaves out what is usual
        ({"methods": ("ds-nerf-lidar",)}, "ds-nerf-lidar: no such method. Is ds-nerf"),
    ],
)
def test_options_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        options(Path("a"), **changes).check()


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
    fine = {"lambdas": (1.0, 2.0, 3.0, 4.0), "sigmas_m": ("own", 1.0, 2.0)}
    options(Path("a"), of=SearchOptions, **fine).check()
    with pytest.raises(InputError, match=message):
        options(Path("a"), of=SearchOptions, **{**fine, **changes}).check()


def test_no_scene_is_an_error():
    with pytest.raises(InputError, match="at least one scene"):
        options().check()


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
    refused(InputError, "folders have the same name", scene, scene)
    bare = write_scene(tmp_path / "bare", lidar=False)
    refused(InputError, r"no LiDAR maps, which the method .*needs", bare, preset="paper")
    refused(InputError, r"no LiDAR maps", bare, methods=("ds-nerf",))
    refused(
        InputError, r"no monocular maps.*estimate-depth", write_scene(tmp_path / "c", mono=False), methods=("edge",)
    )
    lacking = write_scene(tmp_path / "e")
    (lacking / "mono/0003.png").unlink()
    refused(FileNotFoundError, r"mono/0003\.png: no such file, but .*transforms\.json names it", lacking)
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


def test_a_folder_keeps_what_its_runs_share(tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    def stop(*_):
        raise Stop

    monkeypatch.setattr(command, "do_runs", stop)
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    first = options(scene, output=output, steps=5, methods=("nerfacto",))
    with pytest.raises(Stop):
        command.compare(first, QUIET)
    assert read_json(output / "runs" / "x" / "nerfacto_seed-0" / "run.json")["steps"] == 5
    for more in ({"methods": ("edge",)}, {"seeds": (0, 1)}, {}):  # these come to what is there
        with pytest.raises(Stop):
            command.compare(replace(first, **more), QUIET)
    begun = f"edge-depth-nerf compare {scene} --output {output} --methods"
    assert read_json(output / "compare.json")["commands"] == [
        f"{begun} nerfacto --steps 5",
        f"{begun} edge --steps 5",
        f"{begun} nerfacto --steps 5 --seeds 0 1",
    ]
    with pytest.raises(InputError, match="steps 5, not 6"):
        command.compare(replace(first, steps=6), QUIET)
    with pytest.raises(InputError, match="preset lite, not full"):
        command.compare(replace(first, preset="full"), QUIET)
    with pytest.raises(InputError, match="detail False, not True"):
        command.compare(replace(first, detail=True), QUIET)
    distances = sorted((scene / "mono").iterdir())[0]
    before = distances.read_bytes()
    write_distance_png(distances, read_distance_png(distances) * 1.1)  # maps of another network under the same names
    with pytest.raises(InputError, match="started with layers_sha256"):
        command.compare(first, QUIET)
    distances.write_bytes(before)
    # what versions without --detail and without digests of maps began
    for file in (output / "compare.json", output / "runs" / "x" / "nerfacto_seed-0" / "run.json"):
        write_json(
            file, {name: value for name, value in read_json(file).items() if name not in ("detail", "layers_sha256")}
        )
    with pytest.raises(Stop):
        command.compare(first, QUIET)
    with monkeypatch.context() as patched:
        # said at once, not after whoever writes there
        patched.setattr(command, "only_writer", lambda *_: pytest.fail("waits for the folder"))
        with pytest.raises(InputError, match="steps 5, not 6"):
            command.compare(replace(first, steps=6), QUIET)
    meta = read_json(scene / "transforms.json")
    write_json(scene / "transforms.json", {**meta, "processed": "anew"})
    with pytest.raises(InputError, match="started with scene_sha256"):
        command.compare(first, QUIET)


def test_methods_may_be_tuned_after_others(tmp_path):
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"

    def open_with(methods: tuple[str, ...], **tuned: float) -> None:
        path = tmp_path / "tuned.json"
        content = {name.replace("_", "-"): {"lambda": value, "sigma_m": 0.5} for name, value in tuned.items()}
        write_json(path, {"scene": "tuning", "methods": content})
        asked = options(scene, output=output, steps=5, methods=methods, tuned=path)
        command.open_output(asked, command.read_tuned(path))
        for name in methods:
            (output / "runs" / "x" / f"{name}_seed-0").mkdir(parents=True, exist_ok=True)

    open_with(("ds-nerf",), ds_nerf=0.1)
    open_with(("edge",), ds_nerf=0.1, edge=0.01)
    assert read_json(output / "compare.json")["tuned"] == {
        "ds-nerf": {"lambda": 0.1, "sigma_m": 0.5},
        "edge": {"lambda": 0.01, "sigma_m": 0.5},
    }
    open_with(("nerfacto",), ds_nerf=0.1, edge=0.01)
    for tuned in ({"ds_nerf": 0.1, "edge": 0.02}, {"ds_nerf": 0.1}):  # another value; one that is gone
        with pytest.raises(InputError, match="contains a comparison with tuned"):
            open_with(("edge",), **tuned)
    (output / "runs" / "x" / "edge-lidar_seed-0").mkdir()  # trained with the default
    with pytest.raises(InputError, match="contains a comparison with tuned"):
        open_with(("edge-lidar",), ds_nerf=0.1, edge=0.01, edge_lidar=0.01)


def test_a_tuned_method_joins_methods_with_their_defaults(tmp_path):
    """As the quick start adds one to the comparison of `demo`, with a file that has values for all."""
    scene, output, path = write_scene(tmp_path / "x"), tmp_path / "out", tmp_path / "tuned.json"
    first = options(scene, output=output, steps=5, methods=("nerfacto", "edge"))
    command.open_output(first, {})
    (output / "runs" / "x" / "edge_seed-0").mkdir(parents=True)
    setting = {"lambda": 0.1, "sigma_m": 0.5}
    write_json(path, {"scene": "tuning", "methods": {"ds-nerf": setting, "edge": {"lambda": 0.02, "sigma_m": "own"}}})
    tuned = command.read_tuned(path)
    command.open_output(replace(first, methods=("ds-nerf",), tuned=path), tuned)
    record = read_json(output / "compare.json")
    assert record["tuned"] == {"ds-nerf": setting} and record["tuned_on"] == "tuning"
    (output / "runs" / "x" / "ds-nerf_seed-0").mkdir()
    command.open_output(first, {})  # goes on with what needs no file
    assert read_json(output / "compare.json")["tuned"] == {"ds-nerf": setting}
    for methods, file in ((("edge",), path), (("ds-nerf",), None)):
        with pytest.raises(InputError, match="contains a comparison with tuned"):
            command.open_output(replace(first, methods=methods, tuned=file), tuned if file else {})
    write_json(path, {"scene": "another", "methods": {"ds-nerf": setting}})
    with pytest.raises(InputError, match="contains a comparison with tuned_on tuning, not another"):
        command.open_output(replace(first, methods=("ds-nerf",), tuned=path), command.read_tuned(path))


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
    deadline = time.monotonic() + 300

    def wait_for(happened):
        while not happened():
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def is_gone():
        done = subprocess.run(["ps", "-o", "stat=", "-p", pid.read_text()], capture_output=True, text=True, check=False)
        return done.stdout.strip() in ("", "Z")

    with subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(pid)]) as parent:
        wait_for(lambda: pid.is_file() and pid.read_text())
        assert not is_gone()
        parent.kill()
    wait_for(is_gone)
