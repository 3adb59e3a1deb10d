"""All commands from capture to export with a database in a bucket, and their messages
if the bucket is missing.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from bucket_server import KEY, SECRET, free_port, own_cache
from test_cli import _run

import skindb


def _done(*args):
    result = _run(*map(str, args), "--no-progress")
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.slow
def test_cli__all_steps_work_in_a_bucket(new_database, tmp_path, monkeypatch):
    url = new_database("moto")
    monkeypatch.setenv("SKINDB_CACHE", str(own_cache(tmp_path / "cache")))
    size = ("--cameras", 3, "--lights", 12, "--width", 48, "--height", 60)
    _done("simulate", tmp_path / "c", "--takes", 1, *size)
    _done("ingest", url, tmp_path / "c/V001", "--spacing", 8)
    assert not [
        path for path in skindb.open(url).scratch().rglob("*") if path.is_file()
    ]
    assert list(json.loads(_done("fit", url, "--json"))) == ["V001"]
    _done("analyze", url, "translucency")
    _done("release", url, "first")
    _done("analyze", url, "translucency", "--release", "first")
    assert _done("verify", url) == "Every version is intact.\n"
    told = json.loads(_done("info", url, "--json"))
    assert list(
        json.loads(_done("info", url, "--json", "--where", "status_fitted > 0"))[
            "takes"
        ]
    ) == ["V001"]
    assert set(told["takes"]["V001"]) == {"capture", "model"}
    assert told["takes"]["V001"]["model"]["path"].startswith(f"{url}/data/model/V001/")
    _done("export", url, "V001", "--out", tmp_path / "out", "--gltf", "--size", 64)
    assert (tmp_path / "out/V001.glb").is_file()
    _done("consent", url, "V001", "--scope", "fit")
    for command in (
        ("analyze", url, "translucency"),
        ("export", url, "V001", "--out", tmp_path / "again"),
    ):
        refused = _run(*map(str, command), "--no-progress")
        assert refused.returncode == 1
        assert "consent" in refused.stderr
    for take in skindb.open(url).takes():
        for kind in skindb.open(url).kinds(take):
            said = json.dumps(skindb.open(url).record(kind, take).provenance)
            assert SECRET not in said
            assert KEY not in said
    _done("withdraw", url, "V001", "--yes")
    assert skindb.open(url).subjects() == []
    _done("clean", url, "--yes")
    assert _done("verify", url) == "Every version is intact.\n"
    requested = _done("refresh", url, "--dry-run").splitlines()
    # no takes are left to compute them from
    assert all(line.endswith("a subject was withdrawn") for line in requested)


def _one_line(*args):
    result = _run(*args)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert SECRET not in line
    assert KEY not in line
    return line


@pytest.mark.slow
def test_cli__a_database_that_does_not_exist(bucket, monkeypatch):
    assert _one_line("info", bucket).endswith(
        "the database must exist; found nothing; ingest a capture into it first"
    )
    for url, said in {
        "s3://no-such-bucket/x": "the bucket must exist",
        "gs://faces/x": "give a folder, or s3://",
    }.items():
        assert said in _one_line("info", url)
        assert said in _one_line("verify", url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    line = _one_line("info", bucket)
    assert "the server must answer; found no connection from http://127.0.0.1:" in line
    assert line.endswith(
        "check AWS_ENDPOINT_URL and the network, then run the command again"
    )
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setattr("skindb.store.s3.VENDOR", Path(os.devnull))
    assert "credentials must be set; found none" in _one_line("info", bucket)
