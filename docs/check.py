"""`make docs-check`: runs the notebooks, and the commands in the pages that are marked to be run.

A block of bash after a line `<!-- run -->` is run, in the order of the page and in one empty folder per page. A block
of text after `<!-- output -->` is compared with what the block before it printed: each of its lines must be there,
whatever its figures; `...` stands for lines left out.

    python docs/check.py                      everything
    python docs/check.py tutorial own_log     some pages and notebooks
    python docs/check.py own_log --write      and keep the outputs in the notebook
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PAGES = {"tutorial": REPO / "docs" / "tutorial.md"}
NOTEBOOKS = {path.stem: path for path in sorted((REPO / "docs" / "notebooks").glob("*.ipynb"))}
MARKED = re.compile(r"<!-- (run|output) -->\n+```(?:bash|text)\n(.*?)^```", re.DOTALL | re.MULTILINE)
LIMIT_S = 3600
MAX_BYTES = 350_000
"""Of a notebook with its outputs."""


def blocks(text: str) -> list[tuple[str, str]]:
    """The commands to run in a page, each with the output it is said to have (empty if nothing is said)."""
    found: list[tuple[str, str]] = []
    for kind, body in MARKED.findall(text):
        if kind == "run":
            found.append((body, ""))
        elif not found:
            raise ValueError("there is an output before the first command")
        else:
            found[-1] = (found[-1][0], body)
    return found


def lines_without_figures(text: str) -> list[str]:
    """Lines without figures, frames of tables and spaces: what stays the same from machine to machine."""
    told = re.sub(r"[─━│┃┌┐└┘├┤┏┓┗┛┡┩╇┳┻┬┴╃╄┼╋┯┷]", " ", text)
    told = re.sub(r"\d[\d,.:]*", "#", told)
    return [stripped for line in told.splitlines() if (stripped := " ".join(line.split()))]


def missing_lines(expected: str, printed: str) -> list[str]:
    """Lines of an expected output that a command did not print."""
    there = set(lines_without_figures(printed))
    return [line for line in lines_without_figures(expected) if line != "..." and line not in there]


def run_page(page: Path) -> None:
    """Run a page's commands in an empty folder.

    Raises:
        SystemExit: a command failed, or did not print what the page says.
    """
    found = blocks(page.read_text(encoding="utf-8"))
    if not found:
        raise SystemExit(f"{page.name} has no block marked with <!-- run -->")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PATH": path, "COLUMNS": "100", "NUREC_SIM_CACHE": f"{folder}/.cache"}
        for commands, expected in found:
            print(commands, end="", flush=True)
            started = time.monotonic()
            done = subprocess.run(
                ["bash", "-e", "-c", commands], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                capture_output=True, text=True, timeout=LIMIT_S,
            )  # fmt: skip
            print(f"  {time.monotonic() - started:.0f} s", flush=True)
            if done.returncode:
                raise SystemExit(f"{page.name}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
            if missing := missing_lines(expected, done.stdout):
                raise SystemExit(f"{page.name}: not printed: {missing}\nprinted was\n{done.stdout}")


def run_notebook(path: Path, write: bool) -> None:
    """Execute a notebook.

    Raises:
        SystemExit: a cell failed, or the notebook is too large with its outputs.
    """
    import nbclient
    import nbformat

    started = time.monotonic()
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = nbclient.NotebookClient(
            notebook, timeout=LIMIT_S, resources={"metadata": {"path": folder}}, record_timing=False
        )
        try:
            client.execute()
        except nbclient.exceptions.CellExecutionError as error:
            raise SystemExit(f"{path.name}: {error}") from None
    for metadata in ("widgets", "language_info"):
        notebook.metadata.pop(metadata, None)
    size = len(nbformat.writes(notebook).encode())
    print(f"{path.name}: {time.monotonic() - started:.0f} s, {size / 1e3:.0f} kB", flush=True)
    if size > MAX_BYTES:
        raise SystemExit(f"{path.name} has {size} bytes with its outputs; at most {MAX_BYTES} are kept")
    if write:
        nbformat.write(notebook, path)


def main() -> None:
    """Check what the command line names, or everything."""
    parser = argparse.ArgumentParser(description="Run the notebooks, and the marked commands of the pages.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join([*PAGES, *NOTEBOOKS])}; default: all")
    parser.add_argument("--write", action="store_true", help="keep the outputs in the notebooks")
    given = parser.parse_args()
    if unknown := set(given.names) - {*PAGES, *NOTEBOOKS}:
        parser.error(f"unknown {', '.join(sorted(unknown))}; have {', '.join([*PAGES, *NOTEBOOKS])}")
    for name in given.names or [*PAGES, *NOTEBOOKS]:
        if name in PAGES:
            run_page(PAGES[name])
        else:
            run_notebook(NOTEBOOKS[name], given.write)


if __name__ == "__main__":
    main()
