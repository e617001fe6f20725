"""Cameras by the names that their models have in files."""

from __future__ import annotations

import dataclasses
from typing import Any

from edge_depth_nerf.base.bounds import finite, shown
from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.cameras.models import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.wide import EUCM, DoubleSphere, OCam

_MODELS: dict[str, type[Camera]] = {
    camera.model: camera for camera in (MEI, KannalaBrandt, Pinhole, DoubleSphere, EUCM, OCam)
}


def camera_from_dict(parameters: dict[str, Any], where: str) -> Camera:
    """Build the camera that `Camera.to_dict` described.

    Raises:
        InputError: the model is unknown, a field is missing, unknown, or not a usable number.
    """
    name = parameters.get("model")
    if not isinstance(name, str) or name not in _MODELS:
        raise InputError(f"{where}: unknown camera model {name!r}, expected one of {', '.join(_MODELS)}.")
    model = _MODELS[name]
    fields = dataclasses.fields(model)
    given = parameters.keys() - {"model"}
    missing = [f.name for f in fields if f.name not in given and f.default is dataclasses.MISSING]
    unknown = sorted(given - {f.name for f in fields})
    if missing or unknown:
        faults = [f"lacks {', '.join(missing)}"] if missing else []
        faults += [f"has unknown {', '.join(unknown)}"] if unknown else []
        expected = ", ".join(f.name for f in fields)
        raise InputError(f"{where}: the {name} camera {' and '.join(faults)}; expected {expected}.")
    numbers = {}
    for key in given:
        value, whole = finite(parameters[key]), key in ("width", "height")
        # a file may hold 700 for 700.0
        if value is None or (whole and value % 1 != 0):
            kind = "a whole number" if whole else "a finite number"
            raise InputError(f"{where}: {key} of the {name} camera is {shown(parameters[key])}, expected {kind}.")
        numbers[key] = int(value) if whole else value
    with found_in(where):
        return model(**numbers)
