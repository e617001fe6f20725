"""Reads the dataparser's settings from a training's config.yml, without executing anything in the file.

nerfstudio's own commands load that file with yaml.Loader, which builds any class and calls any function that it names
(PyYAML's python tags). This module only parses the file into nodes. It then takes the settings of a known dataparser
from them, and checks each against its type.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any, get_type_hints

from edge_depth_nerf.base.bounds import read_text, shown
from edge_depth_nerf.base.errors import InputError

MAX_CONFIG_BYTES = 1 << 15
"""Larger files are refused. nerfstudio writes about 10 kB; the parser needs up to a third of a second for the limit."""
MAX_DEPTH = 40
"""Deeper nesting is refused. nerfstudio's files are about 10 deep; the parser's time grows with the depth's square."""
MAX_NODES = 5000
"""Files with more names, values and lists are refused. nerfstudio's have about 500."""
_PYTHON = "tag:yaml.org,2002:python/"
_HINT = "--load-config takes the config.yml that ns-train wrote"


def read_dataparser(path: Path) -> Any:
    """Read the dataparser's settings of a training.

    Returns:
        A `FisheyeDepthDataParserConfig` or nerfstudio's `NerfstudioDataParserConfig`, with `data` set.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not YAML, is not a training's config.yml, or has another dataparser.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from pydantic import ConfigDict, TypeAdapter, ValidationError
    from yaml import YAMLError

    from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig

    if not path.is_file():
        raise FileNotFoundError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}. {_HINT}.")
    known = {
        f"{kind.__module__}.{kind.__name__}": kind
        for kind in (FisheyeDepthDataParserConfig, NerfstudioDataParserConfig)
    }
    try:
        root = _compose(read_text(path, MAX_CONFIG_BYTES))
    except (YAMLError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({' '.join(str(error).split())}). {_HINT}.") from None
    manager = _child(_child(root, "pipeline"), "datamanager")
    if manager is None or not re.fullmatch(rf"{_PYTHON}object:[\w.]*TrainerConfig", root.tag):
        raise InputError(f"{path}: this is not the config.yml of a training. {_HINT}.")
    node = _child(manager, "dataparser")
    name = node.tag.removeprefix(f"{_PYTHON}object:") if node is not None else "none"
    if name not in known:
        raise InputError(
            f"{path}: its dataparser is {shown(name)}, expected one of {', '.join(known)}. Train with "
            "fisheye-depth-data or nerfstudio-data."
        )
    settings: dict[str, Any] = {}
    hints, strictly = get_type_hints(known[name]), ConfigDict(strict=True, allow_inf_nan=False)
    for field in dataclasses.fields(known[name]):
        found = _child(node, field.name)
        if found is None or field.name == "_target":
            continue
        value = _value(found)
        try:
            settings[field.name] = TypeAdapter(hints[field.name], config=strictly).validate_python(value)
        except ValidationError:
            raise InputError(
                f"{path}: dataparser.{field.name} is {shown(value)}, which is not a valid value. {_HINT}."
            ) from None
    data = _value(_child(manager, "data"))
    return known[name](**{**settings, **({"data": data} if isinstance(data, Path) else {})})  # pyrefly: ignore


def _compose(text: str) -> Any:
    """Parse a YAML document into nodes. Stop at more than `MAX_NODES` nodes or `MAX_DEPTH` levels."""
    import yaml

    class Shallow(yaml.SafeLoader):
        depth = nodes = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.depth, self.nodes = self.depth + 1, self.nodes + 1
            if self.nodes > MAX_NODES:
                raise yaml.YAMLError(f"it has more than {MAX_NODES} names and values")
            if self.depth > MAX_DEPTH:
                raise yaml.YAMLError(f"nested more than {MAX_DEPTH} deep")
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    return yaml.compose(text, Loader=Shallow)


def _child(node: Any, key: str) -> Any:
    """Return the node under a key of a mapping, or None."""
    if node is None or node.id != "mapping":
        return None
    return next((value for name, value in node.value if name.id == "scalar" and name.value == key), None)


class _Unknown:
    """Stands for a value that is neither plain nor a path, or a number larger than any setting."""


def _value(node: Any) -> Any:
    """Convert a node to a plain value, a path or a list of plain values."""
    from yaml.constructor import ConstructorError, SafeConstructor

    if node is None:
        return None
    if node.id == "scalar" and not node.tag.startswith(_PYTHON):
        try:
            found = SafeConstructor().construct_object(node)
            return _Unknown() if isinstance(found, int) and abs(found) >= 2**31 else found
        except (ConstructorError, ValueError):
            return _Unknown()
    if node.id != "sequence" or len(node.value) > 100 or any(item.id != "scalar" for item in node.value):
        return _Unknown()
    items = [_value(item) for item in node.value]
    if re.fullmatch(rf"{_PYTHON}object/apply:pathlib[\w.]*\.\w*Path", node.tag):
        text = all(isinstance(item, str) and "\0" not in item for item in items)
        return Path(*items) if text else _Unknown()
    return tuple(items) if node.tag == f"{_PYTHON}tuple" else items
