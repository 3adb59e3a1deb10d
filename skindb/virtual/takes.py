"""The demo's virtual takes as capture folders, all photographed by one dome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from skindb.virtual.capture import DEVICE_SEED, simulate_take
from skindb.virtual.dome import build_dome
from skindb.virtual.person import default_people

Progress = Callable[[str, int, int], None]


def simulate_takes(
    out: Path,
    *,
    takes: int = 8,
    cameras: int = 8,
    lights: int = 48,
    width: int = 160,
    height: int = 200,
    head: Path | None = None,
    subsurface: bool = False,
    seed: int = 2005,
    progress: Progress | None = None,
) -> list[Path]:
    """Write `<out>/<take>` and `<out>/<take>.truth.npz` for the first `takes` of the default people.

    Parameters
    ----------
    out
        Folder of the captures; a take's own folder must be absent or empty.
    takes
        How many, in the order of `default_people`.
    cameras, lights, width, height
        The dome and its frames in pixels.
    head
        Head model file that replaces the parametric face.
    subsurface
        Carry diffuse light through the skin by the dipole instead of letting it out where it enters.
    seed
        Of the noise; shapes and skins follow from the people alone.
    progress
        Called with stage, steps done and steps in all.
    """
    return [
        simulate_nth(
            out, i, cameras=cameras, lights=lights, width=width, height=height, head=head, subsurface=subsurface,
            seed=seed, progress=progress,
        )
        for i in range(len(default_people()[:takes]))
    ]  # fmt: skip


def simulate_nth(
    out: Path,
    i: int,
    *,
    cameras: int = 8,
    lights: int = 48,
    width: int = 160,
    height: int = 200,
    head: Path | None = None,
    subsurface: bool = False,
    seed: int = 2005,
    progress: Progress | None = None,
) -> Path:
    """Write number `i` of them, the same whether the others are written or not; see `simulate_takes`."""
    dome = build_dome(lights, cameras, width=width, height=height, rng=np.random.default_rng(DEVICE_SEED))
    person, rng = replace(default_people()[i], head_file=head), np.random.default_rng([seed, i])
    simulate_take(out / person.take, person, dome, subsurface=subsurface, rng=rng, progress=progress)
    return out / person.take
