"""Drives synthesised in other layouts than KITTI-360's."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import tree as contents

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import LayoutName, SynthesizeOptions
from edge_depth_nerf.synthetic.rig_drive import jbnu_cameras, looking, rig_cameras

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("layout", ["rig", "jbnu-depth360"])
def test_the_same_options_give_the_same_bytes_also_when_continued(tmp_path: Path, layout: LayoutName) -> None:
    options = SynthesizeOptions(tmp_path / "once", "parking", frames=2, size=32, layout=layout)
    whole = contents(synthesize_drive(options))
    again = SynthesizeOptions(tmp_path / "again", "parking", frames=2, size=32, layout=layout)
    for path in sorted(synthesize_drive(again).rglob("*")):
        if path.suffix in (".toml", ".pcd", ".bin") or path.name == "000001.png":
            path.unlink()
    assert contents(synthesize_drive(again)) == whole
    assert read_json(tmp_path / "once/drive.json")["options"]["layout"] == layout
    with pytest.raises(InputError, match="layout is"):
        synthesize_drive(SynthesizeOptions(tmp_path / "once", "parking", frames=2, size=32))
    # what a mask keeps has a distance or is open; what it hides has none
    masks = sorted((tmp_path / "once/masks").iterdir())
    assert len(masks) == (3 if layout == "rig" else 4)
    for path in masks:
        distance = read_distance_png(tmp_path / f"once/truth/{path.stem}/distance/000000.png")
        assert not (distance > 0)[~read_mask(path)].any()
        assert (distance > 0)[read_mask(path)].mean() > 0.95  # a car park has a ceiling
        assert read_image(tmp_path / f"once/truth/{path.stem}/rgb/000000.png")[read_mask(path)].mean() > 30


def test_what_the_lenses_see() -> None:
    assert len(rig_cameras(256)) == 3 and len(jbnu_cameras(192)) == 4
    for mounted in rig_cameras(256).values():
        camera = mounted.camera
        seen, valid = camera.unproject(camera.pixel_centres())
        theta_deg = torch.rad2deg(torch.acos(seen[..., 2][valid]))
        assert theta_deg.max() > (110 if mounted.lens_theta_deg == 110 else 35)
    for mounted in jbnu_cameras(192).values():
        assert (mounted.camera.width, mounted.camera.height) == (192, 108)
        rim = torch.tensor([[np.sin(np.deg2rad(91.5)), 0.0, np.cos(np.deg2rad(91.5))]], dtype=torch.float64)
        assert mounted.camera.project(rim)[0][0, 0] == pytest.approx(0.992 * 192, abs=1)


def test_looking() -> None:
    left = looking(90.0, 0.0, (1.0, 2.0, 3.0))
    # forward is the vehicle's left (y), right is its front (x), down is down
    assert left == pytest.approx(np.array([[1, 0, 0, 1], [0, 0, 1, 2], [0, -1, 0, 3], [0, 0, 0, 1]]), abs=1e-12)
    assert looking(0.0, 90.0, (0.0, 0.0, 0.0))[:3, 2] == pytest.approx([0, 0, -1], abs=1e-12)
