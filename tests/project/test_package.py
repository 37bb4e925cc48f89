"""What is released: every package and data file is in the wheel, every file of the repository in the sdist."""

import io
import json
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import nurec_sim

REPO = Path(__file__).parents[2]
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())
FOLDERS = PROJECT["tool"]["setuptools"]["package-dir"]
ASK_SETUPTOOLS = """\
import json, sys
from distutils.core import run_setup
dist = run_setup("setup.py", stop_after="commandline")
build = dist.get_command_obj("build_py"); build.build_lib = "."; build.ensure_finalized()
info = dist.get_command_obj("egg_info"); info.egg_base = sys.argv[1]; info.ensure_finalized(); info.run()
facts = {"packages": dist.packages, "wheel": build.get_outputs(include_bytecode=False),
         "sdist": info.filelist.files, "version": dist.metadata.version}
print("\\n" + json.dumps(facts))
"""


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """What setuptools would put into a wheel and an sdist of this folder."""
    code = ["import setuptools\n" + ASK_SETUPTOOLS, str(tmp_path_factory.mktemp("egg"))]
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", *code], cwd=REPO, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def package_files():
    """Files below the packages, as paths in the repository."""
    below = (path for folder in FOLDERS.values() for path in (REPO / folder).rglob("*") if path.is_file())
    return {path.relative_to(REPO).as_posix() for path in below if "__pycache__" not in path.parts}


def in_wheel(path):
    """Where a file of the repository lies in the wheel."""
    home, package = max((folder, name) for name, folder in FOLDERS.items() if path.startswith(folder + "/"))
    return package.replace(".", "/") + path[len(home) :]


def test_every_folder_with_code_is_a_package(asked):
    folders = {in_wheel(path).rpartition("/")[0] for path in package_files() if path.endswith(".py")}
    assert folders == {name.replace(".", "/") for name in asked["packages"]}


def test_the_wheel_holds_every_file_of_the_packages(asked):
    held = {path.removeprefix("./") for path in asked["wheel"]}
    assert held == {in_wheel(path) for path in package_files()}
    assert "nurec_sim/py.typed" in held


def test_the_wheel_stays_small():
    """30 MB is the limit. A wheel is a zip archive, deflated: code shrinks to a fifth, weights and the log hardly."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as wheel:
        for path in sorted(package_files()):
            wheel.write(REPO / path, in_wheel(path))
    assert len(packed.getvalue()) < 30e6


def test_the_sdist_holds_every_file_of_the_repository(asked):
    if not (REPO / ".git").exists():
        pytest.skip("not a git checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=REPO, capture_output=True, text=True, check=True).stdout.split()
    missing = {path for path in listed if (REPO / path).exists()} - set(asked["sdist"])
    assert not missing


def test_the_version_stands_in_pyproject_only(asked):
    version = PROJECT["project"]["version"]
    assert nurec_sim.__version__ == asked["version"] == version
    held = [path for path in (REPO / "nurec_sim").rglob("*.py") if f'"{version}"' in path.read_text()]
    assert not held
    assert f"\n## [{version}]" in (REPO / "CHANGELOG.md").read_text()
    assert f"\nversion: {version}\n" in (REPO / "CITATION.cff").read_text()


def version_of(folder):
    """What a copy of the package says that is imported from a folder."""
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); import nurec_sim; print(nurec_sim.__version__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_checkout_knows_its_version_and_an_installed_copy_asks_its_metadata(tmp_path):
    (tmp_path / "nurec_sim").mkdir()
    shutil.copy(REPO / "nurec_sim" / "__init__.py", tmp_path / "nurec_sim")
    (tmp_path / "nurec_sim-1.2.3.dist-info").mkdir()
    (tmp_path / "nurec_sim-1.2.3.dist-info" / "METADATA").write_text("Name: nurec-sim\nVersion: 1.2.3\n")
    assert version_of(tmp_path) == "1.2.3"
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "another"\nversion = "9.8.7"\n')
    assert version_of(tmp_path) == "1.2.3"
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "nurec-sim"\nversion = "9.8.7"\n')
    assert version_of(tmp_path) == "9.8.7"
