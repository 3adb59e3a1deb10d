"""Fixtures of emulated devices."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _quick(quick_links):
    """No test here is about the pauses of pyserial."""
