"""Where the takes of a command are processed: in this process, in local processes, or
on a Dask cluster.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click
from click.core import ParameterSource

import skindb
from skindb.cli.options import asked
from skindb.cli.progress import Progress

if TYPE_CHECKING:
    from distributed import Client

P = TypeVar("P", Path, Path | None)


def _refuse_both(
    ctx: click.Context, _: click.Parameter, scheduler: str | None
) -> str | None:
    if (
        scheduler is not None
        and ctx.get_parameter_source("workers") is ParameterSource.COMMANDLINE
    ):
        raise click.UsageError(
            "--workers starts local processes and --scheduler uses a cluster; give only one of them"
        )
    return scheduler


SCHEDULER = click.option(
    "--scheduler",
    metavar="ADDRESS",
    callback=_refuse_both,
    help=(
        "Dask scheduler whose workers process the takes: tcp://HOST:PORT, or the .json "
        "file that it wrote."
    ),
)


@contextmanager
def client_of(scheduler: str | None, progress: Progress) -> Iterator[Client | None]:
    """Client of the named scheduler, whose dashboard is reported; None if no scheduler
    was named.
    """
    if scheduler is None:
        yield None
        return
    if not asked("verbose"):
        logging.disable(
            logging.ERROR
            # messages of distributed; their consequence for the takes is reported in one
            # line
        )
    with skindb.workflow.connected(scheduler) as client:
        if link := skindb.workflow.dashboard_link(client):
            progress.dashboard(link)
        yield client


def shared_path(path: P, scheduler: str | None) -> P:
    """A path that is valid for workers of a cluster, whose working folders differ from
    that of this process.
    """
    return path if scheduler is None or path is None else path.absolute()
