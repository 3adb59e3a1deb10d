"""The demo's virtual takes as capture folders, all photographed by one dome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from skindb.types import Progress
from skindb.virtual.capture import DEVICE_SEED, simulate_take
from skindb.virtual.dome import build_dome
from skindb.virtual.person import Person, default_people


def simulate_takes(
    out: Path,
    *,
    takes: int | Sequence[int] = 8,
    people: Sequence[Person] | None = None,
    cameras: int = 8,
    lights: int = 48,
    width: int = 160,
    height: int = 200,
    head: Path | None = None,
    subsurface: bool = False,
    seed: int = 2005,
    progress: Progress | None = None,
) -> list[Path]:
    """Write `<out>/<take>` and `<out>/<take>.truth.npz` for virtual people; each take
    is independent of the others.

    Parameters
    ----------
    out
        Folder of the captures; a take's own folder must be absent or empty.
    takes
        Number of people, or their indices.
    people
        The people to choose from; default `default_people`.
    cameras, lights, width, height
        The dome and its frames in pixels.
    head
        Head model file that replaces the parametric face.
    subsurface
        Transport diffuse light through the skin by the dipole instead of reflecting it
        where it enters.
    seed
        Random seed of the noise; shapes and skins depend on the people alone.
    progress
        Called with the stage, the steps done and the total number of steps.
    """
    folders = []
    dome = build_dome(
        lights,
        cameras,
        width=width,
        height=height,
        rng=np.random.default_rng(DEVICE_SEED),
    )
    everybody = default_people() if people is None else people
    for i in range(len(everybody))[:takes] if isinstance(takes, int) else takes:
        person = replace(everybody[i], head_file=head)
        rng = np.random.default_rng([seed, i])
        folders.append(out / person.take)
        simulate_take(
            folders[-1], person, dome, subsurface=subsurface, rng=rng, progress=progress
        )
    return folders
