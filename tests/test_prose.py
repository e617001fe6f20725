"""The prose rules, by which `make lint` checks all texts: they refuse riddles of former pages, and nothing else."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def prose() -> ModuleType:
    specification = importlib.util.spec_from_file_location("check_prose", ROOT / "docs/check_prose.py")
    assert specification and specification.loader
    module = importlib.util.module_from_spec(specification)
    sys.modules["check_prose"] = module  # dataclasses look themselves up there
    specification.loader.exec_module(module)
    return module


def test_the_linters_check_pages_messages_and_docstrings(prose):
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert lint and "docs/check_prose.py" in lint[1]
    for pattern in (*prose.PAGES, prose.MODULES):
        assert [*ROOT.glob(pattern)], pattern


@pytest.mark.parametrize(
    "riddle",
    [
        "Whoever has a nerfstudio scene already trains on it as it is.",
        "Stopped with Ctrl-C, the same command goes on.",
        "Not searched for features: what lies further than 85° from a lens's axis.",
        "Much less, or none, means that a clock is wrong; as much does not mean that they are right.",
        "On a rendered street one in a thousand of its returns is wrong.",
        "It is held to the real geometry by LiDAR.",
        "With neither, a scan is taken as of one moment, and you are told so.",
        "Without them the figure is left out, and said so.",
        "Trained, it waits for you to look.",
    ],
)
def test_a_riddle_in_a_page_is_refused(prose, tmp_path, capsys, riddle):
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs/page.md"
    page.write_text(f"# Title\n\nThis sentence is plain. {riddle}\n", encoding="utf-8")
    assert prose.main(tmp_path) > 0
    assert "docs/page.md:3: " in capsys.readouterr().out
    page.write_text("# Title\n\nThis sentence is plain.\n", encoding="utf-8")
    assert prose.main(tmp_path) == 0


def test_a_riddle_in_a_message_is_refused(prose, tmp_path, capsys):
    module = tmp_path / "edge_depth_nerf/jobs/worker.py"
    module.parent.mkdir(parents=True)
    module.write_text('"""A docstring."""\n\nNAME = "moment"\nprint(f"{NAME}: its worker goes on on {NAME}")\n')
    assert prose.main(tmp_path) == 1
    assert "edge_depth_nerf/jobs/worker.py:4: “goes on on”" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("where", "line"),
    [
        ('"""DOCSTRING"""\n', 1),
        ('class Sweep:\n    """A sweep.\n\n    DOCSTRING\n    """\n', 4),
        ('class Sweep:\n    @property\n    def time_s(self):\n        """DOCSTRING"""\n', 4),
        ('class Sweep:\n    time_s: float\n    """DOCSTRING"""\n', 3),
        ('TIME_S = 0.1\n"""A time.\n\nDOCSTRING\n"""\n', 4),
        ('def read():\n    """Read.\n\n    Args:\n        time_s: DOCSTRING\n    """\n', 4),
    ],
    ids=["module", "class", "function", "attribute", "constant", "argument"],
)
def test_a_riddle_in_a_docstring_is_refused(prose, tmp_path, capsys, where, line):
    module = tmp_path / "edge_depth_nerf/lidar/sweeps.py"
    module.parent.mkdir(parents=True)
    module.write_text(where.replace("DOCSTRING", "The sweep's own moment."))
    assert prose.main(tmp_path) == 1
    assert f"edge_depth_nerf/lidar/sweeps.py:{line}: “moment”" in capsys.readouterr().out
    module.write_text(where.replace("DOCSTRING", "The sweep's own time."))
    assert prose.main(tmp_path) == 0


def test_a_long_sentence_in_a_docstring_is_refused_and_code_and_headings_are_not(prose, tmp_path, capsys):
    module = tmp_path / "edge_depth_nerf/module.py"
    module.parent.mkdir(parents=True)
    module.write_text(f'"""A module.\n\nA {"very " * 40}long sentence.\n"""\n')
    assert prose.main(tmp_path) == 1
    assert "edge_depth_nerf/module.py:3: a sentence of 43 words" in capsys.readouterr().out
    module.write_text(
        '"""Reads `moment`.\n\n    print(moment)\n\nIt is plain.\n"""\n\n\ndef read(time_s):\n'
        '    """Read what `moment_s` holds; the function returns it.\n\n'
        '    Args:\n        moment_s: a time.\n\n    Returns:\n        Seconds.\n    """\n'
    )
    assert prose.main(tmp_path) == 0


def test_code_examples_and_long_lists_are_left_alone(prose, tmp_path, capsys):
    page = tmp_path / "README.md"
    page.write_text(
        "Call `find_moments()`:\n\n    print(moment)\n\n```python\nmoment = 1\n```\n\n[it](moment.md)\n\n"
        f"<!-- prose: off -->\nA moment.\n<!-- prose: on -->\n\n| {' | '.join(['a word'] * 40)} |\n",
        encoding="utf-8",
    )
    assert prose.main(tmp_path) == 0
    page.write_text("A " + "very " * 40 + "long sentence.\n", encoding="utf-8")
    assert prose.main(tmp_path) == 1
    assert "README.md:1: a sentence of 43 words" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("def find_returns(): ...\n", "find_returns"),
        ("def find(returns): ...\n", "returns"),
        ("find = lambda at_return: 0\n", "at_return"),
        ("class NearReturns: ...\n", "NearReturns"),
        ("LEAST_RETURNS = 4\n", "LEAST_RETURNS"),
        ("class Scan:\n    returns: int = 3\n", "returns"),
        ("class Scan:\n    def __init__(self):\n        self.returns = 3\n", "returns"),
    ],
)
def test_a_word_in_a_name_is_refused(prose, monkeypatch, tmp_path, capsys, code, name):
    rules = tmp_path / "rules.toml"
    rules.write_text(
        'rules = []\n[sentences]\nmost_words = 40\n[[identifiers]]\npattern = "returns?"\n'
        'instead = "points"\nallowed = ["keep_returns"]\n'
    )
    monkeypatch.setattr(prose, "RULES", rules)
    module = tmp_path / "edge_depth_nerf/scan.py"
    module.parent.mkdir()
    module.write_text(f"{code}\n\ndef returned(keep_returns):\n    returns = 3\n    return returns\n")
    assert prose.main(tmp_path) == 1
    assert f"the name {name}: write points" in capsys.readouterr().out
    module.write_text(re.sub("(?i)returns?", "points", code))
    assert prose.main(tmp_path) == 0
    module.rename(module.with_name("returns.py")).write_text('"""A module."""\n')
    assert prose.main(tmp_path) == 1
