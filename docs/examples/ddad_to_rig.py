"""A scene of DDAD as a rig: links to its files, rig.json and poses.txt.

    python ddad_to_rig.py SCENE OUTPUT      # such as /data/ddad_train_val/000000 drives/ddad_000000
    edge-depth-nerf process rig --root OUTPUT --output scenes/ddad_000000

SCENE is the folder of a scene_….json. Each reading has the pose of its own sensor in the world: together with where the
sensor is mounted they are the vehicle's path. Points have no times, and are taken to be corrected for the vehicle's
motion to the time of their file. What is 0 may be missing in the JSON.
"""

from __future__ import annotations

import json
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

LATEST_US = 4_000_000_000_000_000
"""The year 2096."""


def matrix(pose: dict[str, dict[str, float]]) -> np.ndarray:
    """A pose of the data set, 4×4."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([pose["rotation"].get(f"q{axis}", 0.0) for axis in "xyzw"]).as_matrix()
    found[:3, 3] = [pose["translation"].get(axis, 0.0) for axis in "xyz"]
    return found


def main(scene: Path, output: Path) -> None:
    """Write the folder that `process rig` reads."""
    (description,) = scene.glob("scene_*.json")
    content = json.loads(description.read_text())
    calibration = json.loads((scene / "calibration" / f"{content['samples'][0]['calibration_key']}.json").read_text())
    mounted = {name: matrix(pose) for name, pose in zip(calibration["names"], calibration["extrinsics"], strict=True)}
    lenses = dict(zip(calibration["names"], calibration["intrinsics"], strict=True))
    rig: dict[str, Any] = {"poses": {"file": "poses.txt", "format": "tum"}, "cameras": {}, "lidars": {}}
    poses = []
    for reading in content["data"]:
        name = reading["id"]["name"]
        (kind, datum), *_ = reading["datum"].items()
        if kind not in ("image", "point_cloud"):
            continue
        table = {"times_from_names": True, "time_unit": "us", "to_vehicle": mounted[name].tolist()}
        if kind == "image":
            lens = {key: lenses[name][key] for key in ("fx", "fy", "cx", "cy")}
            size = {"width": datum["width"], "height": datum["height"]}
            rig["cameras"][name] = {**table, "images": name, "model": "pinhole", **size, **lens}
        else:
            columns = [field.lower() for field in datum["point_format"]]
            rig["lidars"][name] = {**table, "scans": name, "array": "data", "columns": columns}
            rig["lidars"][name] |= {"corrected_to": "timestamp"}
        file = (scene / datum["filename"]).resolve()
        time_us = round(datetime.fromisoformat(reading["id"]["timestamp"].replace("Z", "+00:00")).timestamp() * 1e6)
        # the data set counts 0.1 µs where its dates say µs: 2019 becomes 2463
        time_us = time_us // 10 if time_us > LATEST_US else time_us
        link = output / name / f"{time_us}{file.suffix}"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file)
        vehicle = matrix(datum["pose"]) @ np.linalg.inv(mounted[name])
        poses.append((time_us, [*vehicle[:3, 3].tolist(), *Rotation.from_matrix(vehicle[:3, :3]).as_quat().tolist()]))
    lines = [f"{time / 1e6:.6f} {' '.join(map(repr, numbers))}\n" for time, numbers in sorted(poses)]
    (output / "poses.txt").write_text("".join(lines))
    (output / "rig.json").write_text(json.dumps(rig, indent=2))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
