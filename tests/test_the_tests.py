"""Tests can fail: none has all of its assertions in loops over data that may not be there."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
KEEPS_LENGTH = {"zip", "enumerate", "product", "reversed", "sorted", "list", "tuple", "set", "dict"}
"""What is not empty when none of what it is given is; a strict zip asks one for its length alone."""


def has_elements(node: ast.expr, known: set[str]) -> bool:
    """Whether a loop over it runs at least once, as far as its text says; `known`: names of such things."""
    if isinstance(node, ast.Starred):
        return has_elements(node.value, known)
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return any(not isinstance(each, ast.Starred) or has_elements(each, known) for each in node.elts)
    if isinstance(node, ast.Dict):
        return any(key is not None for key in node.keys)
    if isinstance(node, ast.Constant):
        return bool(node.value)
    if isinstance(node, ast.Name):
        return node.id in known
    if isinstance(node, ast.BinOp):
        either = has_elements(node.left, known) or has_elements(node.right, known)
        return isinstance(node.op, (ast.Add, ast.BitOr, ast.Mult)) and either
    if isinstance(node, (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)):
        return all(has_elements(each.iter, known) and not each.ifs for each in node.generators)
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func).rpartition(".")[2]
        if name == "range":
            return all(isinstance(each, ast.Constant) for each in node.args)
        if name in ("items", "keys", "values") and isinstance(node.func, ast.Attribute):
            return has_elements(node.func.value, known)
        strict = any(keyword.arg == "strict" for keyword in node.keywords)
        return name in KEEPS_LENGTH and (any if strict else all)([has_elements(each, known) for each in node.args])
    return False


def assigned(body: list[ast.stmt], known: set[str]) -> set[str]:
    """`known`, and names that these statements give something with elements."""
    known = set(known)
    for node in (each for statement in body for each in ast.walk(statement)):
        if isinstance(node, ast.Assign) and has_elements(node.value, known):
            known |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return known


def checks(node: ast.AST, known: set[str], certain: bool = True) -> Iterator[bool]:
    """For each check below a node whether it is certain that something is looked at."""
    if isinstance(node, ast.Assert):
        match node.test:
            case ast.Call(func=ast.Name("all"), args=[ast.GeneratorExp() as generator]):
                yield certain and has_elements(generator, known)
            case _:
                yield certain
    elif isinstance(node, ast.withitem) and re.match(r"pytest\.(raises|warns)", ast.unparse(node.context_expr)):
        yield certain
    elif isinstance(node, ast.Call) and "assert" in ast.unparse(node.func).rpartition(".")[2]:
        yield certain
    turns = isinstance(node, ast.While) or (isinstance(node, ast.For) and not has_elements(node.iter, known))
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from checks(child, known, certain and not (turns and name == "body"))


def vacuous(source: str) -> list[str]:
    """Names of the tests that pass when there is nothing to look at."""
    tree = ast.parse(source)
    outside = assigned([each for each in tree.body if isinstance(each, ast.Assign)], set())
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            known = assigned(node.body, outside)
            certain = [each for statement in node.body for each in checks(statement, known)]
            if certain and not any(certain):
                found.append(node.name)
    return found


@pytest.mark.parametrize("path", sorted(TESTS.glob("test_*.py")), ids=lambda path: path.stem)
def test_something_is_looked_at_in_every_test(path: Path) -> None:
    assert vacuous(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("for path in folder.rglob('*'):\n  assert path.is_file()", True),
        ("for path in folder.rglob('*'):\n  with pytest.raises(OSError):\n   read(path)", True),
        ("for path in folder.rglob('*'):\n  np.testing.assert_allclose(read(path), 1)", True),
        ("assert all(path.is_file() for path in folder.rglob('*'))", True),
        ("while queue:\n  assert queue.pop()", True),
        ("found = list(folder.glob('*'))\nfor path in found:\n  assert path", True),
        ("for name in ('a', 'b'):\n  for path in (folder / name).iterdir():\n   assert path", True),
        ("for name in [each for each in NAMES if each in there]:\n  assert name", True),
        ("for path in folder.rglob('*'):\n  assert path.is_file()\nassert count == 3", False),
        ("paths = list(folder.glob('*'))\nassert paths\nfor path in paths:\n  assert path", False),
        ("for name in NAMES:\n  assert name", False),
        ("for index, name in enumerate(zip(NAMES, range(3))):\n  assert name", False),
        ("for name, path in zip(NAMES, folder.iterdir(), strict=True):\n  assert path", False),
        ("for name, path in zip(NAMES, folder.iterdir()):\n  assert path", True),
        ("assert all(name for name in NAMES)", False),
        ("assert all(name in there for name in ('a', *others))", False),
        ("run(folder)", False),
    ],
)
def test_the_check_itself(body: str, found: bool) -> None:
    lines = "\n".join(f" {line}" for line in body.splitlines())
    assert vacuous(f"NAMES = ['a', 'b']\ndef test_it():\n{lines}\n") == (["test_it"] if found else [])


def test_types_are_checked_in_all_rooms_but_one():
    hooked = re.findall(r"edge_depth_nerf\.(\w+),", (TESTS.parent / "pyproject.toml").read_text(encoding="utf-8"))
    rooms = {path.parent.name for path in (TESTS.parent / "edge_depth_nerf").glob("*/__init__.py")}
    assert set(hooked) == rooms - {"synthetic"}
