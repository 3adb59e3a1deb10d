"""Each planted fault of a firmware is found, with the section of docs/protocol.md; the
emulated devices have none.
"""

from __future__ import annotations

import pytest
from devices_pair import emulated_dome

from skindb.clock import SimulatedClock
from skindb.hw.conformance import check_device
from skindb.virtual.devices import (
    DeviceFaults,
    DirectPort,
    EmulatedProbe,
    RefusedError,
)


def _probe(faults=None):
    return EmulatedProbe(lambda _: None, faults, clock=SimulatedClock())


def _checked(device):
    return check_device(DirectPort(device, device.clock), clock=device.clock)


def _answering(verb, change):
    """A controller whose reply to a verb is changed; a refusal is None."""

    def plant(device):
        handle = device.handle

        def changed(asked, values):
            try:
                reply = handle(asked, values)
            except RefusedError:
                if asked != verb or (reply := change(device, None)) is None:
                    raise
                return reply
            return reply if asked != verb else change(device, reply)

        device.handle = changed

    return plant


def _accepting(verb):
    return _answering(verb, lambda _, reply: {} if reply is None else reply)


def _with(verb, **values):
    def change(_, reply):
        return reply if reply is None else reply | values

    return _answering(verb, change)


def _executing_repeated_lines(device):
    answer = device._answer

    def again(message):
        device._answered = (-1, b"", b"")
        return answer(message)

    device._answer = again


def _without_a_watchdog(device):
    act = device.act

    def heard():
        device.heard = device.clock.monotonic()
        return act()

    device.act = heard


def _flashing_without_an_operator(device):
    arm = device._arm
    device._arm = lambda values: arm({**values, "operator": "none"})


FAULTS = {
    "it accepts a step that never ran": (_accepting("REPORT"), "did not run"),
    "it accepts an unknown verb": (_accepting("DANCE"), "unknown verb"),
    "it starts without being armed": (_accepting("START"), "not armed"),
    "it accepts steps in any order": (_accepting("STEP"), "index 0 comes next"),
    "it arms any plan": (_accepting("ARM"), "another digest"),
    "it needs no operator": (_flashing_without_an_operator, "no operator"),
    "its digest is another": (_with("PLAN", digest="12345678"), "their digest"),
    "its protocol is newer": (_with("HELLO", protocol=2), "protocol must be 1"),
    "it has one light twice": (_with("HELLO", lights="l00,l00"), "different lights"),
    "its lamps are weak": (_with("REPORT", level="0.85"), "level"),
    "light remains": (_with("REPORT", rest="0.05"), "a rest of at most"),
    "it counts no triggers": (_with("REPORT", triggers=0), "one trigger"),
    "it sends no number": (_with("REPORT", on="early"), "must have numbers"),
    "it stays idle": (_with("STATUS", state="idle"), "must be running after START"),
    "it executes repeated lines": (_executing_repeated_lines, "a repeated line"),
    "it has no watchdog": (_without_a_watchdog, "must be stopped by watchdog"),
}


@pytest.mark.parametrize(("plant", "rule"), FAULTS.values(), ids=FAULTS)
def test_check_device__faults_of_a_controller(plant, rule):
    device = emulated_dome()
    plant(device)
    kind, faults = _checked(device)
    assert kind == "dome"
    assert any(rule in fault.rule for fault in faults), faults


def test_check_device__emulated_devices_agree_with_the_page():
    assert _checked(emulated_dome()) == ("dome", [])
    assert _checked(_probe()) == ("probe", [])


def test_check_device__slow_replies_and_lost_ones():
    for planted in (DeviceFaults(delay=0.4), DeviceFaults(lost_replies=0.2)):
        _, faults = _checked(emulated_dome(planted))
        assert faults


def test_check_device__faults_of_a_probe():
    device = _probe()
    device._release = lambda: None
    _, faults = _checked(device)
    rules = [fault.rule for fault in faults]
    assert "must send no PRESSURE after STOP" in rules
    assert "must send no PRESSURE after 0.5 s without a request" in rules
    dark = _probe()
    dark._expose = lambda *_: None
    _, faults = _checked(dark)
    assert {fault.where for fault in faults} == {"Probe of docs/protocol.md"}
    assert any("the light is off" in fault.rule for fault in faults)


def test_check_device__something_else():
    device = emulated_dome()
    device.kind = "toaster"
    kind, [fault] = _checked(device)
    assert kind == "toaster"
    assert "must name the kind dome or probe" in fault.rule
