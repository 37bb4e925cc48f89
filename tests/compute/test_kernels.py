"""Compiled loops: no stale machine code after an edit, and none needed on disk."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nurec_sim.compute import kernels

PACKAGE = Path(kernels.__file__).parents[1]
DECORATORS = {"kernel", "inner", "unchecked_kernel", "unchecked_inner", "vector_kernel", "intrinsic", "entry_point"}
SOURCES = {path: path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
WITH_KERNELS = [
    path
    for path, text in SOURCES.items()
    if "from nurec_sim.compute.kernels import" in text or "from nurec_sim.render.cpu.kernel import" in text
]


def defined_in(path):
    """Names that a file's own statements bind, imports left out."""
    names = set()
    for node in ast.parse(SOURCES[path]).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names |= {name.id for target in targets if target for name in ast.walk(target) if isinstance(name, ast.Name)}
    return names


def file_of(module):
    return PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")


def test_numba_compiles_through_one_place_only():
    direct = [p.name for p, text in SOURCES.items() if "import njit" in text or "numba.njit" in text or "@jit" in text]
    assert sorted(direct) == ["kernel.py", "kernels.py"]
    assert len(WITH_KERNELS) > 20


@pytest.mark.parametrize("path", WITH_KERNELS, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_kernels_take_names_from_the_files_that_their_digest_covers(path):
    """A name that another file, or a package, only passes on could change without a word to the digest."""
    tree = ast.parse(SOURCES[path])
    brought = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "nurec_sim":
            brought |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
        marks = {
            getattr(mark.func if isinstance(mark, ast.Call) else mark, "id", "") for mark in function.decorator_list
        }
        if marks & DECORATORS:
            used = {name.id for part in function.body for name in ast.walk(part) if isinstance(name, ast.Name)}
            for name in used & brought.keys():
                module, there = brought[name]
                source = file_of(module)
                assert source.is_file() and there in defined_in(source), f"{function.name} uses {name} of {module}"


def made(folder, **files):
    for name, text in files.items():
        path = folder.joinpath(*name.split("__")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_an_entry_points_name_follows_every_file_that_it_is_made_of(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "_ROOT", tmp_path)

    def digest(salt=""):
        return kernels.source_digest.__wrapped__("nurec_sim.room.a", salt)

    made(
        tmp_path,
        room__a="from nurec_sim.room.b import f\nfrom nurec_sim.other.x import K\n",
        room__b="from nurec_sim.room.c import g\n",
        room__c="g = 1\n",
        other__x="from nurec_sim.other.y import z\nK = 1\n",
        other__y="z = 1\n",
        room__unrelated="u = 1\n",
    )
    first = digest()
    assert first == digest() and first != digest("avx512")
    made(tmp_path, room__unrelated="u = 2\n")
    assert digest() == first
    seen = {first}
    for name, text in (
        ("room__a", "# 2"),
        ("room__b", "# 2"),
        ("room__c", "g = 2\n"),
        ("other__x", "K = 2\n"),
        ("other__y", "z = 2\n"),
    ):
        path = tmp_path.joinpath(*name.split("__")).with_suffix(".py")
        path.write_text(path.read_text() + text)
        seen.add(digest())
    assert len(seen) == 6


def test_an_edit_of_the_projection_renames_what_is_compiled_with_it(tmp_path, monkeypatch):
    """``lifting.owned`` has ``splat.project_point`` compiled into it."""
    from nurec_sim.reconstruct.lift import lifting

    name = "nurec_sim.reconstruct.lift.lifting"
    assert lifting.owned.py_func.__qualname__ == f"owned_{kernels.source_digest(name)}"
    for path in SOURCES:
        copy = tmp_path / path.relative_to(PACKAGE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
    splat = tmp_path / "reconstruct" / "lift" / "splat.py"
    monkeypatch.setattr(kernels, "_ROOT", tmp_path)
    before = kernels.source_digest.__wrapped__(name)
    splat.write_text(splat.read_text().replace("c <= 1e-3", "c <= 2e-3"))
    assert kernels.source_digest.__wrapped__(name) != before


RUN = """
import numpy as np
from nurec_sim.reconstruct.feedforward.merging import comparison
from nurec_sim.reconstruct.lift import colour, depth, lifting, points, splat
from nurec_sim.render.cpu.blend import sweep
import nurec_sim
w, index = np.array([[1.0, 2.0]], np.float32), np.zeros((1, 2), np.int32)
splat.drop_shine_through(w, index)
assert w.tolist() == [[1.0, 2.0]]
print(comparison._exposed(np.full(3, 0.5, np.float32)))
print({type(f._cache).__name__ for f in (splat.splat, comparison._compare, sweep.sweep_returns)})
print(nurec_sim.__file__)
"""


@pytest.mark.slow
def test_a_read_only_install_without_a_home_runs(tmp_path):
    """``__pycache__`` is a file and the home lies in one: nothing can be written, not even by root."""
    skip = shutil.ignore_patterns("__pycache__", "weights", "*.cu", "*.cuh")
    copy = shutil.copytree(PACKAGE, tmp_path / "nurec_sim", ignore=skip)
    for folder in {path.parent for path in copy.rglob("*.py")}:
        (folder / "__pycache__").write_text("")
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "XDG", "IPYTHON"))
    }
    environment |= {"HOME": f"{copy}/__init__.py/home", "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "-c", RUN], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["True", "{'NullCache'}", str(copy / "__init__.py")]
