"""Borders that import-linter cannot see: folders mapped into the package, and what a bare import loads."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).parents[2]
POLICY_MAY_IMPORT = {
    "nurec_sim.types", "nurec_sim.geometry", "nurec_sim.policies", "numpy", "jaxtyping", "safetensors"
}  # fmt: skip


def imported_modules(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = node.module == "nurec_sim"
            names |= {f"nurec_sim.{alias.name}" for alias in node.names} if whole else {node.module}
    return names


@pytest.mark.parametrize("path", sorted((REPO / "policies").glob("*.py")), ids=lambda path: path.stem)
def test_policies_know_types_and_geometry_only(path: Path) -> None:
    standard = set(sys.stdlib_module_names)
    foreign = {
        name
        for name in imported_modules(path)
        if name.split(".")[0] not in standard
        and not any(name == allowed or name.startswith(allowed + ".") for allowed in POLICY_MAY_IMPORT)
    }
    assert not foreign


@pytest.mark.slow
def test_nothing_imports_policies() -> None:
    paths = sorted((REPO / "nurec_sim").rglob("*.py"))
    assert len(paths) > 100
    assert not [path for path in paths if any(name.startswith("nurec_sim.policies") for name in imported_modules(path))]


def test_the_package_is_found_from_anywhere(tmp_path: Path) -> None:
    code = "import nurec_sim.policies, nurec_sim.scenarios, nurec_sim.protos"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0


def test_files_stay_readable() -> None:
    folders = ("nurec_sim", "policies", "protos", "scenarios", "benchmarks", "docs")
    sources = [path for folder in folders for path in (REPO / folder).rglob("*.py")]
    assert not [path for path in sources if len(path.read_text().splitlines()) > 400]
