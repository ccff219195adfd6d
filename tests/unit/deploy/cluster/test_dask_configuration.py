"""Certificates of Dask's configuration that cannot be used: which, and why."""

from __future__ import annotations

import os
import re
from pathlib import Path

import dask
import pytest

from handfast.deploy.cluster.connection import ClusterError
from handfast.deploy.cluster.dask_configuration import configured_security
from handfast.deploy.cluster.on_hosts import credentials

TLS = "distributed.comm.tls"
KEY, CERTIFICATE = credentials()
OTHER_KEY, _ = credentials()
LOCKED = "-----BEGIN ENCRYPTED PRIVATE KEY-----\nMIIF\n-----END ENCRYPTED PRIVATE KEY-----\n"
GARBAGE = "-----BEGIN CERTIFICATE-----\nnothing\n-----END CERTIFICATE-----\n"


@pytest.fixture
def files(tmp_path: Path) -> Path:
    texts = {"ca": CERTIFICATE, "cert": CERTIFICATE, "key": KEY, "other-key": OTHER_KEY}
    for name, text in (texts | {"text": "hello\n", "garbage": GARBAGE, "locked": LOCKED}).items():
        (tmp_path / f"{name}.pem").write_text(text)
    return tmp_path


def setting(files: Path, **changed: object) -> dask.config.set:
    """Dask's configuration with `ca`, `cert` and `key`; a changed one is the name of a file, or any value."""

    def value(name: str) -> object:
        found = changed.get(name, name)
        return str(files / f"{found}.pem") if isinstance(found, str) and "\n" not in found else found

    return dask.config.set(
        {
            f"{TLS}.ca-file": value("ca"),
            f"{TLS}.client.cert": value("cert"),
            f"{TLS}.client.key": value("key"),
        }
    )


def test_what_is_right_can_be_used(files: Path) -> None:
    for changed in ({}, {"cert": CERTIFICATE, "key": KEY, "ca": CERTIFICATE}):
        with setting(files, **changed):
            assert configured_security().get_connection_args("client")["ssl_context"] is not None


def test_where_nothing_is_configured_there_are_no_certificates() -> None:
    assert configured_security().get_connection_args("client")["ssl_context"] is None


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"ca": "none"}, f"{TLS}.ca-file, FOLDER/none.pem: no such file or directory"),
        ({"cert": "none"}, f"{TLS}.client.cert, FOLDER/none.pem: no such file or directory"),
        ({"key": "none"}, f"{TLS}.client.key, FOLDER/none.pem: no such file or directory"),
        ({"ca": "text"}, f"{TLS}.ca-file, FOLDER/text.pem: there is no certificate in it (PEM)"),
        ({"key": "text"}, f"{TLS}.client.key, FOLDER/text.pem: there is no private key in it (PEM)"),
        (
            {"cert": "key", "key": "cert"},
            f"{TLS}.client.cert, FOLDER/key.pem: there is no certificate in it (PEM)",
        ),
        (
            {"key": "other-key"},
            f"{TLS}.client.key, FOLDER/other-key.pem: it is not the key of the certificate in "
            f"{TLS}.client.cert, FOLDER/cert.pem",
        ),
        (
            {"key": OTHER_KEY},
            f"{TLS}.client.key: it is not the key of the certificate in {TLS}.client.cert, FOLDER/cert.pem",
        ),
        (
            {"key": None},
            f"{TLS}.client.key names no file, and there is no private key in {TLS}.client.cert, "
            "FOLDER/cert.pem",
        ),
        ({"ca": 7}, f"{TLS}.ca-file must be the name of a file, and is 7"),
        (
            {"key": "locked"},
            f"{TLS}.client.key, FOLDER/locked.pem: its private key needs a pass phrase, for which nobody is "
            "asked: give one that needs none (openssl pkey -in OLD -out NEW)",
        ),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_setting_and_its_file(
    changed: dict[str, object], says: str, files: Path
) -> None:
    with setting(files, **changed), pytest.raises(ClusterError) as raised:
        configured_security()
    said = str(raised.value).replace(str(files), "FOLDER")
    assert said == f"the certificates of Dask's configuration cannot be used: {says}"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("ca", r"ca-file, \S+/garbage\.pem: it cannot be read \(\w+: .+\)$"),
        ("cert", r"client\.cert, \S+/garbage\.pem: one cannot be read \(\w+: .+\)$"),
    ],
)
def test_what_only_looks_like_a_certificate_is_named(name: str, says: str, files: Path) -> None:
    with setting(files, **{name: "garbage"}), pytest.raises(ClusterError, match=rf"{re.escape(TLS)}\.{says}"):
        configured_security()


@pytest.mark.parametrize("ciphers", ["rubbish", 7])
def test_ciphers_that_there_are_none_of_are_one_line(ciphers: object, files: Path) -> None:
    with (
        setting(files),
        dask.config.set({f"{TLS}.ciphers": ciphers}),
        pytest.raises(ClusterError, match=rf"{TLS}\.ciphers, .*{ciphers}.*: OpenSSL knows no such ciphers"),
    ):
        configured_security()


def test_a_pipe_is_not_waited_for(files: Path) -> None:
    os.mkfifo(files / "pipe")
    with (
        setting(files),
        dask.config.set({f"{TLS}.client.key": str(files / "pipe")}),
        pytest.raises(ClusterError, match=r"client\.key, .*/pipe: it is a pipe or a device: give a file"),
    ):
        configured_security()


def test_a_setting_that_is_no_file_is_named_by_dask() -> None:
    with (
        dask.config.set({f"{TLS}.min-version": 9}),
        pytest.raises(ClusterError, match=r"min-version=9 is not"),
    ):
        configured_security()
