"""Which program this is, by what its Python files hold: two checkouts of one version may differ.

Standard library only: every worker of a cluster imports it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Final

PACKAGES: Final = tuple(f"handfast/{name}" for name in ("agent", "plant", "bridges", "deploy"))
MODULE: Final = "handfast/__init__.py"


def sources_digest(root: Path, others: Mapping[str, bytes] | None = None) -> str:
    """16 hex digits over the names and contents of our Python files below `root`, and of `others`."""
    found = blake2b(digest_size=8)
    for path in _sources(root):
        _add(found, path.relative_to(root).as_posix(), path.read_bytes())
    for name, data in sorted((others or {}).items()):
        _add(found, name, data)
    return found.hexdigest()


def _add(found: blake2b, name: str, data: bytes) -> None:
    found.update(f"{name}\0{len(data)}\0".encode())
    found.update(data)


def _sources(root: Path) -> Iterator[Path]:
    for package in PACKAGES:
        yield from sorted(path for path in (root / package).rglob("*.py") if path.is_file())
    yield root / MODULE
