import gc
import os
from pathlib import Path

import pytest

# Tests compare bytes of frames: "auto" is the CPU, on a machine with a GPU too.
os.environ.setdefault("NUREC_SIM_DEVICE", "cpu")

# Asserts in helpers show the values that they compared, as those in tests do.
pytest.register_assert_rewrite(*(path.stem for path in (Path(__file__).parent / "helpers").glob("*.py")))

if "PYTEST_XDIST_WORKER" in os.environ:
    # As many workers as cores: more threads in each of them would only wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Workers are told a terminal's width, which they have not got.
    os.environ.pop("COLUMNS", None)


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
    """Folder of all recorded AlpaSim messages; those of the demo log alone are part of the repository."""
    return _folder("NUREC_SIM_ALPASIM_MESSAGES", "alpasim_messages", "AlpaSim messages")
