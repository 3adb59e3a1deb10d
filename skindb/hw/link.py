"""A device at the end of a serial line or a socket: requests with deadlines, events, and a log of all bytes."""

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
REPLY_SECONDS = 0.3  # that a device has to answer
ATTEMPTS = 3  # of a request: together less than a second, after which a device counts as vanished
READ_SECONDS = 0.005  # that one look for new bytes may wait
CURE = "check its power and its cable, then run the command again"


class DeviceError(InputError):
    """A device does not answer, refuses a request, or sends an invalid reply."""


class RefusedError(DeviceError):
    """A device answered a request with a refusal."""


class Port(Protocol):
    """What a `Link` needs of a serial port."""

    def read(self, size: int) -> bytes:
        """At most `size` bytes; none after a short time without any."""

    def write(self, data: bytes) -> object:
        """Send bytes."""

    def close(self) -> None:
        """Close the port."""


class Link:
    """The connection to one device.

    A request is repeated with its number if no reply arrives in time; the device answers a repeated number again
    without doing it twice. Every call ends within `ATTEMPTS * REPLY_SECONDS`.

    Parameters
    ----------
    port
        Of `open_port` or a `ReplayPort`.
    name
        Of the device in messages.
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
        """Lines that arrived damaged."""
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
                    found = reply.values.get("text", "no reason")
                    raise RefusedError(Fault(self.name, f"must accept {verb}", found, ""))
                return reply
        seconds = ATTEMPTS * REPLY_SECONDS
        noise = f", and {self.damaged} damaged lines, the last {self._lines.sample!r}" if self.damaged else ""
        raise self.error(f"must answer {verb} within {seconds:.1f} s", f"nothing{noise}")

    def values(self, reply: Message, **kinds: Callable[[str], Any]) -> list[Any]:
        """The values of a reply by name, each read by its kind; `DeviceError` if one is missing or of another kind."""
        try:
            return [kind(reply.values[name]) for name, kind in kinds.items()]
        except (KeyError, ValueError):
            rule, found = f"must send the values {', '.join(kinds)}", reply.encode().decode("ascii").strip()
            raise self.error(rule, found, "correct the firmware, see docs/protocol.md") from None

    def hello(self, kind: str) -> Message:
        """Ask for the identity of the device; `DeviceError` unless it is of this kind and protocol."""
        found = self.request("HELLO")
        said = found.values.get("kind", "an unknown device"), found.values.get("protocol", "?")
        if said != (kind, str(PROTOCOL)):
            rule = f"must be a {kind} with protocol {PROTOCOL}"
            raise self.error(rule, f"{said[0]} with protocol {said[1]}", "check which device has which address")
        return found

    def events(self) -> list[Message]:
        """Events since the last call, in their order."""
        self.poll()
        found, self._events = self._events, []
        return found

    def poll(self) -> None:
        """Read and decode the bytes that have arrived."""
        try:
            data = self._port.read(4096)
        except (OSError, serial.SerialException, TypeError) as error:  # TypeError: pyserial, of a closed descriptor
            raise self.error("must stay connected", f"{error}") from None
        if not data:
            return
        self._note("<", data)
        for message in self._lines.feed(data):
            if message.kind == REPLY and message.number == self._number:  # those of earlier attempts are late
                self._replies[message.number] = message
            elif message.kind == EVENT:
                self._count(message.number)
                self._events.append(message)

    def error(self, rule: str, found: str, cure: str = CURE) -> DeviceError:
        """An error with this message about the device."""
        return DeviceError(Fault(self.name, rule, found, cure))

    def close(self) -> None:
        """Close the connection and the log."""
        own = getattr(self._port, "_socket", None)
        self._port.close()
        if own is not None:  # pyserial leaves it open if the other end is gone
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
    """The path, or the first one like it with a number that does not exist: logs of earlier sessions stay."""
    numbered = (path.with_stem(f"{path.stem}-{i}") for i in count(2))
    return path if not path.exists() else next(one for one in numbered if not one.exists())


def open_port(url: str) -> Port:
    """A port by its pyserial URL: ``/dev/ttyACM0``, ``socket://host:port``, ``loop://``, ``spy://...``.

    Raises
    ------
    DeviceError
        If there is nothing at that address.
    """
    try:
        port: Port = serial.serial_for_url(url, baudrate=BAUD_RATE, timeout=READ_SECONDS, write_timeout=REPLY_SECONDS)
    except (OSError, ValueError, LookupError, AttributeError, TypeError, serial.SerialException) as error:
        # pyserial parses its URLs without checks, and lets what goes wrong there through
        rule, cure = "a device must be at this address", "an address is like /dev/ttyACM0 or socket://127.0.0.1:7000"
        raise DeviceError(Fault(f"address {url}", rule, _system_reason(error), cure)) from None
    return port


def _system_reason(error: BaseException | None) -> str:
    """Why the system did not open a port, without the repetitions of pyserial."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return os.strerror(error.errno)
        error = error.__context__
    return "no address that pyserial understands"


class ReplayPort:
    """A port that answers as a recorded session did.

    Parameters
    ----------
    path
        Log of a `Link`.

    Raises
    ------
    DeviceError
        At a request that is not the recorded one.
    """

    def __init__(self, path: Path, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.path, self._sleep = path, sleep
        lines = path.read_text(encoding="ascii").splitlines()
        self._left = [(direction, _bytes(text)) for _, direction, text in (line.split(" ", 2) for line in lines)]

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return the recorded bytes up to the next request of the host."""
        data = b""
        while self._left and self._left[0][0] == "<":
            data += self._left.pop(0)[1]
        if not data:
            self._sleep(READ_SECONDS)
        return data

    def write(self, data: bytes) -> None:
        """Compare with the recorded request."""
        self.read(0)  # late replies to requests that have timed out
        recorded = self._left.pop(0)[1] if self._left else b"nothing more"
        if recorded != data:
            rule, found = f"a replay must be asked {recorded!r}", f"{data!r}"
            raise DeviceError(Fault(str(self.path), rule, found, "replay it with the same commands"))

    def close(self) -> None:
        """Do nothing: no port is open."""


def _bytes(text: str) -> bytes:
    value = ast.literal_eval(text)
    if not isinstance(value, bytes):
        raise ValueError(text)
    return value
