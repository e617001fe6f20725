"""A scene of nuScenes as a rig: links to its files, rig.json and poses.txt.

    python nuscenes_to_rig.py DATASET SCENE OUTPUT      # such as /data/nuscenes/v1.0-mini scene-0061 drives/scene-0061
    edge-depth-nerf process rig --root OUTPUT --output scenes/scene-0061

DATASET is the folder of the JSON tables; samples and sweeps lie beside it. Pictures are undistorted. Sweeps have been
corrected for the vehicle's motion, to the end of their turn, which is also what their times are. Each reading of a
sensor has an ego pose of its own: together they are the vehicle's path.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def sensor_to_vehicle(calibrated: dict[str, Any]) -> dict[str, list[float]]:
    """The data set's quaternions begin with w."""
    w, *xyz = calibrated["rotation"]
    return {"translation": calibrated["translation"], "quaternion": [*xyz, w]}


def camera(folder: str, reading: dict[str, Any], calibrated: dict[str, Any]) -> dict[str, Any]:
    """A camera's table of the rig file."""
    (fx, _, cx), (_, fy, cy), _ = calibrated["camera_intrinsic"]
    return {
        **{"images": folder, "times_from_names": True, "time_unit": "us", "model": "pinhole"},
        **{"width": reading["width"], "height": reading["height"], "fx": fx, "fy": fy, "cx": cx, "cy": cy},
        "to_vehicle": sensor_to_vehicle(calibrated),
    }


def scanner(folder: str, calibrated: dict[str, Any]) -> dict[str, Any]:
    """A scanner's table of the rig file."""
    return {
        **{
            "scans": folder,
            "times_from_names": True,
            "time_unit": "us",
            "columns": ["x", "y", "z", "intensity", "ring"],
        },
        **{"turn_s": 0.05, "timestamp": "end", "corrected_to": "timestamp"},
        "to_vehicle": sensor_to_vehicle(calibrated),
    }


def main(dataset: Path, name: str, output: Path) -> None:
    """Write the folder that `process rig` reads."""

    def table(what: str) -> dict[str, dict[str, Any]]:
        return {row["token"]: row for row in json.loads((dataset / f"{what}.json").read_text())}

    (scene,) = [row["token"] for row in table("scene").values() if row["name"] == name]
    samples = {token for token, row in table("sample").items() if row["scene_token"] == scene}
    sensors, calibration, ego_poses = table("sensor"), table("calibrated_sensor"), table("ego_pose")
    rig: dict[str, Any] = {"poses": {"file": "poses.txt", "format": "tum"}, "cameras": {}, "lidars": {}}
    poses = []
    for reading in table("sample_data").values():
        calibrated = calibration[reading["calibrated_sensor_token"]]
        sensor = sensors[calibrated["sensor_token"]]
        channel = sensor["channel"]
        if reading["sample_token"] not in samples or sensor["modality"] == "radar":
            continue
        if sensor["modality"] == "camera":
            rig["cameras"][channel] = camera(channel, reading, calibrated)
        else:
            rig["lidars"][channel] = scanner(channel, calibrated)
        file = (dataset.parent / reading["filename"]).resolve()
        link = output / channel / f"{reading['timestamp']}{file.suffix}"
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file)
        pose = ego_poses[reading["ego_pose_token"]]
        w, *xyz = pose["rotation"]
        poses.append((pose["timestamp"], [*pose["translation"], *xyz, w]))
    lines = [f"{time / 1e6:.6f} {' '.join(map(repr, numbers))}\n" for time, numbers in sorted(poses)]
    (output / "poses.txt").write_text("".join(lines))
    (output / "rig.json").write_text(json.dumps(rig, indent=2))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
