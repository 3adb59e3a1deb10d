"""The connection to an S3 bucket: its address, credentials and time limits, and failures in words for people."""

from __future__ import annotations

import configparser
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from skindb.errors import Fault, InputError
from skindb.store.place import UnavailableError

if TYPE_CHECKING:
    from obstore.store import BackoffConfig, S3Store

BUCKET = r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]"
PREFIX_PART = r"[A-Za-z0-9._=-]{1,255}"  # every server and the signature of a request spell these alike
CONNECT_TIMEOUT = timedelta(seconds=5)
REQUEST_TIMEOUT = timedelta(seconds=120)  # the largest object is a shard: 16 MB take that long at 1 Mbit/s
RETRY_TIMEOUT = timedelta(seconds=290)  # two requests that time out and a third; a signature expires after 300
MAX_RETRIES = 10  # with the pauses below half a minute: servers that are restarted or ask to slow down
FIRST_PAUSE, LONGEST_PAUSE, PAUSE_GROWTH = timedelta(seconds=0.1), timedelta(seconds=10), 2
ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
KEYS = {"access_key_id": "aws_access_key_id", "secret_access_key": "aws_secret_access_key"}
# where credentials come from, besides a profile and the metadata service of a machine at Amazon
SOURCES = (
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_METADATA_ENDPOINT",
    "AWS_SKIP_SIGNATURE",
)
VENDOR = Path("/sys/class/dmi/id/sys_vendor")
_USED_BY: list[int] = []  # number of the process whose threads serve obstore
CURE_KEYS = "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and what they permit"
CURE_NO_KEYS = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"
CURE_NETWORK = "check AWS_ENDPOINT_URL and the network, then run the command again"


def bucket_and_prefix(url: str) -> tuple[str, str]:
    """Bucket and prefix of "s3://bucket/prefix"; the prefix may be empty.

    Raises
    ------
    InputError
        For another form, and for credentials in the URL, which the message does not repeat.
    """
    rest = url.removeprefix("s3://").rstrip("/")
    if "@" in rest or "?" in rest:
        cure = CURE_NO_KEYS
        raise InputError(Fault("s3://...", "a URL of a database holds no credentials or options", "some", cure))
    bucket, _, prefix = rest.partition("/")
    parts = prefix.split("/") if prefix else []
    usable = all(re.fullmatch(PREFIX_PART, part) and part not in (".", "..") for part in parts)
    if not (usable and re.fullmatch(BUCKET, bucket)):
        rule = "must be s3://BUCKET/PREFIX, of lower case letters, digits, '.' and '-', then also '_', '=' and capitals"
        raise InputError(Fault(url, rule, "another name", "choose another name"))
    return bucket, prefix


def connect(bucket: str, prefix: str) -> S3Store:
    """The bucket, below its prefix; nothing is sent yet.

    Address and credentials are taken from the environment, then from the profile of the AWS command line.

    Raises
    ------
    InputError
        Without the extra "s3", and for settings that cannot be used.
    """
    try:
        from obstore.exceptions import BaseError
        from obstore.store import S3Store
    except ImportError:
        rule, cure = "a database in a bucket needs obstore", "pip install 'skindb[s3]'"
        raise InputError(Fault(f"s3://{bucket}", rule, "it is not installed", cure)) from None
    settings: dict[str, Any] = {"endpoint": endpoint()} if endpoint() else {}
    if not {"AWS_REGION", "AWS_DEFAULT_REGION"} & os.environ.keys() and "region" in _profile():
        settings["region"] = _profile()["region"]
    if not set(SOURCES) & os.environ.keys():
        if set(KEYS.values()) <= _profile().keys():
            settings["credential_provider"] = _profile_credentials
        elif not _is_at_amazon():  # elsewhere the request times out, which takes a minute
            raise InputError(Fault(f"s3://{bucket}", "credentials must be set", "none", CURE_NO_KEYS))
    pauses: BackoffConfig = {"init_backoff": FIRST_PAUSE, "max_backoff": LONGEST_PAUSE, "base": PAUSE_GROWTH}
    try:
        return S3Store(
            bucket,
            prefix=prefix or None,
            client_options={"timeout": REQUEST_TIMEOUT, "connect_timeout": CONNECT_TIMEOUT, "allow_http": True},
            retry_config={"max_retries": MAX_RETRIES, "retry_timeout": RETRY_TIMEOUT, "backoff": pauses},
            **settings,
        )
    except (BaseError, ValueError, TypeError):  # their text may hold what a variable is set to
        rule, cure = "the AWS_ variables must hold usable settings", "correct them"
        raise InputError(Fault(f"s3://{bucket}", rule, "others", cure)) from None


def endpoint() -> str:
    """The address of the server; empty for that of AWS.

    Raises
    ------
    InputError
        If it is no URL, or would send data of people unencrypted over a network.
    """
    found = next((os.environ[name] for name in ENDPOINTS if os.environ.get(name)), _profile().get("endpoint_url", ""))
    if not found:
        return ""
    parts = urlsplit(found)
    host = parts.hostname or ""
    if not re.fullmatch(r"https?://[^@/?#]+/?", found) or not host:
        rule, cure = "must be http(s)://HOST:PORT without credentials", "correct it"
        raise InputError(Fault("AWS_ENDPOINT_URL", rule, "another URL", cure))
    loopback = host in ("localhost", "::1") or host.startswith("127.")
    if parts.scheme == "http" and not loopback and os.environ.get("AWS_ALLOW_HTTP", "").lower() not in ("1", "true"):
        rule = "faces travel over a network encrypted only"
        cure = "use https, or set AWS_ALLOW_HTTP=true where the network is yours alone"
        raise InputError(Fault("AWS_ENDPOINT_URL", rule, f"http to {host}", cure))
    return found.rstrip("/")


class BrokenAnswerError(UnavailableError):
    """No answer, or half of one, to a request that obstore did not repeat until it may no more."""


@contextmanager
def readable_errors(where: str) -> Iterator[None]:
    """Errors of obstore as those that `Place` promises; none holds more of a request than its key.

    `AlreadyExistsError` is left as it is: it is an answer.
    """
    from obstore.exceptions import AlreadyExistsError, BaseError

    _require_own_process(where)
    try:
        yield
    except AlreadyExistsError:
        raise
    except FileNotFoundError as error:
        if "NoSuchBucket" in str(error):
            raise _unavailable(where, str(error)) from None
        raise FileNotFoundError(2, "no such object", where) from None
    except BaseError as error:
        if "416 Range" in str(error):
            raise OSError(22, "fewer bytes than were asked for", where) from None
        raise _unavailable(where, str(error)) from None


def _require_own_process(where: str) -> None:
    """A process that was forked has no threads of obstore and would wait for ever."""
    if not _USED_BY:
        _USED_BY.append(os.getpid())
    elif _USED_BY[0] != os.getpid():
        rule, cure = (
            "processes that use a bucket are started instead of forked",
            "use workers of skindb, loky, Dask or spawn",
        )
        raise InputError(Fault(where, rule, "one that was forked from another that used it", cure))


def _unavailable(where: str, text: str) -> UnavailableError:
    """What the text of an error of obstore says, without the request that it repeats."""
    status = re.search(r"status code: (\d{3})([A-Za-z ]*)", text)
    code, phrase = (int(status[1]), f"{status[1]}{status[2].rstrip()}") if status else (0, "")
    if "NoSuchBucket" in text:
        return _fault(where, "the bucket must exist", "none of this name", "make the bucket, or correct its name")
    if "/latest/" in text and not code:  # the metadata service of a virtual machine
        return _fault(where, "credentials must be set", "none", CURE_NO_KEYS)
    if code in (401, 403) or "AccessDenied" in text:
        return _fault(where, "the credentials must permit this", phrase or "access denied", CURE_KEYS)
    if 300 <= code < 400:
        return _fault(where, "must be asked of the region of the bucket", phrase, "set AWS_REGION")
    reason = phrase or ("a time-out" if "kind: Timeout" in text else "no connection")
    retries = re.search(r"after (\d+) retries", text)
    found = f"{reason} from {endpoint() or 'AWS'}" + (f", after {retries[1]} retries" if retries else "")
    given_up = code or (retries and int(retries[1]) >= MAX_RETRIES)
    kind = UnavailableError if given_up else BrokenAnswerError
    return kind(Fault(where, "the server must answer", found, CURE_NETWORK))


def _fault(where: str, rule: str, found: str, cure: str) -> UnavailableError:
    return UnavailableError(Fault(where, rule, found, cure))


def _profile() -> dict[str, str]:
    """Settings of the profile AWS_PROFILE, by default "default", in the files of the AWS command line."""
    name, home = os.environ.get("AWS_PROFILE", ""), Path.home() / ".aws"
    section = f"profile {name}" if name and name != "default" else "default"
    files = {
        Path(os.environ.get("AWS_CONFIG_FILE") or home / "config"): section,
        Path(os.environ.get("AWS_SHARED_CREDENTIALS_FILE") or home / "credentials"): name or "default",
    }
    found: dict[str, str] = {}
    for path, title in files.items():
        parser = configparser.ConfigParser(interpolation=None, default_section="no defaults")
        try:
            parser.read(path, encoding="utf-8")
        except (configparser.Error, UnicodeDecodeError):  # their text repeats lines of the file
            rule, cure = "must be a file of profiles", "correct it"
            raise InputError(Fault(str(path), rule, "lines that cannot be read", cure)) from None
        found |= dict(parser[title]) if title in parser else {}
    if name and not found:
        raise InputError(Fault("AWS_PROFILE", "must name a profile", repr(name), "correct it, or unset it"))
    return found


def _is_at_amazon() -> bool:
    try:
        return VENDOR.read_text(encoding="utf-8").startswith("Amazon")
    except (OSError, UnicodeDecodeError):
        return False


def _profile_credentials() -> Any:
    profile = _profile()
    keys = {name: profile[key] for name, key in KEYS.items()}
    return keys | {"token": profile.get("aws_session_token"), "expires_at": None}
