"""The rig.toml of an unpacked bag: what was found, and TODO lines for what was not."""

from __future__ import annotations

from collections.abc import Sequence

from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.process.bags.survey import FoundCamera, FoundScanner
from edge_depth_nerf.process.rig_file import TODO


def rig_text(
    bag: str,
    vehicle: str,
    cameras: Sequence[tuple[FoundCamera, Transform | None]],
    scanners: Sequence[tuple[FoundScanner, Transform | None]],
    poses: str | None,
) -> str:
    """The whole file.

    Args:
        bag: its name.
        vehicle: the name of the vehicle's frame.
        cameras: those that were written, with their transforms to the vehicle; None if that is not known.
        scanners: likewise.
        poses: where the poses come from; None if there are none.
    """
    lines = [f"# Made by `edge-depth-nerf unpack` from {bag}. docs/rig.md explains each key.", ""]
    if poses is None:
        lines += [
            "# The vehicle's poses were not found. Add [poses], or compute them: --poses lidar or --poses colmap."
        ]
    else:
        lines += [f"# {poses}", "[poses]", 'file = "poses.txt"', 'format = "tum"']
    for camera, to_vehicle in cameras:
        lines += ["", f"# {camera.topic.name}", f"[cameras.{camera.name}]", f'images = "images/{camera.name}"', *_CLOCK]
        lines += _lens_lines(camera)
        lines += _mounting_lines(to_vehicle, camera.frame, vehicle)
    for scanner, to_vehicle in scanners:
        lines += ["", f"# {scanner.topic.name}", f"[lidars.{scanner.name}]", f'scans = "lidar/{scanner.name}"', *_CLOCK]
        lines += _turn_lines(scanner)
        lines += _mounting_lines(to_vehicle, scanner.frame, vehicle)
    if not scanners:
        lines += [
            "",
            "# The bag has no scans. Add depth maps (docs/rig.md), or scans of another file as [lidars.NAME].",
        ]
    return "\n".join(lines) + "\n"


_CLOCK = ("times_from_names = true", 'time_unit = "ns"')


def _todo(key: str, what: str) -> str:
    return f'{key} = "{TODO}: {what}"'


def _lens_lines(camera: FoundCamera) -> list[str]:
    size = [f"width = {camera.width}", f"height = {camera.height}"]
    if isinstance(camera.lens, str):
        lacking = [("model", "mei, kannala-brandt or pinhole")]
        lacking += [(key, "focal length in pixels") for key in ("fx", "fy")]
        lacking += [(key, "principal point in pixels") for key in ("cx", "cy")]
        named = [_todo(key, what) for key, what in lacking]
        return [f"# {camera.lens}; calibrate it, and add its distortion (k1 …)", *size, *named]
    # NumPy's numbers are written otherwise
    plain = {key: value if isinstance(value, (str, int)) else float(value) for key, value in camera.lens.keys.items()}
    numbers = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}" for key, value in plain.items()]
    return ([f"# {camera.lens.note}"] if camera.lens.note else []) + numbers


def _turn_lines(scanner: FoundScanner) -> list[str]:
    note = [f"# {scanner.note}"] if scanner.note else []
    if scanner.times is not None:
        turn = [f"turn_s = {scanner.turn_s:.6f}", f'timestamp = "{scanner.timestamp}"']
        times = 'point_times = {column = "t", unit = "s", counted_from = "timestamp"}'
        return [*note, f"# from the field {scanner.times.field}, in {scanner.times.unit}", *turn, times]
    how = "clockwise or counter-clockwise, seen from above"
    return [
        *note,
        "# If a scan is a turn, fill in direction, and correct the other three lines. If its points are corrected for",
        '# the vehicle\'s motion, replace these four lines by corrected_to = "timestamp". Otherwise remove them.',
        f"turn_s = {scanner.turn_s:.6f}",
        'timestamp = "end"',
        _todo("direction", how),
        "start_azimuth_deg = 180",
    ]


def _mounting_lines(to_vehicle: Transform | None, frame: str, vehicle: str) -> list[str]:
    if to_vehicle is None:
        what = f"4 rows of 4 numbers, from its frame ({frame or 'without name'}) to the vehicle's ({vehicle})"
        return [_todo("to_vehicle", what)]
    # chains leave the last digits unsure; -0.0 is written as 0
    numbers = [[round(float(value), 12) + 0.0 for value in row] for row in to_vehicle]
    return ["to_vehicle = [", *(f"    [{', '.join(f'{value:.12g}' for value in row)}]," for row in numbers), "]"]
