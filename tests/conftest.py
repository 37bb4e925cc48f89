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


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real driving packs, which are not part of the repository."""
    folder = Path(os.environ.get("NUREC_SIM_REALDATA", Path(__file__).parents[2] / "shared" / "realdata"))
    if not folder.is_dir():
        pytest.skip(f"no real driving packs at {folder}; set NUREC_SIM_REALDATA to their folder")
    return folder


@pytest.fixture(scope="session")
def rawlogs() -> Path:
    """Folder of real logs in their publishers' layouts, which are not part of the repository."""
    folder = Path(os.environ.get("NUREC_SIM_RAWLOGS", Path(__file__).parents[2] / "shared" / "rawlogs"))
    if not folder.is_dir():
        pytest.skip(f"no published logs at {folder}; set NUREC_SIM_RAWLOGS to their folder")
    return folder


@pytest.fixture(scope="session")
def alpasim_messages() -> Path:
    """Folder of all recorded AlpaSim messages; those of the demo log alone are part of the repository."""
    shared = Path(__file__).parents[2] / "shared" / "alpasim_messages"
    folder = Path(os.environ.get("NUREC_SIM_ALPASIM_MESSAGES", shared))
    if not folder.is_dir():
        pytest.skip(f"no AlpaSim messages at {folder}; set NUREC_SIM_ALPASIM_MESSAGES to their folder")
    return folder
