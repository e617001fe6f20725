"""What a command names as the next one: it exists, with these options."""

import re
import shlex
from pathlib import Path

import pytest

from edge_depth_nerf import cli
from edge_depth_nerf.inspecting.options import InspectOptions
from edge_depth_nerf.process import command as process_command
from edge_depth_nerf.process.options import JbnuDepth360Options, Kitti360Options, RigOptions
from edge_depth_nerf.synthetic import drive


@pytest.mark.parametrize(
    ("layout", "expected"),
    [("kitti-360", Kitti360Options), ("jbnu-depth360", JbnuDepth360Options), ("rig", RigOptions)],
)
def test_after_a_drive_comes_its_converter(monkeypatch, capsys, tmp_path, layout, expected):
    monkeypatch.setattr(drive, "synthesize_drive", lambda options: options.output)
    output = tmp_path / "my drive"
    cli.run(cli.parse(["synthesize", "--layout", layout, "--output", str(output)]))
    said = capsys.readouterr().out
    found = re.search(r"Make a scene of it: edge-depth-nerf (.*)\n", said)
    assert found is not None, said
    command = cli.parse(shlex.split(found[1]))
    assert isinstance(command, cli.Process) and isinstance(command.options, expected)
    assert isinstance(command.options, Kitti360Options | JbnuDepth360Options | RigOptions)
    assert command.options.root == output and command.options.output == Path("SCENE")


def test_after_a_scene_comes_its_training(monkeypatch, capsys, tmp_path):
    scene = tmp_path / "a scene"
    monkeypatch.setattr(process_command, "process_drive", lambda _: [scene])
    cli.run(cli.parse(["process", "rig", "--root", "x", "--output", str(scene)]))
    inspect, train = (line.rsplit(": ", 1)[1] for line in capsys.readouterr().out.splitlines())
    looking = cli.parse(shlex.split(inspect)[1:])
    assert isinstance(looking, InspectOptions) and looking.scene == scene
    assert shlex.split(train) == ["ns-train", "edge-depth-nerf-lite", "--data", str(scene)]
