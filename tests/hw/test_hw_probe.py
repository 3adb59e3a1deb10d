"""The probe: a gauge that fails, suction that is wrong, exposures without end; the
suction is always released.
"""

from __future__ import annotations

import numpy as np
import pytest
from devices_pair import linked

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.hw.link import SILENCE_SECONDS, SLACK_SECONDS, DeviceError
from skindb.hw.probe import MAX_AGE_SECONDS, POLL_SECONDS, PlacementError, Probe
from skindb.virtual.devices import DeviceFaults, EmulatedProbe

EXPOSURES = {"b00": 3.0, "b01": 1.0}


class OddProbe(EmulatedProbe):
    """A probe whose events and replies are changed by functions."""

    def __init__(self, change_event=None, change_reply=None, faults=None):
        super().__init__(lambda _: None, faults, clock=SimulatedClock())
        self.change_event = change_event or (lambda _, values: values)
        self.change_reply = change_reply or (lambda _, values: values)

    def event(self, verb, **values):
        changed = self.change_event(self.clock.monotonic(), values)
        return b"" if changed is None else super().event(verb, **changed)

    def handle(self, verb, values):
        reply = super().handle(verb, values)
        return self.change_reply(verb, reply)


def _measure(device, **options):
    """Measure with a device; afterwards the light is off and the suction released."""
    try:
        return Probe(linked(device, "probe")).measure(EXPOSURES, **options)
    finally:
        assert not device.led
        assert device.target == 0


def _from(seconds, **changed):
    """Change the values of the readings of the gauge from a time on."""
    return lambda now, values: values | changed if now >= seconds else values


def test_measure__keeps_the_readings_of_the_exposures():
    placement = _measure(OddProbe())
    assert placement.triggers == {"b00": 1, "b01": 1}
    assert (np.diff(placement.pressure[:, 0]) > 0).all()
    assert placement.pressure[-1, 0] - placement.pressure[0, 0] == pytest.approx(
        4.0, abs=0.3
    )


@pytest.mark.parametrize(
    ("kpa", "said"),
    [
        ("nan", "must send as kpa a number from -101.4 to 1,000 kPa; found 'nan'"),
        ("inf", "must send as kpa a number from -101.4 to 1,000 kPa; found 'inf'"),
        ("-1e300", "must send as kpa a number"),
        ("1e3000", "must send as kpa a number"),
        ("-5,0", "must send as kpa a number"),
        ("-5_0", "must send as kpa a number"),
        ("", "must send as kpa a number"),
        ("-101.3", "must hold a pressure from -6 to 1 kPa; found -101.30 kPa"),
        ("-6.1", "must hold a pressure from -6 to 1 kPa; found -6.10 kPa"),
        ("1.1", "must hold a pressure from -6 to 1 kPa; found 1.10 kPa"),
        ("500", "must hold a pressure from -6 to 1 kPa; found 500.00 kPa"),
    ],
)
@pytest.mark.parametrize(
    "seconds", [0.3, 3.0], ids=["while it settles", "while it exposes"]
)
def test_measure__a_wrong_pressure_ends_it_at_once(kpa, said, seconds):
    device = OddProbe(_from(seconds, kpa=kpa))
    with pytest.raises(DeviceError, match=said) as error:
        _measure(device)
    assert not isinstance(error.value, PlacementError)  # it is not tried again
    assert device.clock.monotonic() < seconds + 1.0


@pytest.mark.parametrize(
    "seconds", [0.0, 0.4, 3.0], ids=["never", "while it settles", "while it exposes"]
)
def test_measure__a_silent_gauge_ends_it_within_its_deadline(seconds):
    device = OddProbe(lambda now, values: None if now >= seconds else values)
    with pytest.raises(
        DeviceError,
        match=r"must have a reading of the gauge in the last 0\.5 s; found none",
    ):
        _measure(device)
    released = device.clock.monotonic()
    assert released < seconds + MAX_AGE_SECONDS + 5 * POLL_SECONDS


def test_measure__a_gap_between_readings_is_refused_although_the_last_one_is_recent():
    """Replies are lost for 0.6 s, in which the gauge is silent too; then both are back."""
    device = OddProbe(lambda now, values: None if 2.0 < now < 2.58 else values)
    answer = device._answer

    def lost(message):
        reply = answer(message)
        return b"" if 2.0 < device.clock.monotonic() < 2.6 else reply

    device._answer = lost
    with pytest.raises(
        DeviceError,
        match=r"must have a reading of the gauge in the last 0\.5 s; found none for 0\.[67]",
    ):
        _measure(device)


@pytest.mark.parametrize("age", [0.5, 0.6, 2.0])
def test_measure__readings_that_arrive_late_are_refused(age):
    """One arrives every 0.1 s, but each is old."""
    device = OddProbe()
    act = device.act
    waiting = []

    def late():
        waiting.append((device.clock.monotonic() + age, act()))
        due = [data for at, data in waiting if at <= device.clock.monotonic()]
        del waiting[: len(due)]
        return b"".join(due)

    device.act = late
    with pytest.raises(
        DeviceError, match=r"must have a reading of the gauge in the last 0\.5 s"
    ):
        _measure(device)


@pytest.mark.parametrize(
    ("t", "said"),
    [
        ("0.5", "in order, with their times since PUMP"),  # again and again
        ("99.0", "in order, with their times since PUMP"),  # from the future
        ("-1.0", "must send as t a number from 0 to 3,600 s"),
        ("nan", "must send as t a number from 0 to 3,600 s"),
    ],
)
def test_measure__a_reading_with_a_wrong_time_ends_it(t, said):
    with pytest.raises(DeviceError, match=said):
        _measure(OddProbe(_from(2.0, t=t)))


def test_measure__a_clock_of_the_gauge_that_is_fast_ends_it():
    device = OddProbe(
        lambda _, values: values | {"t": f"{1.5 * float(values['t']):.3f}"}
    )
    with pytest.raises(
        DeviceError,
        match=r"in order, with their times since PUMP; found 0\.[67]5 s, 0\.[45]",
    ):
        _measure(device)


def test_measure__a_leak_asks_for_another_placement():
    device = OddProbe(faults=DeviceFaults(leak=2.0))
    with pytest.raises(
        PlacementError,
        match=r"must hold -5 kPa within 1 kPa; found .* so it leaks; press it on",
    ):
        _measure(device)


def test_measure__suction_that_is_not_reached_asks_for_another_placement():
    device = OddProbe(_from(0.0, kpa="-2.0"))
    with pytest.raises(
        PlacementError, match=r"must reach -5 kPa within 5 s; found -2\.00 kPa"
    ):
        _measure(device)
    assert device.clock.monotonic() == pytest.approx(5.5, abs=0.3)


@pytest.mark.parametrize("pressure", [0.0, 3.0, -25.0, np.nan, -np.inf])
def test_measure__a_pressure_that_is_not_gentle_suction_is_refused(pressure):
    device = OddProbe()
    with pytest.raises(InputError, match="the suction must be from -20 to 0 kPa"):
        _measure(device, pressure=pressure)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"state": "exposing"},
            r"must expose b00 within 5\.0 s; found still exposing after 5",
        ),
        ({"state": "idle"}, r"must expose b00 for 3\.000 s; found 0\.0"),
        (
            {"state": "asleep"},
            "must send as state one of idle, exposing; found 'asleep'",
        ),
        (
            {"triggers": "2"},
            "must send as triggers a whole number from 0 to 1; found '2'",
        ),
        ({"triggers": "-1"}, "must send as triggers a whole number from 0 to 1"),
        ({"triggers": "1.0"}, "must send as triggers a whole number from 0 to 1"),
        (
            {"triggers": "99999999999999999999"},
            "must send as triggers a whole number from 0 to 1",
        ),
    ],
)
def test_measure__a_state_that_cannot_be_right_ends_it(changed, said):
    device = OddProbe(
        change_reply=lambda verb, values: (
            values | changed if verb == "STATUS" else values
        )
    )
    with pytest.raises(DeviceError, match=said):
        _measure(device)
    assert device.clock.monotonic() < 2.0 + EXPOSURES["b00"] + SLACK_SECONDS + 1.0


def test_measure__a_reply_without_its_values_is_refused():
    device = OddProbe(
        change_reply=lambda verb, values: {} if verb == "STATUS" else values
    )
    with pytest.raises(DeviceError, match="must send the value state; found R"):
        _measure(device)


def test_measure__a_stop_that_is_ignored_is_left_to_the_watchdog():
    """The host is silent until the probe has released by itself, and says that it did not obey."""
    device = OddProbe()
    handle = device.handle
    device.handle = lambda verb, values: {} if verb == "STOP" else handle(verb, values)
    with pytest.raises(
        DeviceError,
        match="must confirm that it released the suction; found readings of the gauge",
    ):
        _measure(device)
    assert device.clock.monotonic() - device.heard >= SILENCE_SECONDS


def test_measure__both_faults_are_named_if_it_cannot_be_stopped():
    device = OddProbe(_from(2.0, kpa="nan"))
    handle = device.handle
    device.handle = lambda verb, values: {} if verb == "STOP" else handle(verb, values)
    with pytest.raises(DeviceError) as error:
        _measure(device)
    assert "found 'nan'" in str(error.value)
    assert "must confirm that it released the suction" in str(error.value)


def test_measure__ctrl_c_releases():
    device = OddProbe()

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _measure(device, progress=interrupt)
