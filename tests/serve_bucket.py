"""localbucket with short waits and with listings that only read the folder they are about.

    python tests/serve_bucket.py --port PORT FOLDER

It answers as localbucket does. Without these changes it reads the whole bucket in each
listing, which took nine tenths of its time, and most requests wait 40 ms for an
acknowledgement of the first half of its answer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import localbucket

Listing = tuple[list[tuple[str, Path]], list[str], bool, str]
list_all = localbucket.S3Handler._list_entries


def list_below(
    handler: Any, bucket: Path, prefix: str, delimiter: str, marker: str, *rest: Any
) -> Listing:
    """Part of a listing after the marker, from the folder that contains all keys with
    the prefix.
    """
    folder, slash, prefix = prefix.rpartition("/")
    top = folder + slash
    is_folder = not {"", ".", ".."} & {*top.split("/")[:-1]}
    if (
        not is_folder
        or delimiter not in ("", "/")
        or (marker and not marker.startswith(top))
    ):
        return list_all(handler, bucket, top + prefix, delimiter, marker, *rest)
    found = list_all(
        handler, bucket / folder, prefix, delimiter, marker.removeprefix(top), *rest
    )
    contents, prefixes, truncated, last = found
    contents = [(top + key, path) for key, path in contents]
    return (
        contents,
        [top + one for one in prefixes],
        truncated,
        last and f"{last[:2]}{top}{last[2:]}",
    )


if __name__ == "__main__":
    localbucket.S3Handler.disable_nagle_algorithm = True
    localbucket.S3Handler._list_entries = list_below
    localbucket.main()
