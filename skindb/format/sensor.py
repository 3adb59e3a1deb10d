"""Sensors of cameras and probes: levels, noise and response."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skindb.errors import attempt
from skindb.files import read_regular
from skindb.format.fields import MAX_MAGNITUDE, Fields, shown
from skindb.format.frames import FrameKind, inside
from skindb.limits import MAX_RESPONSE_BYTES
from skindb.types import Float64

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
    response: Float64 | None = None  # (n, 4) dn, r, g, b; None for linear
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
    earlier = len(item.faults)
    bits = item.integer("bit_depth", minimum=1, maximum=16, default=16)
    highest = 2**bits - 1
    black = item.number("black_level", minimum=0.0, default=0.0)
    white = item.number("white_level", above=0.0, default=float(highest))
    if white <= black:
        item.fault("white_level", f"must be above black_level {black:g}", shown(white))
        white = black + 1
    elif len(item.faults) == earlier and white > highest:
        rule = (
            f"must be at most {highest}, the highest value of {bits} bits: no "
            "pixel would be saturated"
        )
        item.fault(
            "white_level",
            rule,
            shown(white),
            "bit_depth is that of the file, adc_bits that of the converter",
        )
    levels = (black, white) if len(item.faults) == earlier else None
    missing = [key for key in ("read_noise_e", "electrons_per_dn") if not item.has(key)]
    if len(missing) == 1:
        rule = (
            "read_noise_e and electrons_per_dn must be given together: noise is in "
            "electrons, pixels are in values"
        )
        item.fault(missing[0], rule, "nothing", "add it, or remove both")
    response, response_file = read_response(folder, item, levels)
    converter_bits = item.integer("adc_bits", minimum=1, maximum=16, default=bits)
    sensor = SensorRecord(
        kind=FrameKind(size.width, size.height, bits),
        black=black,
        white=white,
        read_noise=item.number("read_noise_e", minimum=0.0, default=0.0),
        electrons_per_dn=item.number(
            "electrons_per_dn", above=0.0, default=UNKNOWN_ELECTRONS
        ),
        step=2.0 ** max(bits - converter_bits, 0),
        response=response,
        response_file=response_file,
    )
    if len(item.faults) == earlier:
        _require_electrons(item, sensor)
    return sensor


def read_response(
    folder: Path, item: Fields, levels: tuple[float, float] | None
) -> tuple[Float64, Path] | tuple[None, None]:
    """The table of a response, and its file; its ends are checked unless the levels are
    faulty (None).
    """
    name = item.text("response", default="linear")
    if name in ("linear", ""):
        return None, None
    path = inside(folder, name, item.place("response"), item.faults)
    if path is None:
        return None, None
    place = f"{path} ({item.place('response')})"
    content = attempt(
        item.faults, lambda: read_regular(path, MAX_RESPONSE_BYTES), where=place
    )
    if content is None:
        return None, None
    cure = (
        "measure the response again, or write it as described in docs/capture_format.md"
    )
    table = np.zeros((0, 4))
    try:
        lines = content.decode("utf-8").splitlines()[1:]
        if any(lines):
            table = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError as error:  # includes errors of UTF-8
        rule = "must be a CSV file dn,r,g,b of numbers"
        item.fault("response", rule, f"{name}: {error}", cure)
        return None, None
    rows, columns = table.shape
    rising = columns == 4 and rows > 1 and bool((np.diff(table, axis=0) > 0).all())
    if not rising or not (np.abs(table) <= MAX_MAGNITUDE).all():
        rule = "must be finite columns dn,r,g,b that all rise"
        item.fault(
            "response", rule, f"{name} of {rows} rows and {columns} columns", cure
        )
        return None, None
    if levels is not None:
        _require_ends(item, name, table, *levels)
    return table, path


def _require_ends(
    item: Fields, name: str, table: Float64, black: float, white: float
) -> None:
    """Require that a response runs from 0 at black to 1 at white: other units would
    scale all radiance.
    """
    ends = np.array(
        [np.interp([black, white], table[:, 0], column) for column in table.T[1:]]
    )
    slack = RESPONSE_ERROR * (white - black)
    covers = table[0, 0] <= black + slack and table[-1, 0] >= white - slack
    if not covers or (np.abs(ends - [0.0, 1.0]) > RESPONSE_ERROR).any():
        (low, *dimmest), (high, *brightest) = table[0], table[-1]
        item.fault(
            "response",
            f"must run from 0 at black_level {black:g} to 1 at white_level {white:g}",
            f"{name}: {min(dimmest):.3g} at {low:g} to {max(brightest):.3g} at {high:g}",
            "measure it over all values, and divide it by that at the white level",
        )


def _require_electrons(item: Fields, sensor: SensorRecord) -> None:
    """Require enough electrons, and little enough noise, for a picture."""
    full = sensor.full_electrons
    if full < MIN_FULL_ELECTRONS:
        rule = (
            "electrons_per_dn * (white_level - black_level) must be at least "
            f"{MIN_FULL_ELECTRONS:g} electrons"
        )
        cure = "measure it by a photon transfer curve"
        item.fault("electrons_per_dn", rule, f"{full:.3g}", cure)
    elif sensor.read_noise > MAX_READ_NOISE_FRACTION * full:
        rule = (
            f"read noise must be at most {MAX_READ_NOISE_FRACTION:g} of the electrons "
            "at the white level"
        )
        cure = "give it in electrons: values times electrons_per_dn"
        item.fault(
            "read_noise_e",
            rule,
            f"{sensor.read_noise:.3g} of {full:.3g} electrons",
            cure,
        )
