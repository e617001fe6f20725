"""The recipes for data sets (docs/examples/*_to_rig.py): small drives in the layouts that are published become scenes
whose LiDAR lies where it is."""

import re
import subprocess
import sys
from pathlib import Path

import data_sets
import numpy as np
import pytest
from rich.console import Console

from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.rig import read_rig_recording

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/rig.md"


@pytest.fixture(scope="module", params=["nuscenes", "argoverse2", "ddad"])
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the data set, and run the recipe as the page types it, with other folders."""
    folder = tmp_path_factory.mktemp(request.param)
    (typed,) = re.findall(rf"^    python (docs/examples/{request.param}_to_rig\.py) (.+)$", PAGE.read_text(), re.M)
    first, *middle, _ = typed[1].split()
    given = getattr(data_sets, request.param)(folder / "data")
    command = [sys.executable, str(ROOT / typed[0]), str(given), *middle, str(folder / "rig")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert first.startswith("/") and done.returncode == 0, done.stderr
    return folder / "rig"


def test_lidar_lies_on_the_walls(rig: Path, tmp_path: Path) -> None:
    options = RigOptions(root=rig, output=tmp_path / "scene", find_ego=False, sky=False, strict=True)
    report = convert(options, Console(quiet=True))
    assert (report.training, report.held_out) == (10, 2)
    assert not any("points of a scan get one time" in notice for notice in report.notices)
    cameras = {frame["camera"] for frame in read_json(report.scene / "transforms.json")["frames"]}
    assert len(cameras) == 2
    data_sets.check_walls(report.scene, dict(zip(sorted(cameras), ("front", "side"), strict=True)))


def test_each_reading_has_its_own_pose(rig: Path, tmp_path: Path) -> None:
    recording = read_rig_recording(RigOptions(root=rig, output=tmp_path / "scene"))
    assert recording.trajectory is not None and len(recording.pictures) == 12 and len(recording.sweeps) >= 6
    first = min(sweep.time_s for sweep in recording.sweeps)
    for one in (*recording.pictures, *recording.sweeps):
        expected = data_sets.vehicle(one.time_s - first)
        expected[:3, 3] += data_sets.OFF
        assert recording.trajectory.at(np.array([one.time_s]))[0] == pytest.approx(expected, abs=1e-4)


def test_the_recipes_are_short() -> None:
    found = sorted((ROOT / "docs/examples").glob("*_to_rig.py"))
    assert len(found) == 3 and all(len(path.read_text().splitlines()) < 90 for path in found)
