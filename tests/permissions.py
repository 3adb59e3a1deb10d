"""Permissions of what was written."""

from __future__ import annotations

import os
from contextlib import contextmanager


def open_to_others(folder, *, itself=True):
    """Files and folders below a folder that are not private: 0600 or, for folders, 0700."""
    every = [folder, *folder.rglob("*")] if itself else [*folder.rglob("*")]
    wrong = [
        path
        for path in every
        if path.lstat().st_mode & 0o777 != (0o700 if path.is_dir() else 0o600)
    ]
    return {
        str(path): oct(path.lstat().st_mode & 0o777)
        for path in wrong
        if not path.is_symlink()
    }


@contextmanager
def open_umask():
    """Context in which new files are readable and writable by everybody, unless their
    writer prevents it.
    """
    before = os.umask(0)
    try:
        yield
    finally:
        os.umask(before)
