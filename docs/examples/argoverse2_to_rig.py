"""A log of Argoverse 2's sensor data set as a rig: a link to its sensors, rig.json and poses.txt.

    pip install 'pyarrow<26'
    python argoverse2_to_rig.py LOG OUTPUT      # such as /data/av2/sensor/train/01bb304d-7bd8-35f8-bbef-7086b688e35e
    edge-depth-nerf process rig --root OUTPUT --output scenes/av2

Pictures are undistorted. The points of both scanners are in one file, in the vehicle's frame, corrected for its motion
to the time in the file's name, when the turn begins. Poses of one time come more than once.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pyarrow import feather


def rows(path: Path) -> list[dict[str, Any]]:
    """A table's rows, by the names of its columns."""
    return feather.read_table(path).to_pylist()


def sensor_to_vehicle(row: dict[str, Any]) -> dict[str, list[float]]:
    """The pose of a row."""
    return {
        "translation": [row[name] for name in ("tx_m", "ty_m", "tz_m")],
        "quaternion": [row[name] for name in ("qx", "qy", "qz", "qw")],
    }


def main(log: Path, output: Path) -> None:
    """Write the folder that `process rig` reads."""
    mounted = {
        row["sensor_name"]: sensor_to_vehicle(row) for row in rows(log / "calibration/egovehicle_SE3_sensor.feather")
    }
    clock = {"times_from_names": True, "time_unit": "ns"}
    cameras = {
        row["sensor_name"]: {
            **{"images": f"sensors/cameras/{row['sensor_name']}", **clock, "model": "pinhole"},
            **{"width": row["width_px"], "height": row["height_px"]},
            **{key: row[f"{key}_px"] for key in ("fx", "fy", "cx", "cy")},
            "to_vehicle": mounted[row["sensor_name"]],
        }
        for row in rows(log / "calibration/intrinsics.feather")
        # the stereo cameras are grey
        if row["sensor_name"].startswith("ring_")
    }
    scanner = {
        **{"scans": "sensors/lidar", **clock, "turn_s": 0.1, "timestamp": "start", "corrected_to": "timestamp"},
        **{"points_in": "vehicle", "to_vehicle": mounted["up_lidar"]},
    }
    lines = []
    for row in sorted(rows(log / "city_SE3_egovehicle.feather"), key=lambda row: row["timestamp_ns"]):
        seconds, nanoseconds = divmod(row["timestamp_ns"], 10**9)
        pose = sensor_to_vehicle(row)
        numbers = " ".join(map(repr, (*pose["translation"], *pose["quaternion"])))
        lines.append(f"{seconds}.{nanoseconds:09d} {numbers}\n")
    output.mkdir(parents=True, exist_ok=True)
    (output / "sensors").symlink_to((log / "sensors").resolve())
    (output / "poses.txt").write_text("".join(lines))
    rig = {"poses": {"file": "poses.txt", "format": "tum"}, "cameras": cameras, "lidars": {"lidar": scanner}}
    (output / "rig.json").write_text(json.dumps(rig, indent=2))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
