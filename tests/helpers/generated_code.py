"""Python code generated from the protos without our additions, as another package would ship it."""

import importlib
import re
import sys
import warnings
from pathlib import Path

import pytest

PROTOS = Path(__file__).parents[2] / "protos"


def protoc(*arguments: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # grpc_tools reads its own resources in a deprecated way
        compiler = pytest.importorskip("grpc_tools.protoc", reason="grpcio-tools is not installed")
        assert compiler.main(["protoc", *arguments]) == 0


def generate_like_alpasim(folder: Path):
    """Python code of our protos without our additions, laid out and imported as AlpaSim does it."""
    package = folder / "alpasim_like" / "v0"
    package.mkdir(parents=True)
    for source in PROTOS.glob("*.proto"):
        text = re.sub(r"^.*= 200\d;.*$", "", source.read_text(), flags=re.MULTILINE)
        (package / source.name).write_text(re.sub(r'import "', 'import "alpasim_like/v0/', text))
    names = [f"alpasim_like/v0/{path.name}" for path in package.glob("*.proto")]
    protoc(f"-I{folder}", f"--python_out={folder}", f"--grpc_python_out={folder}", *names)
    sys.path.insert(0, str(folder))
    try:
        return [importlib.import_module(f"alpasim_like.v0.{n}") for n in ("common_pb2", "sensorsim_pb2")]
    finally:
        sys.path.remove(str(folder))
