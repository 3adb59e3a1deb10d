"""Addresses, credentials and failures of buckets: one line each, without secrets."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from bucket_server import KEY, SECRET
from faulty_proxy import faulty_proxy
from stored import commit

from skindb.errors import InputError, UnavailableError
from skindb.store import Database, s3


@pytest.fixture(autouse=True)
def no_settings(monkeypatch, tmp_path):
    """Remove the settings of the user who runs the tests."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))


@pytest.mark.parametrize(
    "url",
    [
        "s3://bucket/a/b",
        "s3://bucket/a/b/",
        "s3://my.own-bucket/A_b.c=d",
        "s3://bucket",
    ],
)
def test_bucket_and_prefix__of_usable_urls(url):
    bucket, prefix = s3.bucket_and_prefix(url)
    assert f"s3://{bucket}/{prefix}".rstrip("/") == url.rstrip("/")


@pytest.mark.parametrize(
    "url",
    [
        "",
        "/a",
        "B/a",
        "bu",
        "bucket/../a",
        "bucket/a//b",
        "bucket/ä",
        "bucket/a b",
        "bucket/.",
        "bucket/%2e",
        "bu:80/a",
    ],
)
def test_bucket_and_prefix__others_are_refused(url):
    with pytest.raises(InputError, match="must be s3://BUCKET/PREFIX"):
        Database(f"s3://{url}")


@pytest.mark.parametrize(
    "url", [f"s3://{KEY}:{SECRET}@bucket/a", f"s3://bucket/a?secret={SECRET}"]
)
def test_bucket_and_prefix__credentials_are_refused_and_not_repeated(url):
    with pytest.raises(InputError, match="must not contain credentials") as caught:
        Database(url)
    assert SECRET not in str(caught.value)


def test_connect__without_credentials_fails_at_once(monkeypatch, tmp_path):
    monkeypatch.setattr(s3, "VENDOR", tmp_path / "none")
    with pytest.raises(
        InputError, match="credentials must be set; found none; set AWS_ACCESS_KEY_ID"
    ):
        Database("s3://faces/x")


@pytest.mark.parametrize(
    ("address", "rule"),
    [
        (f"http://{KEY}:{SECRET}@127.0.0.1:1", "without credentials"),
        ("127.0.0.1:1", "without credentials"),
        ("ftp://127.0.0.1", "without credentials"),
        ("http://store.example.org", "must be encrypted"),
    ],
)
def test_endpoint__must_be_encrypted_or_on_this_machine(monkeypatch, address, rule):
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    with pytest.raises(InputError, match=rule) as caught:
        s3.endpoint()
    assert SECRET not in str(caught.value)


def test_endpoint__of_one_s_own_network(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://store.example.org:9000/")
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    assert s3.endpoint() == "http://store.example.org:9000"


@pytest.mark.parametrize(
    ("variable", "value"),
    [("AWS_CONDITIONAL_PUT", "maybe"), ("AWS_SKIP_SIGNATURE", SECRET)],
)
def test_connect__unusable_settings(monkeypatch, variable, value):
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", KEY)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    monkeypatch.setenv(variable, value)
    with pytest.raises(InputError, match="must have valid values") as caught:
        Database("s3://faces/x").takes()
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize("kind", ["moto", "localbucket"])
def test_readable_errors__a_bucket_that_is_not_there(new_database, kind):
    new_database(kind)
    db = Database("s3://no-such-bucket/x")
    for call in (
        db.names,
        db.takes,
        lambda: commit(db.url),
        lambda: db.read("capture", "A1"),
        db.verify,
    ):
        with pytest.raises(
            UnavailableError,
            match="the bucket must exist; found no bucket of this name; create it",
        ):
            call()


def test_readable_errors__refused_access(new_database, monkeypatch):
    url = new_database("localbucket")
    with faulty_proxy(
        os.environ["AWS_ENDPOINT_URL"], fraction=1.0, faults=("403",)
    ) as proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.address)
        with pytest.raises(
            UnavailableError,
            match="must permit this request; found 403 Forbidden; check AWS_ACCESS",
        ) as caught:
            Database(url).takes()
        with pytest.raises(UnavailableError, match="must permit this"):
            commit(url)
    assert SECRET not in str(caught.value)
    assert KEY not in str(caught.value)


@pytest.mark.slow
def test_connect__without_obstore_names_what_to_install():
    code = (
        "import sys; sys.modules['obstore'] = sys.modules['obstore.exceptions'] = "
        "None\nimport skindb\nskindb.open('s3://faces/x')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.stderr.strip().endswith("it is not installed; pip install 'skindb[s3]'")
