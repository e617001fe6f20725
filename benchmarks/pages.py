"""Pages whose tables are made: what stands between `<!-- NAME -->` and the next `<!-- end -->` is replaced.

    python benchmarks/pages.py PAGE NAME=FILE [NAME=FILE ...]

puts Markdown that a command wrote (`tables.md`, `search.md`) into a page, its title left out and its headings one level
further down: docs/results.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from edge_depth_nerf.files import write_text

END = "<!-- end -->"


def with_part(page: str, name: str, content: str) -> str:
    """A page with a part of it replaced; as it was if it has no such part."""
    mark = f"<!-- {name} -->"
    begin = page.find(mark)
    if begin < 0:
        return page
    begin += len(mark)
    return f"{page[:begin]}\n{content.strip()}\n{page[page.index(END, begin) :]}"


def lowered(markdown: str) -> str:
    """Without its title, other headings a level further down."""
    lines = [line for line in markdown.splitlines() if not line.startswith("# ")]
    return "\n".join(f"#{line}" if line.startswith("##") else line for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("parts", nargs="+", metavar="NAME=FILE")
    options = parser.parse_args()
    page = options.page.read_text(encoding="utf-8")
    for part in options.parts:
        name, _, file = part.partition("=")
        if f"<!-- {name} -->" not in page:
            parser.error(f"{options.page} has no line <!-- {name} -->")
        page = with_part(page, name, lowered(Path(file).read_text(encoding="utf-8")))
    write_text(options.page, page)


if __name__ == "__main__":
    main()
