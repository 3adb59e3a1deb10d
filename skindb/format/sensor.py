"""Sensors of cameras and probes: levels, noise and response."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.files import read_regular
from skindb.format.fields import Fields
from skindb.format.frame_paths import inside
from skindb.format.frames import FrameKind
from skindb.format.json_file import MAX_MAGNITUDE, shown
from skindb.limits import MAX_RESPONSE_BYTES

Array = NDArray[np.float64]
UNKNOWN_ELECTRONS = 1e30  # per value, where the file does not state them: no shot noise
RESPONSE_ERROR = 0.01  # tolerance at the ends of a response, in values and in exposure

# electrons at the white level; cameras of phones have thousands
MIN_FULL_ELECTRONS = 100.0
MAX_READ_NOISE_FRACTION = 0.1  # of the white level; cameras have at most 0.01


@dataclass(frozen=True)
class SensorRecord:
    """Levels and noise in values of the file; `kind.bits` is 0 for linear OpenEXR,
    which does not use them.
    """

    kind: FrameKind
    black: float
    white: float
    read_noise: float  # electrons
    electrons_per_dn: float  # infinity: shot noise unknown
    # between neighbouring values that occur: 16 for a 12-bit converter in 16-bit files
    step: float = 1.0
    response: Array | None = None  # (n, 4) dn, r, g, b; None for linear
    response_file: Path | None = None

    @property
    def full_electrons(self) -> float:
        """Electrons that reach the white level."""
        return self.electrons_per_dn * (self.white - self.black)

    @property
    def noise_known(self) -> bool:
        """Whether the number of electrons per value is known."""
        return self.kind.bits > 0 and self.electrons_per_dn < UNKNOWN_ELECTRONS


def read_sensor(
    folder: Path, item: Fields, size: FrameKind, *, linear: bool
) -> SensorRecord:
    """The sensor of a camera or probe, whose frames have this size; faults are recorded
    in `item`.
    """
    if linear:
        return SensorRecord(size, 0.0, np.inf, 0.0, np.inf)
    noted = len(item.faults)
    bits = item.integer("bit_depth", least=1, most=16, default=16)
    black = item.number("black_level", least=0.0, default=0.0)
    white = item.number("white_level", above=0.0, default=float(2**bits - 1))
    if white <= black:
        item.fault("white_level", f"must be above black_level {black:g}", shown(white))
        white = black + 1
    elif len(item.faults) == noted and white > 2**bits - 1:
        rule = (
            f"must be at most {2**bits - 1}, the highest value of {bits} bits: no "
            "pixel would be saturated"
        )
        item.fault(
            "white_level",
            rule,
            shown(white),
            "bit_depth is that of the file, adc_bits that of the converter",
        )
    levels = (black, white) if len(item.faults) == noted else None
    missing = [
        key
        for key in ("read_noise_e", "electrons_per_dn")
        if item.get(key, None) is None
    ]
    if len(missing) == 1:
        rule = (
            "read_noise_e and electrons_per_dn must be given together: noise is in "
            "electrons, pixels are in values"
        )
        item.fault(missing[0], rule, "nothing", "add it, or remove both")
    response = _response(folder, item, levels)
    sensor = SensorRecord(
        kind=FrameKind(size.width, size.height, bits),
        black=black,
        white=white,
        read_noise=item.number("read_noise_e", least=0.0, default=0.0),
        electrons_per_dn=item.number(
            "electrons_per_dn", above=0.0, default=UNKNOWN_ELECTRONS
        ),
        step=2.0
        ** max(bits - item.integer("adc_bits", least=1, most=16, default=bits), 0),
        response=None if response is None else response[0],
        response_file=None if response is None else response[1],
    )
    fault = (
        noise_fault(item.where, sensor.read_noise, sensor.full_electrons)
        if len(item.faults) == noted
        else None
    )
    item.faults += [] if fault is None else [fault]
    return sensor


def _response(
    folder: Path, item: Fields, levels: tuple[float, float] | None
) -> tuple[Array, Path] | None:
    """The table of a response, and its file; its ends are checked unless the levels are
    faulty (None).
    """
    name = item.text("response", default="linear")
    path = (
        None
        if name in ("linear", "")
        else inside(folder, name, f"{item.where}[response]", item.faults)
    )
    if path is None:
        return None
    cure = (
        "measure the response again, or write it as described in docs/capture_format.md"
    )
    try:
        lines = read_regular(path, MAX_RESPONSE_BYTES).decode("utf-8").splitlines()[1:]
        table = (
            np.loadtxt(lines, delimiter=",", ndmin=2)
            if any(lines)
            else np.zeros((0, 4))
        )
    except InputError as error:
        item.faults += [
            Fault(f"{path} ({item.place('response')})", f.rule, f.found, f.cure)
            for f in error.faults
        ]
        return None
    except ValueError as error:  # includes errors of UTF-8
        item.fault(
            "response",
            "must be a CSV file dn,r,g,b of numbers",
            f"{name}: {error}",
            cure,
        )
        return None
    rising = (
        table.ndim == 2
        and table.shape[1] == 4
        and len(table) > 1
        and bool((np.diff(table, axis=0) > 0).all())
    )
    if not rising or not (np.abs(table) <= MAX_MAGNITUDE).all():
        found = f"{name} of {table.shape[0]} rows and {table.shape[1]} columns"
        item.fault(
            "response", "must be finite columns dn,r,g,b that all rise", found, cure
        )
        return None
    if levels is not None:
        _require_ends(item, name, table, *levels)
    return np.asarray(table), path


def _require_ends(
    item: Fields, name: str, table: Array, black: float, white: float
) -> None:
    """Require that a response runs from 0 at black to 1 at white: other units would
    scale all radiance.
    """
    ends = np.array(
        [
            [np.interp(level, table[:, 0], column) for column in table.T[1:]]
            for level in (black, white)
        ]
    )
    slack = RESPONSE_ERROR * (white - black)
    covers = table[0, 0] <= black + slack and table[-1, 0] >= white - slack
    if not covers or (np.abs(ends - [[0.0], [1.0]]) > RESPONSE_ERROR).any():
        rule = f"must run from 0 at black_level {black:g} to 1 at white_level {white:g}"
        (low, *first), (high, *last) = table[0], table[-1]
        found = f"{name}: {min(first):.3g} at {low:g} to {max(last):.3g} at {high:g}"
        item.fault(
            "response",
            rule,
            found,
            "measure it over all values, and divide it by that at the white level",
        )


def noise_fault(where: str, read_noise: float, full_electrons: float) -> Fault | None:
    """Fault of a sensor with too few electrons, or too much noise, for a picture."""
    if full_electrons < MIN_FULL_ELECTRONS:
        rule = (
            "electrons_per_dn * (white_level - black_level) must be at least "
            f"{MIN_FULL_ELECTRONS:g} electrons"
        )
        return Fault(
            f"{where}[electrons_per_dn]",
            rule,
            f"{full_electrons:.3g}",
            "measure it by a photon transfer curve",
        )
    if read_noise > MAX_READ_NOISE_FRACTION * full_electrons:
        rule = (
            f"read noise must be at most {MAX_READ_NOISE_FRACTION:g} of the electrons "
            "at the white level"
        )
        found = f"{read_noise:.3g} of {full_electrons:.3g} electrons"
        return Fault(
            f"{where}[read_noise_e]",
            rule,
            found,
            "give it in electrons: values times electrons_per_dn",
        )
    return None
