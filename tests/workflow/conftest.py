"""Fixtures of studies."""

from __future__ import annotations

import pytest

from skindb.workflow import studies

TEXELS = 128  # along each side; the least for pyramids of 7 levels


@pytest.fixture
def small_textures(monkeypatch):
    """The study of albedo computes its textures from small maps."""
    monkeypatch.setattr(studies, "TEXELS", TEXELS)
