"""Virtual captures, several at a time."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from skindb.errors import input_error, require
from skindb.files import make_private, private_file
from skindb.format.fields import read_json
from skindb.parameters import SimulationParameters
from skindb.types import Progress, silent
from skindb.virtual.capture import simulate_takes
from skindb.virtual.person import Person, cohort_people
from skindb.workflow.takes import map_takes, results_of

PAPER_SUBJECTS = 87  # of dataset B
COHORT = "cohort.json"  # what the captures of a folder were made with


def simulate(
    out: str | Path,
    *,
    takes: int = 8,
    cohort: int | None = None,
    conditions: Sequence[str] = (),
    visits: int = 1,
    paper: bool = False,
    workers: int | None = None,
    progress: Progress = silent,
    **options: Any,
) -> list[Path]:
    """Write virtual captures, one folder for each take, with their truth beside them.

    Parameters
    ----------
    out
        Folder of the captures.
    takes
        Number of takes of the demo's people, at most 8.
    cohort
        Number of subjects of a population like that of the paper's table 1, in place of
        the demo's people. Takes that are there already are kept, so that the same call
        continues a run that was interrupted.
    conditions
        Conditions in which every subject of the cohort is photographed too.
    visits
        Visits of every subject of the cohort, see `skindb.virtual.person.cohort_people`.
    paper
        The datasets of the paper: a cohort, of 87 subjects by default, and one more
        subject in seven conditions.
    workers
        Number of takes at a time, each in its own process; default one, in this process.
    progress
        Called with the stage, the number of finished steps and the total number; only
        in this process.
    **options
        Of `skindb.parameters.SimulationParameters`: cameras, lights, width, height,
        subsurface, polarised, bases, seed.

    Returns
    -------
    list of Path
        The folders, in the order of the takes.

    Raises
    ------
    InputError
        If the folder holds a cohort that was made with other options.
    """
    call, numbers = begin_simulation(
        Path(out),
        SimulationParameters(**options),
        takes=takes,
        cohort=cohort,
        conditions=conditions,
        visits=visits,
        paper=paper,
        progress=progress,
    )
    folders = dict(results_of(map_takes(call, numbers, workers=workers)))
    return [folders[number] for number in sorted(folders)]


def begin_simulation(
    out: Path,
    parameters: SimulationParameters,
    *,
    takes: int,
    cohort: int | None,
    progress: Progress,
    **of_cohort: Any,
) -> tuple[Callable[[int], tuple[int, Path]], range]:
    """The function that simulates a take by its number, and the numbers; arguments as of
    `simulate`.
    """
    people = None
    if cohort is not None or of_cohort["paper"]:
        people = _begin_cohort(out, cohort, parameters, **of_cohort)
        takes = len(people)
    call = partial(simulate_one, out, parameters, people=people, progress=progress)
    return call, range(takes)


def _begin_cohort(
    out: Path,
    subjects: int | None,
    parameters: SimulationParameters,
    *,
    conditions: Sequence[str],
    visits: int,
    paper: bool,
) -> list[Person]:
    """The people of a cohort, whose parameters are noted in its folder, or compared
    with those that are noted there.
    """
    # which takes have which noise depends on the conditions
    options = asdict(parameters) | {"conditions": list(conditions)}
    if visits > 1:
        options["visits"] = visits
    if paper:
        options["paper"] = paper
    note = out / COHORT
    if note.is_file():
        read = read_json(note, [])
        stored = read if isinstance(read, dict) else {}
        differ = [
            f"{name} {stored.get(name)}"
            for name in sorted({*stored, *options})
            if stored.get(name) != options.get(name)
        ]
        require(
            not differ,
            str(note),
            "a cohort is continued with the same options",
            ", ".join(differ),
            "give them, or choose another folder",
        )
    elif out.is_dir() and any(out.iterdir()):
        raise input_error(
            str(out),
            "a new cohort needs an absent or empty folder",
            "something there",
            "choose another",
        )
    else:
        make_private(out)
        private_file(note).write_text(json.dumps(options, indent=1), encoding="utf-8")
    return cohort_people(
        subjects or PAPER_SUBJECTS,
        conditions=conditions,
        visits=visits,
        paper=paper,
        seed=parameters.seed,
    )


def simulate_one(
    out: Path,
    parameters: SimulationParameters,
    number: int,
    *,
    people: Sequence[Person] | None = None,
    progress: Progress = silent,
) -> tuple[int, Path]:
    """One of the virtual takes, by its number; see `simulate`."""
    if people is not None:
        folder = out / people[number].take
        if (folder / "capture.json").is_file():  # which is written last
            return number, folder
        if folder.exists():
            shutil.rmtree(folder)  # what a run that was killed had written
    (folder,) = simulate_takes(
        out, parameters, takes=[number], people=people, progress=progress
    )
    return number, folder
