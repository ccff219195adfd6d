"""Python files of this program and of plugins: a digest that tells programs apart, and copies for others."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import Error
from handfast.agent.fleet.model import Fleet

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


BYTES_MAX: Final = 16_000_000
_COMPILED: Final = (".so", ".pyd", ".dylib")


class PluginFilesError(Error):
    """A plugin cannot be sent; the text is one clear line."""


def plugin_modules(fleet: Fleet) -> tuple[str, ...]:
    """Modules of the plugins that a fleet uses.

    Raises:
        PluginFilesError: one of them is known in this process alone.
    """
    used = plugins_of([fleet])
    for reference in used:
        if ":" not in reference:
            raise PluginFilesError(
                f"{reference}: this class is known in this process alone: robots' computers need it as "
                '"package.module:Class"'
            )
    return tuple(sorted({reference.partition(":")[0] for reference in used}))


def files_of_plugins(references: Iterable[str]) -> tuple[dict[str, bytes], list[PluginFilesError]]:
    """Return the files of these plugins, as of `plugin_files`, and the reasons why a plugin has none.

    Plugins that are known in this process alone are left out.
    """
    files: dict[str, bytes] = {}
    lacking: list[PluginFilesError] = []
    for module in sorted({each.partition(":")[0] for each in references if ":" in each}):
        try:
            files |= dict(plugin_files((module,)))
        except PluginFilesError as error:
            lacking.append(error)
    return files, lacking


def plugin_files(modules: tuple[str, ...]) -> Iterator[tuple[str, bytes]]:
    """Names, as below a folder of Python packages, and bytes of the files that these modules need.

    A module's whole top-level package is sent, without what it was compiled to here.

    Raises:
        PluginFilesError: there is none, it is too large, or part of it is compiled for this machine.
    """
    seen: set[Path] = set()
    total = 0
    for module in modules:
        base, place = _whole(module)
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        for path in files:
            if not path.is_file() or path.suffix == ".pyc" or path in seen:
                continue
            name = path.relative_to(base).as_posix()
            if path.suffix in _COMPILED:
                raise PluginFilesError(
                    f"{module}: {name} is compiled for this machine: only packages of pure Python are sent"
                )
            seen.add(path)
            total += path.stat().st_size
            if total > BYTES_MAX:
                raise PluginFilesError(
                    f"{module}: {place} is larger than {BYTES_MAX // 1_000_000} MB: put the class into a "
                    "package of its own"
                )
            yield name, path.read_bytes()


def plugins_of(fleets: Iterable[Fleet]) -> tuple[str, ...]:
    """Return the plugins that fleets name, as their files give them."""
    found: set[str] = set()
    for fleet in fleets:
        found |= {robot.plant for robot in fleet.robots if robot.kind.is_plugin}
        if fleet.control.law is not None:
            found.add(fleet.control.law)
    return tuple(sorted(found))


def _whole(module: str) -> tuple[Path, Path]:
    """The folder above, and the folder or file of, a module's top-level package.

    Of a namespace that several packages share, the part with the module.
    """
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        spec = importlib.util.find_spec(".".join(parts[:depth]))
        if spec is not None and spec.origin is not None and spec.origin.endswith(".py"):
            file = Path(spec.origin)
            place = file.parent if spec.submodule_search_locations is not None else file
            return place.parents[depth - 1], place
        if spec is None or spec.origin is not None:
            break
    raise PluginFilesError(f"{module}: it is no file of Python: only packages of pure Python are sent")
