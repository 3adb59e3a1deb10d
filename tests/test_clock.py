"""Tests of the simulated clock."""

from __future__ import annotations

import signal

import pytest

from skindb.clock import TICK_SECONDS, SimulatedClock


def test_simulated_clock__ctrl_c_waits_until_devices_have_acted():
    """A device that stops in the midst of an act would have a state that no device has."""
    clock = SimulatedClock()
    acted = []

    def act():
        signal.raise_signal(signal.SIGINT)
        acted.append(clock.monotonic())

    clock.attach(act)
    clock.attach(act)
    # a shell ignores Ctrl-C in processes that it starts in the background
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            clock.sleep(1.0)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert acted == [TICK_SECONDS, TICK_SECONDS]
