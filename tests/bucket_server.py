"""Real S3 servers on 127.0.0.1, each in its own process, and buckets on them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from skindb.files import cache_folder

# the servers accept any
KEY = "planted-key"
SECRET = "planted-secret"
START_S = 30.0
COMMANDS = {
    "moto": ["-m", "moto.server", "-H", "127.0.0.1", "-p"],
    # its conditional put is a hard link and therefore atomic; moto checks first and then writes
    "localbucket": [str(Path(__file__).with_name("serve_bucket.py")), "--port"],
}


@contextmanager
def s3_server(kind: str) -> Iterator[str]:
    """Context with the address of a server."""
    port = free_port()
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            *COMMANDS[kind],
            str(port),
            *([folder] if kind == "localbucket" else []),
        ]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as server:
            try:
                wait_for(port, server)
                yield f"http://127.0.0.1:{port}"
            finally:
                server.kill()


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def wait_for(port: int, server: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end and server.poll() is None:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
            return
        time.sleep(0.02)
    raise RuntimeError("the server did not start")


def settings(address: str) -> dict[str, str]:
    """Environment variables of a client of the server, without any settings of the user."""
    return {
        "AWS_ENDPOINT_URL": address,
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        "AWS_DISABLE_BULK_DELETE": "true",  # localbucket deletes objects one by one
    }


def new_bucket(address: str) -> str:
    """Create a bucket, and return its name."""
    bucket = f"faces-{uuid.uuid4().hex[:12]}"
    request = urllib.request.Request(f"{address}/{bucket}", method="PUT", data=b"")
    with urllib.request.urlopen(request) as answer:
        assert answer.status == 200
    return bucket


def own_cache(folder: Path) -> Path:
    """A new cache without the scratch of other databases, with links to the tables that
    take seconds to compute.
    """
    folder.mkdir(mode=0o700)
    if known := cache_folder():
        for place in known.glob("*-*"):
            (folder / place.name).symlink_to(place)
    return folder
