"""The Dockerfiles, read: what they copy exists and is enough, what they start is a command of ours, nobody is root."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from nurec_sim.cli.serving import sort_serve_grpc

REPO = Path(__file__).parents[2]
FILES = ("Dockerfile", "Dockerfile.cuda")
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())


def instructions(name):
    """(instruction, arguments) of each line, comments dropped and continued lines joined."""
    text = re.sub(r"^#.*\n", "", (REPO / name).read_text(), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    return [tuple(line.split(maxsplit=1)) for line in lines if line.strip()]


def of_kind(name, kind):
    return [arguments for instruction, arguments in instructions(name) if instruction == kind]


def copied(name):
    return [source for arguments in of_kind(name, "COPY") for source in arguments.split()[:-1]]


@pytest.mark.parametrize("name", FILES)
def test_what_is_copied_is_here_and_is_all_that_the_package_needs(name):
    sources = copied(name)
    assert all((REPO / source).exists() for source in sources)
    folders = PROJECT["tool"]["setuptools"]["package-dir"].values()
    needed = {
        *folders,
        "pyproject.toml",
        "setup.py",
        PROJECT["project"]["readme"],
        *PROJECT["project"]["license-files"],
    }
    assert needed <= set(sources)
    let_through = {line[1:] for line in (REPO / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert let_through == set(sources)


@pytest.mark.parametrize("name", FILES)
def test_what_is_installed_is_this_package_in_known_versions(name):
    (install,) = [line for line in of_kind(name, "RUN") if "pip install" in line]
    assert "--constraint constraints.txt" in install and not re.search(r"https?://|index|find-links", install)
    assert of_kind(name, "ARG") == ["BASE=python:3.12-slim-bookworm", "TORCH=torch"] and '"${TORCH}"' in install
    assert "INDEX" not in (REPO / name).read_text(), "no package may come from a second index"
    (target,) = re.findall(r'(?<=\s)"?\.(?:\[(\w+)\])?"?$', install)
    assert target == ("gpu" if name.endswith("cuda") else "")
    assert not target or target in PROJECT["project"]["optional-dependencies"]


@pytest.mark.parametrize("name", FILES)
def test_the_image_starts_our_server_and_not_as_root(name):
    assert json.loads(of_kind(name, "ENTRYPOINT")[0]) == ["nurec-sim"]
    assert "nurec-sim" in PROJECT["project"]["scripts"]
    verb, *words = json.loads(of_kind(name, "CMD")[0])
    assert verb == "serve-grpc" and "--artifact-glob" in sort_serve_grpc(words)
    order = [instruction for instruction, _ in instructions(name)]
    assert order.index("USER") < order.index("ENTRYPOINT") and of_kind(name, "USER") == ["nurec"]
    assert any("useradd" in line and "nurec" in line for line in of_kind(name, "RUN"))
    assert of_kind(name, "FROM") == ["${BASE}"] and "BASE=python:3.12-slim-bookworm" in of_kind(name, "ARG")


@pytest.mark.parametrize("name", FILES)
def test_health_is_asked_where_the_server_answers_it(name):
    command = of_kind(name, "HEALTHCHECK")[0].partition("CMD ")[2]
    program, verb, address = json.loads(command)
    assert (program, verb) == ("nurec-sim", "health")
    port = address.rpartition(":")[2]
    assert f"--health-port={port}" in json.loads(of_kind(name, "CMD")[0])
    assert port in of_kind(name, "EXPOSE")[0].split()


def test_documented_runs_publish_on_this_machine_only():
    pages = [REPO / "README.md", *(REPO / "docs").glob("*.md"), *(REPO / name for name in FILES)]
    published = [port for page in pages for port in re.findall(r"docker run[^\n]* -p (\S+)", page.read_text())]
    assert len(published) >= 3 and set(published) == {"127.0.0.1:8080:8080"}


def test_the_two_images_differ_only_where_they_must():
    first, second = (instructions(name) for name in FILES)
    changed = {line[0] for line in set(first) ^ set(second)}
    assert changed == {"RUN", "ENV", "CMD"}
