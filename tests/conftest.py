import gc
import os
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings

# Property tests draw the same examples in every run, however long each takes on a busy machine;
# --hypothesis-profile=default draws new ones.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# Tests compare bytes of frames: "auto" is the CPU, on a machine with a GPU too.
os.environ.setdefault("NUREC_SIM_DEVICE", "cpu")

# Asserts in helpers show the values that they compared, as those in tests do.
pytest.register_assert_rewrite(*(path.stem for path in (Path(__file__).parent / "helpers").glob("*.py")))

if "PYTEST_XDIST_WORKER" in os.environ:
    # As many workers as cores: more threads in each of them would only wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Workers are told a terminal's width, which they have not got.
    os.environ.pop("COLUMNS", None)


TESTS = Path(__file__).parent
BEGIN = (
    "render/test_render_parity.py",
    "world/test_world_write.py",
    "scene/test_scene_validate.py",
    "world/test_world_plan.py",
    "render/test_render_gradients.py",
    "logs/test_logs_checks.py",
    "logs/test_logs_faults.py",
    "reconstruct/test_reconstruct.py",
    "world/test_world_sense.py",
    "world/test_world_lens.py",
    "reconstruct/test_optimize.py",
)
"""Files that workers begin with, in this order. While one of them compiles the kernels of a room, the other gets files
that need none; else both would compile the same ones, where none are on disk yet."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items) -> None:
    """What takes long comes first, so that no worker is left with it alone: ``BEGIN``, then files of many tests."""
    sizes = Counter(item.path for item in items)
    place = {TESTS / name: k for k, name in enumerate(BEGIN)}
    items.sort(key=lambda item: (place.get(item.path, len(BEGIN)), 0 if item.path in place else -sizes[item.path]))


def pytest_collection_finish() -> None:
    """What is imported stays: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disk():
    """Files of tests need not survive a power failure, and each of thousands of synchronisations takes milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


def _folder(variable: str, beside: str, what: str) -> Path:
    """A folder named by a variable or beside the repository; skips where it is not."""
    folder = Path(os.environ.get(variable, Path(__file__).parents[2] / "shared" / beside))
    if not folder.is_dir():
        pytest.skip(f"no {what} at {folder}; set {variable} to their folder")
    return folder


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real driving packs, which are not part of the repository."""
    return _folder("NUREC_SIM_REALDATA", "realdata", "real driving packs")


@pytest.fixture(scope="session")
def rawlogs() -> Path:
    """Folder of real logs in their publishers' layouts, which are not part of the repository."""
    return _folder("NUREC_SIM_RAWLOGS", "rawlogs", "published logs")


@pytest.fixture(scope="session")
def alpasim_messages() -> Path:
    """Folder of all recorded AlpaSim messages; those of a generated street alone are part of the repository."""
    return _folder("NUREC_SIM_ALPASIM_MESSAGES", "alpasim_messages", "AlpaSim messages")
