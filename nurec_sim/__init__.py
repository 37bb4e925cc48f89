"""nurec_sim: an open closed-loop sensor simulator for driving. Its parts are loaded on first use."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__: str

_PARTS = (
    "client", "client_v1", "conformance", "driving", "errors", "evaluate", "geometry", "logs", "metrics", "network",
    "plugins", "reconstruct", "render", "report", "runs", "scene", "scene_store", "sensors", "server", "service", "sim",
    "training", "types", "wire", "world",
)  # fmt: skip
__all__ = ["__version__", *_PARTS]

if not TYPE_CHECKING:  # to a type checker they are modules, as ever

    def __getattr__(name: str) -> Any:
        """Import a part of the package, or look up its version."""
        if name == "__version__":
            return globals().setdefault(name, _version())
        if name not in _PARTS:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    return sorted(__all__)


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
