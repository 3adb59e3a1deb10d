"""Random misbehaving devices: the program of docs/reliability.md with a bounded number of cases."""

from __future__ import annotations

import shutil

import pytest
from attack_devices import LIGHTS, attacked_setup, frame_faults, violations

pytestmark = pytest.mark.slow

CASES = 60


@pytest.mark.destructive
def test_attack__sessions_end_safely_and_lose_nothing(tmp_path):
    setup = attacked_setup(tmp_path / "lab")
    refused = 0
    for seed in range(CASES):
        outcome, wrong, refusal = violations(setup, tmp_path / "case", seed)
        shutil.rmtree(tmp_path / "case")
        assert wrong == [], f"case {seed}: {refusal}"
        refused += outcome == "refused"
    assert refused > CASES / 2  # most attacks are no noise that a session survives


def test_attack__no_frame_is_taken_for_another(tmp_path):
    """Cameras that drop, repeat and delay frames."""
    setup = attacked_setup(tmp_path / "lab", LIGHTS)
    for seed in range(12):
        faults = frame_faults(seed)
        _, wrong, refusal = violations(setup, tmp_path / "case", seed, faults=faults)
        shutil.rmtree(tmp_path / "case")
        assert wrong == [], f"case {seed}: {refusal}"
