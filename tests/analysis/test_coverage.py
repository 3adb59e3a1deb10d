"""Coverage reports of planted populations: counts and empty cells."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from scipy import stats

from skindb.analysis import coverage_report, describe_coverage, plot_coverage
from skindb.analysis.subjects import Attribute, multiple_correlation
from skindb.errors import InputError
from skindb.schema import ProbeStatus

mpl.use("Agg")


def cohort_of(subjects, conditions=None, status=None, **attributes):
    n = len(subjects)

    def column(values):
        return ("take", np.array(values, object))

    coords = {"take": [f"T{i}" for i in range(n)], "subject": column(subjects)}
    coords |= {"condition": column(conditions or ["normal"] * n)}
    coords |= {name: column(values) for name, values in attributes.items()}
    variables = {}
    if status is not None:
        variables["site_status"] = (
            ("take", "site", "channel"),
            np.repeat(np.array(status)[..., None], 3, axis=-1),
        )
        coords["site"] = ["cheek", "neck"]
    return xr.Dataset(variables, coords)


GOOD = int(ProbeStatus.FITTED)
NOTHING = int(ProbeStatus.NOT_MEASURED)


@pytest.fixture
def population():
    """24 women aged 20 to 39, and 12 men, one of them aged 62 and without a probe; S0
    was also measured with lotion.
    """
    subjects = [f"S{i}" for i in range(36)]
    gender = ["female"] * 24 + ["male"] * 12
    age = [20 + i % 20 for i in range(35)] + [62]
    ancestry = ["european" if i % 2 else "african" for i in range(35)] + [None]
    status = [[GOOD, NOTHING]] * 35 + [[NOTHING, NOTHING]]
    return cohort_of(
        [*subjects, "S0"],
        ["normal"] * 36 + ["lotion"],
        [*status, [GOOD, GOOD]],
        gender=[*gender, "female"],
        age=[*age, None],
        ancestry=[*ancestry, "african"],
    )


def counts_of(report):
    return dict(
        zip(
            report["cell"].values.tolist(),
            report["coverage_count"].values.tolist(),
            strict=True,
        )
    )


def test_coverage_report__counts_subjects_not_takes(population):
    report = coverage_report(population)
    counts = counts_of(report)
    assert (report.attrs["subjects"], len(report.attrs["takes"])) == (36, 37)
    assert (counts["gender: female"], counts["gender: male"]) == (24, 12)
    assert (counts["condition: normal"], counts["condition: lotion"]) == (36, 1)
    # the neck was measured with lotion only
    assert (counts["site: cheek"], counts["site: neck"]) == (35, 0)
    bands = [counts[f"age band: {decade}-{decade + 9}"] for decade in range(20, 70, 10)]
    assert bands == [20, 15, 0, 0, 1]
    assert counts["gender: male x condition: lotion"] == 0
    assert counts["gender: female x age band: 20-29"] == 14
    assert counts["gender: male x ancestry: african x age band: 20-29"] == 3
    assert (
        counts["gender: male x ancestry: african"]
        + counts["gender: male x ancestry: european"]
        == 11
    )
    singles = sum(
        count
        for name, count in counts.items()
        if name.startswith("gender") and " x " not in name
    )
    crossed = sum(
        count
        for name, count in counts.items()
        if name.count(" x ") == 1 and "gender" in name and "age" in name
    )
    assert singles == crossed == 36


def test_coverage_report__counts_every_value_of_a_subject():
    report = coverage_report(
        cohort_of(
            ["S0", "S0", "S1", "S1"],
            side=["left", "right", "left", None],
            dose=[0, 2, 0, 1],
            phase=[1.0, 3.0, 1.0, 3.0],
        )
    )
    counts = counts_of(report)
    assert (counts["side: left"], counts["side: right"]) == (2, 1)
    assert (counts["phase: 1.0"], counts["phase: 3.0"]) == (2, 2)
    assert not any("dose" in cell for cell in counts)


def test_coverage_report__names_empty_and_small_cells(population):
    flags = coverage_report(population).attrs["flags"]
    assert "age band: no subjects in 40-49, 50-59" in flags
    assert "age band: fewer than 10 subjects: 60-69 (1)" in flags
    assert "site: no subjects in neck" in flags
    # the only line names 40-49
    assert "gender x age band: no subjects in female x 60-69" in flags
    assert "gender x condition: no subjects in male x lotion" in flags
    assert "ancestry: unknown for 1 of 36 subjects" in flags
    lines = describe_coverage(coverage_report(population))
    assert lines[0] == "36 subjects, 37 takes"


def test_multiple_correlation__is_that_of_an_analysis_of_variance():
    rng = np.random.default_rng(4)
    group = np.repeat([0, 1, 2], 20)
    age = 30 + 8.0 * group + rng.normal(0, 5, 60)
    f = stats.f_oneway(*(age[group == one] for one in range(3))).statistic
    plain = 2 * f / (2 * f + 57)
    want = np.sqrt(1 - (1 - plain) * 59 / 57)
    columns = Attribute("place", tuple(f"g{x}" for x in group)).columns
    assert multiple_correlation(age, columns) == pytest.approx(want)


def test_coverage_report__nothing_is_said():
    report = coverage_report(cohort_of(["A", "B"]))
    assert counts_of(report) == {"condition: normal": 2}
    assert [
        f"{name}: no subject has this attribute" in report.attrs["flags"]
        for name in ("gender", "ancestry", "age")
    ] == [True] * 3
    assert plot_coverage(report).get_xlabel() == "subjects"
    mpl.pyplot.close("all")


def test_coverage_report__refuses_an_empty_cohort():
    with pytest.raises(InputError, match="the cohort must have a take"):
        coverage_report(cohort_of([]))


def test_plot_coverage__values_may_look_like_crossings_and_factors():
    subjects = [f"S{i}" for i in range(4)]
    words = ["a x b", "a x b", "age band: x", "c"]
    ages = [20, 30, 40, 50]
    report = coverage_report(
        cohort_of(subjects, gender=words, age=ages, **{"age band": ["y"] * 4})
    )
    counts = counts_of(report)
    assert counts["age band: 20-29"] == 1
    assert counts["attribute age band: y"] == 4
    ax = plot_coverage(report)
    labels = {text.get_text() for text in ax.get_yticklabels()}
    assert labels == {f"gender: {word}" for word in words} | {"condition: normal"}
    mpl.pyplot.close(ax.figure)


def test_plot_coverage__shows_the_counts(population):
    ax = plot_coverage(coverage_report(population))
    labels = [text.get_text() for text in ax.get_yticklabels()]
    bands = [text.get_text() for text in ax.get_xticklabels()]
    texts = {
        (round(t.get_position()[1]), round(t.get_position()[0])): t.get_text()
        for t in ax.texts
    }
    assert texts[labels.index("gender: female"), bands.index("20-29")] == "14"
    assert texts[labels.index("gender: male"), bands.index("60-69")] == "1"
    assert ax.get_title() == "number of subjects (n = 36)"
    mpl.pyplot.close(ax.figure)
