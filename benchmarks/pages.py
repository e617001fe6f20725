"""Generated tables of the pages: replaces the text between `<!-- NAME -->` and the next `<!-- end -->`.

    python -m benchmarks.pages PAGE NAME=FILE#HEADING [NAME=FILE#HEADING ...]

puts what stands under a heading of Markdown that a command wrote (`tables.md`) into a page such as docs/results.md.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_text

END = "<!-- end -->"


def with_part(page: str, name: str, content: str) -> str:
    """A page with a part of it replaced; as it was if it has no such part."""
    mark = f"<!-- {name} -->"
    begin = page.find(mark)
    if begin < 0:
        return page
    begin += len(mark)
    return f"{page[:begin]}\n{content.strip()}\n{page[page.index(END, begin) :]}"


def under(markdown: str, heading: str) -> str:
    """What stands under the first heading that begins with these words, without it.

    Raises:
        InputError: there is none.
    """
    parts = re.split(r"^#+ (.*)\n", markdown, flags=re.MULTILINE)
    for title, content in zip(parts[1::2], parts[2::2], strict=True):
        if title.startswith(heading):
            return content
    raise InputError(f"there is no heading {heading!r}; there are {', '.join(map(repr, parts[1::2]))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("parts", nargs="+", metavar="NAME=FILE#HEADING")
    options = parser.parse_args()
    page = options.page.read_text(encoding="utf-8")
    for part in options.parts:
        name, _, rest = part.partition("=")
        file, _, heading = rest.partition("#")
        if f"<!-- {name} -->" not in page:
            parser.error(f"{options.page} has no line <!-- {name} -->")
        content = Path(file).read_text(encoding="utf-8")
        try:
            page = with_part(page, name, under(content, heading))
        except InputError as error:
            parser.error(f"{file}: {error}")
    write_text(options.page, page)


if __name__ == "__main__":
    main()
