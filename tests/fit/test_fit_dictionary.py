"""The labelled report on measured BRDFs, and what a fit keeps of their files."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit import dictionary_report
from skindb.reflectance.brdf_files import SHAPE, read_dictionary, write_merl
from skindb.reflectance.dictionary import Dictionary, embedded_dictionary
from skindb.schema import GROUPS, check


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Dictionary:
    folder = tmp_path_factory.mktemp("merl")
    for name, albedo in (("teflon", 0.5), ("mine", 1.3)):
        write_merl(folder / f"{name}.binary", np.full((*SHAPE, 3), albedo / np.pi))
    return read_dictionary(folder)


@pytest.mark.slow
def test_dictionary_report__is_labelled_and_carries_the_notes(measured):
    report = dictionary_report(measured, disc_angular_radius=0.01)
    check(report, [v.name for v in GROUPS["dictionary_report"]])
    assert list(report["dictionary"].values) == ["mine", "teflon"]
    np.testing.assert_allclose(report["energy_excess"], [0.3, 0], atol=1e-3)
    np.testing.assert_array_equal(report["hole_fraction"], 0)
    assert report.attrs["notes"] == list(measured.notes)
    assert report["disc_angular_radius"] == 0.01


def test_provenance__sums_of_what_was_read(measured):
    found = measured.provenance
    assert found["dictionary_notes"] == []
    assert {len(value) for value in found["dictionary_sha256"].values()} == {64}
    assert set(embedded_dictionary().provenance) == {
        "dictionary",
        "dictionary_digest",
    }
