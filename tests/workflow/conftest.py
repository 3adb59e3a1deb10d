"""Fixtures of studies."""

from __future__ import annotations

import shutil

import pytest

from skindb.analysis import texture
from skindb.workflow import derive

TEXELS = 128  # along each side; the least for pyramids of 7 levels


@pytest.fixture
def small_textures(monkeypatch):
    """The study of albedo computes its textures from small maps."""
    monkeypatch.setattr(texture, "SIZE", TEXELS)


@pytest.fixture
def change_code(tmp_path, monkeypatch):
    """Function that changes a file in the copy of skindb whose digests are computed."""
    copy = tmp_path / "changed" / "skindb"
    shutil.copytree(derive.ROOT, copy, ignore=shutil.ignore_patterns("__pycache__"))

    def change(name, old, new):
        text = (copy / name).read_text()
        assert old in text
        (copy / name).write_text(text.replace(old, new))
        monkeypatch.setattr(derive, "ROOT", copy)

    return change
