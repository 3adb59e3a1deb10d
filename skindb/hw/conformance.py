"""Comparison of a device with docs/protocol.md: every exchange, limit and deadline of the
page that needs no hands. Lights flash at most three times in a second.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle, islice, pairwise

import numpy as np

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import Fault
from skindb.hw.dome import KIND as DOME
from skindb.hw.link import (
    BAUD_RATE,
    BOOT_SECONDS,
    CLOCK_ERROR,
    CURRENT,
    EARLY_SECONDS,
    ERROR,
    EVENT,
    GAUGE_KPA,
    GAUGE_SECONDS,
    INTERLOCKS,
    MAX_LINE_BYTES,
    MAX_NUMBER,
    OK,
    PROTOCOL,
    REPLY,
    REPLY_SECONDS,
    REQUEST,
    REST_CURRENT,
    SILENCE_SECONDS,
    SLACK_SECONDS,
    STATES,
    TRIGGERS,
    WATCHDOG_SECONDS,
    Accepted,
    Count,
    Lines,
    Message,
    Port,
    Range,
    checksum,
    text_of,
)
from skindb.hw.probe import KIND as PROBE
from skindb.hw.sequence import DARK, Schedule, Step
from skindb.hw.session import MAX_LEVEL, MAX_REST, MAX_TIME_ERROR_US, MIN_LEVEL

FLASH_US = 50_000
PERIOD_US = 400_000  # between flashes: at most three in any second
STEPS = 12  # of the plan that runs to its end
# s between requests: the watchdog acts if one of them is not taken as a sign of life
PACE = 0.3
ALIVE = 0.42  # s, silence after which a watchdog must not have acted
LATE_SECONDS = 0.15  # by which a watchdog may act late
EXPOSURE = "long=0.05"  # with a character that is percent-encoded
MAX_REPLY_BYTES = 512
OPERATOR = "O" * 400
TARGET_KPA = -5.0
PUMP_SECONDS = 5.0
# why it is refused, verb, values
_Request = tuple[str, str, Mapping[str, object]]
ONE_REPLY = "must send one reply to each request, with its number"
NO_LIGHT = "no-such-light"
NO_REPLY = Message("", 0, "no reply")


class _Device:
    """Exchanges of single lines with a device, without repetitions."""

    def __init__(self, port: Port, clock: Clock) -> None:
        self.clock = clock
        self.faults = dict[str, Fault]()
        self.section = "Lines"
        self.slowest = 0.0  # s, of all replies
        self.sent = 0.0  # when the last line was sent
        self.number = 0
        self.events = list[tuple[float, Message]]()  # with the times of their arrival
        self._port = port
        self._lines = Lines()

    def expect(self, is_right: object, rule: str, found: object) -> None:
        """Note a fault unless it is right, or noted before."""
        if not is_right:
            where = f"{self.section} of docs/protocol.md"
            fault = Fault(where, rule, str(found), "correct the firmware")
            self.faults.setdefault(rule, fault)

    def listen(
        self, seconds: float, numbers: Sequence[int] = (), rule: str = ONE_REPLY
    ) -> list[Message]:
        """Replies that arrive within so many seconds, or until those with these numbers."""
        end = self.clock.monotonic() + seconds
        replies = []
        due = list(numbers)
        while self.clock.monotonic() < end and (due or not numbers):
            for message in self._lines.feed(self._port.read(4096)):
                if message.kind == EVENT:
                    self.events.append((self.clock.monotonic(), message))
                    continue
                is_due = message.kind == REPLY and message.number in due
                self.expect(is_due, rule, f"{message.kind}{message.number}")
                if is_due:
                    due.remove(message.number)
                    replies.append(message)
        return replies

    def pace(self, seconds: float) -> None:
        """Wait until so many seconds after the last request."""
        self.listen(max(self.sent + seconds - self.clock.monotonic(), 0.0))

    def line(self, verb: str, **values: object) -> bytes:
        """The line of the next request."""
        self.number = self.number % MAX_NUMBER + 1
        texts = {name: str(value) for name, value in values.items()}
        return Message(REQUEST, self.number, verb, texts).encode()

    def write(self, data: bytes) -> None:
        """Send bytes that are no request."""
        self._port.write(data)

    def send(self, *lines: bytes) -> Message:
        """The reply to the last of these lines; without one, a message with the verb
        "no reply".
        """
        self.sent = self.clock.monotonic()
        self.write(b"".join(lines))
        numbers = range(self.number - len(lines) + 1, self.number + 1)
        replies = self.listen(2 * REPLY_SECONDS, numbers)
        if len(replies) < len(lines):
            return NO_REPLY
        self.slowest = max(self.slowest, self.clock.monotonic() - self.sent)
        reply = replies[-1]
        is_right = reply.verb == OK or (
            reply.verb == ERROR and reply.values.get("text")
        )
        self.expect(is_right, "must reply OK, or ERR with a text", reply)
        size = 0 if "lights" in reply.values else len(reply.encode())
        rule = f"replies need at most {MAX_REPLY_BYTES} bytes, unless they list lights"
        self.expect(size <= MAX_REPLY_BYTES, rule, f"{size} bytes")
        return reply

    def ask(self, verb: str, **values: object) -> Message:
        """The reply to a request."""
        return self.send(self.line(verb, **values))

    def accepts(self, verb: str, **values: object) -> Message:
        """The reply to a request that must be accepted."""
        reply = self.ask(verb, **values)
        self.expect(reply.verb == OK, f"must accept {text_of(verb, values)}", reply)
        return reply

    def refuses(self, why: str, verb: str, **values: object) -> None:
        """A request that must be refused, with a reason."""
        reply = self.ask(verb, **values)
        rule = f"must refuse {text_of(verb, values)} ({why}) by ERR with a text"
        self.expect(reply.verb == ERROR, rule, reply)

    def keep_alive(self, why: str, verb: str, values: Mapping[str, object]) -> None:
        """A request, refused if there is a reason; any of them resets the watchdog."""
        if why:
            self.refuses(why, verb, **values)
        else:
            self.accepts(verb, **values)

    def repeats(self, line: bytes) -> None:
        """A line, and again after a while, which must only be answered again."""
        first = self.send(line)
        rule = f"must accept {line.split(b'*')[0].decode()}"
        self.expect(first.verb == OK, rule, first)
        self.pace(PACE)
        second = self.send(line)
        rule = "must send its last reply again to the same line"
        self.expect(first == second, rule, f"{first}; {second}")

    def value(self, reply: Message, name: str, accepted: Accepted[object]) -> float:
        """A number of a reply or an event; NaN if it is not one of these."""
        text = reply.values.get(name, "nothing")
        try:
            value = accepted.parse(text)
        except ValueError:
            self.expect(False, f"must send as {name} {accepted}", text)
            return float("nan")
        return value if isinstance(value, int | float) else 0.0

    def ignores(self, what: str, line: bytes) -> None:
        """A line that must be ignored, and do no harm to the next one."""
        self.write(line)
        seconds = REPLY_SECONDS + 10 * len(line) / BAUD_RATE
        self.listen(seconds, rule=f"must ignore {what}")
        self.accepts("BEAT")


def check_device(port: Port, *, clock: Clock = SYSTEM_CLOCK) -> tuple[str, list[Fault]]:
    """Kind of a device ("dome", "probe" or "" for another), and what it does otherwise than
    docs/protocol.md.
    """
    device = _Device(port, clock)
    hello = device.ask("HELLO")
    end = clock.monotonic() + BOOT_SECONDS
    while hello is NO_REPLY and clock.monotonic() < end:
        hello = device.ask("HELLO")
    kind = hello.values.get("kind", "")
    checks = {DOME: _check_dome, PROBE: _check_probe}
    device.expect(kind in checks, "HELLO must name the kind dome or probe", hello)
    if kind in checks:
        for name in ("name", "firmware"):
            device.expect(hello.values.get(name), f"HELLO must have a {name}", hello)
        protocol = hello.values.get("protocol")
        device.expect(protocol == str(PROTOCOL), "protocol must be 1", protocol)
        device.slowest = 0.0
        device.accepts("STOP")
        _check_lines(device, kind)
        checks[kind](device, hello)
        device.section = "Lines"
        rule = f"must reply within {REPLY_SECONDS} s"
        device.expect(device.slowest <= REPLY_SECONDS, rule, f"{device.slowest:.2f} s")
    return kind, list(device.faults.values())


def _closed(body: bytes, mask: int = 0) -> bytes:
    """A line with its checksum, some of whose bits may be changed."""
    return body + b"*%04X\n" % (checksum(body) ^ mask)


def _check_lines(device: _Device, kind: str) -> None:
    """Damage, repetition, numbers and unknown verbs."""
    device.number = MAX_NUMBER - 1  # and then from 1
    for line, mask in ((b"Q7 BEAT", 0x0001), (b"Q7 BEAT", 0x8000), (b"Q7 STOP", 1)):
        device.ignores("a wrong checksum", _closed(line, mask))
    device.ignores("a line without a checksum", b"Q7 BEAT\n")
    small = b"*%04x\n" % checksum(b"Q7 BEAT")
    device.ignores("a checksum in small letters", b"Q7 BEAT" + small)
    device.ignores("noise", bytes(range(128, 160)) + b"\n")
    device.ignores("an empty line", b"\r\n\n")
    for line in (b"R7 BEAT", b"E7 BEAT"):
        device.ignores("replies and events", _closed(line))
    long = b"Q7 BEAT text=" + b"x" * (MAX_LINE_BYTES - 17)
    device.ignores(f"a line of more than {MAX_LINE_BYTES} bytes", _closed(long))
    reply = device.send(device.line("BEAT")[:-1] + b"\r\n")
    rule = "must ignore a carriage return before the newline"
    device.expect(reply.verb == OK, rule, reply)
    line = device.line("BEAT")
    device.write(line[:4])
    reply = device.send(line[4:])
    device.expect(reply.verb == OK, "must accept a line in pieces", reply)
    reply = device.send(device.line("BEAT"), device.line("STATUS"))
    device.expect(reply.verb == OK, "must answer lines that arrive at once", reply)
    device.refuses("unknown verb", "DANCE")
    for verb in ("PUMP", "LED") if kind == DOME else ("CLEAR", "START"):
        device.refuses("a verb of other devices", verb)
    device.accepts("BEAT")
    device.number -= 1
    device.refuses("another line with the number of the last one", "DANCE")
    device.repeats(device.line("STATUS"))


def _flashes(lights: list[str], count: int) -> Schedule:
    """Steps of the lights in turn, the first one dark."""
    names = [DARK, *islice(cycle(lights), 1, count)]
    return Schedule(
        tuple(
            Step(name, EXPOSURE, i * PERIOD_US, i * PERIOD_US + FLASH_US)
            for i, name in enumerate(names)
        )
    )


def _upload(device: _Device, schedule: Schedule) -> None:
    device.accepts("CLEAR")
    _state(device, "idle", step=0, reason="")
    for index, step in enumerate(schedule.steps):
        values = {"light": step.light, "exposure": step.exposure}
        device.accepts("STEP", index=index, **values, on=step.on_us, off=step.off_us)
    _holds(device, schedule)


def _holds(device: _Device, schedule: Schedule) -> None:
    plan = device.ask("PLAN").values
    held = (plan.get("steps"), plan.get("digest", "").upper())
    rule = "PLAN must have the number of steps and their digest"
    device.expect(held == (str(len(schedule.steps)), schedule.digest), rule, held)


def _start(device: _Device, schedule: Schedule) -> float:
    """When a plan was started."""
    device.accepts("ARM", digest=schedule.digest, operator="check")
    device.accepts("START")
    return device.sent


def _state(device: _Device, state: str, **values: object) -> Message:
    """The state, which must have these values."""
    reply = device.ask("STATUS")
    device.value(reply, "state", STATES)
    device.value(reply, "interlock", INTERLOCKS)
    expected = {"state": state} | {name: str(value) for name, value in values.items()}
    found = {name: reply.values.get(name) for name in expected}
    rule = f"STATUS must say {text_of('', dict(expected)).strip()}"
    device.expect(found == expected and "reason" in reply.values, rule, reply)
    return reply


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
    _check_arming(device, lights)
    schedule = _flashes(lights, STEPS)
    _upload(device, schedule)
    _check_run(device, schedule)
    for reason in ("stop", "watchdog"):
        _check_stopped(device, lights, reason)


def _check_plan(device: _Device, lights: list[str]) -> None:
    """What STEP refuses, and plans as long as those of sessions."""
    device.accepts("CLEAR")
    _state(device, "idle", step=0, reason="")
    device.accepts("STOP")
    _state(device, "idle")
    device.refuses("not armed", "START")
    step = {
        "index": 0,
        "light": lights[0],
        "exposure": "long",
        "on": 0,
        "off": FLASH_US,
    }
    for why, changed in (
        ("unknown light", {"light": NO_LIGHT}),
        ("unknown light", {"light": lights[0] + "x"}),
        ("index 0 comes next", {"index": 1}),
        ("it ends before it begins", {"off": 0}),
        ("times are digits", {"on": "-5"}),
        ("times are digits", {"on": "0.5"}),
    ):
        device.refuses(why, "STEP", **(step | changed))
    device.refuses("off is missing", "STEP", **dict([*step.items()][:-1]))
    _holds(device, Schedule(()))
    device.repeats(device.line("STEP", **step))
    step |= {"index": 1, "on": FLASH_US - 1, "off": 2 * FLASH_US}
    device.refuses("steps overlap", "STEP", **step)
    device.accepts("STEP", **(step | {"on": FLASH_US}))
    half = FLASH_US // 2
    both = [
        Step(light, EXPOSURE, (2 * i + k) * half, (2 * i + k + 1) * half)
        for i, light in enumerate((DARK, *lights))
        for k in (0, 1)
    ]
    _upload(device, Schedule(tuple(both)))


def _check_arming(device: _Device, lights: list[str]) -> None:
    """What ARM accepts and refuses."""
    for lit, dark, is_safe in (
        ((0, 300, 600, 950), (), False),
        ((0, 300, 600, 1050), (), True),
        ((600, 800, 1100, 1300), (), False),
        ((0, 2000, 4000, 6000, 8000, 8300, 8600, 8900), (), False),
        ((0, 300, 600), (150, 450, 750), True),
    ):
        steps = [
            Step(
                DARK if ms in dark else lights[0],
                EXPOSURE,
                1000 * ms,
                1000 * ms + 40_000,
            )
            for ms in sorted((*lit, *dark))
        ]
        # a digest that begins with 0
        last = steps.pop()
        ends = (
            Schedule((*steps, replace(last, off_us=last.off_us + i)))
            for i in range(1000)
        )
        schedule = next(plan for plan in ends if plan.digest.startswith("0"))
        _upload(device, schedule)
        digest = schedule.digest
        device.refuses("another digest", "ARM", digest="00000001", operator="check")
        device.refuses("not armed", "START")
        if is_safe:
            device.accepts("ARM", digest=digest)
        else:
            device.accepts("ARM", digest=digest.lower(), operator=OPERATOR)
            device.accepts("CLEAR")
            _upload(device, schedule)
            device.refuses("more than 3 flashes in a second", "ARM", digest=digest)
            device.refuses("not armed", "START")
            device.accepts("ARM", digest=digest, operator="check")
        device.pace(SILENCE_SECONDS)
        _state(device, "armed")
    device.accepts("STOP")
    _state(device, "stopped", reason="stop")
    device.refuses("not armed", "START")
    _holds(device, schedule)
    device.accepts("ARM", digest=schedule.digest)
    after = schedule.steps[-1].off_us
    step = {
        "light": lights[0],
        "exposure": "long",
        "on": after,
        "off": after + FLASH_US,
    }
    device.accepts("STEP", index=len(schedule.steps), **step)
    device.refuses("STEP and CLEAR disarm", "START")
    device.accepts("CLEAR")
    _state(device, "idle", step=0, reason="")
    _holds(device, Schedule(()))


def _check_run(device: _Device, schedule: Schedule) -> None:
    """A plan that is stopped, and then runs to its end, and its reports."""
    _start(device, schedule)
    device.pace(PACE)
    device.accepts("BEAT")
    device.pace(PACE)
    device.accepts("STOP")
    device.accepts("ARM", digest=schedule.digest, operator="check")
    last = len(schedule.steps) - 1
    step = {"light": DARK, "exposure": "long", "on": 0, "off": 9}
    running = "a plan is running"
    requests: list[_Request] = [
        (running, "CLEAR", {}),
        (running, "STEP", {"index": 0} | step),
        ("", "REPORT", {"index": 0}),
        ("it did not run", "REPORT", {"index": last}),
        (running, "ARM", {"digest": schedule.digest}),
        ("", "HELLO", {}),
        (running, "START", {}),
        ("", "PLAN", {}),
    ]
    due = cycle(requests)
    begin = device.clock.monotonic()
    device.repeats(device.line("START"))
    device.refuses("it has not run again", "REPORT", index=1)
    state = _state(device, "running")
    finished = 0
    ends = np.array([step.off_us / 1e6 for step in schedule.steps])
    while state.values.get("state") == "running":
        device.pace(PACE)
        device.keep_alive(*next(due))
        device.pace(PACE)
        state = device.ask("STATUS")
        early = device.sent - begin
        late = device.clock.monotonic() - begin
        fewest = int((ends * (1 + CLOCK_ERROR) + SLACK_SECONDS < early).sum())
        most = int((ends * (1 - CLOCK_ERROR) - EARLY_SECONDS < late).sum())
        steps = device.value(state, "step", Count(0, len(ends)))
        rule = "step must be the number of steps that have ended"
        device.expect(max(finished, fewest) <= steps <= most, rule, state)
        if early > schedule.seconds + SLACK_SECONDS:
            break
        finished = int(steps)
    for _ in range(2):
        _state(device, "done", step=len(ends))
        device.accepts("STOP")  # changes nothing
    planned = list(enumerate(schedule.steps))
    first = [_report(device, *step) for step in planned]
    second = [_report(device, *step) for step in reversed(planned)]
    rule = "REPORT must have the same values again, in any order"
    device.expect(first == second[::-1], rule, "others")
    rule = "a step must begin after the one before"
    for (_, off), (on, _) in pairwise(first):
        device.expect(off <= on, rule, f"on={on:.0f} after off={off:.0f}")
    for index in (len(ends), "-1", "0.0"):
        device.refuses("no such step", "REPORT", index=index)
    device.refuses("not armed", "START")


def _report(
    device: _Device, index: int, step: Step, latest: float | None = None
) -> tuple[float, float]:
    """Times of a step [us] as measured, which must be as planned; a step that was interrupted
    must end at the latest [us].
    """
    reply = device.accepts("REPORT", index=index)
    drift = step.on_us * CLOCK_ERROR
    earliest = max(step.on_us - drift - EARLY_SECONDS * 1e6, 0)
    delay = drift + SLACK_SECONDS * 1e6
    on = device.value(reply, "on", Range(earliest, step.on_us + delay, "us"))
    off = device.value(reply, "off", Range(earliest, step.off_us + delay, "us"))
    triggers = device.value(reply, "triggers", TRIGGERS)
    level = device.value(reply, "level", CURRENT)
    rest = device.value(reply, "rest", REST_CURRENT)
    is_lit = step.light != DARK
    lowest, highest = (MIN_LEVEL, MAX_LEVEL) if is_lit else (-1.0, MAX_REST)
    error = abs(off - on - (step.off_us - step.on_us))
    in_time = error <= MAX_TIME_ERROR_US if latest is None else off <= latest
    for is_right, rule in (
        (in_time, "must last as planned, or until it was stopped"),
        (triggers == 1, "must have one trigger"),
        (lowest <= level <= highest, f"must have a level of {lowest:g} to {highest:g}"),
        (rest <= MAX_REST, f"must leave a rest of at most {MAX_REST}"),
    ):
        device.expect(is_right, f"step {index} of the plan {rule}", reply)
    return on, off


def _check_stopped(device: _Device, lights: list[str], reason: str) -> None:
    """A run that is stopped while a light is on, by the host or by the watchdog."""
    steps = (
        Step(lights[0], EXPOSURE, 0, FLASH_US),
        Step(lights[-1], EXPOSURE, PERIOD_US, 5 * PERIOD_US),
        Step(lights[0], EXPOSURE, 6 * PERIOD_US, 7 * PERIOD_US),
    )
    schedule = Schedule(steps)
    _upload(device, schedule)
    begin = _start(device, schedule)
    for _ in range(2):
        device.pace(ALIVE)
        _state(device, "running", step=1)
    if reason == "stop":
        device.accepts("STOP")
        end = device.clock.monotonic()
    else:
        end = device.sent + WATCHDOG_SECONDS
        for _ in range(12):  # damage is no sign of life
            device.write(b"Q1 BEAT*0000\n")
            device.listen(0.1)
    latest = (end + LATE_SECONDS - begin) * 1e6
    _state(device, "stopped", reason=reason, step=1)
    _report(device, 0, steps[0])
    _report(device, 1, steps[1], latest)
    device.refuses("the step did not run", "REPORT", index=2)
    _holds(device, schedule)
    device.accepts("STOP")
    _state(device, "stopped", reason=reason)
    device.refuses("not armed", "START")
    device.accepts("ARM", digest=schedule.digest)
    device.accepts("STOP")
    device.accepts("CLEAR")
    _state(device, "idle", step=0, reason="")
    _holds(device, Schedule(()))
    device.refuses("the plan is forgotten", "REPORT", index=0)


def _check_probe(device: _Device, _hello: Message) -> None:
    """Pressure, light, exposure, stop and watchdog of a probe."""
    device.section = "Probe"
    _rests(device, "STOP")
    for why, verb, values in (
        ("on is 1 or 0", "LED", {"on": "2"}),
        ("on is missing", "LED", {}),
        ("no number", "PUMP", {"kpa": "much"}),
    ):
        device.refuses(why, verb, **values)
    device.events.clear()
    begin = device.clock.monotonic()
    device.repeats(device.line("PUMP", kpa=f"{10 * TARGET_KPA:g}e-1"))
    device.accepts("LED", on=1)
    device.refuses("us is missing", "EXPOSE", exposure="b00")
    device.accepts("EXPOSE", exposure="b00", us=20_000_000)
    requests: list[_Request] = [
        ("", "BEAT", {}),
        ("unknown verb", "DANCE", {}),
        ("", "HELLO", {}),
    ]
    requests *= 4  # any of them resets the watchdog
    for request in requests:
        device.pace(PACE)
        device.keep_alive(*request)
        device.pace(PACE)
        _exposes(device, "exposing")
    _check_readings(device, begin, settles=True)
    begin = device.clock.monotonic()
    device.accepts("PUMP", kpa=TARGET_KPA)
    device.events.clear()
    device.pace(PACE)
    device.accepts("BEAT")
    _check_readings(device, begin, settles=False)
    device.accepts("LED", on=0)
    device.refuses("the light is off", "EXPOSE", exposure="b00", us=FLASH_US)
    device.accepts("STOP")
    _exposes(device, "idle")
    device.accepts("LED", on=1)
    for _ in range(2):
        begin = device.clock.monotonic()
        device.repeats(device.line("EXPOSE", exposure="b00", us=1_000_000))
        for seconds, state in ((0.6, "exposing"), (0.85, "exposing"), (1.2, "idle")):
            device.listen(seconds - (device.clock.monotonic() - begin))
            reply = _exposes(device, state)
        device.expect(
            device.value(reply, "triggers", TRIGGERS) == 1,
            "must have one trigger",
            reply,
        )
    device.accepts("PUMP", kpa=TARGET_KPA)
    device.accepts("STOP")
    _rests(device, "STOP")
    device.accepts("LED", on=1)
    device.accepts("PUMP", kpa=TARGET_KPA)
    device.pace(ALIVE)
    device.accepts("BEAT")
    device.events.clear()
    device.pace(ALIVE)
    rule = "must send PRESSURE until 0.5 s after the last request"
    device.expect(device.events, rule, "none")
    device.listen(SILENCE_SECONDS - ALIVE)
    _rests(device, "0.5 s without a request")


def _exposes(device: _Device, state: str) -> Message:
    """The state of a probe, which must be this one."""
    reply = device.ask("STATUS")
    device.expect(reply.values.get("state") == state, f"must be {state}", reply)
    return reply


def _rests(device: _Device, why: str) -> None:
    """Pump and light must be off."""
    device.listen(0.05)
    device.events.clear()
    device.listen(0.25)
    found = f"{len(device.events)} events"
    device.expect(not device.events, f"must send no PRESSURE after {why}", found)
    off = f"the light is off after {why}"
    device.refuses(off, "EXPOSE", exposure="b00", us=FLASH_US)


def _check_readings(device: _Device, begin: float, *, settles: bool) -> None:
    """Events since PUMP: their order, clock and pressures."""
    numbers = [event.number for _, event in device.events]
    is_right = all(
        0 < (b - a) % MAX_NUMBER < MAX_NUMBER // 2 for a, b in pairwise(numbers)
    )
    device.expect(
        is_right, "must send events in the order of their numbers", numbers[:5]
    )
    times, values = [], []
    for arrival, event in device.events:
        device.expect(event.verb == "PRESSURE", "must send no other events", event.verb)
        t = device.value(event, "t", GAUGE_SECONDS)
        rule = "t must be the seconds since PUMP"
        device.expect(-0.5 <= t - (arrival - begin) <= 0.2, rule, t)
        times.append(t)
        values.append(device.value(event, "kpa", GAUGE_KPA))
    periods = np.diff(times)
    is_even = len(times) > 1 and bool(((periods > 0) & (periods <= 0.5)).all())
    is_even = is_even and 0.08 < float(np.mean(periods)) < 0.12
    device.expect(is_even, "must send PRESSURE every 0.1 s", np.round(times[:5], 3))
    if not settles or not is_even:
        return
    is_near = np.abs(np.array(values) - TARGET_KPA) <= 1.0
    reached = int(np.argmax(is_near))
    is_right = bool(is_near[reached:].all()) and times[reached] < PUMP_SECONDS
    in_range = min(values) >= TARGET_KPA - 1.0 and max(values) <= 1.0
    rule = "kpa must come within 1 kPa of the target in 5 s, and stay there"
    device.expect(is_right and in_range, rule, np.round(values[::10], 2))
