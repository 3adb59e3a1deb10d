"""The wire protocol: round trips, an independent checksum, and attacks on the parser."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skindb.hw.protocol import (
    MAX_LINE_BYTES,
    MAX_NUMBER,
    Lines,
    Message,
    ProtocolError,
    checksum,
    decode,
)

NAMES = st.text("abcxyz_", min_size=1, max_size=8)
MESSAGES = st.builds(
    Message,
    st.sampled_from("QRE"),
    st.integers(0, MAX_NUMBER),
    st.text("ABCXYZ", min_size=1, max_size=12),
    st.dictionaries(
        NAMES, st.text(st.characters(codec="utf-8"), max_size=8), max_size=4
    ),
)


def bitwise_crc(data):
    """Bit by bit, as firmware would compute it."""
    value = 0xFFFF
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def test_checksum__has_the_published_check_value():
    # CRC-16/IBM-3740 in the catalogue of parametrised CRC algorithms
    assert checksum(b"123456789") == 0x29B1


@settings(deadline=None)
@given(st.binary(max_size=130))
def test_checksum__is_that_of_shifting_bits(data):
    assert checksum(data) == bitwise_crc(data)


@settings(deadline=None)
@given(MESSAGES)
def test_encode__round_trip(message):
    line = message.encode()
    assert line.endswith(b"\n")
    assert line.isascii()
    assert decode(line[:-1]) == message


@settings(deadline=None)
@given(
    st.one_of(
        st.binary(max_size=160), MESSAGES.map(lambda message: message.encode()[:-1])
    )
)
def test_decode__accepts_lines_of_the_format_only(line):
    try:
        message = decode(line)
    except ProtocolError:
        return
    assert decode(message.encode()[:-1]) == message
    assert int(line[-4:], 16) == bitwise_crc(line[:-5])


@pytest.mark.parametrize(
    "message",
    [
        Message("X", 1, "HELLO"),
        Message("Q", -1, "HELLO"),
        Message("Q", 10**6, "HELLO"),
        Message("Q", 1, "hello"),
        Message("Q", 1, "HELLO", {"Name": "a"}),
        Message("Q", 1, "HELLO", {"name": "a" * 9000}),
    ],
)
def test_encode__refuses_what_breaks_the_format(message):
    with pytest.raises(ProtocolError, match="is not a message of the protocol"):
        message.encode()


@settings(deadline=None)
@given(
    st.lists(MESSAGES, max_size=6),
    st.lists(st.integers(1, 40), min_size=1, max_size=30),
)
def test_feed__any_cuts_of_the_stream_give_the_same_messages(messages, cuts):
    stream = b"".join(message.encode() for message in messages)
    lines = Lines()
    found = []
    at = 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        found += lines.feed(stream[at : at + step])
        at += step
    assert found == messages
    assert lines.damaged == 0


def test_feed__counts_noise_and_goes_on():
    lines = Lines()
    good = Message("E", 7, "PRESSURE", {"kpa": "-5.0"}).encode()
    assert (
        len(lines.feed(b"\xff\x00noise\n\n" + good + good.replace(b"-5", b"-6") + good))
        == 2
    )
    assert lines.damaged == 2
    assert lines.feed(b"x" * (10 * MAX_LINE_BYTES)) == []
    assert lines.feed(b"\n" + good) == [decode(good[:-1])]


def test_feed__attacks_never_raise_nor_pass_a_changed_message():
    """Flips of one to three bits, cuts, merged lines, random bytes: whatever is
    accepted was sent.
    """
    for seed in range(300):
        _check_feed__attacks_never_raise_nor_pass_a_changed_message(seed)


def _check_feed__attacks_never_raise_nor_pass_a_changed_message(seed):
    rng = np.random.default_rng(seed)
    sent = [
        Message(
            "R",
            int(rng.integers(MAX_NUMBER)),
            "OK",
            {"v": str(rng.integers(10**8)), "w": str(i)},
        )
        for i in range(20)
    ]
    wire = []
    for message in sent:
        line = bytearray(message.encode())
        attack = rng.integers(6)
        # the CRC finds any three flipped bits of lines that are so short
        if attack == 0:
            for bit in rng.choice(
                8 * (len(line) - 1), rng.integers(1, 4), replace=False
            ):
                line[bit // 8] ^= 1 << (bit % 8)
        elif attack == 1:
            del line[int(rng.integers(len(line))) :]
        elif attack == 2:
            line[:0] = rng.bytes(int(rng.integers(1, 30)))
        elif attack == 3:
            del line[-1]  # merged with the next one
        wire.append(bytes(line))
    stream = b"".join(wire)
    lines = Lines()
    found = []
    for at in range(0, len(stream), 17):
        found += lines.feed(stream[at : at + 17])
    assert all(message in sent for message in found)
    untouched = [
        m
        for m, line, before in zip(sent, wire, [b"\n", *wire], strict=False)
        if line == m.encode() and before.endswith(b"\n")
    ]
    assert all(message in found for message in untouched)


def test_protocol_page__examples_are_what_the_code_says():
    page = (Path(__file__).parents[2] / "docs/protocol.md").read_text(encoding="utf-8")
    examples = re.findall(r"^[<>] (.+)$", page, re.MULTILINE)
    assert len(examples) >= 12
    for line in examples:
        assert decode(line.encode()).encode() == line.encode() + b"\n"


def test_message__holds_the_ids_of_a_large_dome():
    """The dome of the paper has 150 lights; its controller lists them in one line."""
    ids = ",".join(f"light-{i:03d}" for i in range(500))
    line = Message("R", 1, "OK", {"kind": "dome", "lights": ids}).encode()
    assert len(line) <= MAX_LINE_BYTES
    (found,) = Lines().feed(line)
    assert found.values["lights"] == ids
