"""Fixtures of emulated devices."""

from __future__ import annotations

from types import SimpleNamespace

import pytest


@pytest.fixture(autouse=True)
def _quick_sockets(monkeypatch):
    """pyserial waits when it closes a socket; no test here is about that pause."""
    monkeypatch.setattr(
        "serial.urlhandler.protocol_socket.time", SimpleNamespace(sleep=lambda _: None)
    )
