"""Pages of the site that do not lie in docs/: other pages of the repository, the notebooks, and an API reference.

A hook of mkdocs. The reference has a page for each public part of ``nurec_sim``, the names of its ``__all__``, and for
each package and module below it that has an ``__all__`` of its own. A page shows the names listed there, with their
docstrings.
"""

import ast
import importlib
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

REPO = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "tests/README.md": "testing.md",
}
"""Pages of the repository outside docs/, and what they are called on the site."""
NOTEBOOKS = sorted((REPO / "docs" / "notebooks").glob("*.ipynb"))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Appends the reference to the navigation."""
    if str(REPO) not in sys.path:
        sys.path.insert(0, str(REPO))
    assert config.nav is not None
    config.nav.append({"API reference": [{name: _page(name)} for name in public_modules()]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that lie elsewhere and those of the reference."""
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=from_docs(REPO / source)))
    for path in NOTEBOOKS:
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=from_notebook(path)))
    for name, path in public_modules().items():
        files.append(File.generated(config, _page(name), content=reference(name, path)))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Leads links to notebooks to their pages."""
    return re.sub(r"(\]\([\w./-]+)\.ipynb(?=[)#])", r"\1.md", markdown)


def from_notebook(path: Path) -> str:
    """The page of a notebook: its texts, its code, and what the code gave when it was last executed."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [shown for output in cell["outputs"] if (shown := _shown(output))]
    return "\n\n".join(parts) + "\n"


def _shown(output: dict[str, Any]) -> str:
    """One output of a cell: HTML and pictures as they are, else its text."""
    data = output.get("data", {"text/plain": output.get("text", "")} if output.get("name") == "stdout" else {})
    for kind in ("image/jpeg", "image/png"):
        if kind in data:
            code = "".join(data[kind]).strip()
            return f'<img src="data:{kind};base64,{code}" alt="">'
    if "text/html" in data:
        # Markdown ends a block of HTML at an empty line, and takes only what is in a block tag as it is.
        return "<div>" + re.sub(r"\n\s*\n", "\n", "".join(data["text/html"])) + "</div>"
    text = "".join(data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```" if text else ""


def from_docs(page: Path) -> str:
    """The text of a page outside docs/, its links to other pages as they are on the site."""

    def on_site(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(page.parent / link[1]))
        source = target.relative_to(REPO).as_posix() if target.is_relative_to(REPO) else link[1]
        return f"]({PAGES.get(source, source.removeprefix('docs/'))}"

    return re.sub(r"\]\(([\w./-]+)(?=[)#])", on_site, page.read_text(encoding="utf-8"))


def public_modules() -> dict[str, Path]:
    """Modules of the reference, and their files."""
    import nurec_sim

    modules = {}
    for part in sorted(set(nurec_sim.__all__) - {"__version__"}):
        home = REPO / "nurec_sim" / part
        modules[f"nurec_sim.{part}"] = home / "__init__.py" if home.is_dir() else home.with_suffix(".py")
        for path in sorted(home.rglob("*.py")):
            if _list_of_names(path) is not None:
                modules[_module(path)] = path
    return modules


def reference(name: str, path: Path) -> str:
    """The page of a module: its docstring, then what its ``__all__`` lists, or if it has none all that is public."""
    listed = _list_of_names(path)
    if listed is None:
        return f"# {name}\n\n::: {name}\n"
    try:
        members = ast.literal_eval(listed)
    except ValueError:  # computed: names that load on first use, which only running the code tells
        module = importlib.import_module(name)
        shown = "\n".join(
            f"::: {home}.{member}\n    options: {{show_root_heading: true, heading_level: 2}}\n"
            for member in module.__all__
            for home in [_home(path.parent, getattr(module, member), member)]
        )
        return f"# {name}\n\n::: {name}\n    options: {{members: []}}\n\n{shown}"
    return f"# {name}\n\n::: {name}\n    options: {{members: {list(members)}}}\n"


def _home(package: Path, thing: object, name: str) -> str:
    """The module that defines what a package offers under a name."""
    if isinstance(thing, type(ast)):
        return thing.__name__.rpartition(".")[0]
    told = getattr(thing, "__module__", "")
    if told.startswith("nurec_sim."):
        return told
    homes = [_module(path) for path in sorted(package.rglob("*.py")) if name in _assigned(path)]
    if len(homes) != 1:
        raise LookupError(f"{name!r} of {package} should be assigned in one module of it; found {homes}")
    return homes[0]


def _assigned(path: Path) -> Iterator[str]:
    """Names that a file assigns to at its top level."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        yield from (target.id for target in targets if isinstance(target, ast.Name))


def _list_of_names(path: Path) -> ast.expr | None:
    """What a file assigns to ``__all__``; None if it has none."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            return node.value
    return None


def _module(path: Path) -> str:
    return ".".join(path.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__")


def _page(module: str) -> str:
    return f"reference/{module}.md"
