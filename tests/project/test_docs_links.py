"""The pages: every one is in the site's navigation, and every link leads to a file and a heading that are there."""

import ast
import json
import re
from pathlib import Path

import pytest
import yaml

REPO = Path(__file__).resolve().parents[2]
SITE = ast.parse((REPO / "docs" / "site_pages.py").read_text()).body
(OUTSIDE,) = [ast.literal_eval(node.value) for node in SITE if ast.unparse(node).startswith("PAGES =")]
"""Pages outside docs/, and their names on the site."""
IN_DOCS = sorted((REPO / "docs").glob("*.md"))
NOTEBOOKS = sorted((REPO / "docs" / "notebooks").glob("*.ipynb"))
PAGES = [*IN_DOCS, *(REPO / name for name in OUTSIDE), *NOTEBOOKS]


def text_of(page):
    """A page, or the texts of a notebook."""
    if page.suffix != ".ipynb":
        return page.read_text()
    return "\n\n".join(
        "".join(cell["source"]) for cell in json.loads(page.read_text())["cells"] if cell["cell_type"] == "markdown"
    )


def outside_code(text):
    """A page without its code, where brackets are no links."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))


def anchors(page):
    """What a link may name after ``#``: headings as mkdocs and GitHub turn them into ids."""
    text = re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)", text, flags=re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", outside_code(text_of(page)))
    for link in links:
        path, _, anchor = link.partition("#")
        if path.startswith(("http://", "https://")):
            continue
        target = (page.parent / path) if path else page
        assert target.is_file(), f"{page.name}: {link}"
        on_site = target.resolve() in PAGES or (REPO / "docs") in target.resolve().parents
        assert on_site, f"{page.name}: {link} is not on the site; name it in docs/site_pages.py"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def named_in(nav):
    """Paths in a navigation, which is made of names, mappings and lists."""
    if isinstance(nav, str):
        return [nav]
    return [path for part in (nav.values() if isinstance(nav, dict) else nav) for path in named_in(part)]


def test_every_page_is_once_in_the_navigation():
    site = yaml.safe_load((REPO / "mkdocs.yml").read_text())
    assert sorted(named_in(site["nav"])) == sorted(
        [*OUTSIDE.values(), *(page.name for page in IN_DOCS), *(f"notebooks/{page.stem}.md" for page in NOTEBOOKS)]
    )


def links_of(page):
    """Files that a page links to."""
    found = re.findall(r"\]\(([^)\s#]+)[^)\s]*\)", outside_code(text_of(page)))
    return {(page.parent / link).resolve() for link in found if "://" not in link}


def test_every_page_can_be_reached_from_the_readme():
    """Without the site's navigation, as people read on a code host."""
    seen, ahead = set(), [REPO / "README.md"]
    while ahead:
        page = ahead.pop()
        seen.add(page)
        ahead += [each for each in links_of(page) if each in PAGES and each not in seen]
    assert not set(PAGES) - seen


def test_pictures_are_small_and_shown_somewhere():
    shown = set().union(*(links_of(page) for page in PAGES))
    for picture in sorted((REPO / "docs" / "images").iterdir()):
        assert picture.stat().st_size <= 200_000, f"{picture.name} has more than 200 kB"
        assert picture in shown, f"no page shows {picture.name}"
