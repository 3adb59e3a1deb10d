"""Work in other processes: in order, and an error ends it in one line."""

from __future__ import annotations

import os
import signal
import time
from functools import partial
from pathlib import Path
from unittest import mock

import pytest

from skindb.errors import Fault, InputError
from skindb.processes import side_by_side

FAULT = Fault("a.exr", "must be readable", "nothing", "write it again")


def _square(x: int, out: Path) -> tuple[int, int]:
    """The first waits for the last: another process must do the others."""
    (out / str(x)).touch()
    while x == 0 and not (out / "3").exists():
        time.sleep(0.01)
    return x * x, os.getpid()


def _fail(out: Path) -> None:
    """The first fails while the second is at work, which would leave a mark."""
    if out.name == "fails":
        raise InputError([FAULT, FAULT])
    time.sleep(3)
    out.touch()


def _killed(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_side_by_side__in_order_and_in_other_processes(tmp_path):
    square = partial(_square, out=tmp_path)
    with mock.patch("os.cpu_count", return_value=2):
        squares, processes = zip(*side_by_side(square, range(4)), strict=True)
    assert squares == (0, 1, 4, 9)
    assert processes[0] not in processes[1:]
    assert os.getpid() not in processes
    with mock.patch("os.cpu_count", return_value=1):
        assert list(side_by_side(square, range(3))) == [(x * x, os.getpid()) for x in range(3)]
    assert list(side_by_side(square, [])) == []


def test_side_by_side__an_error_stops_the_others(tmp_path):
    places = [tmp_path / name for name in ("fails", "goes on", "waits")]
    with mock.patch("os.cpu_count", return_value=2), pytest.raises(InputError, match="must be readable") as error:
        list(side_by_side(_fail, places))
    assert error.value.faults == (FAULT, FAULT)
    assert list(tmp_path.iterdir()) == []


def test_side_by_side__a_killed_process_is_told():
    with mock.patch("os.cpu_count", return_value=2), pytest.raises(InputError, match="a lack of memory") as error:
        list(side_by_side(_killed, range(2)))
    assert len(error.value.faults) == 1
