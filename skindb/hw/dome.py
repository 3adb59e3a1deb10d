"""The light controller of a dome: uploads a sequence, arms it, runs it, and reads back
the measurements.
"""

from collections.abc import Callable
from dataclasses import dataclass

from skindb.hw.link import (
    CLOCK_ERROR,
    CURRENT,
    EARLY_SECONDS,
    FIRMWARE_CURE,
    INTERLOCKS,
    REPLY_SECONDS,
    REST_CURRENT,
    SILENCE_SECONDS,
    SLACK_SECONDS,
    STATES,
    TRIGGERS,
    Count,
    DeviceError,
    Link,
    Range,
    stopped_at_end,
)
from skindb.hw.sequence import Measured, Override, Rehearsal, Schedule, require_safe

POLL_SECONDS = 0.1  # interval of status requests during a run
REPORTS_AT_A_TIME = 10  # read between two status requests
KIND = "dome"
# name of the emulated controller, by which a rehearsal recognises it
EMULATED = "emulated"
LIGHTS_CURE = "see that the lights are off, or switch off the power of the controller"
STOPPED = {
    "watchdog": (
        "it received nothing from this computer for half a second and switched the "
        "lights off"
    ),
    "interlock": "the interlock was opened",
    "stop": "it was stopped",
    "": "it gave no reason",
}


@dataclass(frozen=True)
class DomeState:
    """Reply to STATUS."""

    state: str  # idle, armed, running, done or stopped
    step: int  # number of finished steps
    interlock: str  # closed or open
    reason: str  # reason of a stop


@dataclass(frozen=True)
class Start:
    """When a sequence started, by the clock of the host: between the request and its reply."""

    requested: float
    replied: float


class Dome:
    """A light controller at the end of a link.

    Parameters
    ----------
    link
        Link to the controller.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        values = link.hello(KIND).values
        self.name = values.get("name", "")
        self.lights = tuple(values.get("lights", "").split(","))

    @property
    def emulated(self) -> bool:
        """Whether it says that it is the emulated controller, which has no lights."""
        return self.name == EMULATED

    def upload(self, schedule: Schedule) -> None:
        """Send the steps, and verify that the controller holds exactly these.

        Raises
        ------
        DeviceError
            If the controller does not have a light, is too slow, or holds another plan afterwards.
        """
        seconds = (len(schedule.steps) + 2) * REPLY_SECONDS
        deadline = self.link.clock.monotonic() + seconds
        self.link.request("CLEAR")
        for index, step in enumerate(schedule.steps):
            if self.link.clock.monotonic() > deadline:
                raise self.link.error(
                    f"must accept {len(schedule.steps)} steps within {seconds:.1f} s",
                    f"{index} steps",
                    FIRMWARE_CURE,
                )
            light = {"light": step.light, "exposure": step.exposure}
            self.link.request(
                "STEP", index=index, **light, on=step.on_us, off=step.off_us
            )
        if not self.holds(schedule):
            held = self.link.request("PLAN").values
            raise self.link.error(
                f"must hold {len(schedule.steps)} steps, digest {schedule.digest}",
                f"{held.get('steps')} steps, digest {held.get('digest')}",
                FIRMWARE_CURE,
            )

    def holds(self, schedule: Schedule) -> bool:
        """Whether the controller holds exactly these steps."""
        held = self.link.request("PLAN").values
        plan = (held.get("steps"), held.get("digest", "").upper())
        return plan == (str(len(schedule.steps)), schedule.digest)

    def arm(
        self, schedule: Schedule, override: Override | Rehearsal | None = None
    ) -> None:
        """Arm the controller; needs a closed interlock, and `override` above the limit of flashes.

        Raises
        ------
        InputError
            If the sequence is not allowed, the controller refuses it, or a real controller would
            run a rehearsal.
        """
        require_safe(schedule, override)
        if isinstance(override, Rehearsal) and not self.emulated:
            raise self.link.error(
                "must be emulated in a rehearsal, in which nobody confirms that flashes are safe",
                repr(self.name),
                "omit --virtual",
            )
        operator = {} if override is None else {"operator": override.operator}
        self.link.request("ARM", digest=schedule.digest, **operator)

    def run(
        self,
        schedule: Schedule,
        progress: Callable[[int, int], None] | None = None,
        done: list[Measured] | None = None,
    ) -> DomeState:
        """Start, and wait until the sequence is done or stopped; at the end the lights are off.

        Requests, which reset the watchdog of the controller, are sent only while it makes progress.

        Parameters
        ----------
        schedule
            The schedule that was uploaded and armed.
        progress
            Called with the steps done and the steps in all.
        done
            List to which the measurements of each finished step are appended, so that they survive
            a lost connection.

        Raises
        ------
        DeviceError
            If the controller stops answering, makes no progress, or sends what cannot be right.
        """
        reports = [] if done is None else done
        clock = self.link.clock
        with stopped_at_end(self.stop):
            requested = clock.monotonic()
            self.link.request("START")
            start = Start(requested, clock.monotonic())
            state = DomeState("running", 0, "closed", "")
            while state.state == "running":
                state = self._progress(schedule, state, start)
                for _ in range(min(state.step - len(reports), REPORTS_AT_A_TIME)):
                    reports.append(self.report_step(schedule, len(reports)))
                if progress is not None:
                    progress(state.step, len(schedule.steps))
                if len(reports) >= state.step:
                    clock.sleep(POLL_SECONDS)
            return state

    def state(self, steps: int) -> DomeState:
        """Current state of the controller, which holds a plan of so many steps."""
        reply = self.link.request("STATUS")
        return DomeState(
            self.link.value(reply, "state", STATES),
            self.link.value(reply, "step", Count(0, steps)),
            self.link.value(reply, "interlock", INTERLOCKS),
            reply.values.get("reason", ""),
        )

    def stop(self) -> None:
        """Switch all lights off.

        If the controller does not confirm it, nothing is sent until its watchdog has done it.

        Raises
        ------
        DeviceError
            If the controller does not confirm that it stopped.
        """
        try:
            self.link.request("STOP")
            state = self.link.value(self.link.request("STATUS"), "state", STATES)
            text = f"the state {state}"
        except DeviceError as error:
            state = ""
            text = error.faults[0].found
        if state in ("", "running"):
            self.link.clock.sleep(SILENCE_SECONDS)
            raise self.link.error(
                "must confirm that it stopped",
                f"{text}, so that lights may be on",
                LIGHTS_CURE,
            )

    def report_step(self, schedule: Schedule, index: int) -> Measured:
        """Measurements of a step.

        Raises
        ------
        RefusedError
            If the step did not run.
        DeviceError
            If a value cannot be right: not finite, outside its range, or far from the plan.
        """
        reply = self.link.request("REPORT", index=index)
        step = schedule.steps[index]
        early = step.on_us * CLOCK_ERROR + EARLY_SECONDS * 1e6
        late = step.on_us * CLOCK_ERROR + SLACK_SECONDS * 1e6
        on_times = Range(
            round(max(step.on_us - early, 0)), round(step.on_us + late), "us"
        )
        on_us = self.link.value(reply, "on", on_times)
        off_us = self.link.value(
            reply, "off", Range(on_us, round(step.off_us + late), "us")
        )
        return Measured(
            round(on_us),
            round(off_us),
            self.link.value(reply, "triggers", TRIGGERS),
            self.link.value(reply, "level", CURRENT),
            self.link.value(reply, "rest", REST_CURRENT),
        )

    def _progress(
        self, schedule: Schedule, before: DomeState, start: Start
    ) -> DomeState:
        """The next state of a running sequence, which must be the one that is due by the plan."""
        sent = self.link.clock.monotonic()
        state = self.state(len(schedule.steps))
        now = self.link.clock.monotonic()
        total = len(schedule.steps)
        for wrong, rule, found in (
            (
                state.state not in ("running", "done", "stopped"),
                "must be running, done or stopped after START",
                state.state,
            ),
            (
                state.state == "running" and state.interlock == "open",
                "must stop when the interlock is open",
                "running",
            ),
            (
                state.state == "done" and state.step < total,
                f"must finish {total} steps before it is done",
                f"{state.step} steps",
            ),
            (
                state.step < before.step,
                "must not count fewer finished steps than before",
                f"{state.step} after {before.step}",
            ),
        ):
            if wrong:
                raise self.link.error(rule, found, FIRMWARE_CURE)
        at_least = sent - start.replied
        at_most = now - start.requested
        self._require_due(schedule, state, at_least=at_least, at_most=at_most)
        return state

    def _require_due(
        self, schedule: Schedule, state: DomeState, *, at_least: float, at_most: float
    ) -> None:
        """Refuse progress that is slower or faster than the plan; times are seconds since START."""
        step = schedule.steps[min(state.step, len(schedule.steps) - 1)]
        latest = step.off_us / 1e6 * (1 + CLOCK_ERROR) + SLACK_SECONDS
        if state.state == "running" and at_least > latest:
            raise self.link.error(
                f"must finish step {state.step} within {latest:.1f} s",
                f"no progress after {at_least:.1f} s",
                FIRMWARE_CURE,
            )
        if state.step > 0:
            planned = schedule.steps[state.step - 1].off_us / 1e6
            earliest = planned * (1 - CLOCK_ERROR) - EARLY_SECONDS
            if at_most < earliest:
                raise self.link.error(
                    f"cannot finish {state.step} steps in less than {earliest:.1f} s",
                    f"{at_most:.1f} s",
                    FIRMWARE_CURE,
                )
