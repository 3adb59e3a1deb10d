"""How tests change the files of a capture folder."""

from __future__ import annotations

import json
from pathlib import Path

C = "capture.json"
D = "dome/dome.json"
P = "contact/probe.json"


def edit(path: Path, change) -> None:
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def edited(file, change):
    return lambda folder: edit(folder / file, change)


def put(file, *keys, value):
    def change(record):
        for key in keys[:-1]:
            record = record[key]
        record[keys[-1]] = value

    return edited(file, change)


def drop(file, *keys):
    def change(record):
        for key in keys[:-1]:
            record = record[key]
        del record[keys[-1]]

    return edited(file, change)
