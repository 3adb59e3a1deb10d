"""Files: opens only regular files of limited size, creates private folders, writes tables as
comma-separated values, and converts values to JSON.
"""

import csv
import hashlib
import io
import json
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import resources
from io import BufferedReader
from itertools import accumulate
from pathlib import Path
from typing import Any

from skindb.errors import InputError, input_error

Json = dict[str, Any]  # a JSON object
Attributes = Mapping[str, Any]  # by their names; only read
ROOT = Path(__file__).parent
PRIVATE = 0o700  # permissions of folders with personal data
PRIVATE_FILE = 0o600  # and of files
CURE_MISSING = "copy the file into the folder, or correct its name"
CURE_KIND = "replace it with the file itself"
# a JSON string, also an unterminated one; runs without a backslash are matched in one
# step, which is much faster
STRING = re.compile(r'(?s)"[^"\\]*+(?:\\.?[^"\\]*+)*+(?:"|\Z)')
KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_regular(path: Path, max_bytes: int) -> BufferedReader:
    """Open a regular file of at most `max_bytes` for reading.

    Pipes and devices are opened without blocking and closed again without reading.

    Raises
    ------
    InputError
        If the file does not exist, is not a regular file, is too large or is not readable.
    """
    where = str(path)
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except OSError as error:
        raise _not_opened(path, error) from None
    except ValueError as error:  # a zero byte or an unpaired surrogate in the name
        raise input_error(
            where, "the file must exist", str(error), "correct its name"
        ) from None
    try:
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode):
            raise _of_kind(where, status.st_mode)
        if status.st_size > max_bytes:
            raise input_error(
                where,
                f"the file must be at most {_size(max_bytes)}",
                _size(status.st_size),
                "check that it is the right file, or make it smaller",
            )
        # keeps the name, which readers of TIFF use
        return open(path, "rb", opener=lambda *_: number)
    except BaseException:
        os.close(number)
        raise


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Content of a file that `open_regular` opens."""
    with open_regular(path, max_bytes) as stream:
        try:
            # the exact size, so that no more is allocated
            return stream.read(os.fstat(stream.fileno()).st_size)
        except OSError as error:
            raise _not_opened(path, error) from None


def file_digest(path: Path) -> str:
    """SHA-256 of the content of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def json_depth(text: str) -> int:
    """Largest depth of nested brackets, computed before parsing, which needs stack and
    memory in proportion.
    """
    if (count := text.count("[") + text.count("{")) <= 1:
        return count
    brackets = re.sub(r"[^][{}]+", "", STRING.sub("", text))
    return max(accumulate((1 if b in "[{" else -1 for b in brackets), initial=0))


def _not_opened(path: Path, error: OSError) -> InputError:
    where = str(path)
    found = error.strerror or str(error)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        if isinstance(error, FileNotFoundError):
            found = "no such file"
        return input_error(where, "the file must exist", found, CURE_MISSING)
    if not stat.S_ISREG(mode):
        return _of_kind(where, mode)
    return input_error(
        where,
        "the file must be readable",
        found,
        "check its permissions and the disk",
    )


def _of_kind(where: str, mode: int) -> InputError:
    found = next((name for test, name in KINDS if test(mode)), "something else")
    return input_error(where, "must be a regular file", found, CURE_KIND)


def _size(count: int) -> str:
    digits = 1 if count % 1_000_000 else 0
    return f"{count / 1e6:,.{digits}f} MB"


def private_file(path: str | os.PathLike[str]) -> Path:
    """The path of a file, which only its owner can read or write from now on, for a
    function that writes it.

    A file that is missing is created, so that libraries which open it by its name do
    not choose its permissions.
    """
    file = Path(path)
    if file.is_file() or not file.exists():  # no pipe or device, such as /dev/stdout
        number = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, PRIVATE_FILE)
        try:
            os.fchmod(number, PRIVATE_FILE)
        finally:
            os.close(number)
    return file


@contextmanager
def private_umask() -> Iterator[None]:
    """Context in which everything that this process creates is private; for processes
    that skindb owns.
    """
    before = os.umask(~PRIVATE & 0o777)
    try:
        yield
    finally:
        os.umask(before)


def cache_folder() -> Path | None:
    """Folder SKINDB_CACHE, or `skindb` in the user's cache folder; None if SKINDB_CACHE
    is empty, or if the user has no folder.
    """
    named = os.environ.get("SKINDB_CACHE")
    if named is not None:
        return Path(named) if named else None
    try:
        return (
            Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "skindb"
        )
    except RuntimeError:
        return None


def make_private(folder: Path, mode: int = PRIVATE) -> None:
    """Create a folder and its missing parents with these permissions, independent of the umask."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for parent in reversed(missing):
        with suppress(FileExistsError):  # another process created it
            parent.mkdir(mode)
            parent.chmod(mode)


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
# first characters of formulas, also in full width
FORMULA = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV (RFC 4180), in which missing values are empty.

    Text that a spreadsheet would evaluate begins with an apostrophe (OWASP, "CSV Injection").
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer)
    for row in (header, *rows):
        writer.writerow([_cell(value) for value in row])
    return buffer.getvalue()


def _cell(value: Any) -> Any:
    if hasattr(value, "tolist"):
        # its digits do not depend on the print options of NumPy
        value = value.tolist()
    if value is None or value != value:
        return ""
    if not isinstance(value, str) or NUMBER.fullmatch(value):
        return value
    beginnings = {value[:1], value.lstrip()[:1]}
    return f"'{value}" if beginnings & FORMULA else value


def plain(value: Any) -> Any:
    """JSON types only: arrays become lists, unknown numbers (NaN, infinite) null,
    anything else its text.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def package_json(package: str, name: str) -> Any:
    """Content of a JSON file that stands beside the modules of a package."""
    return json.loads((resources.files(package) / name).read_text(encoding="utf-8"))


def filled_template(package: str, name: str, **values: Any) -> str:
    """Text of a Jinja template that stands beside the modules of a package; HTML is escaped."""
    import jinja2  # takes longer to import than most commands run

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, ""),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(name).render(values)


@cache
def package_digest(root: Path = ROOT) -> str:
    """Digest of all source files of skindb, byte by byte: whether two processes run the
    same program.
    """
    digest = hashlib.sha256()
    files = [file for end in ("py", "pyi", "json") for file in root.rglob(f"*.{end}")]
    for file in sorted(files):
        # locks and copies of editors
        if file.name.startswith(".") or not file.is_file():
            continue
        name = file.relative_to(root).as_posix()
        digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
