"""Damage to one file of a capture folder, chosen by a random generator; each function
returns a description.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import tempfile
import zlib
from pathlib import Path

import imagecodecs
import numpy as np

JSON_TEXTS = {  # values that json.dumps does not write, or not without recursion
    "1e999": "1e999",
    "deep": "[" * 5_000 + "]" * 5_000,
    "rather deep": "[" * 40 + "]" * 40,
    "digits": "9" * 5_000,
}
VALUES = (
    float("nan"),
    float("inf"),
    -float("inf"),
    1e300,
    -1e300,
    1e30,
    1e-300,
    1e9,
    -1e9,
    0,
    -1,
    0.5,
    10**400,
    2**63,
    None,
    True,
    False,
    "1.0",
    "\uff11",
    "\u202e\u0301",
    "é" * 70,
    "",
    "x",
    "\ud800",
    "\x1b[31m",
    "a\0b",
    "a" * 100_000,
    "../x",
    "/etc/passwd",
    "{light}",
    [],
    {},
    [[]],
    [None],
    {"a": {"b": [1]}},
    [1] * 30_000,
    {str(i): i for i in range(20_000)},
    *JSON_TEXTS,
)
SUBSTITUTES = (
    "nothing",
    "pipe",
    "folder",
    "zeros",
    "loop",
    "outside",
    "socket",
    "sparse",
    "secret",
)
TOKENS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "9" * 25,
    "x",
    "1_0",
    "\x00",
    "",
    "-",
    "1e5",
    "4294967296",
    "a" * 5_000,
)


def damage(folder: Path, rng: np.random.Generator) -> str:
    """Damage one file of the folder; returns what was done to which."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    kinds = sorted({_kind(path) for path in files})
    kind = kinds[rng.integers(len(kinds))]  # otherwise nearly all would be frames
    of_kind = [path for path in files if _kind(path) == kind]
    path = of_kind[rng.integers(len(of_kind))]
    choices = [flip, flip, truncate, zero, extend, replace_by, replace_by, swap]
    if path.suffix == ".json":
        choices += [json_value] * 16
    if path.suffix in (".obj", ".csv") or (
        path.suffix == ".ply" and b"ascii" in path.read_bytes()[:40]
    ):
        choices += [token] * 8
    if path.suffix in (".png", ".tif"):
        choices += [picture] * 4
    if path.suffix == ".png":
        choices += [promise] * 2
    done = choices[rng.integers(len(choices))](path, rng)
    return f"{path.relative_to(folder)}: {done}"


def _kind(path: Path) -> str:
    return (
        path.name
        if path.suffix in (".json", ".csv", ".ply", ".obj")
        else f"{path.parts[-3]}{path.suffix}"
    )


def flip(path: Path, rng: np.random.Generator) -> str:
    content = bytearray(path.read_bytes())
    count = int(rng.choice([1, 1, 10]))
    places = rng.integers(
        0, min(len(content), int(rng.choice([200, len(content)]))), count
    )
    for at in places:
        content[at] ^= int(rng.integers(1, 256))
    path.write_bytes(content)
    return f"bytes {sorted(int(at) for at in places)} changed"


def truncate(path: Path, rng: np.random.Generator) -> str:
    content = path.read_bytes()
    size = int(rng.choice([0, 1, len(content) - 1, rng.integers(len(content))]))
    path.write_bytes(content[:size])
    return f"cut to {size} of {len(content)} bytes"


def zero(path: Path, rng: np.random.Generator) -> str:
    content = bytearray(path.read_bytes())
    at = int(rng.integers(len(content)))
    count = min(int(rng.choice([4, 64, 4_096])), len(content) - at)
    content[at : at + count] = bytes(count)
    path.write_bytes(content)
    return f"{count} bytes from {at} set to zero"


def extend(path: Path, rng: np.random.Generator) -> str:
    count = int(rng.choice([1, 100, 100_000]))
    with path.open("ab") as stream:
        stream.write(rng.bytes(count) if rng.random() < 0.5 else bytes(count))
    return f"{count} bytes added"


def replace_by(path: Path, rng: np.random.Generator) -> str:
    what = str(rng.choice(SUBSTITUTES))
    path.unlink()
    put(what, path)
    return f"replaced by {what}"


def put(what: str, path: Path) -> None:
    """Put something that is not a regular file, or nothing, at a free path."""
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "zeros":
        path.symlink_to("/dev/zero")
    elif what == "loop":
        path.symlink_to(path.name)
    elif what == "outside":
        path.symlink_to("/etc/hostname")
    elif what == "socket":
        with (
            tempfile.TemporaryDirectory(dir="/tmp") as short,
            socket.socket(socket.AF_UNIX) as one,
        ):
            one.bind(f"{short}/socket")  # their names are limited to 107 bytes
            shutil.move(f"{short}/socket", path)
    elif what == "sparse":
        path.touch()
        os.truncate(path, 1 << 36)
    elif what == "secret":
        path.symlink_to("/proc/self/mem")


def swap(path: Path, rng: np.random.Generator) -> str:
    """Exchange the file with another one of the same suffix in the same capture."""
    root = next(p for p in path.parents if (p / "capture.json").exists())
    others = sorted(p for p in root.rglob(f"*{path.suffix}") if p != path)
    if not others:
        return "nothing (no other file)"
    other = others[rng.integers(len(others))]
    mine = path.read_bytes()
    theirs = other.read_bytes()
    path.write_bytes(theirs)
    other.write_bytes(mine)
    return f"exchanged with {other.relative_to(root)}"


def picture(path: Path, rng: np.random.Generator) -> str:
    from skindb.format.frames import read_frame, write_frame

    frame = read_frame(path)
    what = str(
        rng.choice(
            [
                "half",
                "grey",
                "alpha",
                "8 bit",
                "turned",
                "mirrored",
                "brighter",
                "black",
                "white",
            ]
        )
    )
    changed = {
        "half": frame[::2, ::2],
        "grey": frame[..., 0],
        "alpha": np.concatenate([frame, frame[..., :1]], axis=-1),
        "8 bit": (frame // 256).astype(np.uint8),
        "turned": frame.swapaxes(0, 1),
        "mirrored": frame[:, ::-1],
        "brighter": np.minimum(frame.astype(np.float64) * 1.5, 65535).astype(
            frame.dtype
        ),
        "black": frame * 0,
        "white": frame * 0 + 65535,
    }[what]
    if path.suffix == ".png":
        path.write_bytes(imagecodecs.png_encode(np.ascontiguousarray(changed)))
    elif changed.ndim == 3 and changed.shape[2] == 3:
        write_frame(path, np.ascontiguousarray(changed))
    return f"picture {what}"


def promise(path: Path, rng: np.random.Generator) -> str:
    """Write another size into the header, with a valid checksum."""
    content = bytearray(path.read_bytes())
    sides = [0, 1, 72, 14_000, 60_000, 2**31 - 1]
    width, height = (int(rng.choice(sides)) for _ in range(2))
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
    return f"promises {width} x {height}"


def token(path: Path, rng: np.random.Generator) -> str:
    """A word of a text file replaced, or a line doubled, removed or joined."""
    lines = path.read_text().split("\n")
    at = int(rng.integers(min(len(lines), int(rng.choice([12, len(lines)])))))
    what = int(rng.integers(5))
    if what == 0:
        lines.insert(at, lines[at])
    elif what == 1:
        lines.pop(at)
    elif what == 2 and at:
        lines[at - 1 : at + 1] = [lines[at - 1] + " " + lines[at]]
    else:
        mark = "," if path.suffix == ".csv" else " "
        words = lines[at].split(mark)
        new = TOKENS[rng.integers(len(TOKENS))]
        words[rng.integers(len(words))] = new
        lines[at] = mark.join(words)
        what = f"a word is {new[:30]!r}"
    path.write_text("\n".join(lines))
    return f"line {at}: {what}"


def json_value(path: Path, rng: np.random.Generator) -> str:
    """One value of a JSON file replaced, removed, doubled or changed a little."""
    data = json.loads(path.read_text())
    places = list(_places(data))
    if not places:
        return "nothing (no value)"
    parent, key = places[rng.integers(len(places))]
    what = int(rng.integers(6))
    marks: dict[str, str] = {}
    if what == 0:
        del parent[key]
        said = "removed"
    elif what == 1 and isinstance(parent, dict):
        parent["@twice@"] = parent[key]
        marks['"@twice@"'] = json.dumps(key)
        said = "given twice"
    elif what == 2 and is_number(parent[key]):
        factor = float(rng.choice([-1, 1.001, 1.1, 10, 1000, 0.001, 0.1]))
        parent[key] = parent[key] * factor
        said = f"times {factor}"
    elif what == 3 and isinstance(parent, list):
        parent.extend([parent[key]] * int(rng.choice([1, 30_000])))
        said = f"repeated, {len(parent)} in all"
    else:
        value = VALUES[rng.integers(len(VALUES))]
        parent[key] = value
        marks = (
            {json.dumps(value): JSON_TEXTS[value]}
            if isinstance(value, str) and value in JSON_TEXTS
            else {}
        )
        said = f"is {str(value)[:30]!r}"
    text = json.dumps(data)
    for mark, put in marks.items():
        text = text.replace(mark, put)
    path.write_text(text)
    return f"{key!s:.30} {said}"


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _places(value: object):
    """Every (container, key) of a JSON value; of long lists only the first three."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield value, key
            yield from _places(item)
    elif isinstance(value, list):
        for i, item in enumerate(value[:3]):
            yield value, i
            yield from _places(item)
