"""The wire protocol, and the link to a device: lines with checksums, readings that are checked
before they are used, requests with deadlines, and a log of all bytes.
"""

import binascii
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Protocol, TextIO, TypeVar
from urllib.parse import quote, unquote

import serial

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import Fault, InputError, system_fault

PROTOCOL = 1  # version that HELLO reports
# HELLO of a dome lists its lights: 150 ids of four characters need 750 bytes
MAX_LINE_BYTES = 8192
MAX_NUMBER = 99_999
REQUEST = "Q"
REPLY = "R"
EVENT = "E"
OK = "OK"
ERROR = "ERR"
LINE = re.compile(
    rb"([QRE])(\d{1,5}) ([A-Z]{1,16})((?: [a-z_]{1,16}=[!-)+-~]{0,8000})*)\*([0-9A-F]{4})"
)
NUMBER = re.compile(
    r"[+-]?[0-9]{1,12}(\.[0-9]{1,12})?(e[+-]?[0-9]{1,2})?", re.IGNORECASE
)
SLACK_SECONDS = 2.0  # by which a device may take longer than planned
EARLY_SECONDS = 0.05  # by which it may take less
CLOCK_ERROR = 0.002  # relative, of its clock; one without a crystal is wrong by 0.01
INTEGER = re.compile(r"-?[0-9]{1,12}")
BAUD_RATE = 115_200
REPLY_SECONDS = 0.3  # within which a device must answer
# of a request, together less than a second, after which a device counts as lost
ATTEMPTS = 3
BOOT_SECONDS = 5.0  # in which a board that resets when its port is opened must answer
READ_SECONDS = 0.005  # timeout of one read of the port
# without a request, after which a device switches everything off
WATCHDOG_SECONDS = 0.5
SILENCE_SECONDS = 0.6  # without a request, after a STOP that a device did not confirm
MAX_WAITING_EVENTS = 1_000  # the gauge of the probe sends ten in a second
CURE = "check its power and its cable, then run the command again"
FIRMWARE_CURE = "correct the firmware, see docs/protocol.md"

T_co = TypeVar("T_co", covariant=True)
T = TypeVar("T")


class ProtocolError(ValueError):
    """A line is not a message of the protocol."""


@dataclass(frozen=True)
class Message:
    """A request of the host, the reply to it, or an event that a device sends without a request.

    Parameters
    ----------
    kind
        `REQUEST`, `REPLY` or `EVENT`.
    number
        Number of the request; a reply has the number of its request, and events are
        counted separately.
    verb
        Name of the request or event; `OK` or `ERR` in replies.
    values
        Named values as text.
    """

    kind: str
    number: int
    verb: str
    values: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        """Verb and values, as shown in messages."""
        return text_of(self.verb, self.values)

    def encode(self) -> bytes:
        """The line of this message, with its newline."""
        values = "".join(
            f" {name}={quote(value, safe='/:.,+-')}"
            for name, value in self.values.items()
        )
        body = f"{self.kind}{self.number} {self.verb}{values}".encode("ascii")
        line = body + b"*%04X\n" % checksum(body)
        if len(line) > MAX_LINE_BYTES or LINE.fullmatch(line[:-1]) is None:
            raise ProtocolError(f"{line[:80]!r} is not a message of the protocol")
        return line


def text_of(verb: str, values: Mapping[str, object]) -> str:
    """A verb and its values, as shown in messages."""
    return " ".join([verb, *(f"{name}={value}" for name, value in values.items())])


def checksum(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, not reflected."""
    return binascii.crc_hqx(body, 0xFFFF)


def decode(line: bytes) -> Message:
    """Decode a line without its newline; raises `ProtocolError` if it is not a message."""
    match = LINE.fullmatch(line)
    if match is None or len(line) >= MAX_LINE_BYTES:
        raise ProtocolError(f"{line[:80]!r} is not a message of the protocol")
    kind, number, verb, values, crc = (part.decode() for part in match.groups())
    if checksum(line[:-5]) != int(crc, 16):
        raise ProtocolError(f"{line[:80]!r} has a wrong checksum")
    pairs = (text.partition("=") for text in values.split())
    named = {name: unquote(value) for name, _, value in pairs}
    return Message(kind, int(number), verb, named)


class Lines:
    """Splits bytes that arrive in arbitrary pieces into messages; other lines are
    counted and skipped.
    """

    def __init__(self) -> None:
        self._rest = b""
        self.damaged = 0  # number of lines that are not messages
        self.sample = b""  # the last of these lines

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes and return the messages that are now complete."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # noise without newlines must not fill the memory
        if len(self._rest) > MAX_LINE_BYTES:
            lines = [*lines, self._rest]
            self._rest = b""
        messages = []
        for line in filter(None, (line.rstrip(b"\r") for line in lines)):
            try:
                messages.append(decode(line))
            except ProtocolError:
                self.damaged = self.damaged + 1
                self.sample = line[:80]
        return messages


@dataclass(frozen=True)
class Range:
    """Numbers from `lowest` to `highest`."""

    lowest: float
    highest: float
    unit: str = ""

    def __str__(self) -> str:
        """Describe the range in words."""
        return f"a number from {self.lowest:,.12g} to {self.highest:,.12g} {self.unit}".rstrip()

    def parse(self, text: str) -> float:
        """The number; raises ValueError if the text is not a finite number in this range."""
        number = float(text) if NUMBER.fullmatch(text) else math.nan
        if not self.lowest <= number <= self.highest:
            raise ValueError(text)
        return number


@dataclass(frozen=True)
class Count:
    """Whole numbers from `lowest` to `highest`."""

    lowest: int
    highest: int

    def __str__(self) -> str:
        """Describe the numbers in words."""
        return f"a whole number from {self.lowest} to {self.highest}"

    def parse(self, text: str) -> int:
        """The number; raises ValueError if the text is not one of these numbers."""
        number = int(text) if INTEGER.fullmatch(text) else self.lowest - 1
        if not self.lowest <= number <= self.highest:
            raise ValueError(text)
        return number


@dataclass(frozen=True)
class Word:
    """One of a few words."""

    words: tuple[str, ...]

    def __str__(self) -> str:
        """Describe the words."""
        return f"one of {', '.join(self.words)}"

    def parse(self, text: str) -> str:
        """The word; raises ValueError if it is another one."""
        if text not in self.words:
            raise ValueError(text)
        return text


# of the light controller
STATES = Word(("idle", "armed", "running", "done", "stopped"))
INTERLOCKS = Word(("closed", "open"))
TRIGGERS = Count(0, 1)  # of the cameras, by step or exposure
# the zero of a current sensor may be off
CURRENT = Range(-0.1, 10.0, "of the nominal current")
# of all lights together
REST_CURRENT = Range(-0.1, 1_000.0, "of the current of a light")

# of the probe
PROBE_STATES = Word(("idle", "exposing"))
GAUGE_KPA = Range(-101.4, 1_000.0, "kPa")  # from a vacuum, as in docs/capture_format.md
GAUGE_SECONDS = Range(0.0, 3_600.0, "s")


class DeviceError(InputError):
    """A device does not answer, refuses a request, or sends an unexpected reply."""


class NoReplyError(DeviceError):
    """A device did not answer a request in time."""


class RefusedError(DeviceError):
    """A device is connected and refused a request."""


class Accepted(Protocol[T_co]):
    """Values that a device may send; see `skindb.hw.link`."""

    def parse(self, text: str) -> T_co:
        """The value; raises ValueError if the text is not one of these values."""


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

    A request is repeated with the same number if no reply arrives in time; the device answers a
    repeated number without executing the request again. Every call ends within
    `ATTEMPTS * REPLY_SECONDS`, twice that if the port accepts no bytes.

    Parameters
    ----------
    port
        From `open_port`, or a `ReplayPort`.
    name
        Name of the device in messages.
    clock
        Clock by which deadlines are measured.
    log
        File for all bytes with their times, which `ReplayPort` reads; if it exists, a number is
        added to the name.
    """

    def __init__(
        self,
        port: Port,
        name: str,
        *,
        clock: Clock = SYSTEM_CLOCK,
        log: Path | None = None,
    ) -> None:
        self.name = name
        self.clock = clock
        self._port = port
        self._lines = Lines()
        self._number = 0
        self._reply: Message | None = None  # to the last request
        self._events: list[Message] = []
        self._next_event: int | None = None
        self._disorder = ""  # why the events cannot be trusted
        self._start = clock.monotonic()
        self._log: TextIO | None = None
        if log is not None:
            numbered = (log.with_stem(f"{log.stem}-{i}") for i in count(2))
            path = next(file for file in chain([log], numbered) if not file.exists())
            self._log = path.open("x", encoding="ascii")

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
        self._reply = None
        texts = {name: str(value) for name, value in values.items()}
        line = Message(REQUEST, self._number, verb, texts).encode()
        for _ in range(ATTEMPTS):
            self._write(line)
            if (reply := self._wait()) is not None:
                return self._require_ok(verb, reply)
        finding = "no reply"
        if self.damaged:
            finding += (
                f", and {self.damaged} damaged lines, the last {self._lines.sample!r}"
            )
        rule = f"must answer {verb} within {ATTEMPTS * REPLY_SECONDS:.1f} s"
        raise NoReplyError(Fault(self.name, rule, finding, CURE))

    def value(self, message: Message, name: str, accepted: Accepted[T]) -> T:
        """A value of a reply or an event.

        Raises
        ------
        DeviceError
            If it is missing, or is not one of the accepted values.
        """
        text = message.values.get(name)
        if text is None:
            line = message.encode().decode("ascii").strip()
            raise self.error(f"must send the value {name}", line, FIRMWARE_CURE)
        try:
            return accepted.parse(text)
        except ValueError:
            raise self.error(
                f"must send as {name} {accepted}",
                f"{text!r} in {message.kind}{message.number}",
                FIRMWARE_CURE,
            ) from None

    def hello(self, kind: str) -> Message:
        """Identify the device, which may start only now; raises `DeviceError` unless it
        has this kind and the supported protocol.
        """
        deadline = self.clock.monotonic() + BOOT_SECONDS
        while True:
            try:
                reply = self.request("HELLO")
                break
            except NoReplyError:
                if self.clock.monotonic() >= deadline:
                    raise
        finding = reply.values.get("kind", "an unknown device")
        finding += f" with protocol {reply.values.get('protocol', '?')}"
        expected = f"{kind} with protocol {PROTOCOL}"
        if finding != expected:
            cure = "check which device has which address"
            raise self.error(f"must be a {expected}", finding, cure)
        return reply

    def events(self) -> list[Message]:
        """Events since the last call, in order.

        Raises
        ------
        DeviceError
            If events were repeated or out of order, or more arrived than a device may send.
        """
        self.poll()
        events = self._events
        disorder = self._disorder
        self._forget_events()
        if disorder:
            raise self.error("must send its events in order", disorder, FIRMWARE_CURE)
        return events

    def discard_events(self) -> None:
        """Ignore the events that have arrived so far."""
        self.poll()
        self._forget_events()
        self._next_event = None

    def poll(self) -> None:
        """Read the bytes that have arrived, and store their replies and events."""
        try:
            data = self._port.read(4096)
        except (OSError, TypeError) as error:
            # TypeError: pyserial with a closed descriptor
            raise self.error("must stay connected", f"{error}") from None
        if not data:
            return
        self._note("<", data)
        for message in self._lines.feed(data):
            if message.kind == EVENT:
                self._store_event(message)
            elif (
                message.kind == REPLY
                and message.number == self._number
                and self._reply is None
            ):
                self._reply = message  # late replies to earlier requests are ignored

    def error(self, rule: str, found: str, cure: str = CURE) -> DeviceError:
        """`DeviceError` that names this device."""
        return DeviceError(Fault(self.name, rule, found, cure))

    def close(self) -> None:
        """Close the port and the log."""
        close_port(self._port)
        if self._log is not None:
            self._log.close()

    def _wait(self) -> Message | None:
        """The reply to the last request, or None if it does not arrive in time."""
        deadline = self.clock.monotonic() + REPLY_SECONDS
        while self._reply is None and self.clock.monotonic() < deadline:
            self.poll()
        return self._reply

    def _require_ok(self, verb: str, reply: Message) -> Message:
        if reply.verb == ERROR:
            text = reply.values.get("text", "a refusal without a reason")
            raise RefusedError(Fault(self.name, f"must accept {verb}", text, ""))
        if reply.verb != OK:
            raise self.error(
                f"must answer {verb} by OK or ERR", repr(reply.verb), FIRMWARE_CURE
            )
        return reply

    def _store_event(self, event: Message) -> None:
        due = self._next_event
        if self._disorder:
            return
        if due is not None and (event.number - due) % MAX_NUMBER > MAX_NUMBER // 2:
            self._disorder = f"event {event.number} where {due} was due"
        elif len(self._events) >= MAX_WAITING_EVENTS:
            self._disorder = (
                f"more than {MAX_WAITING_EVENTS} events that were not asked for"
            )
        else:
            self._next_event = event.number % MAX_NUMBER + 1
            self._events.append(event)

    def _forget_events(self) -> None:
        self._events = []
        self._disorder = ""

    def _write(self, data: bytes) -> None:
        try:
            # pyserial also reports a timeout if this process was suspended after it had
            # sent the line; if it was not sent, there is no reply, and it is sent again
            with suppress(serial.SerialTimeoutException):
                self._port.write(data)
        except OSError as error:
            raise self.error("must stay connected", f"{error}") from None
        self._note(">", data)

    def _note(self, direction: str, data: bytes) -> None:
        if self._log is None:
            return
        seconds = self.clock.monotonic() - self._start
        try:
            self._log.write(f"{seconds:.4f} {direction} {data!r}\n")
            self._log.flush()
        except OSError as error:
            name = self._log.name
            self._log = None  # a full disk must not keep the device from being stopped
            raise DeviceError(system_fault(error, name)) from None


def open_port(url: str) -> Port:
    """Open a port by its pyserial URL: ``/dev/ttyACM0``, ``socket://host:port``,
    ``loop://``, ``spy://...``.

    Raises
    ------
    DeviceError
        If the port cannot be opened.
    """
    try:
        port: Port = serial.serial_for_url(
            url, baudrate=BAUD_RATE, timeout=READ_SECONDS, write_timeout=REPLY_SECONDS
        )
    except (OSError, ValueError, LookupError, AttributeError, TypeError) as error:
        # pyserial, whose own error is an OSError, does not catch the errors of parsing
        raise DeviceError(
            Fault(
                f"address {url}",
                "a device must be at this address",
                _system_reason(error),
                "give an address like /dev/ttyACM0 or socket://127.0.0.1:7000",
            )
        ) from None
    return port


def close_port(port: Port) -> None:
    """Close a port; pyserial leaves a socket open if the other end is closed."""
    connection = getattr(port, "_socket", None)
    port.close()
    if connection is not None:
        connection.close()


def _system_reason(error: BaseException | None) -> str:
    """Reason of the operating system why a port was not opened, without the repetitions
    of pyserial.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return os.strerror(error.errno)
        error = error.__context__
    return "an address that pyserial cannot parse"


@contextmanager
def stopped_at_end(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` at the end, also after an error; the faults of both are raised together."""
    try:
        yield
    except InputError as error:
        try:
            stop()
        except DeviceError as second:
            raise DeviceError([*error.faults, *second.faults]) from None
        raise
    except BaseException:
        stop()
        raise
    stop()
