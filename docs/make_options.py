"""Write docs/options.md, every option of every command and method (`python docs/make_options.py`).

Names, types, defaults and explanations are those of the dataclasses that the commands read.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import re
import textwrap
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from edge_depth_nerf import cli
from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.method.depth_losses import LOSSES
from edge_depth_nerf.plugin.config import make_specifications, read_method_file
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.plugin.model import EdgeDepthNerfModelConfig
from edge_depth_nerf.plugin.pose_refinement import PoseRefinerConfig
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainerConfig

PAGE = Path(__file__).with_name("options.md")

HEADER = """# Every option

`python docs/make_options.py` writes this page from the code; a test checks that it is current. The commands print the
same: `edge-depth-nerf COMMAND --help`, `ns-train METHOD --help`.

## The command line

`--no-motion` turns off a switch such as `--motion`. Separate several values by spaces: `--cameras image_02 image_03`.
Give words in capitals without a name.

"""

METHODS_HEADER = """## The methods

What `ns-train edge-depth-nerf`, `edge-depth-nerf-lite` and `edge-depth-nerf-paper` add to nerfstudio's nerfacto, or
set to another value. Switches take `True` or `False`. If a method has another default, the table names it.

"""

DATAPARSER = """Put these last on the line: `ns-train METHOD --data SCENE … fisheye-depth-data --metres-per-unit 10`.
nerfstudio's other methods accept them in the same way.

"""

HOSTS_OWN = """### What each method sets of nerfstudio's own

Sizes, steps and learning rates are in [nerfstudio_method.toml](../nerfstudio_method.toml).

Learning rates reach `--optimizers.….scheduler.lr-final` at the end of the training, whatever `--max-num-iterations` is;
`--optimizers.….scheduler.max-steps` sets another end. `--pipeline.model.proposal-warmup`,
`--pipeline.model.proposal-weights-anneal-max-num-iters` and `--optimizers.….scheduler.warmup-steps` below 1 are shares
of the training. From 1 on they are steps, as in nerfstudio.
"""

HOSTS = ("proposal_warmup", "proposal_weights_anneal_max_num_iters")
"""nerfstudio's options that our model declares again, to take shares."""

SHARED = "Options of all of them:\n\n"


# ---- reading dataclasses ---------------------------------------------------------------------------------------


def field_docs(cls: type) -> dict[str, str]:
    """The docstrings below the fields that a dataclass declares itself, in one line each."""
    node = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    assert isinstance(node, ast.ClassDef)
    docs = {}
    for entry, following in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name):
            text = ""
            if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                text = " ".join(str(following.value.value).split())
            docs[entry.target.id] = text
    return docs


def kind_of(hint: Any) -> str:
    """What values an option takes, in words."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return kind_of(arguments[0])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        return ", ".join(kind_of(each) for each in arguments if each is not type(None))
    if origin in (tuple, list, Mapping):
        return f"{kind_of(arguments[0])} …"
    return {bool: "switch", int: "integer", float: "number", str: "word", Path: "path"}[hint]


def shown(value: Any) -> str:
    """A default, as it is given on the command line."""
    if value is None:
        return ""
    if isinstance(value, tuple | list):
        return ", ".join(f"`{each}`" for each in value)
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def default_of(entry: dataclasses.Field) -> Any:
    """A field's default; MISSING if it must be given."""
    return entry.default_factory() if entry.default_factory is not dataclasses.MISSING else entry.default


def dashed(name: str) -> str:
    """A field's name as an option."""
    return name.replace("_", "-")


COLUMNS = ("option", "values; default", "what")


def is_marked(hint: Any, marker: Any) -> bool:
    """Whether a field has a marker of tyro's: `Positional` (given without its name) or `Suppress` (no option)."""
    return get_origin(hint) is Annotated and get_args(marker[str])[1] in get_args(hint)[1:]


def cell(text: str) -> str:
    """Text of a table's cell."""
    parts = re.split(r"(`[^`]*`)", text.replace("|", "\\|"))
    return "".join(part if part.startswith("`") else _prose(part) for part in parts)


def _prose(text: str) -> str:
    """Text outside code: nothing in it is markup, and pages are links."""
    return re.sub(r"\bdocs/(\w+\.md)", r"[\1](\1)", text.replace("<", "&lt;").replace("*", "\\*"))


def table(rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    head, *body = (f"| {' | '.join(line)} |\n" for line in [COLUMNS, *rows])
    return f"{head}|{'---|' * len(COLUMNS)}\n{''.join(body)}\n"


def values_and(default: str, hint: Any) -> str:
    """What an option takes, and its default."""
    return f"{kind_of(hint)}; {default}" if default else kind_of(hint)


# ---- our own commands ------------------------------------------------------------------------------------------


def commands(union: Any = cli.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], type]]:
    """All commands: the words that name one, and the dataclass of its options."""
    for member in get_args(union):
        cls, marker = get_args(member)[:2]
        words = (*path, marker.name)
        hints = get_type_hints(cls, include_extras=True).values()
        nested = [hint for hint in hints if is_union_of_commands(hint)]
        if nested:
            yield from commands(get_args(nested[0])[0], words)
        else:
            yield words, cls


def is_union_of_commands(hint: Any) -> bool:
    """Whether a field holds a subcommand."""
    inner = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    is_union = get_origin(inner) in (Union, types.UnionType)
    return is_union and all(get_origin(member) is Annotated for member in get_args(inner))


def option_rows(cls: type, declared_by: type) -> list[tuple[str, ...]]:
    """The options of a command that one of its dataclasses declares."""
    docs, hints = field_docs(declared_by), get_type_hints(cls, include_extras=True)
    rows: list[tuple[str, ...]] = []
    for entry in dataclasses.fields(cls):
        if entry.name not in docs or is_marked(hints[entry.name], tyro.conf.Suppress):
            continue
        default, name = default_of(entry), f"`--{dashed(entry.name)}`"
        if is_marked(hints[entry.name], tyro.conf.Positional):
            name = f"`{entry.name.upper()}`"
        elif isinstance(default, bool):
            name = f"`--{dashed(entry.name)}`, `--no-{dashed(entry.name)}`"
        needed = "needed" if default is dataclasses.MISSING else shown(default)
        if isinstance(default, bool):
            needed = "on" if default else "off"
        rows.append((name, values_and(needed, hints[entry.name]), cell(docs[entry.name])))
    return rows


def own_commands() -> str:
    """The section of `edge-depth-nerf`."""
    found = list(commands())
    groups: dict[type, list[tuple[tuple[str, ...], type]]] = {}
    for words, cls in found:
        # commands that share a dataclass have a section in common
        groups.setdefault(next(base for base in reversed(cls.__mro__) if dataclasses.is_dataclass(base)), []).append(
            (words, cls)
        )
    text = ""
    for members in groups.values():
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(words[0] for words, _ in members))
        text += f"### {names.replace('`', '`edge-depth-nerf ', 1)}\n\n"
        ancestors = [[base for base in cls.__mro__ if dataclasses.is_dataclass(base)] for _, cls in members]
        shared = [base for base in ancestors[0] if len(members) > 1 and all(base in each for each in ancestors)]
        for base in shared:
            text += SHARED + table(option_rows(members[0][1], base))
        for (words, cls), bases in zip(members, ancestors, strict=True):
            rows = [row for base in reversed(bases) if base not in shared for row in option_rows(cls, base)]
            about = " ".join((inspect.getdoc(cls) or "").split())
            text += (f"`edge-depth-nerf {' '.join(words)}`: " if len(members) > 1 else "") + cell(about) + "\n\n"
            text += table(rows) if rows else "It has no options.\n\n"
    return text


# ---- the methods -----------------------------------------------------------------------------------------------


def methods() -> str:
    """The section of what our methods add to nerfstudio."""
    configs = {name: made.config for name, made in make_specifications(read_method_file()).items()}
    groups = (
        ("The training", "", EdgeDepthTrainerConfig),
        ("The training data", "pipeline.datamanager", FisheyeDepthDataManagerConfig),
        ("The model and its loss", "pipeline.model", EdgeDepthNerfModelConfig),
        *(
            (f"The loss {name}", f"pipeline.model.losses.{name.replace('-', '_')}", kind)
            for name, kind in LOSSES.items()
        ),
        ("Poses refined in training", "pipeline.model.camera_optimizer", PoseRefinerConfig),
        ("The scene", "pipeline.datamanager.dataparser", FisheyeDepthDataParserConfig),
    )
    places = [place for _, place, _ in groups]
    text = METHODS_HEADER
    for title, place, cls in groups:
        is_parser = cls is FisheyeDepthDataParserConfig
        ours = [base for base in reversed(cls.__mro__) if base.__module__.startswith("edge_depth_nerf.")]
        docs = {name: text for base in ours for name, text in field_docs(base).items()}
        hints, rows = get_type_hints(cls, include_extras=True), []
        for entry in dataclasses.fields(cls):
            # a group of options has a table of its own
            full = f"{place}.{entry.name}".removeprefix(".")
            hidden = is_marked(hints[entry.name], tyro.conf.Suppress)
            if hidden or not docs.get(entry.name) or entry.name in ("_target", "losses", *HOSTS) or full in places:
                continue
            values = {name: at(config, full) for name, config in configs.items()}
            first = next(iter(values.values()))
            default = shown(first)
            for name, value in values.items():
                if value != first:
                    default += f"; {name.removeprefix('edge-depth-nerf-')}: {shown(value)}"
            option = f"`--{dashed(entry.name)}`" if is_parser else f"`--{dashed(full)}`"
            rows.append((option, values_and(default, hints[entry.name]), cell(docs[entry.name])))
        if rows:
            text += f"### {title}\n\n" + (DATAPARSER if is_parser else "")
            text += table(rows)
    return text + HOSTS_OWN


def at(config: Any, name: str) -> Any:
    """A value of a configuration by its dotted name."""
    for part in name.split("."):
        config = config[part] if isinstance(config, dict) else getattr(config, part)
    return config


def page() -> str:
    """The whole page."""
    return (HEADER + own_commands() + methods()).rstrip("\n") + "\n"


if __name__ == "__main__":
    argparse.ArgumentParser(description="Write docs/options.md from the code.").parse_args()
    write_text(PAGE, page())
