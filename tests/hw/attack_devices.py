"""Attack sessions with devices that misbehave at random; see docs/reliability.md.

    python tests/hw/attack_devices.py --cases 1000 --seed 0
    python tests/hw/attack_devices.py --cases 500 --seed 0 --frames

With `--frames` it is the cameras that misbehave: each drops frames and delivers others
twice, late by up to 12 s, while the line to the controller has noise or is lost.

Each case is a session with a controller and a probe whose messages are changed, lost,
repeated, delayed or invented, whose checksums are right, and which may ignore requests.
The clock is simulated. Whatever they do, the session must end within its deadlines with
the lights off and the suction released, name what was wrong, accept no frame and no
reading wrongly, and lose nothing that was good before: the same session with sound
devices then completes.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
import trimesh
from devices_pair import (
    BRACKETS,
    CAMERAS,
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    is_frame,
    subject_folder,
    value_of,
)

from skindb.clock import SimulatedClock
from skindb.errors import InputError
from skindb.hw.cameras import FolderCameras
from skindb.hw.capture import CapturePlan, Devices, run_capture
from skindb.hw.capture_folder import Subject, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import EVENT, OK, REPLY, Lines, Link, Message
from skindb.hw.probe import Probe
from skindb.virtual.devices import DeviceFaults, DirectPort
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults

PERSON = Subject(
    "S1", "2026-01-01T10:00:00+00:00", {"scope": ["fit"], "reference": "none"}
)
PLAN = CapturePlan(seconds=2.0, sites=("cheek",))
ATTACKED_LIGHTS = LIGHTS[::3]
LONG_BRACKETS = {name: 10 * seconds for name, seconds in BRACKETS.items()}
# By the simulated clock: four runs of 65 steps, of which 32 are flashes of markers, with
# their uploads, reports and last frames, three placements, and two boards that start.
MAX_SECONDS = 4 * (67 * 0.3 + 5.0 + 3.0 + 66 * 0.9 + 15.0 + 12.0) + 3 * 45.0 + 2 * 6.0
ODD_VALUES = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e308",
        "-1",
        "-999999999",
        "999999999",
        "0",
        "1",
        "17",
        "0.5",
        "9" * 30,
        "",
        "odd",
    ),
)
PLAUSIBLE_VALUES = {
    "state": ("idle", "armed", "running", "done", "stopped", "exposing"),
    "interlock": ("open", "closed"),
    "step": ("0", "3", "10", "17"),
    "triggers": ("0", "1", "2"),
    "kpa": ("-90", "-7", "-5.2", "-3", "0", "500"),
    "t": ("0", "0.5", "3", "100"),
    "on": ("0", "290000", "2500000"),
    "off": ("40000", "290000", "2500000"),
    "level": ("0", "0.5", "1", "1.5"),
    "rest": ("0", "0.1", "1"),
}
SCOPES = ("all", "events", "replies")
# What the message of a session with this single fault contains: of a changed value, and
# of other faults.
NAMED_VALUES = {
    "state": "state|running|done|exposing|expose|must run|must confirm",
    "step": "step",
    "interlock": "interlock",
    "on": "as on |as off |duration",
    "off": "as off |duration",
    "triggers": "triggers|missing frames",
    "level": "level|current",
    "rest": "rest |current",
    "steps": "steps",
    "digest": "digest",
    "t": "as t |times since PUMP|reading of the gauge",
    "kpa": "kPa",
}
NAMED_FAULTS = {
    "vanish": "closed its line",
    "frozen": "no progress",
    "silent": "no reply|reading of the gauge",
    "deaf": "no reply|reading of the gauge",
    "slow": "no reply|reading of the gauge|within",
}
NAMES = {
    "dome": (
        "state",
        "step",
        "interlock",
        "reason",
        "on",
        "off",
        "triggers",
        "level",
        "rest",
        "steps",
        "digest",
    ),
    "probe": ("state", "triggers", "t", "kpa"),
}
IGNORED = {
    "dome": ("CLEAR", "STEP", "ARM", "START", "STATUS", "REPORT", "STOP"),
    "probe": ("PUMP", "LED", "EXPOSE", "BEAT", "STATUS", "STOP"),
}
KINDS = (
    "silent",
    "deaf",
    "slow",
    "late",
    "duplicate",
    "reorder",
    "babble",
    "truncate",
    "repeat",
    "wrong number",
    "frozen",
    "vanish",
)
KINDS = (
    *KINDS,
    *3 * ("silent", "late", "frozen"),
    *5 * ("ignore", "stale"),
    *12 * ("value",),
)


@dataclass(frozen=True)
class Attack:
    """What a device does, from a message on, with a probability for each message."""

    kind: str
    device: str
    begin: int
    probability: float
    name: str = ""  # of a value
    text: str = ""  # new value
    seconds: float = 0.0
    verb: str = ""  # that is ignored
    scope: str = "all"  # which messages it changes

    @classmethod
    def drawn(cls, rng):
        device = str(rng.choice(["dome", "probe"]))
        name = str(rng.choice(NAMES[device]))
        texts = (
            PLAUSIBLE_VALUES.get(name, ODD_VALUES) if rng.random() < 0.5 else ODD_VALUES
        )
        return cls(
            kind=str(rng.choice(KINDS)),
            device=device,
            begin=int(rng.choice([0, rng.integers(0, 40), rng.integers(0, 160)])),
            probability=float(rng.choice([1.0, 0.5, 0.05])),
            name=name,
            text=str(rng.choice(texts)),
            seconds=float(10 ** rng.uniform(-2, 0.7)),
            verb=str(rng.choice(IGNORED[device])),
            scope=str(rng.choice(SCOPES)) if device == "probe" else "all",
        )


class AttackedPort(DirectPort):
    """The line of a device that misbehaves."""

    def __init__(self, device, clock, attacks, rng):
        super().__init__(device, clock)
        self.attacks = attacks
        self.rng = rng
        self.count = 0
        self.requests = Lines()
        self.replies = Lines()
        self.late = []
        self.held = []
        self.before = {}

    def active(self, kind, message=None):
        """The attacks of a kind that happen now, or to a message that the device sends."""
        scopes = SCOPES
        if message is not None:
            scopes = ("all", "events" if message.kind == EVENT else "replies")
        begun = [
            attack
            for attack in self.attacks
            if attack.kind == kind and self.count >= attack.begin
        ]
        return [
            attack
            for attack in begun
            if attack.scope in scopes and self.rng.random() < attack.probability
        ]

    def write(self, data):
        self._require_line()
        if self.active("deaf"):
            return
        for attack in self.active("slow"):
            object.__setattr__(self._device.faults, "delay", attack.seconds)
        for _ in self.active("frozen"):
            object.__setattr__(
                self._device.faults, "frozen_at", getattr(self._device, "_done", -1)
            )
        if self.active("vanish"):
            self._device.gone = True
        for message in self.requests.feed(data):
            if any(attack.verb == message.verb for attack in self.active("ignore")):
                self._device.heard = self._clock.monotonic()
                self.send(Message(REPLY, message.number, OK))
            else:
                self._device.receive(message.encode())

    def _act(self):
        for message in self.replies.feed(self._device.tick()):
            self.count += 1
            self.send(message)
        for _ in self.active("babble"):
            self._sent += self.babble()
        while self.late and self.late[0][0] <= self._clock.monotonic():
            self._sent += self.late.pop(0)[1]

    def send(self, message):
        """Send a message of the device, or what it has become."""
        sent = message
        for attack in self.active("value", message):
            if attack.name in sent.values:
                sent = Message(
                    sent.kind,
                    sent.number,
                    sent.verb,
                    {**sent.values, attack.name: attack.text},
                )
        for attack in self.active("stale", message):
            if attack.name in sent.values and attack.name in self.before:
                sent = Message(
                    sent.kind,
                    sent.number,
                    sent.verb,
                    {**sent.values, attack.name: self.before[attack.name]},
                )
        self.before = (
            {**message.values, **self.before} if self.before else dict(message.values)
        )
        if self.active("wrong number", message):
            sent = Message(
                sent.kind, int(self.rng.integers(100_000)), sent.verb, sent.values
            )
        line = sent.encode()
        if self.active("silent", message):
            line = b""
        if self.active("duplicate", message):
            line += line
        if self.active("truncate", message):
            line = line[: int(self.rng.integers(len(line) + 1))]
        if self.active("reorder", message):
            self.held.append(line)
            return
        line += b"".join(self.held)
        self.held = []
        if self.active("repeat", message):
            self.held.append(line)
        delay = max(
            (attack.seconds for attack in self.active("late", message)), default=0.0
        )
        if delay or self.late:
            self.late.append((self._clock.monotonic() + delay, line))
        else:
            self._sent += line

    def babble(self):
        """Noise, or messages that nobody asked for."""
        choice = self.rng.integers(4)
        if choice == 0:
            return self.rng.bytes(int(self.rng.integers(1, 200)))
        number = int(self.rng.integers(100_000))
        if choice == 1:
            return Message(
                EVENT, number, "PRESSURE", {"t": "1.0", "kpa": "-5.0"}
            ).encode()
        if choice == 2:
            return Message(REPLY, number, OK, {"state": "done", "step": "17"}).encode()
        return Message(EVENT, number, "HELP").encode()


def attacks_of(seed):
    """One to three attacks."""
    rng = np.random.default_rng([seed, 28])
    return [Attack.drawn(rng) for _ in range(int(rng.integers(1, 4)))]


class Session:
    """A folder of a capture, and sessions of it with devices that misbehave or not."""

    def __init__(self, setup, folder):
        self.setup = setup
        self.folder = folder
        self.out = folder / "C"

    def run(self, attacks=(), seed=0, faults=None):
        """Run once; returns the text of the refusal, with the laboratory and its clock
        as they are then.
        """
        clock = SimulatedClock()
        watched = self.folder / "watched"
        laboratory = Laboratory(self.setup, watched, faults, clock=clock)
        rng = np.random.default_rng(seed)
        ports = {}
        for name in ("dome", "probe"):
            own = [attack for attack in attacks if attack.device == name]
            ports[name] = AttackedPort(getattr(laboratory, name), clock, own, rng)
        refusal = ""
        try:
            dome = Dome(Link(ports["dome"], "dome", clock=clock))
            probe = Probe(Link(ports["probe"], "probe", clock=clock))
            cameras = FolderCameras(laboratory.watched, CAMERAS, clock=clock)
            devices = Devices(
                dome,
                cameras,
                probe,
                FolderCameras(laboratory.watched, ["probe"], clock=clock),
            )
            run_capture(
                self.out,
                read_setup(self.setup),
                PERSON,
                devices,
                PLAN,
                files={"mesh": self.setup / "scan.ply"},
                override=OVERRIDE,
                place=lambda site, _: laboratory.place(site),
            )
        except InputError as error:
            refusal = str(error) or "nothing"
        return refusal, laboratory, clock

    def kept(self):
        """Everything that the folder holds of the subject: frames, steps and placements."""
        files = {
            path.relative_to(self.out): path.read_bytes()
            for path in self.out.glob("*/*/**/*")
            if path.is_file()
        }
        note = self.out / "unfinished.json"
        if note.is_file():
            record = json.loads(note.read_text())
            return (
                files,
                record["sequence"],
                {
                    (one["site"], one["number"]): one["pressure"]
                    for one in record["sites"]
                },
            )
        if not (self.out / "capture.json").is_file():
            return files, [], {}
        sequence = json.loads((self.out / "dome/dome.json").read_text())["sequence"]
        logs = json.loads((self.out / "contact/probe.json").read_text())["pressure"]
        return (
            files,
            sequence,
            {
                (site, int(number)): log
                for site, by in logs.items()
                for number, log in by.items()
            },
        )


def frame_faults(seed):
    """Frames that are lost, repeated and late, and a line with noise or that is lost."""
    rng = np.random.default_rng([seed, 35])
    count = int(rng.integers(0, 4))
    dropped, repeated = (
        tuple((str(rng.choice(CAMERAS)), int(rng.integers(65))) for _ in range(count))
        for _ in range(2)
    )
    line = {"garbage": 0.3, "delay": 0.05, "vanish_after": int(rng.integers(72, 180))}
    kind = str(rng.choice([*line, "none"]))
    dome = DeviceFaults(**({kind: line[kind]} if kind in line else {}), seed=seed)
    late = float(rng.choice([0.0, 0.5, 12.0]))
    return LaboratoryFaults(
        dome, dropped_frames=dropped, repeated_frames=repeated, late_seconds=late
    )


def violations(setup, folder, seed, *, faults=None):
    """Run a case; returns the outcome, and what must not be."""
    session = Session(setup, folder)
    attacks = [] if faults else attacks_of(seed)
    refusal, laboratory, clock = session.run(attacks, seed, faults)
    wrong = []
    if laboratory.dome.on is not None or laboratory.dome.state == "running":
        wrong.append("a light is on")
    if laboratory.probe.led or laboratory.probe.target:
        wrong.append("the suction is not released")
    if clock.monotonic() > MAX_SECONDS:
        wrong.append(f"it took {clock.monotonic():.0f} s")
    if refusal and len(attacks) == 1:
        [attack] = attacks
        expected = (
            NAMED_VALUES[attack.name]
            if attack.kind == "value"
            else NAMED_FAULTS.get(attack.kind, "")
        )
        if not re.search(expected, refusal):
            wrong.append(f"the message does not name the fault: {refusal}")
    named = re.compile(r"(dome|probe|capture|camera|light|dark frame)\b.*: .*; found .")
    unnamed = [
        line for line in refusal.split("\n") if refusal and not named.match(line)
    ]
    wrong += [f"the message names nothing: {line}" for line in unnamed]
    before = session.kept() if session.out.exists() else ({}, [], {})
    wrong += wrong_content(*before)
    if refusal:
        again, _, _ = session.run()
        if again:
            wrong.append(f"sound devices do not complete it: {again}")
    after = session.kept()
    wrong += wrong_content(*after)
    wrong += lost_content(before, after)
    steps = json.loads((setup / "dome/dome.json").read_text())["lights"]
    if len(after[1]) != len(steps) * len(EXPOSURES) or [*after[2]] != [("cheek", 1)]:
        wrong.append("the capture is not complete")
    return ("refused" if refusal else "complete"), wrong, refusal


def wrong_content(files, sequence, logs):
    """Frames and readings that must not have been accepted."""
    wrong = []
    for entry in sequence:
        for camera in CAMERAS:
            path = Path(
                f"dome/frames/{entry['exposure']}/{entry['light']}_{camera}.png"
            )
            value = value_of(entry["light"], camera, entry["exposure"])
            if path not in files or not is_frame(
                imagecodecs.png_decode(files[path]), value
            ):
                wrong.append(f"{path} is not the frame of its step")
        times = (entry["t_on"], entry["t_off"])
        if (
            not np.isfinite(times).all()
            or entry["trigger_count"] != 1
            or not 0 <= times[0] <= times[1]
        ):
            wrong.append(f"a step has wrong measurements: {entry}")
    for (site, number), log in logs.items():
        readings = np.array(log)
        if (
            not len(readings)
            or not np.isfinite(readings).all()
            or (np.abs(readings[:, 1] + 5) > 1).any()
        ):
            wrong.append(f"readings of {site} {number} are wrong")
        elif (
            np.diff(readings[:, 0]).max() > 0.65
            or np.ptp(readings[:, 0]) < sum(LONG_BRACKETS.values()) - 1.1
        ):
            wrong.append(f"readings of {site} {number} do not cover the exposures")
        for i, bracket in enumerate(BRACKETS):
            path = Path(f"contact/{site}/{bracket}-{number}.png")
            if not (imagecodecs.png_decode(files[path]) == 1000 * (1 + i)).all():
                wrong.append(f"{path} is not the frame of its exposure")
    return wrong


def lost_content(before, after):
    """What was kept by the session with misbehaving devices, and is not there any more."""
    lost = [
        f"{path} was lost"
        for path, content in before[0].items()
        if after[0].get(path) != content
    ]
    lost += [
        f"a step was lost: {entry}" for entry in before[1] if entry not in after[1]
    ]
    return lost + [
        f"placement {key} was lost"
        for key, log in before[2].items()
        if after[2].get(key) != log
    ]


def attacked_setup(folder, lights=ATTACKED_LIGHTS):
    """The laboratory of all cases."""
    subject_folder(folder)
    path = folder / "dome/dome.json"
    record = json.loads(path.read_text())
    record["lights"] = [light for light in record["lights"] if light["id"] in lights]
    path.write_text(json.dumps(record))
    path = folder / "contact/probe.json"
    record = json.loads(path.read_text()) | {
        "exposures": [{"id": k, "seconds": v} for k, v in LONG_BRACKETS.items()]
    }
    path.write_text(json.dumps(record))
    trimesh.creation.icosphere(subdivisions=1).export(folder / "scan.ply")
    return folder


def main():
    """Run the cases of the command line; the status is 1 if any has a violation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the first case; each has the next one",
    )
    parser.add_argument(
        "--frames", action="store_true", help="attack the frames of the cameras"
    )
    parser.add_argument(
        "--list", action="store_true", help="print attacks and message of every case"
    )
    options = parser.parse_args()
    outcomes = Counter()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        lights = LIGHTS if options.frames else ATTACKED_LIGHTS
        setup = attacked_setup(Path(folder) / "lab", lights)
        for seed in range(options.seed, options.seed + options.cases):
            case = Path(folder) / "case"
            faults = frame_faults(seed) if options.frames else None
            outcome, wrong, refusal = violations(setup, case, seed, faults=faults)
            shutil.rmtree(case)
            outcomes[outcome] += 1
            failed += bool(wrong)
            if wrong or options.list:
                print(
                    seed,
                    outcome,
                    *([faults] if faults else attacks_of(seed)),
                    refusal,
                    *wrong,
                    sep="\n  ",
                    flush=True,
                )
    print(
        ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items()),
        f"; {failed} with a violation",
        sep="",
    )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
