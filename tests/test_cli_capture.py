"""`skindb capture`: a rehearsal from an empty folder to a capture that ingest reads,
with faults and without.
"""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from permissions import open_to_others

from skindb.cli import cli
from skindb.errors import InputError
from skindb.format.frames import read_frame
from skindb.hw.capture_folder import one_session
from skindb.ingest import read_capture
from skindb.virtual.devices import RefusedError
from skindb.workflow.session import VIRTUAL_SIZE

pytestmark = pytest.mark.slow

SMALL = {"width": 80, "height": 100}  # px of the frames of the virtual subject


@pytest.fixture(scope="module")
def rehearsal(tmp_path_factory):
    """A complete rehearsal, whose virtual subject the other tests reuse."""
    out = tmp_path_factory.mktemp("rehearsal") / "C"
    log = out.with_suffix(".log")
    with pytest.MonkeyPatch.context() as patch:
        for name, pixels in SMALL.items():
            patch.setitem(VIRTUAL_SIZE, name, pixels)
        result = CliRunner().invoke(
            cli,
            [
                "capture",
                str(out),
                "--virtual",
                "--sites",
                "cheek,neck",
                "--log",
                str(log),
            ],
        )
    assert result.exit_code == 0, result.output + str(result.exception)
    return out


def test_capture__its_folders_belong_to_their_owner_alone(rehearsal):
    assert {path.name for path in rehearsal.parent.iterdir()} == {
        "C",
        "C.log",
        "C.virtual",
    }
    assert open_to_others(rehearsal.parent, itself=False) == {}


def _use_subject(rehearsal, tmp_path):
    """A capture in this folder is of the virtual subject of the rehearsal."""
    beside = tmp_path / "C.virtual"
    if not beside.exists():
        beside.mkdir()
        (beside / "subject-2005").symlink_to(
            rehearsal.parent / "C.virtual/subject-2005"
        )


def _again(rehearsal, tmp_path, *options):
    """A capture of the same subject with other options."""
    out = tmp_path / "C"
    _use_subject(rehearsal, tmp_path)
    sites = () if "--sites" in options else ("--sites", "cheek")
    return out, CliRunner().invoke(
        cli, ["capture", str(out), "--virtual", *sites, *options]
    )


def _same_frames(out, rehearsal):
    files = sorted(
        path.relative_to(rehearsal) for path in rehearsal.glob("dome/frames/*/*")
    )
    assert files == sorted(
        path.relative_to(out) for path in out.glob("dome/frames/*/*")
    )
    # a picture that is delivered again has new noise with a standard deviation of one
    return all(
        np.abs(
            read_frame(out / name).astype(float) - read_frame(rehearsal / name)
        ).max()
        <= 8
        for name in files
    )


def _flashes(out):
    """Recorded flashes per second of a rehearsal."""
    return json.loads((out / "capture.json").read_text())["rehearsal"][
        "flashes_per_second"
    ]


def test_capture__rehearsal_is_a_capture(rehearsal):
    capture = read_capture(rehearsal)
    assert len(capture.dome.sequence.light) == len(capture.dome.lights) * 2
    assert (capture.dome.sequence.triggers == 1).all()
    assert capture.dome.dark is not None
    assert capture.probe.sites == ("cheek", "neck")
    log = capture.probe.pressure["cheek", "1"]
    assert np.abs(log[:, 1] + 5).max() < 1
    subject = rehearsal.parent / "C.virtual/subject-2005"
    assert _same_frames(rehearsal, subject)
    assert not (rehearsal / "unfinished.json").exists()
    assert "HELLO" in (rehearsal.with_suffix(".log") / "probe.log").read_text()


def test_capture__lost_frames_only_cost_time(rehearsal, tmp_path):
    faults = [
        "dropped_frame=c02:11",
        "dome.lost_triggers=7",
        "probe.lost_triggers=4",
    ]
    out, result = _again(
        rehearsal, tmp_path, *(part for fault in faults for part in ("--fault", fault))
    )
    assert result.exit_code == 0, result.output + str(result.exception)
    assert "repeated" in result.output
    for light in (2, 9, 20):
        name = f"dome/frames/e0/l{light:03d}_c02.png"
        assert (out / name).read_bytes() == (rehearsal / name).read_bytes()
    assert read_capture(out).dome.sequence is not None


@pytest.mark.parametrize(
    "fault", ["dome.open_interlock_at=60", "dome.vanish_after=215"]
)
def test_capture__continues_after_a_stop(rehearsal, tmp_path, fault):
    out, result = _again(rehearsal, tmp_path, "--fault", fault)
    assert isinstance(result.exception, InputError)
    assert "must run to its end" in str(result.exception)
    kept = len(json.loads((out / "unfinished.json").read_text())["sequence"])
    # between the second and the third marker
    assert kept == (25 if "interlock" in fault else kept) > 0
    out, result = _again(rehearsal, tmp_path)
    assert result.exit_code == 0, str(result.exception)
    assert _same_frames(out, rehearsal)
    assert (np.diff(read_capture(out).dome.sequence.on) >= 0).all()


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            "dead_light=l005",
            (
                "light l005: must be as bright as the others; found its picture has 0% "
                "of the brightness"
            ),
        ),
        (
            "stuck_light=l020",
            "light l020: must be as bright as the others; found 100% of the current",
        ),
        ("silently_stuck_light=l020", "dark frame: all lights must be off; found "),
    ],
)
def test_capture__frames_of_a_light_that_failed_are_taken_again(
    rehearsal, tmp_path, fault, said
):
    out, result = _again(rehearsal, tmp_path, "--fault", f"dome.{fault}")
    assert said in str(result.exception)
    light = fault.partition("=")[2]
    kept = json.loads((out / "unfinished.json").read_text())["sequence"]
    assert light not in {entry["light"] for entry in kept}
    out, result = _again(rehearsal, tmp_path)  # repaired
    assert result.exit_code == 0, str(result.exception)
    assert _same_frames(out, rehearsal)


def test_capture__one_session_at_a_time_writes_into_a_folder(rehearsal, tmp_path):
    with one_session(tmp_path / "C"):
        _, result = _again(rehearsal, tmp_path)
    assert "only one session at a time may write into a folder" in str(result.exception)
    assert not list(tmp_path.glob(".*"))
    assert not (tmp_path / "C").exists()


def test_capture__a_set_up_that_ingest_cannot_read_is_refused_before_the_session(
    rehearsal, tmp_path
):
    setup = tmp_path / "lab"
    (setup / "dome").mkdir(parents=True)
    dome = json.loads((rehearsal / "dome/dome.json").read_text())
    del dome["cameras"][2]["R"], dome["white"]
    dome["lights"][3]["position"] = [0, 0]
    (setup / "dome/dome.json").write_text(json.dumps(dome))
    options = [
        "--subject",
        "S1",
        "--reference",
        "f",
        "--consent",
        "fit",
        "--scan",
        str(rehearsal / "scan.ply"),
    ]
    options += ["--dome", "socket://127.0.0.1:1", "--cameras", str(tmp_path)]
    result = CliRunner().invoke(
        cli, ["capture", str(tmp_path / "C"), "--setup", str(setup), *options]
    )
    assert "[cameras][2][R]: this key is required" in str(result.exception)
    assert "[lights][3][position]: must be 3 numbers" in str(result.exception)
    assert not (tmp_path / "C").exists()


def test_capture__a_leak_is_refused_and_the_dome_s_frames_are_kept(rehearsal, tmp_path):
    _, result = _again(rehearsal, tmp_path, "--fault", "probe.leak=0.05")
    assert "so it leaks; press it on, check its seal" in str(result.exception)
    out, result = _again(rehearsal, tmp_path, "--placements", "2")
    assert result.exit_code == 0, str(result.exception)
    capture = read_capture(out)
    assert capture.probe.placements["cheek"] == ("1", "2")
    assert _same_frames(out, rehearsal)


def test_capture__plan_only_prints(rehearsal, tmp_path):
    out, result = _again(rehearsal, tmp_path, "--plan", "--slower")
    assert (
        "24 lights, 2 exposures, 4 cameras: at most 3 flashes in any second"
        in result.output
    )
    assert not out.exists()
    _, result = _again(rehearsal, tmp_path, "--plan", "--json")
    told = json.loads(result.output)
    assert told["safe"] is False
    assert told["flashes_per_second"] > 10


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "--setup: a capture needs it"),
        (["--fault", "dropped_frame=c0:1"], "--fault: belongs to --virtual"),
        (["--virtual", "--dome", "/dev/x"], "--dome: belongs to a real laboratory"),
        (
            ["--virtual", "--fault", "dome.earthquake=1"],
            "must be dropped_frame=CAMERA:NUMBER",
        ),
        (
            ["--virtual", "--fault", "dropped_frame=many"],
            "must be dropped_frame=CAMERA:NUMBER",
        ),
    ],
)
def test_capture__mistakes(rehearsal, tmp_path, options, said):
    _use_subject(rehearsal, tmp_path)
    result = CliRunner().invoke(cli, ["capture", str(tmp_path / "C"), *options])
    assert said in str(result.exception)


def test_capture__mistakes_of_a_real_session(rehearsal, tmp_path):
    """Options that a real session lacks are reported, with the set-up of the rehearsal."""
    subject = rehearsal.parent / "C.virtual/subject-2005"
    own = [
        "--setup",
        str(subject),
        "--subject",
        "S1",
        "--reference",
        "form 1",
        "--scan",
        str(subject / "scan.ply"),
    ]

    def said(*options):
        return str(
            CliRunner()
            .invoke(cli, ["capture", str(tmp_path / "R"), *own, *options])
            .exception
        )

    assert "--consent: a capture needs it" in said()
    assert (
        "--consent: must be from fit, statistics, export, publish; found sell"
        in said("--consent", "sell")
    )
    assert "--trait: must be NAME=VALUE" in said("--consent", "fit", "--trait", "age")
    assert "--confirm-screening: an operator must be responsible for it" in said(
        "--consent", "fit", "--confirm-screening"
    )
    for operator in ("", "  ", "a b"):
        assert "--operator: must be 1 to 64 letters" in said(
            "--consent", "fit", "--confirm-screening", "--operator", operator
        )
    assert "capture.json[traits][age]: a trait must be a number" in said(
        "--consent", "fit", "--trait", "age=nan"
    )
    named = said(
        "--consent", "fit", "--trait", "subject=S2", "--trait", "hair=red\x1b[2J"
    )
    assert (
        "capture.json[traits][subject]: an attribute must not have the name of another column"
        in named
    )
    assert (
        "capture.json[traits][hair]: a text must be at most 256 characters that can be printed"
        in named
    )
    assert "capture.json[subject]: must be 1 to 64 letters" in said(
        "--consent", "fit", "--subject", "Anna Müller"
    )
    assert "capture.json[calibration]: must be 1 to 64" in said(
        "--consent", "fit", "--calibrated-by", "a b"
    )
    assert "--sites: a name must be 1 to 64 letters" in said(
        "--consent", "fit", "--sites", "left cheek"
    )
    assert "--dome: a capture needs it" in said("--consent", "fit")
    for scope in ("statistics", "export,publish", " ", ","):
        assert (
            "--consent: must contain fit, without which nothing may be computed"
            in said("--consent", scope)
        )
    wrong = [
        "--consent",
        "sell",
        "--trait",
        "age",
        "--sites",
        "a b",
        "--operator",
        " ",
        "--landmarks",
        "absent.json",
    ]
    together = said(*wrong, "--seed", "3", "--fault", "dome.delay=2")
    for name in (
        "consent",
        "trait",
        "sites",
        "operator",
        "landmarks",
        "seed",
        "fault",
        "dome",
        "cameras",
    ):
        assert f"--{name}: " in together
    assert not (tmp_path / "R").exists()
    (tmp_path / "frames").mkdir()
    cameras = ["--consent", "fit", "--cameras", str(tmp_path / "frames")]
    assert "must have a subfolder for each camera" in said(
        *cameras, "--dome", "socket://127.0.0.1:1"
    )
    for name in ("c00", "c01", "c02", "c03"):
        (tmp_path / "frames" / name).mkdir()
    assert "a device must be at this address" in said(
        *cameras, "--dome", "socket://127.0.0.1:1"
    )
    shutil.copytree(tmp_path / "frames", tmp_path / "R")
    result = CliRunner().invoke(
        cli, ["capture", str(tmp_path / "C"), "--setup", str(tmp_path), "--plan"]
    )
    assert "dome.json" in str(result.exception)


def test_capture__an_unfinished_capture_is_continued_for_the_same_subject_only(
    rehearsal, tmp_path
):
    """Subjects must not be mixed, so another name, consent, condition or set-up
    needs another folder.
    """
    out, result = _again(rehearsal, tmp_path, "--fault", "dome.open_interlock_at=20")
    assert "must run to its end" in str(result.exception)
    before = json.loads((out / "unfinished.json").read_text())
    for name, options in {
        "subject": ["--subject", "S2"],
        "condition": ["--condition", "lotion"],
    }.items():
        _, result = _again(rehearsal, tmp_path, *options)
        assert f"an unfinished capture must be resumed with the same {name}" in str(
            result.exception
        )
        assert json.loads((out / "unfinished.json").read_text()) == before
    for name, value in {"consent": {"scope": ["fit"]}, "set-up": "0" * 16}.items():
        (out / "unfinished.json").write_text(
            json.dumps(before | {"identity": before["identity"] | {name: value}})
        )
        _, result = _again(rehearsal, tmp_path)
        assert f"an unfinished capture must be resumed with the same {name}" in str(
            result.exception
        )
    for damaged in (
        {},
        [],
        {"sequence": 3},
        before | {"sequence": [{"light": "l000"}]},
    ):
        (out / "unfinished.json").write_text(json.dumps(damaged))
        _, result = _again(rehearsal, tmp_path)
        assert "must be the record of an unfinished capture" in str(result.exception)


def test_capture__may_be_continued_more_slowly_and_reports_its_flashes(
    rehearsal, tmp_path
):
    out, result = _again(rehearsal, tmp_path, "--fault", "dome.open_interlock_at=20")
    assert "must run to its end" in str(result.exception)
    out, result = _again(rehearsal, tmp_path, "--slower")
    assert result.exit_code == 0, str(result.exception)
    assert _flashes(out) > 3  # of the first session
    assert "at most 3 flashes" not in result.output


def test_capture__a_slow_capture_is_repeated_slowly(rehearsal, tmp_path):
    """Missing steps are repeated at the same pace, without a confirmation."""
    out, result = _again(
        rehearsal, tmp_path, "--slower", "--fault", "dropped_frame=c02:11"
    )
    assert result.exit_code == 0, str(result.exception)
    assert "repeated" in result.output
    assert "at most 3 flashes in any second" in result.output
    assert "a real session would be refused" not in result.output
    assert _flashes(out) == 3


def test_capture__a_full_disk_is_found_before_a_light_is_switched_on(
    rehearsal, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        "shutil.disk_usage", lambda _: shutil._ntuple_diskusage(10**12, 10**12, 10**6)
    )
    _, result = _again(rehearsal, tmp_path)
    assert "need up to 0.0 GB; found 0.0 GB free" in str(result.exception)
    monkeypatch.undo()
    assert _again(rehearsal, tmp_path)[1].exit_code == 0
    _, result = _again(rehearsal, tmp_path)
    assert "that of an unfinished capture; found a complete capture" in str(
        result.exception
    )


@pytest.mark.parametrize(
    "fault",
    [
        "dropped_frame=c99:1",
        "dropped_frame=c02:-1",
        "dome.garbage=1.5",
        "dome.garbage=nan",
        "dome.delay=inf",
        "dome.lost_triggers=-4",
        "dome.dead_light=l999",
        "probe.leak=-1",
        "probe.gauge=odd",
    ],
)
def test_capture__a_fault_that_cannot_happen_is_refused(rehearsal, tmp_path, fault):
    _, result = _again(rehearsal, tmp_path, "--fault", fault)
    assert f"found '{fault}'" in str(result.exception)


def test_capture__an_interrupted_rehearsal_can_begin_again(tmp_path):
    made = tmp_path / "C.virtual/made"
    made.mkdir(parents=True)
    (made / "half").write_text("of a subject")
    result = CliRunner().invoke(
        cli, ["capture", str(tmp_path / "C"), "--virtual", "--plan"]
    )
    assert result.exit_code == 0, str(result.exception)


def test_capture__logs_of_earlier_sessions_are_kept(rehearsal, tmp_path):
    log = tmp_path / "log"
    _again(
        rehearsal, tmp_path, "--log", str(log), "--fault", "dome.open_interlock_at=20"
    )
    first = (log / "dome.log").read_text()
    assert _again(rehearsal, tmp_path, "--log", str(log))[1].exit_code == 0
    assert (log / "dome.log").read_text() == first
    assert "HELLO" in (log / "dome-2.log").read_text()


def test_capture__ctrl_c_at_the_probe_keeps_earlier_measurements(
    rehearsal, tmp_path, monkeypatch
):
    """If the second site is interrupted, the first one is not measured again."""
    placed = []

    def place(self, site):
        placed.append(site)
        self.site = site
        if len(placed) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("skindb.virtual.laboratory.Laboratory.place", place)
    sites = ["--sites", "cheek,neck"]
    out, result = _again(rehearsal, tmp_path, *sites)
    assert (
        "stopped by the operator at neck, placement 1; run the same command again"
        in str(result.exception)
    )
    out, result = _again(rehearsal, tmp_path, *sites)
    assert result.exit_code == 0, str(result.exception)
    assert placed == ["cheek", "neck", "neck"]
    assert read_capture(out).probe.sites == ("cheek", "neck")


def test_capture__a_refused_session_does_not_fix_the_subject(
    rehearsal, tmp_path, monkeypatch
):
    """Until something of a subject is recorded, the folder may be used for another one."""

    def refuse(self, values):
        raise RefusedError("the interlock is open")

    monkeypatch.setattr("skindb.virtual.devices.EmulatedDome._arm", refuse)
    out, result = _again(rehearsal, tmp_path, "--subject", "S1")
    assert "the interlock is open" in str(result.exception)
    assert json.loads((out / "unfinished.json").read_text())["flashes_per_second"] == 0
    monkeypatch.undo()
    out, result = _again(rehearsal, tmp_path, "--subject", "S2")
    assert result.exit_code == 0, str(result.exception)
    assert read_capture(out).subject == "S2"


def test_capture__a_rehearsal_records_what_its_options_say_and_that_it_is_one(
    rehearsal, tmp_path
):
    said = [
        "--consent",
        "fit,publish",
        "--reference",
        "form 1",
        "--trait",
        "age=34",
        "--condition",
        "lotion",
    ]
    out, result = _again(rehearsal, tmp_path, *said)
    assert result.exit_code == 0, str(result.exception)
    record = json.loads((out / "capture.json").read_text())
    assert record["virtual"] is True
    assert record["consent"] == {"scope": ["fit", "publish"], "reference": "form 1"}
    assert (record["traits"]["age"], record["condition"]) == (34, "lotion")
    assert "gender" in record["traits"]  # of the virtual subject
    assert not (tmp_path / "C.virtual/frames").exists()


def test_capture__a_rehearsal_records_that_nobody_was_present(rehearsal):
    """Above the limit of flashes, and without the confirmation that a real session would need."""
    record = json.loads((rehearsal / "capture.json").read_text())
    assert record["rehearsal"] == {"person_present": False, "flashes_per_second": 43}
    assert "override" not in record
    assert read_capture(rehearsal).unknown_keys == ()


def test_capture__a_rehearsal_shows_the_refusal_of_a_real_session(rehearsal, tmp_path):
    _, result = _again(rehearsal, tmp_path)
    refusal = (
        "a real session would be refused: sequence: an operator must confirm "
        "screening, consent and closed eyes for "
        "more than 3 flashes in a second; found at most 43 flashes in any second"
    )
    assert refusal in result.output
    assert "give --confirm-screening --operator ID, or --slower" in result.output


def test_capture__a_rehearsal_shows_whose_confirmation_a_real_session_needs(
    rehearsal, tmp_path
):
    out, result = _again(
        rehearsal, tmp_path, "--confirm-screening", "--operator", "OP-1"
    )
    assert "a real session would be refused" not in result.output
    confirmed = (
        "a real session would run because OP-1 confirms screening, consent and closed "
        "eyes for 43 flashes"
    )
    assert confirmed in result.output
    record = json.loads((out / "capture.json").read_text())
    assert "override" not in record
    assert record["rehearsal"]["person_present"] is False


@pytest.mark.parametrize(
    ("gauge", "said"),
    [
        (
            "nan",
            "probe: must send as kpa a number from -101.4 to 1,000 kPa; found 'nan'",
        ),
        (
            "silent",
            "probe: must have a reading of the gauge in the last 0.5 s; found none for 0.5",
        ),
        (
            "late",
            "probe: must send readings of the gauge in order, with their times since PUMP",
        ),
        ("wild", "probe: must hold a pressure from -6 to 1 kPa; found 500.00 kPa"),
    ],
)
def test_capture__a_gauge_that_fails_ends_the_session(rehearsal, tmp_path, gauge, said):
    _, result = _again(rehearsal, tmp_path, "--fault", f"probe.gauge={gauge}")
    assert said in str(result.exception)
    assert "measured again" not in result.output  # it is not tried again
    _, result = _again(rehearsal, tmp_path)
    assert result.exit_code == 0, str(result.exception)


def test_capture__a_controller_without_progress_is_stopped(rehearsal, tmp_path):
    out, result = _again(rehearsal, tmp_path, "--fault", "dome.frozen_at=60")
    assert "dome must finish step 60 within" in str(result.exception)
    kept = json.loads((out / "unfinished.json").read_text())["sequence"]
    assert len(kept) == 25  # between the second and the third marker
    out, result = _again(rehearsal, tmp_path)
    assert result.exit_code == 0, str(result.exception)
    assert _same_frames(out, rehearsal)


def test_capture__another_seed_is_another_subject(rehearsal, tmp_path):
    out, result = _again(rehearsal, tmp_path, "--fault", "dome.open_interlock_at=20")
    assert "must run to its end" in str(result.exception)
    (tmp_path / "C.virtual/subject-7").symlink_to(
        rehearsal.parent / "C.virtual/subject-2005"
    )
    _, result = _again(rehearsal, tmp_path, "--seed", "7")
    assert "must be resumed with the same virtual subject" in str(result.exception)
    assert not (out / "capture.json").exists()


def test_capture__a_slow_sequence_has_the_wanted_length_or_is_refused(
    rehearsal, tmp_path
):
    _, result = _again(rehearsal, tmp_path, "--plan", "--slower", "--seconds", "5")
    assert "with at most 3 flashes in a second the sequence lasts at least 15." in str(
        result.exception
    )
    assert "found 5 s; allow more time, or omit --slower" in str(result.exception)
    _, result = _again(
        rehearsal, tmp_path, "--plan", "--slower", "--seconds", "60", "--json"
    )
    plan = json.loads(result.output)
    assert 60 <= plan["seconds"] <= 72  # with dark frames and markers
    assert plan["flashes_per_second"] <= 3  # of the markers


def test_capture__a_capture_of_the_own_dome_can_be_rehearsed(rehearsal, tmp_path):
    """A complete capture provides the lights, cameras and frames of the rehearsal; it
    is not changed.
    """
    before = {path: path.read_bytes() for path in rehearsal.rglob("*.json")}
    out = tmp_path / "R"
    options = [
        "--virtual",
        "--setup",
        str(rehearsal),
        "--subject",
        "R1",
        "--sites",
        "neck",
    ]
    result = CliRunner().invoke(cli, ["capture", str(out), *options])
    assert result.exit_code == 0, str(result.exception)
    assert _same_frames(out, rehearsal)
    assert read_capture(out).probe.sites == ("neck",)
    assert before == {path: path.read_bytes() for path in rehearsal.rglob("*.json")}
    result = CliRunner().invoke(
        cli, ["capture", str(tmp_path / "Q"), *options, "--seed", "3"]
    )
    assert (
        "--seed: makes a virtual subject, which a capture given by --setup replaces"
        in str(result.exception)
    )
    (tmp_path / "lab").mkdir()
    options[2] = str(tmp_path / "lab")
    result = CliRunner().invoke(cli, ["capture", str(tmp_path / "Q"), *options])
    assert "lab/dome/dome.json: the file must exist" in str(result.exception)
    assert not (tmp_path / "Q").exists()


def test_capture__a_set_up_copied_from_a_capture_is_accepted(rehearsal, tmp_path):
    """Its dark frames and its sequence are those of the capture, of which the session
    takes its own.
    """
    (tmp_path / "lab").mkdir()
    shutil.copytree(
        rehearsal / "contact",
        tmp_path / "lab/contact",
        ignore=shutil.ignore_patterns("*.png"),
    )
    shutil.copytree(
        rehearsal / "dome",
        tmp_path / "lab/dome",
        ignore=shutil.ignore_patterns("frames", "dark"),
    )
    own = [
        "--setup",
        str(tmp_path / "lab"),
        "--subject",
        "S1",
        "--reference",
        "f",
        "--consent",
        "fit",
    ]
    own += [
        "--scan",
        str(rehearsal / "scan.ply"),
        "--cameras",
        str(tmp_path),
        "--dome",
        "socket://127.0.0.1:1",
    ]
    result = CliRunner().invoke(cli, ["capture", str(tmp_path / "C"), *own])
    # the set-up itself is sound
    assert "must have a subfolder for each camera" in str(result.exception)


def test_capture__the_session_of_the_paper(tmp_path):
    """150 lights, two exposures and 16 cameras in 25 s, with small frames: 4,800
    frames, of which three are lost.
    """
    sim = [
        "simulate",
        str(tmp_path / "sim"),
        "--takes",
        "1",
        "--lights",
        "150",
        "--cameras",
        "16",
    ]
    result = CliRunner().invoke(cli, [*sim, "--width", "24", "--height", "30"])
    assert result.exit_code == 0, str(result.exception)
    subject = next(path for path in (tmp_path / "sim").iterdir() if path.is_dir())
    options = [
        "--virtual",
        "--setup",
        str(subject),
        "--seconds",
        "25",
        "--confirm-screening",
        "--operator",
        "OP-1",
    ]
    faults = [
        "--fault",
        "dropped_frame=c03:100",
        "--fault",
        "dropped_frame=c15:5",
        "--fault",
        "dome.lost_triggers=222",
    ]
    result = CliRunner().invoke(
        cli, ["capture", str(tmp_path / "C"), *options, *faults, "--sites", "cheek"]
    )
    assert result.exit_code == 0, str(result.exception)
    assert "repeated" in result.output
    capture = read_capture(tmp_path / "C")
    assert len(capture.dome.sequence.light) == 300
    assert 12 <= _flashes(tmp_path / "C") <= 17  # docs/howto/capture.md
    assert _same_frames(tmp_path / "C", subject)
