"""What MkDocs does beside its own: pages of the repository that lie outside docs/, and links to files there.

In the site docs/ is the repository's root: `../data/README.md` in a page of docs/ becomes `data/README.md`, and what is
linked is put there. So every link works in the repository and in the site. The home page is README.md without its
badges, which would be fetched from the network.

slider.html is a page of its own, made of the pictures in docs/slider/ (see slider_page.py).
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("data/README.md", "benchmarks/README.md", "CONTRIBUTING.md", "CHANGELOG.md")
"""Pages of the site that lie elsewhere in the repository."""
HOME, HOME_OF = "index.md", "README.md"
"""The site's home, and the page of the repository that it is."""
BADGE = re.compile(r"^\[!\[.*\n", re.MULTILINE)
SLIDER = "slider.html"
"""The page of pictures, beside results.html."""
LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)#\s]+)")


def in_site(page: str, link: str) -> str:
    """What a link of a page becomes in the site; both paths as in the repository, the link from the page's folder.

    Returns:
        The link from the page's place in the site.
    """
    folder = (ROOT / page).parent
    target = (folder / link).resolve()
    place = target.relative_to(ROOT / "docs") if target.is_relative_to(ROOT / "docs") else target.relative_to(ROOT)
    place = Path(HOME) if place == Path(HOME_OF) else place
    own = Path(page).parent
    depth = len(own.parts) - (own.parts[:1] == ("docs",))
    return "../" * depth + place.as_posix()


def linked_files(page: str, text: str) -> list[str]:
    """Files outside docs/ that a page links to, as paths in the repository."""
    targets = [((ROOT / page).parent / link).resolve() for _, link in LINK.findall(text)]
    return [
        target.relative_to(ROOT).as_posix()
        for target in targets
        if target.is_file() and target.is_relative_to(ROOT) and not target.is_relative_to(ROOT / "docs")
    ]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside docs/ and all files that any page links to."""
    wanted = dict.fromkeys(PAGES)
    pages = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    for page in (HOME_OF, *pages, *PAGES):
        wanted |= dict.fromkeys(linked_files(page, (ROOT / page).read_text(encoding="utf-8")))
    for name in wanted:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    files.append(File.generated(config, HOME, abs_src_path=str(ROOT / HOME_OF)))
    files.append(File.generated(config, SLIDER, content=_slider_page()))
    return files


def _slider_page() -> str:
    """Build the page with docs/slider_page.py, which is no module of a package."""
    specification = importlib.util.spec_from_file_location("slider_page", ROOT / "docs/slider_page.py")
    assert specification and specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.page()


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make the page's links those of the site."""
    name = page.file.src_uri
    if name == HOME:
        name, markdown = HOME_OF, BADGE.sub("", markdown)
    elif name not in PAGES:
        name = f"docs/{name}"
    return LINK.sub(lambda found: found[1] + in_site(name, found[2]), markdown)
