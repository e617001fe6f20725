"""Check that pages, messages and docstrings are in plain English: `python docs/check_prose.py`; `make lint` runs it.

The rules are in docs/prose_rules.toml: patterns that must not occur, with the words to use instead, and the longest
sentence. Code and addresses are left out. In the package's modules, docstrings are checked like pages, and other
strings of four words or more are checked as messages; docs/options.md contains the help texts. The names of modules,
classes, functions, arguments and attributes must not contain the words of `identifiers`. vale, the usual program for
this, is not used, because its wheel downloads the program when it first runs.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyrefly: ignore[missing-import]

ROOT = Path(__file__).resolve().parents[1]
RULES = Path(__file__).with_name("prose_rules.toml")
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "data/README.md", "benchmarks/README.md", "docs/*.md")
MODULES = "edge_depth_nerf/**/*.py"
LEAST_WORDS = 4
"""Strings of a module with fewer words are names and keys, not messages."""
NAME_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
LIST_ITEM = re.compile(r" *(?:[-*]|\d+\.) +")
SENTENCE_END = re.compile(r"[.!?:;][)\"*]*\s+")
OFF, ON = "<!-- prose: off -->", "<!-- prose: on -->"
"""Lines between these comments are examples of what not to write."""


@dataclass(frozen=True)
class Text:
    """A paragraph of a page or docstring, or a message."""

    line: int
    words: str
    is_message: bool = False


def without_code(line: str) -> str:
    """A line of Markdown without what is code, an address or a comment."""
    line = re.sub(r"`[^`]*`", "CODE", line)
    line = re.sub(r"<!--.*?-->|<[^>]+>", "", line)
    return re.sub(r"\]\([^)]*\)", "]", line)


def paragraphs(markdown: str) -> Iterator[Text]:
    """Paragraphs, list items, headings and cells of tables, each on one line, without code."""
    fenced = quoted = is_off = False
    begin, held = 0, ""
    for number, line in enumerate([*markdown.splitlines(), ""], 1):
        if line.strip() in (OFF, ON):
            is_off = line.strip() == OFF
        line = "" if is_off else line
        if line.lstrip().startswith("```"):
            fenced = not fenced
        quoted = line.startswith("    ") and not held
        is_row = line.lstrip().startswith("|")
        ends = fenced or quoted or is_row or not line.strip() or LIST_ITEM.match(line) or line.startswith(("#", "```"))
        if ends and held:
            yield Text(begin, without_code(held))
            held = ""
        if is_row and not fenced:
            yield from (Text(number, without_code(cell.strip())) for cell in line.split("|") if cell.strip())
        elif line.strip() and not fenced and not quoted and not line.lstrip().startswith("```"):
            begin, held = (begin, f"{held} {line.strip()}") if held else (number, line.strip())


def messages(source: str) -> Iterator[Text]:
    """The strings of a module that people read, an f-string's values left out."""
    nodes = [*ast.walk(ast.parse(source))]
    joined = [node for node in nodes if isinstance(node, ast.JoinedStr)]
    apart = {node.value for node in nodes if isinstance(node, ast.Expr)}
    apart.update(part for node in joined for part in node.values)
    for node in joined:
        words = "VALUE".join(str(part.value) for part in node.values if isinstance(part, ast.Constant))
        if len(words.split()) >= LEAST_WORDS:
            yield Text(node.lineno, without_code(words), is_message=True)
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in apart:
            if len(node.value.split()) >= LEAST_WORDS:
                yield Text(node.lineno, without_code(node.value), is_message=True)


def docstrings(source: str) -> Iterator[Text]:
    """The paragraphs of a module's docstrings, those of attributes included."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            for text in paragraphs(inspect.cleandoc(node.value.value)):
                yield Text(node.lineno + text.line - 1, text.words)


def identifiers(path: Path) -> Iterator[Text]:
    """The names that a module defines, and its own; names within a function are left out, except its arguments."""
    yield Text(1, path.stem)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield Text(node.lineno, node.name)
        elif isinstance(node, ast.arg):
            yield Text(node.lineno, node.arg)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield Text(node.lineno, node.attr)
        if isinstance(node, ast.Module | ast.ClassDef):
            assigned = [one for one in node.body if isinstance(one, ast.Assign | ast.AnnAssign)]
            names = [one for each in assigned for one in ast.walk(each) if isinstance(one, ast.Name)]
            yield from (Text(name.lineno, name.id) for name in names if isinstance(name.ctx, ast.Store))


def faults_of_name(name: str, rules: dict[str, Any]) -> Iterator[str]:
    """What the rules have against an identifier: patterns are searched in its words, joined by _."""
    words = "_".join(NAME_WORD.findall(name)).lower()
    for rule in rules.get("identifiers", []):
        if re.search(rf"(?:^|_)(?:{rule['pattern']})(?:_|$)", words) and name not in rule.get("allowed", []):
            yield f"the name {name}: write {rule['instead']}"


def texts(path: Path) -> Iterator[Text]:
    """Everything that people read in a page or module."""
    content = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        yield from paragraphs(content)
    else:
        yield from docstrings(content)
        yield from messages(content)


def faults(text: Text, rules: dict[str, Any]) -> Iterator[str]:
    """What the rules have against a text."""
    for rule in rules["rules"]:
        found = re.search(rule["pattern"], text.words, re.IGNORECASE)
        if found:
            yield f"“{found[0]}”: write {rule['instead']}"
    most = rules["sentences"]["most_words"]
    for sentence in SENTENCE_END.split(text.words) if not text.is_message else ():
        words = sentence.split()
        if len(words) > most:
            yield f"a sentence of {len(words)} words, more than {most}: “{' '.join(words[:8])} …”"


def main(root: Path = ROOT) -> int:
    """Print what is wrong; how many faults there are."""
    rules = tomllib.loads(RULES.read_text(encoding="utf-8"))
    found = 0
    for pattern in (*PAGES, MODULES):
        for path in sorted(root.glob(pattern)):
            for text in texts(path):
                for fault in faults(text, rules):
                    print(f"{path.relative_to(root)}:{text.line}: {fault}")
                    found += 1
            for name in identifiers(path) if pattern == MODULES else ():
                for fault in faults_of_name(name.words, rules):
                    print(f"{path.relative_to(root)}:{name.line}: {fault}")
                    found += 1
    print(f"{found} faults" if found else "The prose is plain.")
    return found


if __name__ == "__main__":
    sys.exit(min(main(), 1))
