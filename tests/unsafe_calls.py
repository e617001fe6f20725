"""What in a module's text could run what it reads: found in its syntax tree, whatever names it imports things under."""

import ast
import builtins
from collections.abc import Iterator

MODULES = {
    *("pickle", "_pickle", "cPickle", "pickle5", "dill", "cloudpickle", "joblib", "marshal", "shelve", "jsonpickle"),
    *("runpy", "code", "codeop", "pty", "imp", "torch.package", "pandas.io.pickle", "importlib.machinery"),
}
"""Which nothing of is used."""
NAMES = {
    *(f"builtins.{name}" for name in ("eval", "exec", "compile", "__import__")),
    *(f"os.{name}" for name in ("system", "popen", "startfile")),
    *(f"os.{name}{form}" for name in ("exec", "spawn") for form in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
    *("subprocess.getoutput", "subprocess.getstatusoutput", "asyncio.create_subprocess_shell"),
    *("torch.load", "torch.serialization.load", "torch.jit.load", "torch.export.load", "torch.hub.load"),
    *("torch.hub.load_state_dict_from_url", "torch.classes.load_library", "torch.ops.load_library"),
    *(f"yaml.{kind}load{all_}" for kind in ("", "unsafe_", "full_") for all_ in ("", "_all")),
    *("yaml.Loader", "yaml.UnsafeLoader", "yaml.FullLoader", "yaml.CLoader", "yaml.CUnsafeLoader", "yaml.CFullLoader"),
    *("pandas.read_pickle", "pandas.eval", "importlib.__import__"),
    *("importlib.util.spec_from_file_location", "importlib.util.spec_from_loader", "importlib.util.module_from_spec"),
}
METHODS = {"read_pickle", "to_pickle", "unsafe_load", "full_load", "exec_module", "load_module"}
"""Unsafe of whatever object."""
READERS = {"numpy.load", "numpy.lib.npyio.load", "numpy.lib.npyio.NpzFile", "numpy.lib.format.read_array"}
"""Safe with allow_pickle=False."""
IMPORTER = "importlib.import_module"
FALSE_ALONE = {"allow_pickle", "shell", "trust_remote_code"}
TRUE_ALONE = {"weights_only"}
ROOTS = {name.partition(".")[0] for name in (*MODULES, *NAMES)} | {"numpy", "importlib"}


def within(name: str, modules: set[str]) -> bool:
    return any(name == module or name.startswith(f"{module}.") for module in modules)


def is_constant(node: ast.expr | None, value: bool) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


class Names:
    """What names stand for, as dotted origins: from imports anywhere in the module, and from plain assignments."""

    def __init__(self, tree: ast.AST) -> None:
        self._origins: dict[str, set[str]] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for each in node.names:
                    whole = each.name if each.asname else each.name.partition(".")[0]
                    self._origins.setdefault(each.asname or whole, set()).add(whole)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                for each in node.names:
                    self._origins.setdefault(each.asname or each.name, set()).add(f"{node.module}.{each.name}")
        before = -1
        while (count := sum(map(len, self._origins.values()))) != before:  # a name of a name of a name
            before = count
            for node in ast.walk(tree):
                value = node.value if isinstance(node, (ast.Assign, ast.AnnAssign, ast.NamedExpr)) else None
                if value is not None:
                    for target in node.targets if isinstance(node, ast.Assign) else [node.target]:  # pyright: ignore
                        if isinstance(target, ast.Name) and (found := self.of(value)):
                            self._origins.setdefault(target.id, set()).update(found)

    def of(self, node: ast.expr) -> set[str]:
        """All that an expression may stand for; empty where its text does not say."""
        if isinstance(node, ast.Name):
            found = self._origins.get(node.id, set())
            return found or ({f"builtins.{node.id}"} if hasattr(builtins, node.id) else set())
        if isinstance(node, ast.Attribute):
            return {f"{each}.{node.attr}" for each in self.of(node.value)}
        if isinstance(node, ast.Call) and self.of(node.func) == {"builtins.getattr"} and len(node.args) > 1:
            name = node.args[1]
            if isinstance(name, ast.Constant):
                return {f"{each}.{name.value}" for each in self.of(node.args[0])}
        if isinstance(node, ast.Call) and self.of(node.func) == {IMPORTER} and node.args:
            name = node.args[0]
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                return {name.value}
        return set()


def _of_a_call(node: ast.Call, names: Names, may_import: bool) -> Iterator[str]:
    called, given = names.of(node.func), {keyword.arg: keyword.value for keyword in node.keywords}
    if called & READERS and not (is_constant(given.get("allow_pickle"), False) and len(node.args) < 3):
        yield f"{min(called & READERS)} without allow_pickle=False"
    if IMPORTER in called and not may_import:
        name = node.args[0] if node.args else given.get("name")
        if not (isinstance(name, ast.Constant) and isinstance(name.value, str)):
            yield "a module by a name that is not written out"
        elif within(name.value, MODULES):
            yield name.value
    if called == {"builtins.getattr"} and len(node.args) > 1 and not isinstance(node.args[1], ast.Constant):
        for origin in names.of(node.args[0]):
            if within(origin, ROOTS - {"code"}):
                yield f"an attribute of {origin} by a name that is not written out"
    for name, value in given.items():
        if (name in FALSE_ALONE and not is_constant(value, False)) or (
            name in TRUE_ALONE and not is_constant(value, True)
        ):
            yield f"{name}={ast.unparse(value)}"


def unsafe(source: str, may_import: bool = False) -> list[str]:
    """What a module must not use.

    Args:
        source: its text.
        may_import: whether it imports modules by names that are not written out.
    """
    tree = ast.parse(source)
    names = Names(tree)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    found: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [each.name for each in node.names if within(each.name, MODULES)]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            whole = [f"{node.module}.{each.name}" for each in node.names]
            found += [name for name in whole if within(name, MODULES | NAMES)]
            if any(each.name == "*" for each in node.names) and within(node.module or "", ROOTS):
                found.append(f"all of {node.module}")
        elif isinstance(node, (ast.Name, ast.Attribute)) and isinstance(node.ctx, ast.Load):
            origins = names.of(node)
            found += [name for name in origins if within(name, MODULES | NAMES)]
            if isinstance(node, ast.Attribute) and node.attr in METHODS:
                found.append(f"….{node.attr}")
            # handed on instead of called, nobody knows with what
            if id(node) not in called:
                found += [name for name in origins if name in {IMPORTER, *READERS}]
        elif isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                if isinstance(key, ast.Constant) and key.value in FALSE_ALONE and not is_constant(value, False):
                    found.append(f"{key.value}: {ast.unparse(value)}")
        elif isinstance(node, ast.Call):
            found += [name for name in names.of(node) if within(name, MODULES | NAMES)]
            found += _of_a_call(node, names, may_import)
    return found
