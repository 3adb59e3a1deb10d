"""Links: deadlines, devices that vanish at any moment, watchdog, recording and replay."""

from __future__ import annotations

import pytest
from devices_pair import (
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    Bench,
    emulated_dome,
    linked,
    subject_folder,
)
from served_devices import Server, Terminal

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.hw.dome import Dome
from skindb.hw.link import (
    ATTEMPTS,
    READ_SECONDS,
    REPLY_SECONDS,
    DeviceError,
    Link,
    ReplayPort,
    open_port,
)
from skindb.hw.probe import Probe
from skindb.hw.protocol import EVENT, OK, REPLY, Message
from skindb.hw.sequence import plan_schedule
from skindb.hw.session import capture_dome, require_complete
from skindb.virtual.devices import DeviceFaults, EmulatedDome
from skindb.virtual.laboratory import LaboratoryFaults

SCHEDULE = plan_schedule(LIGHTS[:4], EXPOSURES)
# at most; a read may begin just before the deadline
REQUEST_SECONDS = ATTEMPTS * (REPLY_SECONDS + READ_SECONDS)


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


def test_events__lost_ones_are_counted():
    clock = SimulatedClock()
    data = b"".join(
        Message(EVENT, number, "PRESSURE").encode() for number in (99_998, 99_999, 1, 4)
    )
    link = Link(Line(clock, data), "probe", clock=clock)
    assert [event.number for event in link.events()] == [99_998, 99_999, 1, 4]
    assert link.lost_events == 2


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


@pytest.mark.parametrize("at", range(1, 8))
def test_run__emergency_stop_at_any_moment(subject, tmp_path, at):
    """Ctrl-C while step `at` is lit: lights off, and every frame so far is kept."""
    slow = plan_schedule(LIGHTS, {"long": 0.9})
    with Bench(subject, tmp_path) as bench:
        seen = []

        def interrupt(stage, done, total):
            seen.append(done)
            if done >= at:
                raise KeyboardInterrupt

        run = capture_dome(
            bench.dome, bench.cameras, slow, override=OVERRIDE, progress=interrupt
        )
        assert run.stopped == "stopped by the operator"
        assert bench.laboratory.dome.on is None
        assert bench.laboratory.dome.state == "stopped"
        kept = {step for _, step in run.frames}
        assert set(range(seen[-1])) <= kept
        with pytest.raises(
            InputError, match="must run to its end; found stopped by the operator"
        ):
            require_complete(run, bench.cameras.ids)


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
        run = capture_dome(bench.dome, bench.cameras, SCHEDULE, override=OVERRIDE)
    clock = SimulatedClock()
    again = Dome(Link(ReplayPort(log, clock=clock), "dome", clock=clock))
    again.upload(SCHEDULE)
    again.arm(SCHEDULE, OVERRIDE)
    done = []
    assert again.run(SCHEDULE, done=done).state == "done"
    assert again.state(len(SCHEDULE.steps)).step == len(SCHEDULE.steps)
    done += [
        again.report_step(SCHEDULE, index)
        for index in range(len(done), len(SCHEDULE.steps))
    ]
    assert done == run.measured
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
