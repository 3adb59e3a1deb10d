from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from sphere import write_capture


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "T001"
    write_capture(folder)
    return folder


@pytest.fixture
def capture_folder(pristine, tmp_path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(pristine, tmp_path / "T001"))
