"""Each planted fault of a firmware is found, with the section of docs/protocol.md; the
emulated devices have none. Most faults are changes of the source of the emulated devices.
"""

from __future__ import annotations

import inspect
from types import SimpleNamespace

import pytest
from devices_pair import emulated_dome

from skindb.clock import SimulatedClock
from skindb.hw.conformance import check_device
from skindb.virtual import devices
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
    "it needs no operator": (_flashing_without_an_operator, "more than 3 flashes"),
    "its digest is another": (_with("PLAN", digest="12345678"), "their digest"),
    "its protocol is newer": (_with("HELLO", protocol=2), "protocol must be 1"),
    "it has one light twice": (_with("HELLO", lights="l00,l00"), "different lights"),
    "its lamps are weak": (_with("REPORT", level="0.85"), "level"),
    "light remains": (_with("REPORT", rest="0.05"), "a rest of at most"),
    "it counts no triggers": (_with("REPORT", triggers=0), "one trigger"),
    "it sends no number": (_with("REPORT", on="early"), "must send as on a number"),
    "it stays idle": (_with("STATUS", state="idle"), "must say state=running"),
    "it executes repeated lines": (_executing_repeated_lines, "its last reply again"),
    "it has no watchdog": (_without_a_watchdog, "reason=watchdog"),
}


# kind, text of the source, its change, and a part of the rule that finds it
RELEASE = "def _release(self) -> None:\n        self.led = False\n"
RUNNING = 'if self.state in ("running", "armed"):'
FEED = "self.heard = self.clock.monotonic()\n                free = max(self.heard,"
CHANGES = {
    "replies have other numbers": ("dome", "message.number, OK", "0, OK", "its number"),
    "old numbers are ignored": (
        "dome",
        "if message.kind == REQUEST and",
        "if message.number >= self._answered[0] and",
        "must accept",
    ),
    "a packet has one line": (
        "dome",
        "self._lines.feed(data):",
        "self._lines.feed(data)[:1]:",
        "lines that arrive at once",
    ),
    "any line is a request": (
        "dome",
        "if message.kind == REQUEST and",
        "if",
        "must ignore replies",
    ),
    "numbers alone tell repetitions": (
        "dome",
        "(message.number, line) != self._answered[:2]",
        "message.number != self._answered[0]",
        "another line with the number",
    ),
    "damage is a sign of life": (
        "dome",
        "for message in self._lines.feed(data):",
        "self.heard = self.clock.monotonic()\n        for message in self._lines.feed(data):",
        "reason=watchdog",
    ),
    "only some requests are": (
        "dome",
        FEED,
        "if message.verb != 'REPORT':\n                    " + FEED,
        "=done",
    ),
    "the watchdog is early": ("dome", "SECONDS = 0.5", "SECONDS = 0.35", "=running"),
    "the watchdog is late": ("dome", "SECONDS = 0.5", "SECONDS = 0.9", "until it was"),
    "flashes are counted by clock seconds": (
        "dome",
        "b - a < 1_000_000",
        "a // 1_000_000 == b // 1_000_000",
        "more than 3 flashes",
    ),
    "adjacent steps overlap": (
        "dome",
        "step.on_us < self.steps[-1].off_us",
        "step.on_us <= self.steps[-1].off_us",
        "must accept STEP",
    ),
    "digests lose zeros": ("dome", "):08X}", "):X}", "their digest"),
    "STOP does not disarm": (
        "dome",
        RUNNING,
        'if self.state == "running":',
        "=stopped",
    ),
    "STEP does not disarm": (
        "dome",
        '"idle" if self.state == "armed" else self.state',
        "self.state",
        "disarm",
    ),
    "reports of an earlier run stay": (
        "dome",
        "replace(step, measured={}, lit=False)",
        "replace(step, lit=False)",
        "it has not run again",
    ),
    "steps are counted when they begin": (
        "dome",
        '"step": self._done,',
        '"step": self._done + bool(self.on),',
        "step=1",
    ),
    "times are since power-on": (
        "dome",
        '"on": step.on_us,',
        '"on": step.on_us + 77_000_000,',
        "must send as on",
    ),
    "its clock is fast": (
        "dome",
        "_start) * 1e6\n",
        "_start) * 1.05e6\n",
        "have ended",
    ),
    "counts have points": ("dome", "int(not lost)", '"1.0"', "must send as triggers"),
    "the source stays on": (
        "probe",
        RELEASE,
        RELEASE.replace("False", "self.led"),
        "the light is off after STOP",
    ),
    "repeated exposures are longer": (
        "probe",
        "(message.number, line) != self._answered[:2]",
        "message.verb == 'EXPOSE' or (message.number, line) != self._answered[:2]",
        "must be idle",
    ),
    "exponents are ignored": (
        "probe",
        'float(values["kpa"])',
        'float(values["kpa"].partition("e")[0])',
        "of the target",
    ),
    "the gauge is in mbar": ("probe", "{kpa:.3f}", "{kpa * 10:.3f}", "of the target"),
    "events have one number": (
        "probe",
        "self._event % MAX_NUMBER + 1",
        "1",
        "in the order",
    ),
    "the clock of the gauge runs on": (
        "probe",
        "self._since = now",
        "self._since = self._since or now",
        "since PUMP",
    ),
}


@pytest.mark.parametrize(
    ("kind", "text", "change", "rule"), CHANGES.values(), ids=CHANGES
)
def test_check_device__changed_sources(kind, text, change, rule):
    source = inspect.getsource(devices)
    assert text in source
    module = {"__name__": devices.__name__}
    exec(source.replace(text, change), module)
    changed = SimpleNamespace(**module)
    clock = SimulatedClock()
    if kind == "dome":
        device = changed.EmulatedDome(("l0", "l1"), lambda *_: None, clock=clock)
    else:
        device = changed.EmulatedProbe(lambda _: None, clock=clock)
    found, faults = check_device(DirectPort(device, clock), clock=clock)
    assert found in (kind, "")
    assert any(rule in fault.rule for fault in faults), faults


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
