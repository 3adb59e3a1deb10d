"""A capture of the virtual dome and its surfels, which no test changes."""

from __future__ import annotations

import pytest

from skindb.format.folder import read_capture
from skindb.ingest.surfels import build_surfels


@pytest.fixture(scope="module")
def capture(pristine):
    return read_capture(pristine)


@pytest.fixture(scope="module")
def surfels(capture):
    return build_surfels(capture, spacing_mm=4.0)
