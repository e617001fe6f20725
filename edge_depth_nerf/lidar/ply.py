"""Point clouds as PLY files: binary, little-endian."""

from __future__ import annotations

from numpy.typing import NDArray

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort"}


def ply_bytes(rows: NDArray) -> bytes:
    """Encode points. The fields of `rows` are the properties, in their order."""
    fields = [(name, _TYPES[rows.dtype[name].str[1:]]) for name in rows.dtype.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, kind in fields]
    return "\n".join([*header, "end_header\n"]).encode() + rows.tobytes()
