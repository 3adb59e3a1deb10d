"""The fibre probe: suction with a gauge, a light source, and a trigger for its camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.hw.link import DeviceError, Link

KIND = "probe"
PRESSURE_KPA = -5.0  # of the gauge: the probe adheres to the skin without leaving a mark
SETTLE_SECONDS = 5.0  # within which the pressure must be reached
PRESSURE_TOLERANCE_KPA = 1.0  # drift from the target during a measurement
SETTLED_KPA = 0.3  # difference from the target below which the pressure counts as reached
POLL_SECONDS = 0.1  # interval of status requests
PAPER_BRACKETS, PAPER_RATIO = 23, 2 ** (2 / 3)  # exposures, and their ratio (Weyrich et al. 2005, section 8)
PAPER_SECONDS = 88.0  # for all exposures of a site

Log = NDArray[np.float64]


def brackets(longest: float, count: int = PAPER_BRACKETS) -> dict[str, float]:
    """Exposures in steps of 2/3 stop: id -> seconds, the longest first."""
    return {f"b{i:02d}": longest / PAPER_RATIO**i for i in range(count)}


@dataclass(frozen=True)
class Placement:
    """Record of one placement of the probe."""

    triggers: Mapping[str, int]  # exposure -> trigger pulses sent to its camera
    pressure: Log  # (n, 2) s since the suction began, kPa
    lost_readings: int  # number of gauge readings that did not arrive

    @property
    def drift(self) -> float:
        """Largest deviation [kPa] of the pressure from that at the first exposure."""
        return float(np.abs(self.pressure[:, 1] - self.pressure[0, 1]).max()) if len(self.pressure) else np.nan


class Probe:
    """A probe at the end of a link."""

    def __init__(self, link: Link, *, sleep: Callable[[float], None] = time.sleep) -> None:
        self.link, self._sleep = link, sleep
        said = link.hello(KIND).values
        self.name, self.firmware = said.get("name", ""), said.get("firmware", "")

    def measure(
        self,
        exposures: Mapping[str, float],
        *,
        pressure: float = PRESSURE_KPA,
        progress: Callable[[int, int], None] | None = None,
    ) -> Placement:
        """Apply suction, expose every bracket, and release; the light and the suction end also after an error.

        Raises
        ------
        DeviceError
            If the suction does not reach or does not hold its pressure.
        """
        self.link.events()
        lost = self.link.lost_events
        try:
            self.link.request("PUMP", kpa=f"{pressure:g}")
            readings = self._settle(pressure)
            self.link.request("LED", on=1)
            triggers = {}
            for number, (name, seconds) in enumerate(exposures.items()):
                triggers[name] = self._expose(name, seconds, readings)
                if progress is not None:
                    progress(number + 1, len(exposures))
                worst = max(readings, key=lambda one: abs(one[1] - pressure))
                if abs(worst[1] - pressure) > PRESSURE_TOLERANCE_KPA:
                    rule = f"must hold {pressure:g} kPa within {PRESSURE_TOLERANCE_KPA:g} kPa"
                    cure = "press it on, check its seal, and place it again"
                    raise self.link.error(rule, f"{worst[1]:.2f} kPa at exposure {name}, so it leaks", cure)
        finally:
            self.stop()
        return Placement(triggers, np.array(readings), self.link.lost_events - lost)

    def stop(self) -> None:
        """Switch off light and pump, and open the valve; a disconnected probe does so by its watchdog."""
        try:
            self.link.request("STOP")
        except DeviceError:
            return

    def _settle(self, pressure: float) -> list[tuple[float, float]]:
        """Wait until the pressure is reached, and return the reading that reached it."""
        deadline = time.monotonic() + SETTLE_SECONDS
        while True:
            last = self._readings()
            if last and abs(last[-1][1] - pressure) < SETTLED_KPA:
                return last[-1:]
            if time.monotonic() > deadline:
                rule, cure = f"must reach {pressure:g} kPa within {SETTLE_SECONDS:g} s", "check its seal and the pump"
                found = f"{last[-1][1]:.2f} kPa" if last else "no reading of the gauge"
                raise self.link.error(rule, found, cure)
            self.link.request("BEAT")
            self._sleep(POLL_SECONDS)

    def _expose(self, name: str, seconds: float, readings: list[tuple[float, float]]) -> int:
        self.link.request("EXPOSE", exposure=name, us=round(seconds * 1e6))
        deadline = time.monotonic() + seconds + SETTLE_SECONDS
        while True:
            state, triggers = self.link.values(self.link.request("STATUS"), state=str, triggers=int)
            readings += self._readings()
            if state != "exposing":
                return int(triggers)
            if time.monotonic() > deadline:
                raise self.link.error(f"must expose {name} within {seconds + SETTLE_SECONDS:.1f} s", "still exposing")
            self._sleep(min(POLL_SECONDS, seconds))

    def _readings(self) -> list[tuple[float, float]]:
        events = [event for event in self.link.events() if event.verb == "PRESSURE"]
        return [tuple(self.link.values(event, t=float, kpa=float)) for event in events]
