"""Numbers that no device has are refused with their file, key and limit; unusual
devices are not.
"""

from __future__ import annotations

import numpy as np
import pytest
from sphere import FIBRES
from spoil import D, P, drop, edited, put

from skindb.errors import InputError
from skindb.ingest import read_capture
from skindb.ingest.probe_profiles import fibre_profiles


def fibres(key, *values):
    """One value of every fibre."""

    def change(record):
        for fibre, value in zip(record["fibres"], values, strict=True):
            fibre[key] = value

    return edited(P, change)


def place(key, index, value):
    """A camera or light that far away."""

    def change(record):
        record[key][index]["t" if key == "cameras" else "position"] = [0, 0, value]

    return edited(D, change)


HOSTILE = {
    "disc of 3 m": (
        put(D, "lights", 0, "disc_radius", value=3e3),
        r"\[0\]\[disc_radius\]: must be at most 2,000; fou",
    ),
    "falloff": (
        put(D, "lights", 0, "falloff", value=1e4),
        r"\[lights\]\[0\]\[falloff\]: must be at most 2,000",
    ),
    "linear polariser": (
        put(D, "lights", 0, "polariser", value=[0, 1, 0]),
        r"\[lights\]\[0\]\[polariser\]: must be left or right, of circular polarisers",
    ),
    "polariser that does not polarise": (
        edited(D, lambda dome: dome["cameras"][0].update(polariser="left", leak=0.5)),
        r"\[cameras\]\[0\]\[leak\]: must be at most 0\.25",
    ),
    "target in metres": (
        put(D, "white", "half_size", value=0.06),
        r"\[white\]\[half_size\]: must be at least 1",
    ),
    "target of 3 m": (
        put(D, "white", "half_size", value=3e3),
        r"\[white\]\[half_size\]: must be at most 2,000",
    ),
    "vignette that brightens": (
        put(D, "cameras", 0, "vignette", value=[4, 0, 0]),
        r"\[0\]\[vignette\]: .* at most 4 in the whole picture; found 5 at r = 1;",
    ),
    "distortion of 1e9": (
        put(D, "cameras", 0, "distortion", value=[0, 0, 1e9, 0, 0]),
        (
            r"\[0\]\[distortion\]: 1 \+ k1 r\^2 .* corners of the picture; found 1 and "
            r"9\.03e\+08 at r = 0\.301;"
        ),
    ),
    "distortion that turns back": (
        put(D, "cameras", 1, "distortion", value=[-11, 0, 0, 0, 0]),
        r"found 0\.00312 ",
    ),
    "light at 200 m": (
        place("lights", 1, 2e5),
        r"dome\.json\[lights\]: .* within 100 m .*; found 1 of 4 farther: l1;",
    ),
    "camera at 200 m": (
        place("cameras", 1, 2e5),
        r"dome\.json\[cameras\]: cameras must be within 100 m of the origin",
    ),
    "no electrons": (
        put(D, "cameras", 0, "electrons_per_dn", value=1e-3),
        r"\[0\]\[electrons_per_dn\]: .* at least 100 electrons; found 65\.3",
    ),
    "read noise": (
        put(P, "read_noise_e", value=5e3),
        (
            r"probe\.json\[read_noise_e\]: read noise must be at most 0\.1 .*; found "
            r"5e\+03 of 3\.26e\+04 electrons"
        ),
    ),
    "seconds of a year": (
        put(D, "exposures", 0, "seconds", value=3e7),
        r"\[0\]\[seconds\]: must be at most 100,000",
    ),
    "fibres in metres": (
        fibres("distance", 1e-3, 2e-3, 3e-3, 4e-3),
        r"fibre must be 0\.1 to 300 mm .*0\.004",
    ),
    "fibres in micrometres": (
        fibres("distance", 1e3, 2e3, 3e3, 4e3),
        r"\[fibres\]: distances must be in mm.*4000 mm",
    ),
    "fibres at one distance": (
        fibres("distance", *[2.0] * FIBRES),
        r"at different distances; found all 4 at 2 mm;",
    ),
    "fibres on the source": (
        put(P, "fibre_radius", value=0.6),
        r"\[fibres\]\[0\]\[distance\]: fibres must not overlap the source: .* 1\.2 mm; found 1 mm;",
    ),
    "fibre of 2 cm": (
        put(P, "fibre_radius", value=20),
        r"probe\.json\[fibre_radius\]: must be at most 10",
    ),
    "circles too large": (
        fibres("radius", *[7.0] * FIBRES),
        (
            r"\[fibres\]: fibres must not overlap in the picture; found 3 pairs, such "
            r"as 0 and 1: 12 px apart, radii 7"
        ),
    ),
    "one place for two": (
        fibres("centre", [10, 8], [22, 8], [22, 8], [46, 8]),
        r"found 1 pairs, such as 1 and 2: 0 p",
    ),
    "gain": (
        put(P, "gain", value=[1.1, 0.9, 1050, 0.8]),
        r"\[gain\]: .* 100 times .*; found 1\.05e\+03 times, of",
    ),
    "gain error in per cent": (
        put(P, "gain_error", value=5),
        r"probe\.json\[gain_error\]: must be at most 1",
    ),
    "pressure of five atmospheres": (
        put(P, "pressure", value={"neck": 500}),
        r"\[neck\]: a gauge .*; found 500 kPa",
    ),
    "pressure in pascal": (
        put(P, "pressure", value={"neck": -7.5e3}),
        r"\[pressure\]\[neck\]: a gauge pressure",
    ),
    "white frames of the face": (
        edited(D, lambda dome: dome["white"].update(frames=dome["frames"])),
        (
            r"\[white\]: every view must have its own file; found 8 shared, l0_c0\.png "
            r"of template frames and of"
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_read_capture__numbers_that_no_device_has(capture_folder, name):
    spoil, message = HOSTILE[name]
    spoil(capture_folder)
    with pytest.raises(InputError, match=message) as caught:
        read_capture(capture_folder)
    (fault,) = caught.value.faults
    assert fault.cure


LEGAL = {
    "soft box": put(D, "lights", 0, "disc_radius", value=1e3),
    "narrow spot": put(D, "lights", 0, "falloff", value=1500),
    "small target": put(D, "white", "half_size", value=5),
    "vignette that brightens": put(D, "cameras", 0, "vignette", value=[2, 0, 0]),
    "fisheye": put(D, "cameras", 1, "distortion", value=[-9, 0, 0.01, -0.01, 0]),
    "light at 90 m": place("lights", 1, 9e4),
    "sensor of a phone": put(D, "cameras", 0, "electrons_per_dn", value=0.02),
    "flash": put(D, "exposures", 0, "seconds", value=1e-6),
    "a ring of fibres": fibres("distance", 2, 2, 2, 2.5),
    "a probe of one fibre": lambda folder: edited(
        P, lambda probe: probe.update(fibres=probe["fibres"][:1], gain=[1])
    )(folder),
    "a far fibre": fibres("distance", 1, 2, 3, 200),
    "fibres that touch the source": put(P, "fibre_radius", value=0.5),
    "circles that touch": fibres("radius", *[6.5] * FIBRES),
    "gains of a dirty fibre": put(P, "gain", value=[1.1, 0.9, 0.02, 0.8]),
    "no gain": drop(P, "gain"),
    "vacuum": put(P, "pressure", value={"neck": -101.3}),
}


@pytest.mark.parametrize("name", LEGAL)
def test_read_capture__unusual_devices_pass(capture_folder, name):
    LEGAL[name](capture_folder)
    assert read_capture(capture_folder).probe is not None


@pytest.mark.parametrize(("factor", "refused"), [(1, False), (10, False), (30, True)])
def test_fibre_profiles__more_light_than_went_in(capture_folder, factor, refused):
    """pi r^2 R is 0.13 of the light at 4 mm, in red."""
    edited(P, lambda probe: probe.update(scale=factor * probe["scale"]))(capture_folder)
    probe = read_capture(capture_folder).probe
    if refused:
        with pytest.raises(
            InputError,
            match=r"\[scale\]: R at r mm must be at most 2 .* found .* at fibre 3 of \w+;",
        ):
            fibre_profiles(probe)
    else:
        assert np.isfinite(fibre_profiles(probe).value).all()
    put(P, "scale", value=None)(capture_folder)
    assert not fibre_profiles(read_capture(capture_folder).probe).scale_known


def test_read_capture__degree_of_polarisation(capture_folder):
    put(D, "lights", 1, "polariser", value="left")(capture_folder)
    put(D, "lights", 1, "leak", value=0.01)(capture_folder)
    put(D, "cameras", 0, "polariser", value="right")(capture_folder)
    dome = read_capture(capture_folder).dome
    assert [light.polarisation for light in dome.lights[:2]] == [
        0,
        pytest.approx(-0.98),
    ]
    assert [camera.polarisation for camera in dome.cameras[:2]] == [1, 0]
