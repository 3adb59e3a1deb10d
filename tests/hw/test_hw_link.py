"""Links to devices: messages of the protocol, requests with deadlines, and damaged lines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import serial
from devices_pair import (
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    Bench,
    emulated_dome,
    linked,
    subject_folder,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from replay import ReplayPort
from served_devices import Server, Terminal

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.hw.dome import Dome
from skindb.hw.frame_markers import MARKER, with_markers
from skindb.hw.link import (
    ATTEMPTS,
    BOOT_SECONDS,
    EVENT,
    MAX_LINE_BYTES,
    MAX_NUMBER,
    OK,
    READ_SECONDS,
    REPLY,
    REPLY_SECONDS,
    DeviceError,
    Lines,
    Link,
    Message,
    ProtocolError,
    checksum,
    decode,
    open_port,
)
from skindb.hw.probe import Probe
from skindb.hw.sequence import plan_schedule
from skindb.hw.session import require_complete
from skindb.virtual.devices import DeviceFaults, DirectPort, EmulatedDome
from skindb.virtual.laboratory import LaboratoryFaults

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
SCHEDULE = plan_schedule(LIGHTS[:4], EXPOSURES)
# at most; a read may begin just before the deadline
REQUEST_SECONDS = ATTEMPTS * (REPLY_SECONDS + READ_SECONDS)


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


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


def _served_dome():
    return Server(EmulatedDome(tuple(LIGHTS), lambda *_: None))


class Line:
    """A port with the given bytes, which then arrive again and again, every 5 ms."""

    def __init__(self, clock, data=b"", chatter=b""):
        self.clock = clock
        self.data = data
        self.chatter = chatter

    def read(self, size):
        self.clock.sleep(READ_SECONDS)
        data = self.data + self.chatter
        self.data = b""
        return data

    def write(self, data):
        pass

    def close(self):
        pass


@pytest.mark.parametrize(
    "url", ["socket://127.0.0.1:1", "/dev/no-such-device", "nonsense://x", ""]
)
def test_open_port__nothing_there(url):
    with pytest.raises(DeviceError, match="a device must be at this address"):
        open_port(url)


def test_request__loop_answers_nothing():
    """loop:// sends back what it gets: requests are no replies."""
    link = Link(open_port("loop://"), "dome")
    with pytest.raises(
        DeviceError, match=r"dome: must answer HELLO within 0\.9 s; found no reply"
    ):
        Dome(link)
    link.close()


@pytest.mark.parametrize("is_sent", [True, False])
def test_request__a_write_that_ended_late_is_no_lost_device(is_sent):
    """A process that was suspended finds a timeout, although the line may have been sent."""

    class Late(DirectPort):
        is_late = True

        def write(self, data):
            if is_sent or not self.is_late:
                super().write(data)
            if self.is_late:
                self.is_late = False
                raise serial.SerialTimeoutException("Write timeout")

    clock = SimulatedClock()
    device = EmulatedDome(tuple(LIGHTS), lambda *_: None, clock=clock)
    assert Dome(Link(Late(device, clock), "dome", clock=clock)).lights


@pytest.mark.parametrize(
    "chatter",
    [
        b"",
        b"\xff\x00noise\n",
        b"x" * 4096,
        Message(REPLY, 7, OK).encode(),
        Message(EVENT, 3, "PRESSURE").encode(),
    ],
    ids=[
        "silent",
        "noise",
        "endless line",
        "replies to other requests",
        "one event again and again",
    ],
)
def test_request__ends_within_its_deadline(chatter):
    clock = SimulatedClock()
    link = Link(Line(clock, chatter=chatter), "dome", clock=clock)
    with pytest.raises(
        DeviceError, match=r"must answer BEAT within 0\.9 s; found no reply"
    ):
        link.request("BEAT")
    assert ATTEMPTS * REPLY_SECONDS <= clock.monotonic() <= REQUEST_SECONDS


def test_request__only_the_first_reply_with_its_number_counts():
    clock = SimulatedClock()
    first, second = (Message(REPLY, 1, OK, {"v": v}).encode() for v in "ab")
    link = Link(Line(clock, first + second), "dome", clock=clock)
    assert link.request("STATUS").values == {"v": "a"}
    with pytest.raises(DeviceError, match="must answer STATUS"):
        link.request("STATUS")


def test_request__a_reply_that_is_neither_ok_nor_an_error_is_refused():
    clock = SimulatedClock()
    link = Link(Line(clock, Message(REPLY, 1, "MAYBE").encode()), "dome", clock=clock)
    with pytest.raises(
        DeviceError, match="must answer STATUS by OK or ERR; found 'MAYBE'"
    ):
        link.request("STATUS")


@pytest.mark.parametrize(
    ("numbers", "found"),
    [
        ((5, 6, 6), "event 6 where 7 was due"),
        ((5, 7, 6), "event 6 where 8 was due"),
        ((5, 99_999, 1), "event 99999 where 6 was due"),
    ],
)
def test_events__repeated_or_out_of_order_are_refused(numbers, found):
    clock = SimulatedClock()
    data = b"".join(Message(EVENT, number, "PRESSURE").encode() for number in numbers)
    link = Link(Line(clock, data), "probe", clock=clock)
    with pytest.raises(
        DeviceError, match=f"must send its events in order; found {found}"
    ):
        link.events()
    assert link.events() == []


def test_events__some_may_be_lost():
    clock = SimulatedClock()
    data = b"".join(
        Message(EVENT, number, "PRESSURE").encode() for number in (99_998, 99_999, 1, 4)
    )
    link = Link(Line(clock, data), "probe", clock=clock)
    assert [event.number for event in link.events()] == [99_998, 99_999, 1, 4]


def test_events__too_many_are_refused_and_do_not_fill_the_memory():
    clock = SimulatedClock()
    data = b"".join(
        Message(EVENT, 1 + number, "PRESSURE").encode() for number in range(1_500)
    )
    link = Link(Line(clock, data), "probe", clock=clock)
    with pytest.raises(
        DeviceError, match="more than 1000 events that were not asked for"
    ):
        link.events()


def test_request__another_device_is_refused():
    with _served_dome() as server:
        link = Link(open_port(server.url), "probe")
        with pytest.raises(
            DeviceError,
            match="must be a probe with protocol 1; found dome with protocol 1",
        ):
            Probe(link)
        link.close()


def test_request__device_vanishes_at_any_message():
    for after in range(30):
        device = emulated_dome(DeviceFaults(vanish_after=after))
        link = linked(device)
        last = 0.0
        with pytest.raises(DeviceError, match=r"dome: must stay connected"):  # noqa: PT012
            dome = Dome(link)
            while True:
                last = device.clock.monotonic()
                dome.upload(SCHEDULE)
                last = device.clock.monotonic()
                link.request("BEAT")
        assert device.clock.monotonic() - last <= REQUEST_SECONDS


def test_request__is_not_done_twice_when_its_reply_is_lost():
    device = emulated_dome(DeviceFaults(lost_replies=0.3, seed=3))
    # a step that was added twice would be refused, and the digest would differ
    Dome(linked(device)).upload(SCHEDULE)
    assert len(device.steps) == len(SCHEDULE.steps)


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.11, 0.3, 0.49])
def test_run__watchdog_switches_off_when_the_host_is_silent(seconds):
    slow = plan_schedule(LIGHTS, {"long": 0.2})
    device = emulated_dome()
    link = linked(device)
    dome = Dome(link)
    dome.upload(slow)
    dome.arm(slow, OVERRIDE)
    link.request("START")
    device.clock.sleep(seconds)
    assert device.state == "running"
    device.clock.sleep(0.51 - seconds)
    assert (device.state, device.reason, device.on) == ("stopped", "watchdog", None)


@pytest.mark.parametrize("at", range(MARKER + 1, MARKER + 8))
def test_run__emergency_stop_at_any_moment(subject, tmp_path, at):
    """Ctrl-C while step `at` is lit: lights off, and what was measured is kept."""
    slow = plan_schedule(LIGHTS, {"long": 0.9})
    with Bench(subject, tmp_path) as bench:
        seen = []

        def interrupt(stage, done, total):
            seen.append(done)
            if done >= at:
                raise KeyboardInterrupt

        run = bench.capture(
            slow,
            progress=interrupt,
        )
        assert run.stopped == "stopped by the operator"
        assert bench.laboratory.dome.on is None
        assert bench.laboratory.dome.state == "stopped"
        measured = [i for i, report in enumerate(run.measured) if report is not None]
        assert [*range(seen[-1] - MARKER)] == measured[: seen[-1] - MARKER]
        with pytest.raises(
            InputError, match="must run to its end; found stopped by the operator"
        ):
            require_complete(run, bench.cameras.ids)


@pytest.mark.parametrize("seconds", [4.0, 7.0])
def test_hello__a_board_that_starts_when_its_port_is_opened(seconds):
    """It hears nothing meanwhile."""
    device = emulated_dome()
    receive = device.receive
    device.receive = lambda data: (
        receive(data) if device.clock.monotonic() > seconds else None
    )
    if seconds < BOOT_SECONDS:
        assert Dome(linked(device)).lights == tuple(LIGHTS)
    else:
        with pytest.raises(DeviceError, match="must answer HELLO"):
            Dome(linked(device))


def test_arm__refused_with_an_open_interlock_or_without_an_operator():
    device = emulated_dome()
    link = linked(device)
    dome = Dome(link)
    dome.upload(SCHEDULE)
    with pytest.raises(
        DeviceError, match="more than 3 flashes in a second, and no operator"
    ):
        # the controller does not rely on the host
        link.request("ARM", digest=SCHEDULE.digest)
    with pytest.raises(DeviceError, match="another plan is held"):
        link.request("ARM", digest="00000000", operator="OP-1")
    with pytest.raises(DeviceError, match="not armed"):
        link.request("START")
    device.interlock_closed = False
    with pytest.raises(DeviceError, match="the interlock is open"):
        dome.arm(SCHEDULE, OVERRIDE)
    with pytest.raises(DeviceError, match="unknown verb DANCE"):
        link.request("DANCE")


def test_replay__a_recorded_session_gives_the_same_sequence(subject, tmp_path):
    log = tmp_path / "dome.log"
    faults = LaboratoryFaults(dome=DeviceFaults(garbage=0.2))
    with Bench(subject, tmp_path / "frames", faults, log=log) as bench:
        run = bench.capture(SCHEDULE)
    clock = SimulatedClock()
    again = Dome(Link(ReplayPort(log, clock=clock), "dome", clock=clock))
    marked = with_markers(SCHEDULE, LIGHTS[0])
    again.upload(marked)
    again.arm(marked, OVERRIDE)
    done = []
    assert again.run(marked, done=done).state == "done"
    assert again.state(len(marked.steps)).step == len(marked.steps)
    done += [
        again.report_step(marked, index)
        for index in range(len(done), len(marked.steps))
    ]
    steps = zip(marked.steps, done, strict=True)
    assert [report for step, report in steps if not step.marker] == run.measured
    with pytest.raises(DeviceError, match="the next request of a replay must be"):
        again.link.request("BEAT")


def test_log__that_cannot_be_written_ends_the_run_with_the_lights_off(
    subject, tmp_path
):
    """A full disk must not keep STOP from the controller."""
    with Bench(subject, tmp_path / "frames", log=tmp_path / "dome.log") as bench:
        bench.dome.upload(SCHEDULE)
        bench.dome.arm(SCHEDULE, OVERRIDE)
        full = open("/dev/full", "w")  # noqa: SIM115, PTH123
        bench.dome.link._log.close()
        bench.dome.link._log = full
        with pytest.raises(
            DeviceError, match="No space left on device; free some space"
        ) as error:
            bench.dome.run(SCHEDULE)
        assert "must confirm that it stopped" not in str(error.value)
        assert bench.laboratory.dome.state == "stopped"
        assert bench.laboratory.dome.on is None
        with pytest.raises(OSError, match="No space left"):
            full.close()


def test_spy__of_a_serial_port(tmp_path):
    with Terminal(EmulatedDome(tuple(LIGHTS), lambda *_: None)) as server:
        port = open_port(f"spy://{server.url}?file={tmp_path / 'spy.txt'}")
        link = Link(port, "dome")
        assert Dome(link).lights == tuple(LIGHTS)
        link.close()
        port.formatter.output.close()  # pyserial leaves the file open
    assert "HELLO" in (tmp_path / "spy.txt").read_text()


@pytest.mark.parametrize("line", [Terminal, Server])
def test_run__behind_a_real_line(line):
    with line(EmulatedDome(tuple(LIGHTS), lambda *_: None)) as server:
        link = Link(open_port(server.url), "dome")
        dome = Dome(link)
        dome.upload(SCHEDULE)
        dome.arm(SCHEDULE, OVERRIDE)
        assert dome.run(SCHEDULE).state == "done"
        link.close()
