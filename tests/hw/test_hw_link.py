"""Links: deadlines, devices that vanish at any moment, watchdog, recording and replay."""

from __future__ import annotations

import time

import pytest
from devices_pair import EXPOSURES, LIGHTS, OVERRIDE, Bench, subject_folder

from skindb.hw.dome import Dome
from skindb.hw.link import DeviceError, Link, ReplayPort, open_port
from skindb.hw.probe import Probe
from skindb.hw.sequence import plan_schedule
from skindb.hw.session import capture_dome, require_complete
from skindb.virtual.devices import DeviceFaults, EmulatedDome, Server, Terminal
from skindb.virtual.laboratory import LaboratoryFaults

SCHEDULE = plan_schedule(LIGHTS[:4], EXPOSURES)
# of a request to a device that vanished: 0.9 s, and what a busy machine adds
DEADLINE_SECONDS = 1.5


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


def _dome(faults=None):
    return Server(EmulatedDome(tuple(LIGHTS), lambda *_: None, faults))


@pytest.mark.parametrize("url", ["socket://127.0.0.1:1", "/dev/no-such-device", "nonsense://x", ""])
def test_open_port__nothing_there(url):
    with pytest.raises(DeviceError, match="a device must be at this address"):
        open_port(url)


def test_request__loop_answers_nothing():
    """loop:// sends back what it gets: requests are no replies."""
    link = Link(open_port("loop://"), "dome")
    before = time.monotonic()
    with pytest.raises(DeviceError, match=r"dome: must answer HELLO within 0\.9 s; found no reply"):
        Dome(link)
    assert time.monotonic() - before < DEADLINE_SECONDS
    link.close()


def test_request__another_device_is_refused():
    with _dome() as server:
        link = Link(open_port(server.url), "probe")
        with pytest.raises(DeviceError, match="must be a probe with protocol 1; found dome with protocol 1"):
            Probe(link)
        link.close()


@pytest.mark.parametrize("after", range(0, 30, 2))
def test_request__device_vanishes_at_any_message(after):
    with _dome(DeviceFaults(vanish_after=after)) as server:
        link = Link(open_port(server.url), "dome")
        last = time.monotonic()
        with pytest.raises(DeviceError, match=r"dome: must (answer|stay)"):  # noqa: PT012
            dome = Dome(link)
            while True:
                last = time.monotonic()
                dome.upload(SCHEDULE)
                dome.heartbeat()
        assert time.monotonic() - last < DEADLINE_SECONDS + 0.1 * len(SCHEDULE.steps)
        link.close()


def test_request__is_not_done_twice_when_its_reply_is_lost():
    with _dome(DeviceFaults(lost_replies=0.3, seed=3)) as server:
        link = Link(open_port(server.url), "dome")
        dome = Dome(link)
        dome.upload(SCHEDULE)  # a step that was added twice would be refused, and the digest would differ
        assert len(server.device.steps) == len(SCHEDULE.steps)
        link.close()


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.11, 0.3])
def test_run__watchdog_switches_off_when_the_host_is_silent(seconds):
    slow = plan_schedule(LIGHTS, {"long": 0.2})
    with _dome() as server:
        link = Link(open_port(server.url), "dome")
        dome = Dome(link)
        dome.upload(slow)
        dome.arm(slow, OVERRIDE)
        link.request("START")
        time.sleep(seconds)
        assert server.device.state == "running"
        time.sleep(0.7)  # of silence: 0.5 and the time that a busy machine needs
        assert (server.device.state, server.device.reason, server.device.on) == ("stopped", "watchdog", None)
        link.close()


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

        run = capture_dome(bench.dome, bench.cameras, slow, override=OVERRIDE, progress=interrupt)
        assert run.stopped == "stopped by the operator"
        assert bench.laboratory.dome.on is None
        assert bench.laboratory.dome.state == "stopped"
        kept = {step for _, step in run.frames}
        assert set(range(seen[-1])) <= kept
        with pytest.raises(Exception, match="must run to its end; found stopped by the operator"):
            require_complete(run, bench.cameras.ids)


def test_arm__refused_with_an_open_interlock_or_without_an_operator():
    with _dome() as server:
        link = Link(open_port(server.url), "dome")
        dome = Dome(link)
        dome.upload(SCHEDULE)
        with pytest.raises(DeviceError, match="more than 3 flashes in a second, and no operator"):
            link.request("ARM", digest=SCHEDULE.digest)  # the controller does not rely on the host
        with pytest.raises(DeviceError, match="another plan is held"):
            link.request("ARM", digest="00000000", operator="OP-1")
        with pytest.raises(DeviceError, match="not armed"):
            link.request("START")
        server.device.interlock_closed = False
        with pytest.raises(DeviceError, match="the interlock is open"):
            dome.arm(SCHEDULE, OVERRIDE)
        with pytest.raises(DeviceError, match="unknown verb DANCE"):
            link.request("DANCE")
        link.close()


def test_replay__a_recorded_session_gives_the_same_sequence(subject, tmp_path):
    log = tmp_path / "dome.log"
    with Bench(subject, tmp_path / "frames", LaboratoryFaults(dome=DeviceFaults(garbage=0.2)), log) as bench:
        run = capture_dome(bench.dome, bench.cameras, SCHEDULE, override=OVERRIDE)
    link = Link(ReplayPort(log), "dome")
    again = Dome(link, sleep=lambda _: None)
    again.upload(SCHEDULE)
    again.arm(SCHEDULE, OVERRIDE)
    done = []
    assert again.run(SCHEDULE, done=done).state == "done"
    assert again.state().step == len(SCHEDULE.steps)
    assert done == run.measured
    with pytest.raises(DeviceError, match="that step was not executed"):
        again.report_step(len(SCHEDULE.steps))
    with pytest.raises(DeviceError, match="the next request of a replay must be"):
        again.heartbeat()


def test_spy__of_a_serial_port(tmp_path):
    with Terminal(EmulatedDome(tuple(LIGHTS), lambda *_: None)) as server:
        port = open_port(f"spy://{server.url}?file={tmp_path / 'spy.txt'}")
        link = Link(port, "dome")
        assert Dome(link).lights == tuple(LIGHTS)
        link.close()
        port.formatter.output.close()  # pyserial leaves the file open
    assert "HELLO" in (tmp_path / "spy.txt").read_text()


def test_run__behind_a_serial_port():
    with Terminal(EmulatedDome(tuple(LIGHTS), lambda *_: None)) as server:
        link = Link(open_port(server.url), "dome")
        dome = Dome(link)
        dome.upload(SCHEDULE)
        dome.arm(SCHEDULE, OVERRIDE)
        assert dome.run(SCHEDULE).state == "done"
        link.close()
