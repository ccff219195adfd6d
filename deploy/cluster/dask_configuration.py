"""The certificates that Dask's own configuration names: where they cannot be used, which and why."""

from __future__ import annotations

import ssl
from contextlib import suppress
from pathlib import Path
from typing import Final

import dask
from distributed.security import Security

from handfast.agent.common.wording import printable, show
from handfast.deploy.cluster.connection import ClusterError
from handfast.deploy.cluster.reasons import error_line

_TLS: Final = "distributed.comm.tls."
_CERTIFICATE: Final = ("-----BEGIN CERTIFICATE-----", "certificate")
_KEY: Final = ("PRIVATE KEY-----", "private key")
_FILES: Final = {"ca-file": _CERTIFICATE, "client.cert": _CERTIFICATE, "client.key": _KEY}
"""Settings that name a file: what stands in it, and how that is called."""


def configured_security() -> Security:
    """Security of connections as Dask's configuration has it.

    Raises:
        ClusterError: it cannot be had so; the text names the setting, and its file.
    """
    # OpenSSL would ask for a pass phrase, whoever is there, and hear of no Ctrl-C.
    why = _no_regular_file() or _encrypted_key()
    if not why:
        try:
            security = Security()
            security.get_connection_args("client")
            return security
        except Exception as error:  # of files, of what is in them, or of any other setting
            why = _wrong_file() or _wrong_pair(error) or _wrong_ciphers() or error_line(error)
    raise ClusterError(f"the certificates of Dask's configuration cannot be used: {why}")


def _no_regular_file() -> str:
    """Which setting names a pipe or a device, whose end would be waited for; empty when none does."""
    for name in _FILES:
        value = _setting(name)
        if isinstance(value, str) and "\n" not in value and "\0" not in value:
            path = Path(value)
            if path.exists() and not path.is_file() and not path.is_dir():
                return f"{_TLS}{name}, {printable(value)}: it is a pipe or a device: give a file"
    return ""


def _encrypted_key() -> str:
    """Which setting names a private key that needs a pass phrase; empty when none does."""
    for name in ("client.key", "client.cert"):
        value = _setting(name)
        text = ""
        if isinstance(value, str):
            with suppress(OSError, ValueError):  # that is said later
                text = value if "\n" in value else Path(value).read_text(errors="replace")
        if "ENCRYPTED" in text:
            why = "its private key needs a pass phrase, for which nobody is asked: give one that needs none"
            return f"{_TLS}{name}{_named(name)}: {why} (openssl pkey -in OLD -out NEW)"
    return ""


def _wrong_file() -> str:
    """Which setting names a file that is none, or another one; empty when none does."""
    for name, (marker, what) in _FILES.items():
        value = _setting(name)
        if value is None:
            continue
        if not isinstance(value, str):
            return f"{_TLS}{name} must be the name of a file, and is {show(value)}"
        if "\n" in value:  # what would be in the file
            said, text = f"{_TLS}{name}", value
        else:
            said = f"{_TLS}{name}, {printable(value)}"
            try:
                text = Path(value).read_text(errors="replace")
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or str(error)
                return f"{said}: {reason.lower()}"
        if marker not in text:
            return f"{said}: there is no {what} in it (PEM)"
    return ""


def _wrong_pair(error: Exception) -> str:
    """What of the files, each of which is what it should be, does not fit; empty when that is unknown."""
    if not isinstance(error, ssl.SSLError) or not hasattr(error, "reason"):  # one of no files has none
        return ""
    pair = [f"{_TLS}{name}{_named(name)}" for name in ("client.key", "client.cert")]
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{pair[0]}: it is not the key of the certificate in {pair[1]}"
    if _setting("client.key") is None:
        return f"{_TLS}client.key names no file, and there is no private key in {pair[1]}"
    ca = str(_setting("ca-file"))
    try:
        if "\n" in ca:
            ssl.create_default_context(cadata=ca)
        else:
            ssl.create_default_context(cafile=ca)
    except (OSError, ValueError) as wrong:
        return f"{_TLS}ca-file{_named('ca-file')}: it cannot be read ({error_line(wrong)})"
    return f"{pair[0]}, or {pair[1]}: one cannot be read ({error_line(error)})"


def _wrong_ciphers() -> str:
    """What is wrong with the ciphers; empty when nothing is."""
    ciphers = _setting("ciphers")
    try:
        if ciphers is not None:
            ssl.create_default_context().set_ciphers(ciphers)  # type: ignore[arg-type]
    except (ssl.SSLError, TypeError):
        return f"{_TLS}ciphers, {show(ciphers)}: OpenSSL knows no such ciphers (openssl ciphers lists them)"
    return ""


def _setting(name: str) -> object:
    return dask.config.get(_TLS + name, None)


def _named(name: str) -> str:
    """The file that a setting names, if it does."""
    value = _setting(name)
    return f", {printable(value)}" if isinstance(value, str) and "\n" not in value else ""
