"""LiDAR beams that are held out of everything: which, from what, and that training views are evaluated by them."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import SEQUENCE, write_room_drive
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.lidar.sweeps import BEAM_RAD, Sweep, without_beams
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.format import depth_sources
from edge_depth_nerf.scene.reader import read_scene


def elevation(points: torch.Tensor) -> torch.Tensor:
    return torch.atan2(points[:, 2], points[:, :2].norm(dim=-1))


def test_one_band_of_elevation_of_ten_is_taken_from_a_sweep():
    generator = torch.Generator().manual_seed(0)
    up = (torch.rand(20_000, generator=generator, dtype=torch.float64) - 0.8) * math.radians(30)
    around = 2 * math.pi * torch.rand(20_000, generator=generator, dtype=torch.float64)
    points = 7 * torch.stack([up.cos() * around.cos(), up.cos() * around.sin(), up.sin()], dim=-1)
    order = torch.arange(20_000, dtype=torch.float64)
    kept, held_out = without_beams(Sweep(points, order, 3, 4, offset_s=order), 10)
    assert len(kept.points_m) + len(held_out.points_m) == 20_000
    assert set(kept.reflectance.tolist()) | set(held_out.reflectance.tolist()) == set(range(20_000))
    assert kept.offset_s is not None and held_out.offset_s is not None
    assert torch.equal(kept.offset_s, kept.reflectance) and torch.equal(held_out.offset_s, held_out.reflectance)
    assert 0.08 < len(held_out.points_m) / 20_000 < 0.12
    # the same bands whatever the sweep: ten apart, and nothing of what is kept in them
    bands = set(torch.floor(elevation(held_out.points_m) / BEAM_RAD).long().tolist())
    assert len(bands) >= 6 and len({band % 10 for band in bands}) == 1
    assert not bands & set(torch.floor(elevation(kept.points_m) / BEAM_RAD).long().tolist())


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("beams")
    room = write_room_drive(folder / "drive", frames=3, size=64, cameras=("image_02",))
    found = {}
    for beams in (0, 10):
        found[beams] = folder / f"scene_{beams}"
        given: dict[str, Any] = {"root": room.root, "sequence": SEQUENCE, "cameras": ("image_02",), "sweeps": 1}
        given |= {"output": found[beams], "find_ego": False, "refine_poses": False, "holdout_beams": beams}
        convert(Kitti360Options(**given), Console(quiet=True))
    return found


def test_a_scene_keeps_them_apart_and_a_scene_without_is_as_before(scenes: dict[int, Path]):
    meta = {beams: read_json(scene / "transforms.json") for beams, scene in scenes.items()}
    assert all("beams_file_path" not in frame for frame in meta[0]["frames"])
    assert "holdout_beams" not in meta[0]["source"] and meta[10]["source"]["holdout_beams"] == 10
    plain, split = (read_scene(scenes[beams]) for beams in (0, 10))
    counts = np.zeros(3, int)
    for one, other in zip(plain.pictures, split.pictures, strict=True):
        lidar = plain.distance_m(one, "lidar")
        kept, beams = split.distance_m(other, "lidar"), split.distance_m(other, "beams")
        assert lidar is not None and kept is not None and beams is not None
        counts += [np.count_nonzero(each > 0) for each in (lidar, kept, beams)]
        # a room without anything in it: where both know a pixel they mean the same wall
        both = (lidar > 0) & (beams > 0)
        assert float(np.median(np.abs(lidar - beams)[both] / lidar[both])) < 0.03
    assert 0 < counts[2] < 0.12 * counts[0]
    assert 0.8 * counts[0] < counts[1] < counts[0]
    # no training takes them for a source of depth
    assert "beams" not in depth_sources()


@pytest.mark.parametrize("beams", [1, 101])
def test_how_many_are_held_out_has_a_range(beams: int, tmp_path: Path):
    options = Kitti360Options(root=tmp_path, sequence=SEQUENCE, output=tmp_path / "scene", holdout_beams=beams)
    with pytest.raises(InputError, match=f"--holdout-beams {beams}: expected 2 to 100, or 0"):
        options.check()
