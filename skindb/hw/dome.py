"""The light controller of a dome: uploads a sequence, arms it, runs it, and reads back the measurements."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from skindb.hw.link import DeviceError, Link
from skindb.hw.protocol import Message
from skindb.hw.safety import Override, require_safe
from skindb.hw.sequence import Measured, Schedule

POLL_SECONDS = 0.1  # interval of status requests during a run; each resets the watchdog
WATCHDOG_SECONDS = 0.5  # without a request from the host, after which the controller switches all lights off
SLACK_SECONDS = 2.0  # by which a run may take longer than planned
KIND = "dome"
STOPPED = {
    "watchdog": "it received nothing from this computer for half a second and switched the lights off",
    "interlock": "the interlock was opened",
    "stop": "it was stopped",
}


@dataclass(frozen=True)
class DomeState:
    """Reply to STATUS."""

    state: str  # idle, armed, running, done or stopped
    step: int  # number of finished steps
    reason: str  # reason of a stop

    @classmethod
    def of(cls, link: Link, reply: Message) -> Self:
        """Parse a reply; raises `DeviceError` if a value is missing."""
        state, step = link.values(reply, state=str, step=int)
        return cls(state, step, reply.values.get("reason", ""))


class Dome:
    """A light controller at the end of a link.

    Parameters
    ----------
    link
        Link to the controller.
    sleep
        Function that waits between requests.
    """

    def __init__(self, link: Link, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.link, self._sleep = link, sleep
        said = link.hello(KIND).values
        self.name, self.firmware = said.get("name", ""), said.get("firmware", "")
        self.lights = tuple(said.get("lights", "").split(","))

    def upload(self, schedule: Schedule) -> None:
        """Send the steps, and verify that the controller holds exactly these.

        Raises
        ------
        DeviceError
            If the controller does not have a light, or holds another plan afterwards.
        """
        self.link.request("CLEAR", base=schedule.base)
        for index, step in enumerate(schedule.steps):
            given = {"light": step.light, "exposure": step.exposure, "on": step.on_us, "off": step.off_us}
            self.link.request("STEP", index=index, **given)
        if not self.holds(schedule):
            held = self.link.request("PLAN").values
            found = f"{held.get('steps')} steps, digest {held.get('digest')}"
            raise self.link.error(f"must hold {len(schedule.steps)} steps, digest {schedule.digest}", found)

    def holds(self, schedule: Schedule) -> bool:
        """Whether the controller holds exactly these steps."""
        held = self.link.request("PLAN").values
        return (held.get("steps"), held.get("digest")) == (str(len(schedule.steps)), schedule.digest)

    def arm(self, schedule: Schedule, override: Override | None = None) -> None:
        """Arm the controller; needs a closed interlock, and `override` above the limit of flashes."""
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
            The schedule that was uploaded and armed.
        progress
            Called with the steps done and the steps in all.
        done
            List to which the measurements of each finished step are appended, so that they survive a lost connection.

        Raises
        ------
        DeviceError
            If the controller stops answering or takes too long.
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
                    rule, found = f"must finish within {schedule.seconds:.1f} s", f"step {state.step} still running"
                    raise self.link.error(rule, found)
                self._sleep(POLL_SECONDS)
        except BaseException:
            self.stop()
            raise

    def state(self) -> DomeState:
        """Current state of the controller."""
        return DomeState.of(self.link, self.link.request("STATUS"))

    def stop(self) -> None:
        """Switch all lights off at once; a disconnected controller does so by its watchdog."""
        try:
            self.link.request("STOP")
        except DeviceError:
            return

    def report_step(self, index: int) -> Measured:
        """Measurements of a step; raises `RefusedError` if the step did not run."""
        kinds = {"on": int, "off": int, "triggers": int, "level": float, "rest": float}
        return Measured(*self.link.values(self.link.request("REPORT", index=index), **kinds))

    def heartbeat(self) -> None:
        """Reset the watchdog of the controller."""
        self.link.request("BEAT")
