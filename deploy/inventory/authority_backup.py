"""A backup of the fleet's authority: its key under a passphrase, its certificate, and whom it has signed for.

A file of JSON. Key and certificate are in it as PKCS 12, encrypted by AES-256 with a key that takes
`KDF_ROUNDS` rounds to derive from the passphrase. What is left readable is public.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any, Final

from handfast.agent.security import private_files
from handfast.agent.security.certificates import (
    CertificateError,
    authority_from_pem,
    fingerprint,
    key_from_pem,
    needs_cryptography,
    pem_of,
    pem_of_key,
)
from handfast.agent.security.credentials import authority_of
from handfast.agent.security.private_files import KeyFileError
from handfast.deploy.inventory.certificate_authority import INDEX_BYTES_MAX, INDEX_FILE, AuthorityError
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, short

BACKUP_BYTES_MAX: Final = 2 * INDEX_BYTES_MAX
KDF_ROUNDS: Final = 600_000
_VERSION: Final = 1


def packed(folder: Path, fleet: str, passphrase: str) -> bytes:
    """The backup of the authority in `folder`, which the caller holds (`Authority`).

    Raises:
        AuthorityError: its files cannot be used.
    """
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.serialization import PrivateFormat, pkcs12

    try:
        data = private_files.read(folder / AUTHORITY_FILE, private=True)
        key, certificate = key_from_pem(data), authority_from_pem(data)
        index = folder / INDEX_FILE
        listed = private_files.read(index, most=INDEX_BYTES_MAX) if private_files.exists(index) else b"null"
    except (KeyFileError, CertificateError) as error:
        raise AuthorityError(str(error)) from None
    encryption = (
        PrivateFormat.PKCS12.encryption_builder()
        .kdf_rounds(KDF_ROUNDS)
        .key_cert_algorithm(pkcs12.PBES.PBESv2SHA256AndAES256CBC)
        .hmac_hash(hashes.SHA256())
        .build(passphrase.encode())
    )
    sealed = pkcs12.serialize_key_and_certificates(fleet.encode(), key, certificate, None, encryption)
    table = {
        "handfast_authority": _VERSION,
        "fleet": fleet,
        "authority": fingerprint(certificate),
        "pkcs12": base64.b64encode(sealed).decode("ascii"),
        "index": json.loads(listed),
    }
    return json.dumps(table, indent=1).encode() + b"\n"


def unpack(folder: Path, fleet: str, backup: bytes, passphrase: str) -> str:
    """Brings an authority back into `folder`, where there is none; its fingerprint.

    Raises:
        AuthorityError: it is no backup of this fleet's authority, the passphrase is not its own, or the
            folder has an authority, or certificates of another one.
    """
    from cryptography.hazmat.primitives.serialization import pkcs12

    table = _table(backup, fleet)
    try:
        needs_cryptography()
        if private_files.exists(folder / AUTHORITY_FILE):
            raise AuthorityError(
                f"{folder} has an authority, {short(authority_of(folder))}: nothing to restore"
            )
        known = authority_of(folder)
    except (KeyFileError, CertificateError) as error:
        raise AuthorityError(str(error)) from None
    try:
        key, certificate, _ = pkcs12.load_key_and_certificates(
            base64.b64decode(table["pkcs12"], validate=True), passphrase.encode()
        )
        assert key is not None
        assert certificate is not None
        pem = pem_of_key(key_from_pem(_pem(key))) + pem_of(certificate)
        found = fingerprint(authority_from_pem(pem_of(certificate)))
    except Exception:  # a wrong passphrase and a damaged file look the same, and raise unrelated types
        raise AuthorityError("the passphrase is not that of this backup, or the backup is damaged") from None
    if known and known != found:
        raise AuthorityError(
            f"the backup is of the authority {short(found)}, and {folder} has certificates of another one, "
            f"{short(known)}: it was replaced since the backup was made, or elsewhere"
        )
    try:
        private_files.private_directory(folder)
        if table["index"] is not None:
            listed = json.dumps(table["index"], indent=1).encode() + b"\n"
            private_files.write(folder / INDEX_FILE, listed, private=True)
        private_files.write(folder / AUTHORITY_FILE, pem, private=True)
    except KeyFileError as error:
        raise AuthorityError(str(error)) from None
    return found


def _pem(key: Any) -> bytes:
    from cryptography.hazmat.primitives import serialization

    data: bytes = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return data


def _table(backup: bytes, fleet: str) -> dict[str, Any]:
    try:
        table = json.loads(backup)
        version, whose = table["handfast_authority"], table["fleet"]
        if not isinstance(table["pkcs12"], str) or not isinstance(table["index"], dict | None):
            raise ValueError
    except (ValueError, TypeError, KeyError, RecursionError):
        raise AuthorityError("it is no backup of an authority (`handfast keys --backup`)") from None
    if version != _VERSION:
        raise AuthorityError(f"it is a backup of version {str(version)[:20]!r}, not {_VERSION}")
    if whose != fleet:
        raise AuthorityError(f"it is the backup of the authority of {str(whose)[:60]!r}, not of {fleet}")
    found: dict[str, Any] = table
    return found
