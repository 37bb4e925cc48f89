"""`make docs-check`: which commands it runs, what it compares; the notebooks as they are kept."""

import importlib.util
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def check():
    spec = importlib.util.spec_from_file_location("docs_check", DOCS / "check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGE = """
```bash
rm -rf not-run
```

<!-- run -->
```bash
echo 1
```

<!-- output -->
```text
1
```

<!-- run -->
```bash
echo 2
echo 3
```

```text
not compared
```
"""


def test_only_marked_blocks_are_run_and_compared(check):
    assert check.blocks(PAGE) == [("echo 1\n", "1\n"), ("echo 2\necho 3\n", "")]


def test_an_output_needs_a_command(check):
    with pytest.raises(ValueError, match="an output before the first command"):
        check.blocks("<!-- output -->\n```text\n1\n```\n")


def test_outputs_may_differ_in_figures_and_frames_but_not_in_words(check):
    printed = "┃ scene ┃\n│ static Gaussians │ 1,234,567 │\nnoise\nwrote a.usdz (43.5 MB)\n"
    assert check.missing_lines("...\n│ static Gaussians    │ 98,765  │\n...\nwrote a.usdz (7 MB)\n", printed) == []
    assert check.missing_lines("│ moving Gaussians │ 1 │\nwrote b.usdz (1 MB)\n", printed) == [
        "moving Gaussians #", "wrote b.usdz (# MB)",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("commands", "expected", "text"),
    [("exit 3", "", "exit status 3"), ("echo one", "two\n", r"not printed: \['two'\]"), ("echo one", "one\n", None)],
)
def test_a_page_fails_with_its_first_wrong_command(check, tmp_path, commands, expected, text):
    page = tmp_path / "page.md"
    output = f"<!-- output -->\n```text\n{expected}```\n" if expected else ""
    page.write_text(f"<!-- run -->\n```bash\n{commands}\n```\n{output}")
    if text is None:
        check.run_page(page)
    else:
        with pytest.raises(SystemExit, match=text):
            check.run_page(page)


def test_a_page_without_marked_commands_is_a_mistake(check, tmp_path):
    (tmp_path / "page.md").write_text("```bash\ntrue\n```\n")
    with pytest.raises(SystemExit, match="page.md has no block marked"):
        check.run_page(tmp_path / "page.md")


@pytest.mark.parametrize("page", ["tutorial"])
def test_pages_to_check_have_commands(check, page):
    assert len(check.blocks(check.PAGES[page].read_text())) >= 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_kept_executed_from_top_to_bottom_and_small(check, path):
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert outputs and not [output for output in outputs if output["output_type"] == "error"]
    assert path.stat().st_size <= check.MAX_BYTES
    for place in ("/tmp/", "/home/", "/root/", "/work/"):
        assert place not in path.read_text(), f"{path.name} names a folder of this machine: {place}"
