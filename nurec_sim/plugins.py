"""Finds what people add: policies, log readers and reconstruction methods.

A plug-in is a class that is called without arguments. Shipped ones are modules of a package, one class each; installed
ones are named by entry points; others are a file (``my_policy.py:Class``) or an importable object (``module:Class``).
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from nurec_sim.errors import ClipError, NurecSimError, ReconstructError, ScenarioError
from nurec_sim.types import LogReader, Method, Needs, Policy

T = TypeVar("T")
_FILES: dict[str, ModuleType] = {}
_REMOTE_POLICY = "nurec_sim.serving.driver:RemotePolicy.from_url"


@dataclass(frozen=True)
class Kind(Generic[T]):
    """One kind of plug-in.

    Attributes:
        noun: what messages call it.
        group: the entry-point group in which installed packages name theirs.
        shipped: the package whose modules are the shipped ones.
        error: what is raised when one cannot be loaded.
        methods: the methods that it must have; the last one tells its class from others in a file.
        attributes: the attributes that it must have, and their types.
    """

    noun: str
    group: str
    shipped: str
    error: type[NurecSimError]
    methods: tuple[str, ...]
    attributes: Mapping[str, type]


POLICIES: Kind[Policy] = Kind(
    "policy",
    "nurec_sim.policies",
    "nurec_sim.policies",
    ScenarioError,
    ("reset", "plan"),
    {"name": str, "needs": Needs},
)
LOG_READERS: Kind[LogReader] = Kind(
    "log reader", "nurec_sim.logs", "nurec_sim.logs.readers", ClipError, ("can_open", "open"),
    {"name": str, "description": str},
)  # fmt: skip
METHODS: Kind[Method] = Kind(
    "reconstruction method", "nurec_sim.methods", "nurec_sim.reconstruct.methods", ReconstructError,
    ("files", "reconstruct"), {"name": str, "settings": type},
)  # fmt: skip


def available_policies() -> list[str]:
    """Names of the shipped policies and of those that installed packages offer, sorted."""
    return available(POLICIES)


def load_policy(reference: str) -> Policy:
    """Make a policy from a reference (see ``load``).

    ``grpc://host:port`` is a driver that is running there (``serving.driver.RemotePolicy.from_url``).

    Raises:
        ScenarioError: nothing of that name, or what was found is no policy; the text says what is available.
    """
    if reference.startswith("grpc://"):
        from_url = pkgutil.resolve_name(_REMOTE_POLICY)
        return _made(POLICIES, reference, lambda: from_url(reference))
    return load(POLICIES, reference)


def available(kind: Kind[Any]) -> list[str]:
    """Names of the shipped plug-ins of a kind and of those that installed packages offer, sorted; imports none."""
    return sorted({*_shipped(kind), *_installed(kind)})


def load(kind: Kind[T], reference: str) -> T:
    """Make a plug-in from a name, a file (``my_file.py:Class``) or an importable object (``module:Class``).

    A file with exactly one class of the kind needs no ``:Class``.

    Raises:
        NurecSimError: the kind's error: nothing of that name, or what was found is not of that kind; the text says
            what is available.
    """
    path, _, name = reference.partition(":")
    if path.endswith(".py"):
        return _made(kind, reference, _class(kind, _load_file(kind, Path(path)), name, reference))
    if name:
        where = f"{kind.noun} '{reference}' cannot be imported"
        return _made(kind, reference, _attempt(kind, where, lambda: pkgutil.resolve_name(reference)))
    if path in _shipped(kind):
        module = importlib.import_module(f"{kind.shipped}.{path}")
        return _made(kind, reference, _class(kind, module, "", reference))
    installed = _installed(kind)
    if path in installed:
        where = f"{kind.noun} '{reference}' is installed but cannot be imported"
        return _made(kind, reference, _attempt(kind, where, installed[path]))
    noun = kind.noun.split()[-1]
    remote = ", grpc://host:port" if kind is POLICIES else ""
    raise kind.error(
        f"unknown {kind.noun} '{reference}'; have {available(kind)}, a file such as my_{noun}.py:Class, module:Class"
        f"{remote}, or an installed package with an entry point in the group '{kind.group}'"
    )


def load_all(kind: Kind[T]) -> Iterator[tuple[str, T | NurecSimError]]:
    """Every plug-in of a kind by name, shipped ones first; for one that cannot be loaded, the error that says why."""
    for names in (_shipped, _installed):
        for name in sorted(names(kind)):
            try:
                yield name, load(kind, name)
            except kind.error as error:
                yield name, error


def _shipped(kind: Kind[Any]) -> list[str]:
    package = importlib.import_module(kind.shipped)
    names = (module.name for module in pkgutil.iter_modules(package.__path__))
    return [name for name in names if not name.startswith("_")]


def _installed(kind: Kind[Any]) -> dict[str, Callable[[], object]]:
    return {point.name: point.load for point in entry_points(group=kind.group)}


def _attempt(kind: Kind[Any], what: str, work: Callable[[], Any]) -> Any:
    """The result of running a plug-in's code; whatever it raises, ``exit()`` too, becomes the kind's error."""
    try:
        return work()
    except (Exception, SystemExit, GeneratorExit) as error:
        raise kind.error(f"{what}: {type(error).__name__}: {error}") from error


def _load_file(kind: Kind[Any], path: Path) -> ModuleType:
    where = f"{kind.noun} file '{path}'"
    if not path.is_file():
        raise kind.error(f"{where} does not exist")
    # The same file gives the same classes every time, so that settings fit the method that they were made for.
    name = f"nurec_sim_plugin_{path.stem}_{hashlib.sha256(bytes(path.resolve()) + path.read_bytes()).hexdigest()[:16]}"
    if name in _FILES:
        return _FILES[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up there
    loader = spec.loader
    try:
        _attempt(kind, f"{where} cannot be imported", lambda: loader.exec_module(module))
    except kind.error:
        sys.modules.pop(name, None)
        raise
    return _FILES.setdefault(name, module)


def _class(kind: Kind[Any], module: ModuleType, name: str, reference: str) -> object:
    """The named class of a module, or its only class of the kind."""
    own = {
        each: value
        for each, value in vars(module).items()
        if inspect.isclass(value) and value.__module__ == module.__name__ and hasattr(value, kind.methods[-1])
    }
    if name:
        if not hasattr(module, name):
            raise kind.error(f"{kind.noun} '{reference}': no class '{name}' in the file; have {sorted(own)}")
        return getattr(module, name)
    if len(own) != 1:
        raise kind.error(f"{kind.noun} '{reference}': name one class, as in file.py:Class; have {sorted(own)}")
    return next(iter(own.values()))


def _made(kind: Kind[T], reference: str, factory: object) -> T:
    """Call the class and check that the object is of the kind."""
    if not callable(factory):
        raise kind.error(f"{kind.noun} '{reference}' must be a class, got {type(factory).__name__}")
    made = _attempt(kind, f"{kind.noun} '{reference}' cannot be made", factory)
    if faults := lacking(kind, made):
        raise kind.error(f"{kind.noun} '{reference}' is not a {kind.noun}: it lacks {', '.join(faults)}")
    return made


def lacking(kind: Kind[Any], made: object) -> list[str]:
    """What an object lacks to be a plug-in of a kind: methods and attributes, for messages."""
    faults = [name for name in kind.methods if not callable(getattr(made, name, None))]
    for name, wanted in kind.attributes.items():
        if not isinstance(getattr(made, name, None), wanted):
            home = "" if wanted.__module__ == "builtins" else "nurec_sim.types."
            faults.append(f"{name} ({home}{wanted.__name__})")
    return faults
