import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real driving packs, which are not part of the repository."""
    folder = Path(os.environ.get("NUREC_SIM_REALDATA", Path(__file__).parents[2] / "shared" / "realdata"))
    if not folder.is_dir():
        pytest.skip(f"no real driving packs at {folder}; set NUREC_SIM_REALDATA to their folder")
    return folder
