"""Finds policies: shipped ones by name, files by path, installed ones by entry point, remote ones by address."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from nurec_sim.errors import ScenarioError
from nurec_sim.types import Needs, Policy

ENTRY_POINT_GROUP = "nurec_sim.policies"


def available_policies() -> list[str]:
    """Names of the shipped policies and of those that installed packages offer, sorted."""
    return sorted({*_shipped(), *_installed()})


def load_policy(reference: str) -> Policy:
    """Make a policy from a name (``log_replay``), a file (``my_policy.py:Class``) or an entry point's name.

    A file with exactly one policy class needs no ``:Class``. The class is called without arguments.
    ``grpc://host:port`` is a driver that is running there (``driving.RemotePolicy.from_url``).

    Raises:
        ScenarioError: nothing of that name, or what was found is no policy; the text says what is available.
    """
    if reference.startswith("grpc://"):
        from nurec_sim.serving.driver import RemotePolicy

        return _make(lambda: RemotePolicy.from_url(reference), reference)
    path, _, class_name = reference.partition(":")
    if path.endswith(".py"):
        return _make(_policy_class(_load_file(Path(path)), class_name, reference), reference)
    if class_name:
        raise ScenarioError(f"policy '{reference}': a class can be named only after a file, as in my_policy.py:Class")
    if path in _shipped():
        module = importlib.import_module(f"nurec_sim.policies.{path}")
        return _make(_policy_class(module, "", reference), reference)
    installed = _installed()
    if path in installed:
        try:
            return _make(installed[path](), reference)
        except ImportError as error:
            raise ScenarioError(f"policy '{reference}' is installed but cannot be imported: {error}") from error
    raise ScenarioError(
        f"unknown policy '{reference}'; have {available_policies()}, a file such as my_policy.py:Class, "
        f"grpc://host:port, or an installed package with an entry point in the group '{ENTRY_POINT_GROUP}'"
    )


def _shipped() -> list[str]:
    package = importlib.import_module("nurec_sim.policies")
    names = (module.name for module in pkgutil.iter_modules(package.__path__))
    return [name for name in names if not name.startswith("_")]


def _installed() -> dict[str, Callable[[], object]]:
    return {point.name: point.load for point in entry_points(group=ENTRY_POINT_GROUP)}


def _load_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ScenarioError(f"policy file '{path}' does not exist")
    spec = importlib.util.spec_from_file_location(f"nurec_sim_policy_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit, GeneratorExit) as error:
        raise ScenarioError(f"policy file '{path}' cannot be imported: {type(error).__name__}: {error}") from error
    return module


def _policy_class(module: ModuleType, class_name: str, reference: str) -> object:
    """The named class of a module, or its only policy class."""
    own = {
        name: value
        for name, value in vars(module).items()
        if inspect.isclass(value) and value.__module__ == module.__name__ and hasattr(value, "plan")
    }
    if class_name:
        if not hasattr(module, class_name):
            raise ScenarioError(f"policy '{reference}': no class '{class_name}' in the file; have {sorted(own)}")
        return getattr(module, class_name)
    if len(own) != 1:
        raise ScenarioError(f"policy '{reference}': name one class, as in file.py:Class; have {sorted(own)}")
    return next(iter(own.values()))


def _make(factory: object, reference: str) -> Policy:
    """Call the class and look whether it is a policy."""
    if not callable(factory):
        raise ScenarioError(f"policy '{reference}' must be a class, got {type(factory).__name__}")
    try:
        policy = factory()
    except (Exception, SystemExit, GeneratorExit) as error:
        raise ScenarioError(f"policy '{reference}' cannot be made: {type(error).__name__}: {error}") from error
    faults = [name for name in ("reset", "plan") if not callable(getattr(policy, name, None))]
    if not isinstance(getattr(policy, "name", None), str):
        faults.append("name (str)")
    if not isinstance(getattr(policy, "needs", None), Needs):
        faults.append("needs (nurec_sim.types.Needs)")
    if faults:
        raise ScenarioError(f"policy '{reference}' is not a policy: it lacks {', '.join(faults)}")
    return policy
