"""Python examples of the documents, run as a reader would."""

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[2] / "docs"


def example(page: str, index: int = 0) -> str:
    """A block of Python of a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)[index]


def names_of(page: str) -> dict[str, Any]:
    """What the first block of a page defines."""
    names: dict[str, Any] = {"__name__": page}
    exec(compile(example(page), page, "exec"), names)
    return names
