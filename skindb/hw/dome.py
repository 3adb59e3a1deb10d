"""The light controller of a dome: upload a sequence, arm, run, and read the reports of its steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from skindb.hw.link import DeviceError, Link
from skindb.hw.protocol import Message
from skindb.hw.safety import Override, require_safe
from skindb.hw.sequence import Measured, Schedule

POLL_SECONDS = 0.1  # between questions during a run; each resets the watchdog
WATCHDOG_SECONDS = 0.5  # of silence of the host, after which the controller switches all lights off
SLACK_SECONDS = 2.0  # a run may last longer than planned
KIND = "dome"
STOPPED = {
    "watchdog": "it heard nothing from this computer for half a second and switched the lights off",
    "interlock": "the interlock was opened",
    "stop": "it was stopped",
}


@dataclass(frozen=True)
class DomeState:
    """Reply to STATUS."""

    state: str  # idle, armed, running, done or stopped
    step: int  # steps that are finished
    reason: str  # why it stopped

    @classmethod
    def of(cls, link: Link, reply: Message) -> Self:
        """Of a reply; `DeviceError` if it lacks a value."""
        state, step = link.values(reply, state=str, step=int)
        return cls(state, step, reply.values.get("reason", ""))


class Dome:
    """A light controller at the end of a link.

    Parameters
    ----------
    link
        To the controller.
    sleep
        Waits between questions.
    """

    def __init__(self, link: Link, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.link, self._sleep = link, sleep
        said = link.hello(KIND).values
        self.name, self.firmware = said.get("name", ""), said.get("firmware", "")
        self.lights = tuple(said.get("lights", "").split(","))

    def upload(self, schedule: Schedule) -> None:
        """Send the steps; the controller must then hold exactly these.

        Raises
        ------
        DeviceError
            For a light that the controller does not have, or if it holds another plan.
        """
        self.link.request("CLEAR", base=schedule.base)
        for index, step in enumerate(schedule.steps):
            given = {"light": step.light, "exposure": step.exposure, "on": step.on_us, "off": step.off_us}
            self.link.request("STEP", index=index, **given)
        held = self.link.request("PLAN").values
        if (held.get("steps"), held.get("digest")) != (str(len(schedule.steps)), schedule.digest):
            found = f"{held.get('steps')} steps, digest {held.get('digest')}"
            raise self.link.error(f"must hold {len(schedule.steps)} steps, digest {schedule.digest}", found)

    def arm(self, schedule: Schedule, override: Override | None = None) -> None:
        """Allow the start: with a closed interlock, and above the limit of flashes with an operator's confirmation."""
        require_safe(schedule, override)
        self.link.request(
            "ARM", digest=schedule.digest, **({} if override is None else {"operator": override.operator})
        )

    def run(
        self, schedule: Schedule, progress: Callable[[int, int], None] | None = None, done: list[Measured] | None = None
    ) -> DomeState:
        """Start, and wait until the sequence is done or stopped; on any error the lights are switched off.

        Parameters
        ----------
        schedule
            What was uploaded and armed.
        progress
            Called with the number of finished steps and the total number of steps.
        done
            Filled with what was measured at every step as soon as it is finished: it is there if the device vanishes.

        Raises
        ------
        DeviceError
            If the controller vanishes or takes too long.
        """
        self.link.request("START")
        deadline = time.monotonic() + schedule.seconds + SLACK_SECONDS
        try:
            while True:
                state = self.state()
                while done is not None and len(done) < state.step:
                    done.append(self.report_step(len(done)))
                if progress is not None:
                    progress(state.step, len(schedule.steps))
                if state.state != "running":
                    return state
                if time.monotonic() > deadline:
                    rule, found = f"must finish within {schedule.seconds:.1f} s", f"step {state.step} after that"
                    raise self.link.error(rule, found)
                self._sleep(POLL_SECONDS)
        except BaseException:
            self.stop()
            raise

    def state(self) -> DomeState:
        """Ask for the state of the controller."""
        return DomeState.of(self.link, self.link.request("STATUS"))

    def stop(self) -> None:
        """Switch all lights off at once; without a connection, the watchdog of the controller does."""
        try:
            self.link.request("STOP")
        except DeviceError:
            return

    def report_step(self, index: int) -> Measured:
        """Measured values of a step; `RefusedError` if it was not driven."""
        kinds = {"on": int, "off": int, "triggers": int, "level": float, "rest": float}
        return Measured(*self.link.values(self.link.request("REPORT", index=index), **kinds))

    def beat(self) -> None:
        """Send a sign of life of the host."""
        self.link.request("BEAT")
