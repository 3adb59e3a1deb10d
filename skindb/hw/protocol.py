"""The wire protocol: lines, and readings that are checked before they are used."""

from __future__ import annotations

import binascii
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import quote, unquote

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


def checksum(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, not reflected."""
    return binascii.crc_hqx(body, 0xFFFF)


def decode(line: bytes) -> Message:
    """Decode a line without its newline; raises `ProtocolError` if it is not a message."""
    match = LINE.fullmatch(line)
    if match is None or len(line) >= MAX_LINE_BYTES:
        raise ProtocolError(f"{line[:80]!r} is not a message of the protocol")
    kind, number, verb, values, crc = match.groups()
    if checksum(line[:-5]) != int(crc, 16):
        raise ProtocolError(f"{line[:80]!r} has a wrong checksum")
    pairs = [text.partition("=") for text in values.decode("ascii").split()]
    return Message(
        kind.decode(),
        int(number),
        verb.decode(),
        {name: unquote(value) for name, _, value in pairs},
    )


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
    """Numbers from `least` to `most`."""

    least: float
    most: float
    unit: str = ""

    def __str__(self) -> str:
        """Describe the range in words."""
        return f"a number from {self.least:,.12g} to {self.most:,.12g} {self.unit}".rstrip()

    def parse(self, text: str) -> float:
        """The number; raises ValueError if the text is not a finite number in this range."""
        number = float(text) if NUMBER.fullmatch(text) else math.nan
        if not self.least <= number <= self.most:
            raise ValueError(text)
        return number


@dataclass(frozen=True)
class Count:
    """Whole numbers from `least` to `most`."""

    least: int
    most: int

    def __str__(self) -> str:
        """Describe the numbers in words."""
        return f"a whole number from {self.least} to {self.most}"

    def parse(self, text: str) -> int:
        """The number; raises ValueError if the text is not one of these numbers."""
        number = int(text) if INTEGER.fullmatch(text) else self.least - 1
        if not self.least <= number <= self.most:
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
