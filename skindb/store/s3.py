"""Connection to an S3 bucket: address, credentials, time limits and readable error messages."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from skindb.errors import Fault, UnavailableError, input_error, require

if TYPE_CHECKING:
    from obstore.store import BackoffConfig, S3Store

BUCKET = r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]"
# characters that are not escaped in requests and their signatures
PREFIX_PART = r"[A-Za-z0-9._=-]{1,255}"
CONNECT_TIMEOUT = timedelta(seconds=5)
# the largest object is a shard of 16 MB, which takes this long at 1 Mbit/s
REQUEST_TIMEOUT = timedelta(seconds=120)
# two requests that time out and a third one; a signature expires after 300 s
RETRY_TIMEOUT = timedelta(seconds=290)
# half a minute with the pauses below, for servers that restart or limit the rate of
# requests
MAX_RETRIES = 10
FIRST_PAUSE = timedelta(seconds=0.1)
LONGEST_PAUSE = timedelta(seconds=10)
PAUSE_GROWTH = 2
ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
# environment variables for credentials; another source is the metadata service of AWS
# machines
SOURCES = (
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_METADATA_ENDPOINT",
    "AWS_SKIP_SIGNATURE",
)
VENDOR = Path("/sys/class/dmi/id/sys_vendor")
_OBSTORE_PROCESS: list[int] = []  # id of the process that owns the threads of obstore
CURE_PERMISSION = "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and their permissions"
CURE_NO_KEYS = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
CURE_NETWORK = "check AWS_ENDPOINT_URL and the network, then run the command again"


def bucket_and_prefix(url: str) -> tuple[str, str]:
    """Bucket and prefix of a URL "s3://bucket/prefix"; the prefix may be empty.

    Raises
    ------
    InputError
        If the URL has a different form, or contains credentials, which the message does not repeat.
    """
    rest = url.removeprefix("s3://").rstrip("/")
    require(
        "@" not in rest and "?" not in rest,
        "s3://...",
        "the URL of a database must not contain credentials or options",
        "some",
        CURE_NO_KEYS,
    )
    bucket, _, prefix = rest.partition("/")
    parts = prefix.split("/") if prefix else []
    usable = all(
        re.fullmatch(PREFIX_PART, part) and part not in (".", "..") for part in parts
    )
    require(
        usable and re.fullmatch(BUCKET, bucket),
        url,
        "must be s3://BUCKET/PREFIX of lower-case letters, digits, '.', '-'; "
        "PREFIX also of capitals, '_', '='",
        "a different form",
        "choose another name",
    )
    return bucket, prefix


def connect(bucket: str, prefix: str) -> S3Store:
    """Store of a bucket below a prefix, without sending a request.

    Address and credentials are taken from the environment.

    Raises
    ------
    InputError
        If the extra "s3" is not installed, or if settings are missing or invalid.
    """
    try:
        from obstore.exceptions import BaseError
        from obstore.store import S3Store
    except ImportError:
        raise input_error(
            f"s3://{bucket}",
            "a database in a bucket needs obstore",
            "it is not installed",
            "pip install 'skindb[s3]'",
        ) from None
    # without the metadata service of AWS the request times out after a minute
    require(
        set(SOURCES) & os.environ.keys() or _is_on_aws(),
        f"s3://{bucket}",
        "credentials must be set",
        "none",
        CURE_NO_KEYS,
    )
    pauses: BackoffConfig = {
        "init_backoff": FIRST_PAUSE,
        "max_backoff": LONGEST_PAUSE,
        "base": PAUSE_GROWTH,
    }
    try:
        return S3Store(
            bucket,
            prefix=prefix or None,
            client_options={
                "timeout": REQUEST_TIMEOUT,
                "connect_timeout": CONNECT_TIMEOUT,
                "allow_http": True,
            },
            retry_config={
                "max_retries": MAX_RETRIES,
                "retry_timeout": RETRY_TIMEOUT,
                "backoff": pauses,
            },
            endpoint=endpoint() or None,
        )
    except (BaseError, ValueError, TypeError):
        # the text of the error may contain secret values of variables
        rule = "the AWS_ variables must have valid values"
        raise input_error(
            f"s3://{bucket}", rule, "an invalid value", "correct them"
        ) from None


def endpoint() -> str:
    """Address of the server; empty for AWS.

    Raises
    ------
    InputError
        If it is not a valid URL, or if data of subjects would be sent unencrypted over a network.
    """
    address = next((os.environ[name] for name in ENDPOINTS if os.environ.get(name)), "")
    if not address:
        return ""
    parts = urlsplit(address)
    host = parts.hostname or ""
    require(
        host and re.fullmatch(r"https?://[^@/?#]+/?", address),
        "AWS_ENDPOINT_URL",
        "must be http(s)://HOST:PORT without credentials",
        "a different URL",
        "correct it",
    )
    loopback = host in ("localhost", "::1") or host.startswith("127.")
    if (
        parts.scheme == "http"
        and not loopback
        and os.environ.get("AWS_ALLOW_HTTP", "").lower() not in ("1", "true")
    ):
        raise input_error(
            "AWS_ENDPOINT_URL",
            "data of subjects must be encrypted when they are sent over a network",
            f"http to {host}",
            "use https, or set AWS_ALLOW_HTTP=true in a private network",
        )
    return address.rstrip("/")


class BrokenAnswerError(UnavailableError):
    """A request got no answer or an incomplete one, and obstore did not use all its retries."""


class DeniedError(UnavailableError):
    """The server refused a request, which was not executed."""


@contextmanager
def readable_errors(location: str) -> Iterator[None]:
    """Convert errors of obstore to those that `Place` documents, without details of the
    request except its key.

    `AlreadyExistsError` is not converted, because it is a valid answer.
    """
    from obstore.exceptions import AlreadyExistsError, BaseError

    if not _OBSTORE_PROCESS:
        _OBSTORE_PROCESS.append(os.getpid())
    require(
        _OBSTORE_PROCESS[0] == os.getpid(),
        location,
        "a process that uses a bucket must not be forked from another one that does",
        "a forked process",
        "use the workers of skindb, loky or Dask, or the start method spawn",
    )
    try:
        yield
    except AlreadyExistsError:
        raise
    except FileNotFoundError as error:
        if "NoSuchBucket" in str(error):
            raise _unavailable(location, str(error)) from None
        raise FileNotFoundError(2, "no such object", location) from None
    except BaseError as error:
        if "416 Range" in str(error):
            raise OSError(22, "fewer bytes than were requested", location) from None
        raise _unavailable(location, str(error)) from None


def _unavailable(location: str, text: str) -> UnavailableError:
    """Error with the reason from the text of an obstore error, without the request that
    the text repeats.
    """
    status = re.search(r"status code: (\d{3})([A-Za-z ]*)", text)
    code, phrase = (
        (int(status[1]), f"{status[1]}{status[2].rstrip()}") if status else (0, "")
    )
    if "NoSuchBucket" in text:
        return _fault(
            location,
            "the bucket must exist",
            "no bucket of this name",
            "create it, or correct its name",
        )
    if "/latest/" in text and not code:  # the metadata service of a virtual machine
        return _fault(location, "credentials must be set", "none", CURE_NO_KEYS)
    if code in (401, 403) or "AccessDenied" in text:
        rule = "the credentials must permit this request"
        return DeniedError(
            Fault(location, rule, phrase or "access denied", CURE_PERMISSION)
        )
    if 300 <= code < 400:
        return _fault(
            location,
            "the request must be sent to the region of the bucket",
            phrase,
            "set AWS_REGION",
        )
    reason = phrase or ("a time-out" if "kind: Timeout" in text else "no connection")
    retries = re.search(r"after (\d+) retries", text)
    finding = f"{reason} from {endpoint() or 'AWS'}" + (
        f", after {retries[1]} retries" if retries else ""
    )
    given_up = code or (retries and int(retries[1]) >= MAX_RETRIES)
    kind = UnavailableError if given_up else BrokenAnswerError
    return kind(Fault(location, "the server must answer", finding, CURE_NETWORK))


def _fault(location: str, rule: str, finding: str, cure: str) -> UnavailableError:
    return UnavailableError(Fault(location, rule, finding, cure))


def _is_on_aws() -> bool:
    try:
        return VENDOR.read_text(encoding="utf-8").startswith("Amazon")
    except (OSError, UnicodeDecodeError):
        return False
