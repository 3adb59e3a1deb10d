"""Emulated light controller and probe for the wire protocol, with optional faults.

The devices are written from docs/protocol.md alone and share only the line format with the drivers.
"""

from __future__ import annotations

import binascii
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from skindb.clock import SYSTEM_CLOCK, Clock, SimulatedClock
from skindb.hw.link import (
    ERROR,
    EVENT,
    MAX_NUMBER,
    OK,
    PROTOCOL,
    READ_SECONDS,
    REPLY,
    REQUEST,
    Lines,
    Message,
)

WATCHDOG_SECONDS = 0.5  # without a message, after which the lights go off
PRESSURE_PERIOD = 0.1  # s between readings of the gauge
PUMP_SECONDS = 0.3  # time constant of the suction
MAX_FLASHES = 3  # in any period of one second
GAUGE_FAULTS = ("nan", "silent", "late", "wild")
LATE_SECONDS = 1.0
WILD_KPA = 500.0


class RefusedError(Exception):
    """A request that the device refuses; the text is its reason."""


@dataclass(frozen=True)
class DeviceFaults:
    """Faults of an emulated device; none by default."""

    # number of requests after which it stops answering and closes the line
    vanish_after: int = -1
    garbage: float = 0.0  # probability of noise on the line before a reply
    lost_replies: float = 0.0  # probability that a reply does not arrive
    delay: float = 0.0  # s until each reply
    # steps of the first run whose cameras are not triggered
    lost_triggers: tuple[int, ...] = ()
    dim_light: str = ""  # light with half of its current
    stuck_light: str = ""  # light that stays on after its first step
    # faults of lights with a normal current:
    dead_light: str = ""  # light that gives no light
    silently_stuck_light: str = ""  # light that stays on after its first step
    open_interlock_at: int = -1  # step at which the door is opened
    frozen_at: int = -1  # step at which it stays, while it answers
    leak: float = 0.0  # kPa/s, loss of the suction since the light was switched on
    gauge: str = ""  # one of GAUGE_FAULTS, since the light was switched on
    seed: int = 0


class Emulated:
    """A device with a clock that receives and sends bytes.

    Parameters
    ----------
    faults
        Its faults.
    clock
        Its clock.
    """

    kind = ""

    def __init__(
        self, faults: DeviceFaults | None = None, *, clock: Clock = SYSTEM_CLOCK
    ) -> None:
        self.faults = faults or DeviceFaults()
        self.clock = clock
        self.gone = False  # whether it has closed its line
        self.heard = clock.monotonic()  # when the last request arrived
        self._rng = np.random.default_rng(self.faults.seed)
        self._lines = Lines()
        self._inbox = deque[tuple[float, Message]]()  # when each request is handled
        # number, request and reply of the last one
        self._answered: tuple[int, bytes, bytes] = (-1, b"", b"")
        self._requests = 0
        self._event = 0

    def receive(self, data: bytes) -> None:
        """Store the requests in received bytes."""
        for message in self._lines.feed(data):
            if message.kind == REQUEST and not self.gone:
                self.heard = self.clock.monotonic()
                free = max(self.heard, self._inbox[-1][0] if self._inbox else 0.0)
                self._inbox.append((free + self.faults.delay, message))

    def tick(self) -> bytes:
        """Let time pass and handle the requests that are due; returns the bytes that it sends."""
        out = self.act()
        while self._inbox and self._inbox[0][0] <= self.clock.monotonic():
            out += self._answer(self._inbox.popleft()[1])
        return out

    def act(self) -> bytes:
        """Do what is due by the clock; returns the events that the device sends."""
        return b""

    def event(self, verb: str, **values: str) -> bytes:
        """The line of an event."""
        self._event = self._event % MAX_NUMBER + 1
        return Message(EVENT, self._event, verb, values).encode()

    def greeting(self) -> dict[str, object]:
        """Reply to HELLO."""
        same = {"name": "emulated", "firmware": "1", "protocol": PROTOCOL}
        return {"kind": self.kind, **same}

    def handle(self, verb: str, values: dict[str, str]) -> dict[str, object]:
        """Execute a request, and return the values of the reply; raises `RefusedError`
        with the reason.
        """
        raise NotImplementedError

    def _answer(self, message: Message) -> bytes:
        self._requests += 1
        if 0 <= self.faults.vanish_after < self._requests:
            self.gone = True
            self._inbox.clear()
            return b""
        line = message.encode()
        # a repeated request is answered again, but not executed again
        if (message.number, line) != self._answered[:2]:
            try:
                values = {
                    name: str(value)
                    for name, value in self.handle(
                        message.verb, dict(message.values)
                    ).items()
                }
                reply = Message(REPLY, message.number, OK, values)
            except (RefusedError, KeyError, ValueError) as error:
                reply = Message(
                    REPLY, message.number, ERROR, {"text": str(error) or "malformed"}
                )
            self._answered = message.number, line, reply.encode()
        noise = b""
        if self._rng.random() < self.faults.garbage:
            noise = self._rng.bytes(int(self._rng.integers(1, 40))) + b"\n"
        return (
            noise
            if self._rng.random() < self.faults.lost_replies
            else noise + self._answered[2]
        )


@dataclass
class _Step:
    light: str
    exposure: str
    on_us: int
    off_us: int
    measured: dict[str, object] = field(default_factory=dict)
    lit: bool = False


class EmulatedDome(Emulated):
    """A light controller: plan, arm, run, watchdog, interlock.

    Parameters
    ----------
    lights
        Ids of its lights.
    trigger
        Called with the exposure and how bright each light is that shines ("-" for none)
        whenever the cameras are triggered.
    faults, clock
        As for `Emulated`.
    """

    kind = "dome"

    def __init__(
        self,
        lights: tuple[str, ...],
        trigger: Callable[[str, dict[str, float]], None],
        faults: DeviceFaults | None = None,
        *,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        super().__init__(faults, clock=clock)
        self.lights = lights
        self._trigger = trigger
        self.state = "idle"
        self.reason = ""
        self.steps = list[_Step]()
        self.on: str | None = None  # light that is on
        self._start = 0.0
        self._runs = 0
        self._done = 0
        self._stuck = ""
        self.interlock_closed = True

    def handle(self, verb: str, values: dict[str, str]) -> dict[str, object]:
        """The verbs of a light controller."""
        if verb == "HELLO":
            return self.greeting() | {"lights": ",".join(self.lights)}
        if verb in ("CLEAR", "STEP", "ARM") and self.state == "running":
            raise RefusedError("a sequence is running")
        actions = {
            "CLEAR": self._clear,
            "STEP": self._add,
            "PLAN": self._plan,
            "ARM": self._arm,
            "START": self._begin,
            "STATUS": self._status,
            "BEAT": lambda _: {},
            "STOP": lambda _: self._halt("stop"),
            "REPORT": self._report,
        }
        if verb not in actions:
            raise RefusedError(f"unknown verb {verb}")
        return actions[verb](values)

    def act(self) -> bytes:
        """Switch lights and trigger cameras according to the plan; the watchdog
        switches the lights off.
        """
        if self.state != "running":
            return b""
        if self.clock.monotonic() - self.heard > WATCHDOG_SECONDS or self.gone:
            self._halt("watchdog")
            return b""
        now = (self.clock.monotonic() - self._start) * 1e6
        while self._done < len(self.steps) and self.state == "running":
            step = self.steps[self._done]
            if not step.lit:
                if now < step.on_us:
                    break
                if self._runs == 1 and self._done == self.faults.open_interlock_at:
                    self.interlock_closed = False
                    self._halt("interlock")
                    break
                self._light(step)
            if now < step.off_us or self._done == self.faults.frozen_at:
                break
            stuck = (self.faults.stuck_light, self.faults.silently_stuck_light)
            if step.light in stuck:
                self._stuck = step.light
            self.on = self._stuck or None
            self._done += 1
        if self.state == "running" and self._done == len(self.steps):
            self.state = "done"
        return b""

    def _light(self, step: _Step) -> None:
        step.lit = True
        self.on = step.light
        lost = self._runs == 1 and self._done in self.faults.lost_triggers
        level = 0.5 if step.light == self.faults.dim_light else 1.0
        wrong = {self._stuck: 1.0} if self._stuck else {}
        shines = 0.0 if step.light == self.faults.dead_light else level
        if not lost:
            self._trigger(step.exposure, wrong | {step.light: shines})
        measured = bool(self._stuck) and self._stuck != self.faults.silently_stuck_light
        rest = measured or step.light == self.faults.stuck_light
        total = level * (step.light != "-") + measured
        step.measured = {
            "on": step.on_us,
            "off": step.off_us,
            "triggers": int(not lost),
            "level": f"{total:.3f}",
            "rest": f"{rest:.3f}",
        }

    def _clear(self, _: dict[str, str]) -> dict[str, object]:
        self.steps = []
        self.state = "idle"
        self.reason = ""
        self._done = 0
        return {}

    def _add(self, values: dict[str, str]) -> dict[str, object]:
        step = _Step(
            values["light"], values["exposure"], int(values["on"]), int(values["off"])
        )
        if step.light not in (*self.lights, "-"):
            raise RefusedError(f"no light {step.light}")
        if int(values["index"]) != len(self.steps):
            raise RefusedError(f"step {len(self.steps)} comes next")
        if not 0 <= step.on_us < step.off_us or (
            self.steps and step.on_us < self.steps[-1].off_us
        ):
            raise RefusedError("steps must not overlap, and end after they begin")
        self.steps.append(step)
        self.state = "idle" if self.state == "armed" else self.state
        return {}

    def _digest(self) -> str:
        lines = "".join(
            f"{s.light} {s.exposure} {s.on_us} {s.off_us}\n" for s in self.steps
        )
        return f"{binascii.crc32(lines.encode()):08X}"

    def _plan(self, _: dict[str, str]) -> dict[str, object]:
        return {"steps": len(self.steps), "digest": self._digest()}

    def _arm(self, values: dict[str, str]) -> dict[str, object]:
        if not self.steps or values["digest"].upper() != self._digest():
            raise RefusedError("another plan is held")
        if not self.interlock_closed:
            raise RefusedError("the interlock is open")
        starts = [s.on_us for s in self.steps if s.light != "-"]
        often = any(
            b - a < 1_000_000
            for a, b in zip(starts, starts[MAX_FLASHES:], strict=False)
        )
        if often and not values.get("operator"):
            raise RefusedError(
                f"more than {MAX_FLASHES} flashes in a second, and no operator confirmed screening"
            )
        self.state = "armed"
        return {}

    def _begin(self, _: dict[str, str]) -> dict[str, object]:
        if self.state != "armed":
            raise RefusedError("not armed")
        self.state = "running"
        self._start = self.clock.monotonic()
        self._runs += 1
        self._done = 0
        self.steps = [replace(step, measured={}, lit=False) for step in self.steps]
        return {}

    def _status(self, _: dict[str, str]) -> dict[str, object]:
        interlock = "closed" if self.interlock_closed else "open"
        return {
            "state": self.state,
            "step": self._done,
            "interlock": interlock,
            "reason": self.reason,
        }

    def _halt(self, reason: str) -> dict[str, object]:
        step = self.steps[self._done] if self._done < len(self.steps) else None
        if self.state == "running" and step is not None and step.lit:
            elapsed = (self.clock.monotonic() - self._start) * 1e6
            step.measured["off"] = min(round(elapsed), step.off_us)
        self.on = None
        if self.state in ("running", "armed"):
            self.state = "stopped"
            self.reason = reason
        return {}

    def _report(self, values: dict[str, str]) -> dict[str, object]:
        step = (
            self.steps[int(values["index"])]
            if 0 <= int(values["index"]) < len(self.steps)
            else None
        )
        if step is None or not step.measured:
            raise RefusedError("that step was not executed")
        return step.measured


class EmulatedProbe(Emulated):
    """A probe: suction with a gauge, light, trigger.

    Parameters
    ----------
    trigger
        Called with the exposure whenever the camera is triggered.
    """

    kind = "probe"

    def __init__(
        self,
        trigger: Callable[[str], None],
        faults: DeviceFaults | None = None,
        *,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        super().__init__(faults, clock=clock)
        self.led = False
        self.target = 0.0
        self.pressure = 0.0
        self._trigger = trigger
        self._exposing = ""
        self._triggers = 0
        self._until = 0.0  # end of the exposure
        self._since = 0.0  # when the pump was switched on
        self._lit = np.inf  # when the light was switched on
        self._next = 0.0  # when the gauge is read
        self._last = clock.monotonic()

    def handle(self, verb: str, values: dict[str, str]) -> dict[str, object]:
        """The verbs of a probe."""
        now = self.clock.monotonic()
        if verb == "HELLO":
            return self.greeting()
        if verb == "PUMP":
            self.target = float(values["kpa"])
            self._since = now
            self._next = now
            self._lit = np.inf
        elif verb == "LED":
            if values["on"] not in ("0", "1"):
                raise RefusedError("on must be 1 or 0")
            self.led = values["on"] == "1"
            self._lit = now
        elif verb == "EXPOSE":
            self._expose(values["exposure"], int(values["us"]) / 1e6)
        elif verb == "STATUS":
            state = "exposing" if now < self._until else "idle"
            return {"state": state, "triggers": self._triggers}
        elif verb == "STOP":
            self._release()
        elif verb != "BEAT":
            raise RefusedError(f"unknown verb {verb}")
        return {}

    def act(self) -> bytes:
        """Let the pressure change, and report it while the pump is on."""
        now = self.clock.monotonic()
        if now - self.heard > WATCHDOG_SECONDS or self.gone:
            self._release()
        leaked = self.faults.leak * max(now - self._lit, 0.0)
        aim = min(self.target + leaked, 0.0)
        self.pressure += (aim - self.pressure) * (
            1 - np.exp(-(now - self._last) / PUMP_SECONDS)
        )
        self._last = now
        out = b""
        while self.target and self._next <= now:
            out += self._reading(
                self._next - self._since, failed=self._next > self._lit
            )
            self._next += PRESSURE_PERIOD
        return out

    def _reading(self, seconds: float, *, failed: bool) -> bytes:
        """The event of a reading of the gauge, which may have failed."""
        fault = self.faults.gauge if failed else ""
        if fault == "silent":
            return b""
        kpa = {"nan": np.nan, "wild": WILD_KPA}.get(fault, self.pressure)
        seconds -= LATE_SECONDS if fault == "late" else 0.0
        return self.event("PRESSURE", t=f"{seconds:.3f}", kpa=f"{kpa:.3f}")

    def _expose(self, exposure: str, seconds: float) -> None:
        if not self.led:
            raise RefusedError("the light is off")
        self._exposing, self._until = exposure, self.clock.monotonic() + seconds
        self._triggers = 0
        if (
            self.faults.lost_triggers
            and int(exposure.strip("b") or 0) in self.faults.lost_triggers
        ):
            self.faults = replace(self.faults, lost_triggers=())  # only once
        else:
            self._trigger(exposure)
            self._triggers = 1

    def _release(self) -> None:
        self.led = False
        self.target = 0.0
        self._until = 0.0


class DirectPort:
    """The line to an emulated device with a simulated clock: a port of `skindb.hw.link.Link`."""

    def __init__(self, device: Emulated, clock: SimulatedClock) -> None:
        self._device = device
        self._clock = clock
        self._sent = b""
        clock.attach(self._act)

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return the bytes that the device has sent; waits shortly if there are none."""
        if not self._sent:
            self._clock.sleep(READ_SECONDS)
        self._require_line()
        data = self._sent
        self._sent = b""
        return data

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        self._require_line()
        self._device.receive(data)

    def close(self) -> None:
        """Do nothing: no file is open."""

    def _act(self) -> None:
        self._sent += self._device.tick()

    def _require_line(self) -> None:
        if self._device.gone:
            raise OSError("the device has closed its line")
