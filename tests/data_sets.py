"""A drive through an empty hall in the layouts of nuScenes, Argoverse 2 and DDAD, with every distance in closed form.

The vehicle (x forward, y left, z up) drives at 10 m/s and turns, so that a wrong time or a wrong pose shows. Cameras
are pinholes without distortion; sweeps are corrected to the frame that their data set says.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_distance_png

HALL = np.array([[-25.0, -9.0, -0.3], [45.0, 12.0, 5.0]])
FIRST_S = 1_532_402_927
FRAMES = 6
INTERVAL_S = 0.1
WIDTH, HEIGHT, FOCAL = 96, 64, 50.0
CENTRE = (47.0, 31.5)
"""The first pixel's centre is 0."""
CAMERAS = {"front": (0.0, (1.6, 0.0, 1.4)), "side": (75.0, (1.2, 0.3, 1.5))}
"""Heading in the vehicle, degrees to the left, and place."""
SCANNER = (90.0, (1.0, 0.1, 1.9))
CAMERA_DELAY_S = {"front": 0.013, "side": 0.004}
COLUMNS, TURN_S = 360, 0.1
"""Of a turn of the scanner."""
OFF = np.array([600.0, 1500.0, 0.0])
"""Worlds of data sets lie far from their origins."""


def rigid(rotation: Rotation, place: Any) -> NDArray[np.float64]:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation.as_matrix(), place
    return made


def vehicle(time_s: float) -> NDArray[np.float64]:
    """To the world, without its offset; 10 m/s, turning to the left."""
    heading = 0.2 + 0.4 * time_s
    place = [25 * (np.sin(heading) - np.sin(0.2)), -25 * (np.cos(heading) - np.cos(0.2)), 0]
    return rigid(Rotation.from_euler("z", heading), place)


def to_vehicle(sensor: str) -> NDArray[np.float64]:
    yaw_deg, place = CAMERAS.get(sensor, SCANNER)
    turn = Rotation.from_euler("z", yaw_deg, degrees=True)
    if sensor in CAMERAS:
        # right, down, ahead
        turn *= Rotation.from_matrix(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float))
    return rigid(turn, place)


def reach(origin: NDArray, rays: NDArray) -> NDArray:
    """Distance along unit rays to the walls."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (np.where(rays > 0, HALL[1], HALL[0]) - origin) / rays
    return np.where(rays == 0, np.inf, along).min(-1)


def camera_time(name: str, number: int) -> float:
    return number * INTERVAL_S + CAMERA_DELAY_S[name]


def true_distance(name: str, number: int) -> NDArray:
    """Of each pixel's centre."""
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack(((column - CENTRE[0]) / FOCAL, (row - CENTRE[1]) / FOCAL, np.ones((HEIGHT, WIDTH))), -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    to_world = vehicle(camera_time(name, number)) @ to_vehicle(name)
    return reach(to_world[:3, 3], rays @ to_world[:3, :3].T)


def check_walls(scene: Path, cameras: dict[str, str], true: Callable[[str, int], NDArray] = true_distance) -> None:
    """LiDAR of a scene's cameras, by their names here, lies on the walls: anywhere in its pixel, 1.1° wide."""
    for camera, name in cameras.items():
        for number in range(FRAMES):
            lidar = read_distance_png(scene / f"lidar/{camera}/{number:010d}.png")
            there = lidar > 0
            assert there.mean() > 0.1
            errors = (lidar / true(name, number) - 1)[there]
            # the floor is flat: on the whole that cancels
            assert abs(np.median(errors)) < 0.002 and np.mean(np.abs(errors) < 0.04) > 0.9


def picture(name: str, number: int) -> NDArray[np.uint8]:
    shade = np.clip(true_distance(name, number) * 8, 0, 255).astype(np.uint8)
    return np.stack((shade, 255 - shade, shade // 2), -1).astype(np.uint8)


def beams(azimuth: NDArray, elevation: NDArray) -> NDArray:
    """Unit directions in a scanner, N×3, of angles in radians."""
    flat = np.cos(elevation)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), -1).reshape(-1, 3)


def points(time_s: float, frame: NDArray) -> NDArray:
    """What the scanner hits at a time, in a frame given by its pose on the vehicle."""
    rays = beams(*np.meshgrid(np.linspace(0, 2 * np.pi, 500, endpoint=False), np.linspace(-0.5, 0.3, 40)))
    to_world = vehicle(time_s) @ to_vehicle("scanner")
    in_world = rays @ to_world[:3, :3].T
    hits = to_world[:3, 3] + in_world * reach(to_world[:3, 3], in_world)[:, None]
    back = np.linalg.inv(vehicle(time_s) @ frame)
    return hits @ back[:3, :3].T + back[:3, 3]


@cache
def turn(start_s: float) -> tuple[NDArray, NDArray]:
    """A turn that starts at a time: points where the scanner was when it measured them, and seconds from the start."""
    azimuths = np.pi - np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    elevations = np.linspace(-0.5, 0.3, 40)
    offsets = np.arange(COLUMNS) / COLUMNS * TURN_S
    points = []
    for azimuth, offset in zip(azimuths, offsets, strict=True):
        rays = beams(np.full(len(elevations), azimuth), elevations)
        to_world = vehicle(start_s + offset) @ to_vehicle("scanner")
        points.append(rays * reach(to_world[:3, 3], rays @ to_world[:3, :3].T)[:, None])
    return np.concatenate(points), np.repeat(offsets, len(elevations))


def quaternion_w_first(pose: NDArray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [w, x, y, z]


def write_picture(path: Path, name: str, number: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture(name, number)[..., ::-1])


def readings(turn_s: float = INTERVAL_S) -> list[tuple[str, int, float]]:
    """Sensor, number, seconds from the first."""
    taken = [(name, number, camera_time(name, number)) for name in CAMERAS for number in range(FRAMES)]
    turns = round(FRAMES * INTERVAL_S / turn_s)
    return taken + [("scanner", number, number * turn_s) for number in range(turns)]


@dataclass
class Tables:
    """nuScenes' tables: rows with tokens."""

    rows: dict[str, list[dict[str, Any]]]

    def add(self, table: str, **values: Any) -> str:
        token = f"{table}-{len(self.rows.setdefault(table, []))}"
        self.rows[table].append({"token": token, **values})
        return token


def nuscenes(root: Path) -> Path:
    """Write the data set; give the folder of its tables. There is a second scene, of which nothing is to be taken."""
    tables = Tables({})
    channels = {"front": "CAM_FRONT", "side": "CAM_FRONT_LEFT", "scanner": "LIDAR_TOP"}
    calibrated = {}
    for name, channel in channels.items():
        sensor = tables.add("sensor", channel=channel, modality="camera" if name in CAMERAS else "lidar")
        matrix = [[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]] if name in CAMERAS else []
        pose = to_vehicle(name)
        calibrated[name] = tables.add(
            "calibrated_sensor",
            sensor_token=sensor,
            translation=pose[:3, 3].tolist(),
            rotation=quaternion_w_first(pose),
            camera_intrinsic=matrix,
        )
    radar = tables.add("sensor", channel="RADAR_FRONT", modality="radar")
    calibrated["radar"] = tables.add(
        "calibrated_sensor", sensor_token=radar, translation=[0, 0, 0], rotation=[1, 0, 0, 0]
    )
    for scene_name in ("scene-0001", "scene-0061"):
        scene = tables.add("scene", name=scene_name, description="")
        samples = [
            tables.add("sample", timestamp=FIRST_S * 10**6 + number * 10**5, scene_token=scene)
            for number in range(FRAMES)
        ]
        for name, number, seconds in [*readings(0.05), ("radar", 0, 0.0)]:
            time_us = FIRST_S * 10**6 + round(seconds * 1e6)
            if scene_name == "scene-0001":
                time_us -= 10**9
            pose = vehicle(seconds)
            ego = tables.add(
                "ego_pose",
                timestamp=time_us,
                rotation=quaternion_w_first(pose),
                translation=(pose[:3, 3] + OFF).tolist(),
            )
            folder = "samples" if number % 2 == 0 else "sweeps"
            channel = channels.get(name, "RADAR_FRONT")
            suffix = "jpg" if name in CAMERAS else "pcd.bin"
            file = f"{folder}/{channel}/n015-2018-07-24-11-22-45+0800__{channel}__{time_us}.{suffix}"
            tables.add(
                "sample_data",
                **{
                    "sample_token": samples[number % FRAMES],
                    "ego_pose_token": ego,
                    "timestamp": time_us,
                    "filename": file,
                },
                **{"calibrated_sensor_token": calibrated[name], "is_key_frame": folder == "samples"},
                **{"width": WIDTH if name in CAMERAS else 0, "height": HEIGHT if name in CAMERAS else 0},
            )
            if name in CAMERAS:
                write_picture(root / file, name, number)
            elif name == "scanner":
                hits = points(seconds, to_vehicle("scanner"))
                record = np.column_stack((hits, np.full((len(hits), 2), 7.0))).astype("<f4")
                (root / file).parent.mkdir(parents=True, exist_ok=True)
                (root / file).write_bytes(record.tobytes())
    (root / "v1.0-mini").mkdir()
    for table, rows in tables.rows.items():
        (root / f"v1.0-mini/{table}.json").write_text(json.dumps(rows))
    return root / "v1.0-mini"


def argoverse2(root: Path) -> Path:
    """Write a log; give its folder."""
    import pyarrow
    from pyarrow import feather

    def write(path: Path, **columns: Any) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        feather.write_feather(pyarrow.table(columns), str(path), compression="lz4")

    def pose_columns(poses: list[NDArray]) -> dict[str, NDArray]:
        quaternions = np.array([quaternion_w_first(pose) for pose in poses])
        places = np.array([pose[:3, 3] for pose in poses])
        named = {f"q{axis}": quaternions[:, number] for number, axis in enumerate("wxyz")}
        return named | {f"t{axis}_m": places[:, number] for number, axis in enumerate("xyz")}

    log, first_ns = root / "01bb304d-7bd8-35f8-bbef-7086b688e35e", 315_967_787_000_000_000
    names = {"front": "ring_front_center", "side": "ring_front_left", "scanner": "up_lidar"}
    mounted = [to_vehicle(name) for name in names]
    # a stereo camera, whose folder is not taken
    write(
        log / "calibration/egovehicle_SE3_sensor.feather",
        sensor_name=[*names.values(), "stereo_front_left", "down_lidar"],
        **pose_columns([*mounted, mounted[0], mounted[2]]),
    )
    lenses = ["ring_front_center", "ring_front_left", "stereo_front_left"]
    lens = {"fx_px": FOCAL, "fy_px": FOCAL, "cx_px": CENTRE[0], "cy_px": CENTRE[1], "k1": -0.2, "k2": -0.1, "k3": 0.3}
    write(
        log / "calibration/intrinsics.feather",
        sensor_name=lenses,
        **{key: [value] * 3 for key, value in lens.items()},
        **{"height_px": [HEIGHT] * 3, "width_px": [WIDTH] * 3},
    )
    times_s = sorted(seconds for _, _, seconds in readings())
    poses = [rigid(Rotation.from_matrix(vehicle(t)[:3, :3]), vehicle(t)[:3, 3] + OFF) for t in times_s]
    # one nanosecond apart, and in no order
    times_ns = [first_ns + round(seconds * 1e9) for seconds in times_s]
    order = np.random.default_rng(0).permutation(2 * len(poses))
    stamps = np.array([*times_ns, *(time + 1 for time in times_ns)])
    twice = [*poses, *poses]
    write(
        log / "city_SE3_egovehicle.feather",
        timestamp_ns=stamps[order],
        **pose_columns([twice[index] for index in order]),
    )
    for name, number, seconds in readings():
        stamp = first_ns + round(seconds * 1e9)
        if name in CAMERAS:
            write_picture(log / f"sensors/cameras/{names[name]}/{stamp}.jpg", name, number)
            continue
        hits = points(seconds, np.eye(4)).astype(np.float16)
        write(
            log / f"sensors/lidar/{stamp}.feather",
            **{axis: hits[:, number] for number, axis in enumerate("xyz")},
            intensity=np.full(len(hits), 7, np.uint8),
            laser_number=np.zeros(len(hits), np.uint8),
            offset_ns=np.linspace(0, 1e8, len(hits)).astype(np.int32),
        )
    return log


def ddad(root: Path) -> Path:
    """Write a scene; give its folder."""
    scene = root / "000000"
    names = {"front": "CAMERA_01", "side": "CAMERA_05", "scanner": "LIDAR"}

    def pose_entry(pose: NDArray) -> dict[str, dict[str, float]]:
        values = dict(zip(("qw", "qx", "qy", "qz"), quaternion_w_first(pose), strict=True))
        place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
        # what is zero is left out, as protocol buffers do
        return {
            "rotation": {key: value for key, value in values.items() if value != 0},
            "translation": {key: value for key, value in place.items() if value != 0},
        }

    data = []
    for name, number, seconds in readings():
        world = vehicle(seconds) @ to_vehicle(name)
        world[:3, 3] += OFF
        # its dates take counts of 0.1 µs for µs, and lie in the year 2455
        time_us = FIRST_S * 10**7 + round(seconds * 1e7)
        stamp = datetime.fromtimestamp(time_us // 10**6, timezone.utc).replace(microsecond=time_us % 10**6)
        identity = {"log": "", "name": names[name], "timestamp": stamp.isoformat().replace("+00:00", "Z"), "index": "0"}
        datum: dict[str, Any] = {"annotations": {}, "metadata": {}, "pose": pose_entry(world)}
        if name in CAMERAS:
            datum |= {"filename": f"rgb/{names[name]}/{time_us}.png", "width": WIDTH, "height": HEIGHT, "channels": 3}
            write_picture(scene / datum["filename"], name, number)
            data.append({"id": identity, "key": "", "datum": {"image": datum}})
            continue
        datum |= {"filename": f"point_cloud/LIDAR/{time_us}.npz", "point_format": ["X", "Y", "Z", "INTENSITY"]}
        hits = points(seconds, to_vehicle("scanner"))
        (scene / datum["filename"]).parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(
            scene / datum["filename"], data=np.column_stack((hits, np.full(len(hits), 7.0))).astype(np.float32)
        )
        data.append({"id": identity, "key": "", "datum": {"point_cloud": datum}})
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1], "skew": 0.0}
    calibration = {
        "names": [*names.values()],
        "intrinsics": [lens if name in CAMERAS else {} for name in names],
        "extrinsics": [pose_entry(to_vehicle(name)) for name in names],
    }
    (scene / "calibration").mkdir()
    (scene / "calibration/0a6f.json").write_text(json.dumps(calibration))
    content = {"name": "", "data": data, "samples": [{"calibration_key": "0a6f", "datum_keys": []}]}
    (scene / "scene_a8dc.json").write_text(json.dumps(content))
    return scene
