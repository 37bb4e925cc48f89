"""nurec_sim: an open closed-loop sensor simulator for driving. Its parts are loaded on first use."""

from typing import Any

import lazy_loader

_parts, _names, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "errors",
        "evaluate",
        "files",
        "geometry",
        "lenses",
        "logs",
        "metrics",
        "network",
        "plugins",
        "reconstruct",
        "render",
        "report",
        "runs",
        "scene",
        "sensors",
        "serving",
        "sim",
        "training",
        "types",
        "world",
    ],  # fmt: skip
)
__all__.append("__version__")


def __getattr__(name: str) -> Any:
    """Import a part of the package, or look up its version."""
    if name == "__version__":
        return globals().setdefault(name, _version())
    return _parts(name)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]


def _version() -> str:
    """The version in pyproject.toml: read from there in a checkout, elsewhere as it was when installed."""
    import tomllib
    from importlib.metadata import version
    from pathlib import Path

    try:
        project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))["project"]
    except (OSError, ValueError, KeyError):
        return version("nurec-sim")
    return str(project["version"]) if project.get("name") == "nurec-sim" else version("nurec-sim")
