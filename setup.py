"""What pyproject.toml cannot say: every folder of ``nurec_sim`` with an ``__init__.py`` is a package."""

import tomllib
from pathlib import Path

from setuptools import find_packages, setup

FOLDERS = tomllib.loads((Path(__file__).parent / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"]
"""Folder of each package that does not lie in its parent's."""

setup(packages=sorted({*find_packages(include=["nurec_sim", "nurec_sim.*"]), *FOLDERS}))
