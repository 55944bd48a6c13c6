"""What the tests of result files share."""

from pathlib import Path

import pytest


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A path where no file is yet."""
    return tmp_path / "result.h5"
