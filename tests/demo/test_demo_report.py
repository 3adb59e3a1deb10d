"""The report from planted results: its content, and its layout in a browser."""

from __future__ import annotations

import base64
import re

import imagecodecs
import numpy as np
import pytest
from browser_page import inaccessible
from planted_results import (
    DIFFUSE_ERROR,
    HELD_OUT_ERROR,
    NORMAL_ERROR,
    PLANTED,
    SURFELS,
    TAKES,
    planted_results,
)

from skindb.demo.report import cell, write_report
from skindb.schema import FitStatus

MAX_HEIGHT = 6000  # px at a width of 400 px, as on a telephone


@pytest.fixture(scope="module")
def results():
    return planted_results()


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    return write_report(
        tmp_path_factory.mktemp("demo") / "report.html",
        results,
        progress=lambda *_: None,
    )


@pytest.mark.slow
def test_write_report__one_row_for_each_take(report):
    text = report.read_text()
    for label, value in (
        ("Normal [deg]", NORMAL_ERROR),
        ("R_d [%]", 100 * DIFFUSE_ERROR),
        ("Held-out lights [%]", 100 * HELD_OUT_ERROR),
    ):
        cells = re.findall(rf'data-label="{re.escape(label)}">([^<]+)<', text)
        assert [float(value) for value in cells] == [pytest.approx(value)] * len(TAKES)
    fitted = 100 * (1 - sum(PLANTED.values()) / SURFELS)
    assert text.count(f"{fitted:.1f} % of {SURFELS:,} surfels") == len(TAKES)
    assert len(re.findall("<tbody><tr><td><figure>", text)) == len(TAKES)
    assert text.count("<summary>Pictures and maps of") == len(TAKES)


def test_write_report__begins_with_medians_over_the_takes(report):
    first = report.read_text().split("<section>")[0]
    found = [float(value) for value in re.findall(r"<dd>([\d.e-]+)</dd>", first)]
    planted = [NORMAL_ERROR, 100 * DIFFUSE_ERROR, 100 * HELD_OUT_ERROR]
    assert found[:3] == [pytest.approx(value) for value in planted]
    assert len(found) == 4
    assert 'src="viewer.html"' in first


def test_write_report__states_why_surfels_have_no_fit(report):
    text = report.read_text()
    for status, count in PLANTED.items():
        assert status.explanation in text
        assert f'<td class="number">{count * len(TAKES):,}</td>' in text
    # no surfel has this status
    assert FitStatus.NOT_FINITE.explanation not in re.sub('base64,[^"]+', "", text)
    assert f"unseen {100 * PLANTED[FitStatus.UNSEEN] / SURFELS:.2g} %" in text


@pytest.mark.slow
def test_write_report__states_the_distance_of_the_edit(report, results):
    text = report.read_text()
    assert "amount 1, distance 0.40: inside the data" in text
    near = re.search(
        r"is ([\d.e-]+) for the unedited model and ([\d.e-]+) at amount 1", text
    )
    assert float(near[2]) < 0.05 * float(
        near[1]
    )  # the edit has the colours of the measured take; few surfels are filled
    far = planted_results(TAKES[:2])
    far.edits[1.0].attrs["edit_distance"] = 1.2
    other = write_report(
        report.with_name("far.html"), far, progress=lambda *_: None
    ).read_text()
    assert "amount 1, distance 1.20: outside the data" in other


@pytest.mark.slow
def test_write_report__without_edits_and_traits(report):
    plain = planted_results((TAKES[0], TAKES[3]))
    plain.edits = {}
    plain.edited_take = ""
    del plain.studies["traits"]
    text = write_report(
        report.with_name("plain.html"), plain, progress=lambda *_: None
    ).read_text()
    assert "An edit and its distance" not in text


def test_cell__is_short_and_readable():
    values = (175952, np.int64(23), 0.012345, 1234.5, np.nan, "a", True, -0.0)
    assert [cell(value) for value in values] == [
        "175,952",
        "23",
        "0.0123",
        "1,234",
        "-",
        "a",
        "True",
        "0",
    ]


@pytest.mark.slow
def test_write_report__text_is_escaped_and_pictures_are_readable(report):
    plain = planted_results((TAKES[0], TAKES[3]))
    plain.models[TAKES[0]].attrs["traits"] = {"gender": '<i>"x'}
    text = write_report(
        report.with_name("plain.html"), plain, progress=lambda *_: None
    ).read_text()
    assert "<i>" not in text
    assert "http" not in re.sub('base64,[^"]+', "", text)
    assert "Portrait of the fitted model of V001: &lt;i&gt;&#34;x, normal" in text
    png = base64.b64decode(re.search(r"image/png;base64,([^\"]+)", text)[1])
    assert imagecodecs.png_decode(png).shape[2] == 3


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_write_report__fits_a_narrow_page(report, browser, theme):
    context = browser.new_context(
        viewport={"width": 400, "height": 800}, color_scheme=theme
    )
    page = context.new_page()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(report.as_uri())
    assert page.evaluate("document.documentElement.scrollHeight") < MAX_HEIGHT
    page.evaluate(
        "document.querySelectorAll('details').forEach(one => one.open = true)"
    )
    assert page.evaluate("document.documentElement.scrollWidth") == 400
    unnamed = "[...document.images].filter(one => !one.alt || !one.naturalWidth).length"
    assert page.evaluate(unnamed) == 0
    assert inaccessible(page) == []
    files = [
        report.as_uri(),
        report.with_name("viewer.html").as_uri(),
        *(image.as_uri() for image in report.parent.glob("plots/*.png")),
    ]
    assert {url for url in asked if not url.startswith("data:")} == set(files)
    assert page.locator('a[href="viewer.html"]').count() == 1
    ink, paper = (
        np.mean(
            [
                int(part)
                for part in re.findall(
                    r"\d+", page.evaluate(f"getComputedStyle(document.body).{what}")
                )
            ]
        )
        for what in ("color", "backgroundColor")
    )
    assert (ink > paper) == (theme == "dark")
    context.close()
