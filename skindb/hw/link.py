"""Connection to a device over a serial line or a socket: requests with deadlines, events, and a log of all bytes."""

from __future__ import annotations

import ast
import os
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, Protocol, TextIO

import serial

from skindb.errors import Fault, InputError
from skindb.hw.protocol import ERROR, EVENT, MAX_NUMBER, PROTOCOL, REPLY, REQUEST, Lines, Message

BAUD_RATE = 115_200
REPLY_SECONDS = 0.3  # within which a device must answer
ATTEMPTS = 3  # of a request, together less than a second, after which a device counts as lost
READ_SECONDS = 0.005  # timeout of one read of the port
CURE = "check its power and its cable, then run the command again"


class DeviceError(InputError):
    """A device does not answer, refuses a request, or sends an unexpected reply."""


class RefusedError(DeviceError):
    """A device is connected and refused a request."""


class Port(Protocol):
    """Interface of a serial port that `Link` needs."""

    def read(self, size: int) -> bytes:
        """Read at most `size` bytes; returns no bytes after a short timeout."""

    def write(self, data: bytes) -> object:
        """Send bytes."""

    def close(self) -> None:
        """Close the port."""


class Link:
    """Connection to one device.

    A request is repeated with the same number if no reply arrives in time; the device answers a repeated number without
    executing the request again. Every call ends within `ATTEMPTS * REPLY_SECONDS`.

    Parameters
    ----------
    port
        From `open_port`, or a `ReplayPort`.
    name
        Name of the device in messages.
    log
        File for all bytes with their times, which `ReplayPort` reads; if it exists, a number is added to the name.
    """

    def __init__(self, port: Port, name: str, *, log: Path | None = None) -> None:
        self.name, self._port, self._lines, self._number = name, port, Lines(), 0
        self._events: list[Message] = []
        self._replies: dict[int, Message] = {}
        self._next_event: int | None = None
        self.lost_events = 0
        self._start = time.monotonic()
        self._log: TextIO | None = None if log is None else _new_file(log).open("x", encoding="ascii")

    @property
    def damaged(self) -> int:
        """Number of damaged lines received."""
        return self._lines.damaged

    def request(self, verb: str, **values: object) -> Message:
        """Send a request and return the reply.

        Raises
        ------
        DeviceError
            If the device does not answer within a second, or refuses.
        """
        self._number = self._number % MAX_NUMBER + 1
        message = Message(REQUEST, self._number, verb, {name: str(value) for name, value in values.items()})
        for _ in range(ATTEMPTS):
            self._write(message.encode())
            deadline = time.monotonic() + REPLY_SECONDS
            while time.monotonic() < deadline:
                self.poll()
                reply = self._replies.pop(self._number, None)
                if reply is None:
                    continue
                if reply.verb == ERROR:
                    found = reply.values.get("text", "a refusal without a reason")
                    raise RefusedError(Fault(self.name, f"must accept {verb}", found, ""))
                return reply
        seconds = ATTEMPTS * REPLY_SECONDS
        noise = f", and {self.damaged} damaged lines, the last {self._lines.sample!r}" if self.damaged else ""
        raise self.error(f"must answer {verb} within {seconds:.1f} s", f"no reply{noise}")

    def values(self, reply: Message, **kinds: Callable[[str], Any]) -> list[Any]:
        """Values of a reply, each converted by its kind; raises `DeviceError` if one is missing or invalid."""
        try:
            return [kind(reply.values[name]) for name, kind in kinds.items()]
        except (KeyError, ValueError):
            rule, found = f"must send the values {', '.join(kinds)}", reply.encode().decode("ascii").strip()
            raise self.error(rule, found, "correct the firmware, see docs/protocol.md") from None

    def hello(self, kind: str) -> Message:
        """Identify the device; raises `DeviceError` unless it has this kind and the supported protocol."""
        found = self.request("HELLO")
        said = found.values.get("kind", "an unknown device"), found.values.get("protocol", "?")
        if said != (kind, str(PROTOCOL)):
            rule = f"must be a {kind} with protocol {PROTOCOL}"
            raise self.error(rule, f"{said[0]} with protocol {said[1]}", "check which device has which address")
        return found

    def events(self) -> list[Message]:
        """Events since the last call, in order."""
        self.poll()
        found, self._events = self._events, []
        return found

    def poll(self) -> None:
        """Read the bytes that have arrived, and store their replies and events."""
        try:
            data = self._port.read(4096)
        except (OSError, serial.SerialException, TypeError) as error:  # TypeError: pyserial with a closed descriptor
            raise self.error("must stay connected", f"{error}") from None
        if not data:
            return
        self._note("<", data)
        for message in self._lines.feed(data):
            if message.kind == REPLY and message.number == self._number:  # late replies to earlier requests are ignored
                self._replies[message.number] = message
            elif message.kind == EVENT:
                self._count(message.number)
                self._events.append(message)

    def error(self, rule: str, found: str, cure: str = CURE) -> DeviceError:
        """`DeviceError` that names this device."""
        return DeviceError(Fault(self.name, rule, found, cure))

    def close(self) -> None:
        """Close the port and the log."""
        own = getattr(self._port, "_socket", None)
        self._port.close()
        if own is not None:  # pyserial leaves the socket open if the other end is closed
            own.close()
        if self._log is not None:
            self._log.close()

    def _count(self, number: int) -> None:
        if self._next_event is not None and number != self._next_event:
            self.lost_events += (number - self._next_event) % MAX_NUMBER
        self._next_event = number % MAX_NUMBER + 1

    def _write(self, data: bytes) -> None:
        self._note(">", data)
        try:
            self._port.write(data)
        except (OSError, serial.SerialException) as error:
            raise self.error("must stay connected", f"{error}") from None

    def _note(self, direction: str, data: bytes) -> None:
        if self._log is not None:
            self._log.write(f"{time.monotonic() - self._start:.4f} {direction} {data!r}\n")
            self._log.flush()


def _new_file(path: Path) -> Path:
    """The path, with a number added if it exists, so that logs of earlier sessions are kept."""
    numbered = (path.with_stem(f"{path.stem}-{i}") for i in count(2))
    return path if not path.exists() else next(one for one in numbered if not one.exists())


def open_port(url: str) -> Port:
    """Open a port by its pyserial URL: ``/dev/ttyACM0``, ``socket://host:port``, ``loop://``, ``spy://...``.

    Raises
    ------
    DeviceError
        If the port cannot be opened.
    """
    try:
        port: Port = serial.serial_for_url(url, baudrate=BAUD_RATE, timeout=READ_SECONDS, write_timeout=REPLY_SECONDS)
    except (OSError, ValueError, LookupError, AttributeError, TypeError, serial.SerialException) as error:
        # pyserial parses its URLs without checks and does not catch the errors of parsing
        rule, cure = "a device must be at this address", "give an address like /dev/ttyACM0 or socket://127.0.0.1:7000"
        raise DeviceError(Fault(f"address {url}", rule, _system_reason(error), cure)) from None
    return port


def _system_reason(error: BaseException | None) -> str:
    """Reason of the operating system why a port was not opened, without the repetitions of pyserial."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return os.strerror(error.errno)
        error = error.__context__
    return "an address that pyserial cannot parse"


class ReplayPort:
    """A port that replays a recorded session.

    Parameters
    ----------
    path
        Log of a `Link`.
    sleep
        Function that waits when nothing is left to read.

    Raises
    ------
    DeviceError
        If a request differs from the recorded one.
    """

    def __init__(self, path: Path, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.path, self._sleep = path, sleep
        lines = path.read_text(encoding="ascii").splitlines()
        self._left = [(direction, _bytes(text)) for _, direction, text in (line.split(" ", 2) for line in lines)]

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return all bytes that were recorded until the next request of the host."""
        data = b""
        while self._left and self._left[0][0] == "<":
            data += self._left.pop(0)[1]
        if not data:
            self._sleep(READ_SECONDS)
        return data

    def write(self, data: bytes) -> None:
        """Compare the data with the recorded request."""
        self.read(0)  # skip late replies that were not used
        recorded = self._left.pop(0)[1] if self._left else b"nothing more"
        if recorded != data:
            rule, found = f"the next request of a replay must be {recorded!r}", f"{data!r}"
            raise DeviceError(Fault(str(self.path), rule, found, "replay it with the same commands"))

    def close(self) -> None:
        """Do nothing: no file is open."""


def _bytes(text: str) -> bytes:
    value = ast.literal_eval(text)
    if not isinstance(value, bytes):
        raise ValueError(text)
    return value
