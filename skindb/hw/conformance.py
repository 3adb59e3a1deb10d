"""Comparison of a device with docs/protocol.md: every exchange, limit and deadline of the
page that needs no hands. Lights flash at most three times in a second.
"""

from itertools import pairwise

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import Fault
from skindb.hw.dome import KIND as DOME
from skindb.hw.link import (
    BOOT_SECONDS,
    ERROR,
    EVENT,
    OK,
    PROTOCOL,
    REPLY_SECONDS,
    REQUEST,
    SILENCE_SECONDS,
    Lines,
    Message,
    Port,
)
from skindb.hw.probe import KIND as PROBE
from skindb.hw.sequence import DARK, Schedule, Step
from skindb.hw.session import MAX_LEVEL, MAX_REST, MAX_TIME_ERROR_US, MIN_LEVEL

FLASH_US = 50_000
PERIOD_US = 400_000  # between flashes: at most three in any second
TARGET_KPA = -5.0
MIN_DARK = 0.1  # current below zero, as that of a gauge that is not exact
NO_LIGHT = "no-such-light"


class _Device:
    """Exchanges of single lines with a device, without repetitions."""

    def __init__(self, port: Port, clock: Clock) -> None:
        self.clock = clock
        self.faults = list[Fault]()
        self.section = "Lines"
        self.slowest = 0.0  # s, of all replies
        self._port = port
        self._lines = Lines()
        self._number = 0

    def expect(self, is_right: object, rule: str, found: object) -> None:
        """Note a fault unless it is right."""
        if not is_right:
            where = f"{self.section} of docs/protocol.md"
            self.faults.append(Fault(where, rule, str(found), "correct the firmware"))

    def listen(self, seconds: float) -> list[Message]:
        """Messages that arrive within so many seconds, up to the first reply."""
        end = self.clock.monotonic() + seconds
        messages = list[Message]()
        while self.clock.monotonic() < end:
            messages += self._lines.feed(self._port.read(4096))
            if any(message.kind != EVENT for message in messages):
                break
        return messages

    def line(self, verb: str, **values: object) -> bytes:
        """The line of the next request."""
        self._number += 1
        texts = {name: str(value) for name, value in values.items()}
        return Message(REQUEST, self._number, verb, texts).encode()

    def write(self, data: bytes) -> None:
        """Send a part of a line."""
        self._port.write(data)

    def send(self, line: bytes) -> Message:
        """The reply to a line; without one, a message with the verb "no reply"."""
        begin = self.clock.monotonic()
        self.write(line)
        for message in self.listen(2 * REPLY_SECONDS):
            if message.kind != EVENT:
                self.slowest = max(self.slowest, self.clock.monotonic() - begin)
                return message
        return Message("", 0, "no reply")

    def ask(self, verb: str, **values: object) -> Message:
        """The reply to a request."""
        return self.send(self.line(verb, **values))

    def accepts(self, verb: str, **values: object) -> Message:
        """The reply to a request that must be accepted."""
        reply = self.ask(verb, **values)
        self.expect(
            reply.verb == OK, f"must accept {_text(verb, values)}", _found(reply)
        )
        return reply

    def refuses(self, why: str, verb: str, **values: object) -> None:
        """A request that must be refused, with a reason."""
        reply = self.ask(verb, **values)
        is_right = reply.verb == ERROR and reply.values.get("text")
        rule = f"must refuse {_text(verb, values)} ({why}) by ERR with a text"
        self.expect(is_right, rule, _found(reply))


def _text(verb: str, values: dict[str, object]) -> str:
    return " ".join([verb, *(f"{name}={value}" for name, value in values.items())])


def _found(reply: Message) -> str:
    return _text(reply.verb, dict(reply.values))


def check_device(port: Port, *, clock: Clock = SYSTEM_CLOCK) -> tuple[str, list[Fault]]:
    """Kind of a device ("dome", "probe" or "" for another), and what it does otherwise than
    docs/protocol.md.
    """
    device = _Device(port, clock)
    hello = device.ask("HELLO")
    end = clock.monotonic() + BOOT_SECONDS
    while hello.verb == "no reply" and clock.monotonic() < end:
        hello = device.ask("HELLO")
    kind = hello.values.get("kind", "")
    checks = {DOME: _check_dome, PROBE: _check_probe}
    device.expect(
        kind in checks, "HELLO must name the kind dome or probe", _found(hello)
    )
    if kind in checks:
        for name in ("name", "firmware"):
            device.expect(
                hello.values.get(name), f"HELLO must have a {name}", _found(hello)
            )
        protocol = hello.values.get("protocol")
        device.expect(protocol == str(PROTOCOL), "protocol must be 1", protocol)
        _check_lines(device)
        checks[kind](device, hello)
        device.section = "Lines"
        rule = f"must reply within {REPLY_SECONDS} s"
        device.expect(device.slowest <= REPLY_SECONDS, rule, f"{device.slowest:.2f} s")
    return kind, device.faults


def _check_lines(device: _Device) -> None:
    """Damage, repetition and unknown verbs."""
    line = device.line("BEAT")
    for rule, damaged in (
        ("a line with a wrong checksum", line[:-5] + b"0000\n"),
        ("a line without a checksum", b"Q7 BEAT\n"),
        ("noise", bytes(range(128, 160)) + b"\n"),
    ):
        reply = device.send(damaged)
        device.expect(reply.verb == "no reply", f"must ignore {rule}", _found(reply))
    reply = device.send(device.line("BEAT")[:-1] + b"\r\n")
    rule = "must ignore a carriage return before the newline"
    device.expect(reply.verb == OK, rule, _found(reply))
    line = device.line("BEAT")
    device.write(line[:4])
    device.expect(
        device.send(line[4:]).verb == OK, "must accept a line in pieces", "no reply"
    )
    device.refuses("unknown verb", "DANCE")
    line = device.line("STATUS")
    first, second = device.send(line), device.send(line)
    rule = "must send its last reply again to the same line"
    device.expect(first == second, rule, _found(second))


def _flashes(lights: list[str], count: int) -> Schedule:
    """Steps of the lights in turn, the first one dark."""
    steps = [
        Step(
            DARK if i == 0 else lights[i % len(lights)],
            "long",
            i * PERIOD_US,
            i * PERIOD_US + FLASH_US,
        )
        for i in range(count)
    ]
    return Schedule(tuple(steps))


def _upload(device: _Device, schedule: Schedule) -> None:
    device.accepts("CLEAR")
    for index, step in enumerate(schedule.steps):
        values = {"light": step.light, "exposure": step.exposure}
        device.accepts("STEP", index=index, **values, on=step.on_us, off=step.off_us)


def _start(device: _Device, schedule: Schedule) -> None:
    _upload(device, schedule)
    device.accepts("ARM", digest=schedule.digest, operator="check")
    device.accepts("START")


def _await(device: _Device, seconds: float) -> Message:
    """The first state that is not `running`, or the last one within so many seconds."""
    end = device.clock.monotonic() + seconds
    state = device.ask("STATUS")
    while state.values.get("state") == "running" and device.clock.monotonic() < end:
        device.clock.sleep(0.1)
        state = device.ask("STATUS")
    return state


def _check_dome(device: _Device, hello: Message) -> None:
    """Plan, arming, run, reports, stop and watchdog of a light controller."""
    device.section = "Light controller"
    lights = hello.values.get("lights", "").split(",")
    is_right = all(lights) and len(set(lights)) == len(lights)
    device.expect(is_right, "HELLO must list different lights", lights)
    state = device.ask("STATUS")
    if state.values.get("interlock") == "open":
        device.expect(False, "close the interlock to check the rest", "interlock=open")
        return
    _check_plan(device, lights)
    _check_run(device, _flashes(lights, 4))
    long = _flashes(lights, 12)
    _start(device, long)
    for _ in range(3):  # until the second step
        device.clock.sleep(PERIOD_US / 2e6)
        device.accepts("BEAT")
    device.accepts("STOP")
    _check_stopped(device, "stop", len(long.steps))
    _start(device, long)
    device.clock.sleep(SILENCE_SECONDS)
    _check_stopped(device, "watchdog", len(long.steps))
    device.accepts("CLEAR")


def _check_plan(device: _Device, lights: list[str]) -> None:
    """What STEP, PLAN and ARM refuse."""
    device.accepts("CLEAR")
    device.refuses("not armed", "START")
    step = {"light": lights[0], "exposure": "long", "on": 0, "off": FLASH_US}
    device.refuses("unknown light", "STEP", **{**step, "index": 0, "light": NO_LIGHT})
    device.refuses("index 0 comes next", "STEP", **step, index=1)
    device.refuses("it ends before it begins", "STEP", **{**step, "index": 0, "off": 0})
    line = device.line("STEP", **step, index=0)
    replies = [device.send(line), device.send(line), device.ask("PLAN")]
    is_right = replies[0] == replies[1] and replies[2].values.get("steps") == "1"
    found = "; ".join(map(_found, replies))
    device.expect(is_right, "must not execute a repeated line again", found)
    device.refuses("steps overlap", "STEP", **step, index=1)
    often = [
        Step(lights[0], "long", 2 * i * FLASH_US, (2 * i + 1) * FLASH_US)
        for i in range(5)
    ]
    schedule = Schedule(tuple(often))
    _upload(device, schedule)
    plan = device.ask("PLAN").values
    held = (plan.get("steps"), plan.get("digest", "").upper())
    rule = "PLAN must have the number of steps and their digest"
    device.expect(held == (str(len(often)), schedule.digest), rule, held)
    device.refuses("another digest", "ARM", digest="00000000", operator="check")
    why = "more than 3 flashes in a second and no operator"
    device.refuses(why, "ARM", digest=schedule.digest)
    device.accepts("ARM", digest=schedule.digest.lower(), operator="check")
    device.accepts("CLEAR")


def _check_run(device: _Device, schedule: Schedule) -> None:
    """A plan that runs to its end, and its reports."""
    _start(device, schedule)
    begun = device.ask("STATUS").values.get("state")
    device.expect(begun == "running", "must be running after START", begun)
    for verb, values in (
        ("CLEAR", {}),
        ("STEP", {"index": 0, "light": DARK, "exposure": "long", "on": 0, "off": 9}),
        ("ARM", {"digest": schedule.digest, "operator": "check"}),
    ):
        device.refuses("a plan is running", verb, **values)
    end = _await(device, schedule.seconds + 2.0).values
    found = (end.get("state"), end.get("step"))
    is_right = found == ("done", str(len(schedule.steps)))
    device.expect(is_right, "must be done, with all steps, after its plan", found)
    for index, step in enumerate(schedule.steps):
        reply = device.accepts("REPORT", index=index)
        try:
            on, off, triggers, level, rest = (
                float(reply.values[name])
                for name in ("on", "off", "triggers", "level", "rest")
            )
        except (KeyError, ValueError):
            rule = "REPORT must have numbers as on, off, triggers, level and rest"
            device.expect(False, rule, _found(reply))
            continue
        is_lit = step.light != DARK
        for is_right, rule in (
            (abs(off - on - FLASH_US) <= MAX_TIME_ERROR_US, "must last as planned"),
            (triggers == 1, "must have one trigger"),
            (
                (MIN_LEVEL if is_lit else -MIN_DARK) <= level
                and level <= (MAX_LEVEL if is_lit else MAX_REST),
                f"level of {MIN_LEVEL} to {MAX_LEVEL}, or of a dark one {-MIN_DARK} to {MAX_REST}",
            ),
            (rest <= MAX_REST, f"must leave a rest of at most {MAX_REST}"),
        ):
            device.expect(is_right, f"step {index} of the plan: {rule}", _found(reply))
    device.refuses("no such step", "REPORT", index=len(schedule.steps))


def _check_stopped(device: _Device, reason: str, steps: int) -> None:
    """The state after a run that was stopped in its first second."""
    state = device.ask("STATUS")
    found = (state.values.get("state"), state.values.get("reason"))
    device.expect(
        found == ("stopped", reason), f"must be stopped by {reason}", _found(state)
    )
    device.accepts("REPORT", index=0)
    device.refuses("the step did not run", "REPORT", index=steps - 1)


def _check_probe(device: _Device, _hello: Message) -> None:
    """Pressure, light, exposure, stop and watchdog of a probe."""
    device.section = "Probe"
    device.accepts("STOP")
    device.refuses("the light is off", "EXPOSE", exposure="b00", us=FLASH_US)
    device.accepts("PUMP", kpa=TARGET_KPA)
    events = list[Message]()
    for _ in range(10):
        events += device.listen(0.2)
        device.accepts("BEAT")
    times = [float(event.values.get("t", "nan")) for event in events]
    steps = [b - a for a, b in pairwise(times)]
    is_right = len(times) > 10 and all(0.05 <= step <= 0.2 for step in steps)
    device.expect(is_right, "must send PRESSURE every 0.1 s, with t and kpa", times[:5])
    device.accepts("LED", on=1)
    device.accepts("EXPOSE", exposure="b00", us=4 * FLASH_US)
    state = device.ask("STATUS").values
    device.expect(state.get("state") == "exposing", "must be exposing", state)
    device.clock.sleep(0.4)
    state = device.ask("STATUS").values
    found = (state.get("state"), state.get("triggers"))
    device.expect(found == ("idle", "1"), "must then be idle, with one trigger", found)
    for rule, act in (
        ("STOP", lambda: device.accepts("STOP")),
        ("0.5 s without a request", lambda: device.clock.sleep(SILENCE_SECONDS)),
    ):
        device.accepts("PUMP", kpa=TARGET_KPA)
        act()
        device.listen(0.05)
        late = device.listen(0.25)
        device.expect(
            not late, f"must send no PRESSURE after {rule}", f"{len(late)} events"
        )
