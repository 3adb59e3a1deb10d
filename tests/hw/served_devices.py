"""Emulated devices behind a real pseudo terminal or socket, served by a thread in real time."""

from __future__ import annotations

import os
import socket
import threading
import tty
from typing import Self

from skindb.virtual.devices import Emulated

TICK_SECONDS = 0.002


class Terminal:
    """An emulated device at a pseudo terminal, like a serial port; use it in a ``with``
    statement.
    """

    def __init__(self, device: Emulated) -> None:
        self.device = device
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        """Start serving; `url` is the path of the port."""
        self._own, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self._own, False)
        self.url = os.ttyname(self._other)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self._end.set()
        self._thread.join(5)
        for descriptor in (self._own, self._other):
            os.close(descriptor)

    def _serve(self) -> None:
        while not self._end.wait(TICK_SECONDS):
            try:
                data = os.read(self._own, 4096)
            except BlockingIOError:
                data = b""
            self.device.receive(data)
            os.write(self._own, self.device.tick())


class Server:
    """An emulated device at a local TCP port, served by a thread.

    Use it in a ``with`` statement; `url` is its address for pyserial.
    """

    def __init__(self, device: Emulated) -> None:
        self.device = device
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.1)
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        """Serve."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self._end.set()
        self._thread.join(5)
        self._listener.close()

    def _serve(self) -> None:
        while not self._end.is_set():
            self.device.tick()
            try:
                line, _ = self._listener.accept()
            except TimeoutError:
                continue
            with line:
                self._talk(line)

    def _talk(self, line: socket.socket) -> None:
        line.settimeout(TICK_SECONDS)
        while not self._end.is_set() and not self.device.gone:
            try:
                data = line.recv(4096)
                if not data:
                    return
                self.device.receive(data)
            except TimeoutError:
                pass
            except OSError:
                return
            try:
                line.sendall(self.device.tick())
            except OSError:
                return
