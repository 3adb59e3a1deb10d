"""The fibre probe: suction with a gauge, a light source, and a trigger for its camera."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from skindb.errors import Fault, require
from skindb.hw.link import (
    CLOCK_ERROR,
    EARLY_SECONDS,
    FIRMWARE_CURE,
    GAUGE_KPA,
    GAUGE_SECONDS,
    PROBE_STATES,
    SILENCE_SECONDS,
    SLACK_SECONDS,
    TRIGGERS,
    DeviceError,
    Link,
    stopped_at_end,
)
from skindb.types import Float64

KIND = "probe"
# of the gauge: the probe adheres to the skin without leaving a mark
PRESSURE_KPA = -5.0
MAX_SUCTION_KPA = 20.0  # stronger suction leaves marks
SETTLE_SECONDS = 5.0  # within which the pressure must be reached
PRESSURE_TOLERANCE_KPA = 1.0  # difference from the target during a measurement
# difference from the target below which the pressure counts as reached
SETTLED_KPA = 0.3
MAX_AGE_SECONDS = 0.5  # of the last reading of the gauge, which sends one every 0.1 s
TIME_PRECISION_SECONDS = 1e-3  # of the times of the gauge
# by which the clock of the gauge may be fast, in the two minutes of a site
MAX_AHEAD_SECONDS = 0.2
POLL_SECONDS = 0.1  # interval of status requests
RELEASE_SECONDS = 0.25  # without a reading, after which the pump counts as off
# exposures, and their ratio (Weyrich et al. 2005, section 8)
PAPER_BRACKETS = 23
PAPER_RATIO = 2 ** (2 / 3)
PAPER_SECONDS = 88.0  # for all exposures of a site

Log = Float64
Reading = tuple[float, float]  # s since the pump was switched on, kPa


def brackets(longest: float, count: int = PAPER_BRACKETS) -> dict[str, float]:
    """Exposures in steps of 2/3 stop: id -> seconds, the longest first."""
    return {f"b{i:02d}": longest / PAPER_RATIO**i for i in range(count)}


class PlacementError(DeviceError):
    """The probe must be placed again: it leaks, or a frame is missing; the devices work."""


@dataclass(frozen=True)
class Placement:
    """Record of one placement of the probe."""

    triggers: Mapping[str, int]  # exposure -> trigger pulses sent to its camera
    pressure: Log  # (n, 2) s since the suction began, kPa; at least one reading


class Gauge:
    """Readings of the gauge since the pump was switched on: recent, finite and in range.

    Parameters
    ----------
    link
        Link to the probe.
    target
        Pressure [kPa] that the probe should hold.
    """

    def __init__(self, link: Link, target: float) -> None:
        self.readings = list[Reading]()
        # whether the pressure was reached, so that it must be held
        self.settled = False
        self._link = link
        self._target = target
        # before PUMP is sent, so that ages are never too low
        self._start = link.clock.monotonic()

    @property
    def kpa(self) -> float:
        """The last reading; that of the open air before the first."""
        return self.readings[-1][1] if self.readings else 0.0

    def check(self) -> None:
        """Read what has arrived.

        Raises
        ------
        PlacementError
            If the pressure was reached and is lost.
        DeviceError
            If a reading is not finite, out of range or out of order, or if the last one is too old.
        """
        events = [event for event in self._link.events() if event.verb == "PRESSURE"]
        seconds = self._link.clock.monotonic() - self._start
        previous = self.readings[-1][0] if self.readings else -1.0
        for event in events:
            t = self._link.value(event, "t", GAUGE_SECONDS)
            kpa = self._link.value(event, "kpa", GAUGE_KPA)
            if not previous < t <= seconds + MAX_AHEAD_SECONDS:
                raise self._link.error(
                    "must send readings of the gauge in order, with their times since PUMP",
                    f"{t:.2f} s, {seconds:.2f} s after PUMP and after a reading of "
                    f"{previous:.2f} s",
                    FIRMWARE_CURE,
                )
            self._require_recent(t - max(previous, 0.0))
            self.readings.append((t, kpa))
            previous = t
            self._require_pressure(t, kpa)
        self._require_recent(seconds - max(previous, 0.0))

    def _require_recent(self, age: float) -> None:
        """Refuse a pressure that was unknown for too long, also if another reading followed."""
        if not age <= MAX_AGE_SECONDS + TIME_PRECISION_SECONDS:
            raise self._link.error(
                f"must have a reading of the gauge in the last {MAX_AGE_SECONDS} s",
                f"none {'for' if self.readings else 'in'} {age:.2f} s",
                "check the gauge and its cable",
            )

    def _require_pressure(self, t: float, kpa: float) -> None:
        """Refuse suction stronger than wanted, overpressure, which lifts the probe, and leaks."""
        lowest = self._target - PRESSURE_TOLERANCE_KPA
        if not lowest <= kpa <= PRESSURE_TOLERANCE_KPA:
            raise self._link.error(
                f"must hold a pressure from {lowest:g} to {PRESSURE_TOLERANCE_KPA:g} kPa",
                f"{kpa:.2f} kPa",
                "check the pump and the gauge",
            )
        if self.settled and not kpa <= self._target + PRESSURE_TOLERANCE_KPA:
            raise PlacementError(
                Fault(
                    self._link.name,
                    f"must hold {self._target:g} kPa within {PRESSURE_TOLERANCE_KPA:g} kPa",
                    f"{kpa:.2f} kPa after {t:.1f} s, so it leaks",
                    "press it on, check its seal, and place it again",
                )
            )


class Probe:
    """A probe at the end of a link."""

    def __init__(self, link: Link) -> None:
        self.link = link
        link.hello(KIND)

    def measure(
        self,
        exposures: Mapping[str, float],
        *,
        pressure: float = PRESSURE_KPA,
        progress: Callable[[int, int], None] | None = None,
    ) -> Placement:
        """Apply suction, expose every bracket, and release; the light and the suction
        end also after an error.

        Requests, which reset the watchdog of the probe, are sent only while its gauge is in order.

        Parameters
        ----------
        exposures
            Id -> seconds.
        pressure
            Pressure of the gauge [kPa], negative.
        progress
            Called with the exposures done and the exposures in all.

        Raises
        ------
        PlacementError
            If the suction does not reach or does not hold its pressure.
        DeviceError
            If the probe stops answering, or if it or its gauge sends what cannot be right.
        """
        require(
            -MAX_SUCTION_KPA <= pressure < 0,
            "probe",
            f"the suction must be from {-MAX_SUCTION_KPA:g} to 0 kPa",
            f"{pressure:g} kPa",
            "use about -5 kPa",
        )
        self.link.discard_events()
        with stopped_at_end(self.stop):
            gauge = Gauge(self.link, pressure)
            self.link.request("PUMP", kpa=f"{pressure:g}")
            self._settle(gauge, pressure)
            unused = len(gauge.readings) - 1
            self.link.request("LED", on=1)
            triggers = {}
            for number, (name, seconds) in enumerate(exposures.items()):
                triggers[name] = self._expose(name, seconds, gauge)
                if progress is not None:
                    progress(number + 1, len(exposures))
        return Placement(triggers, np.array(gauge.readings[unused:]))

    def stop(self) -> None:
        """Switch off light and pump, and open the valve.

        If the probe does not confirm it, nothing is sent until its watchdog has done it.

        Raises
        ------
        DeviceError
            If the probe does not confirm it, or if the gauge sends readings as if the pump ran.
        """
        text = ""
        try:
            self.link.request("STOP")
            self.link.discard_events()
            self.link.clock.sleep(RELEASE_SECONDS)
            if any(event.verb == "PRESSURE" for event in self.link.events()):
                text = "readings of the gauge, which it sends while the pump runs"
        except DeviceError as error:
            text = error.faults[0].found
        if text:
            self.link.clock.sleep(SILENCE_SECONDS)
            raise self.link.error(
                "must confirm that it released the suction",
                text,
                "take the probe off, and switch off its power",
            )

    def _settle(self, gauge: Gauge, pressure: float) -> None:
        """Wait until the pressure is reached."""
        deadline = self.link.clock.monotonic() + SETTLE_SECONDS
        while True:
            gauge.check()
            if gauge.readings and abs(gauge.kpa - pressure) < SETTLED_KPA:
                gauge.settled = True
                return
            if self.link.clock.monotonic() > deadline:
                fault = Fault(
                    self.link.name,
                    f"must reach {pressure:g} kPa within {SETTLE_SECONDS:g} s",
                    f"{gauge.kpa:.2f} kPa",
                    "check its seal and the pump, and place it again",
                )
                raise PlacementError(fault)
            self.link.request("BEAT")
            self.link.clock.sleep(POLL_SECONDS)

    def _expose(self, name: str, seconds: float, gauge: Gauge) -> int:
        """Expose once, and return the number of triggers."""
        clock = self.link.clock
        begin = clock.monotonic()
        self.link.request("EXPOSE", exposure=name, us=round(seconds * 1e6))
        while True:
            gauge.check()
            reply = self.link.request("STATUS")
            state = self.link.value(reply, "state", PROBE_STATES)
            triggers = self.link.value(reply, "triggers", TRIGGERS)
            elapsed = clock.monotonic() - begin
            if state == "idle":
                break
            if elapsed > seconds + SLACK_SECONDS:
                raise self.link.error(
                    f"must expose {name} within {seconds + SLACK_SECONDS:.1f} s",
                    f"still exposing after {elapsed:.1f} s",
                    FIRMWARE_CURE,
                )
            clock.sleep(min(POLL_SECONDS, seconds))
        if elapsed < seconds * (1 - CLOCK_ERROR) - EARLY_SECONDS:
            raise self.link.error(
                f"must expose {name} for {seconds:.3f} s",
                f"{elapsed:.3f} s",
                FIRMWARE_CURE,
            )
        gauge.check()
        return triggers
