"""What every test may lean on: where the recorded flights are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def _shared_folder() -> Path | None:
    """The folder ``shared`` named by UAVLINKD_SHARED, or beside the checkout."""
    named = os.environ.get("UAVLINKD_SHARED")
    candidates = [Path(named)] if named else [parent / "shared" for parent in Path(__file__).parents]
    return next((folder for folder in candidates if (folder / "data").is_dir()), None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded flights (.tlog), which are not part of the project."""
    folder = _shared_folder()
    if folder is None:
        pytest.skip("no recorded flights: set UAVLINKD_SHARED to a folder that has data/*.tlog")
    return folder / "data"
