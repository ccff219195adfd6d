"""What runs on a cluster's workers import of others is in the extra `cluster`, in what is sent to hosts, and
in what a worker is asked for: a run that lacks a package there, and not here, is another one."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Final

from handfast.agent.fleet.plants import KINDS
from handfast.deploy.cluster.identity import LIBRARIES, NEEDED
from handfast.deploy.console.data_files import WORKER_REQUIREMENTS

ROOT: Final = Path(__file__).parents[2]
ROOTS: Final = (
    "handfast.deploy.cluster.on_worker",
    "handfast.deploy.cluster.worker_process",
    "handfast.deploy.sweep.run",
    "handfast.plant.plugin",
    *(kind.virtual.partition(":")[0] for kind in KINDS.values()),
)
"""Modules that a worker, or the work that is sent to it, begins with; plants are named, not imported."""
ELSEWHERE: Final = {
    "serial": "handfast.bridges.mavlink.transport.serial_channel",  # a real vehicle's line
}
"""What only one of these modules imports, when it does what no run in virtual time does."""
DASK: Final = {"distributed"}
"""What a worker is a part of: there is none without it."""


def imported(source: str) -> set[str]:
    """Everything that a module imports, wherever in it, but for the sake of types."""
    return set(_imported(ast.parse(source)))


def _imported(node: ast.AST) -> Iterator[str]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module is not None:
            yield child.module
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        else:
            yield from _imported(child)


def file_of(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), None)


def reached() -> dict[str, set[str]]:
    """Packages of others that can be imported from `ROOTS` on, with the modules of ours that do."""
    found: dict[str, set[str]] = {}
    seen: set[str] = set()
    left = list(ROOTS)
    while left:
        module = left.pop()
        file = file_of(module)
        if module in seen or file is None:
            continue
        seen.add(module)
        for name in imported(file.read_text(encoding="utf-8")):
            top, *rest = name.split(".")
            if top == "handfast":
                left += [".".join((top, *rest[:count])) for count in range(len(rest) + 1)]
            elif top not in sys.stdlib_module_names:
                found.setdefault(top, set()).add(module)
    return found


def needed() -> set[str]:
    """What a run may import."""
    return {name for name, modules in reached().items() if modules != {ELSEWHERE.get(name)}}


def distribution(name: str) -> str:
    (found,) = set(packages_distributions()[name])
    return found.lower().replace("_", "-")


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~; ]", line)[0] for line in requirements}


def test_a_worker_is_asked_for_what_runs_import() -> None:
    assert needed() == {*LIBRARIES, *NEEDED, *DASK}


def test_the_extra_cluster_brings_what_runs_import() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert "handfast[recorder,security]" in extras["cluster"]
    brought = names([*project["dependencies"], *extras["cluster"], *extras["recorder"], *extras["security"]])
    assert {distribution(name) for name in needed()} <= brought


def test_what_is_sent_to_hosts_has_what_runs_import() -> None:
    locked = re.findall(r"^([a-z0-9-]+)==", WORKER_REQUIREMENTS.read_text(), re.MULTILINE)
    assert {distribution(name) for name in needed()} <= set(locked)


def test_what_is_left_out_is_imported_by_that_module_alone() -> None:
    assert {name: reached()[name] for name in ELSEWHERE} == {
        name: {module} for name, module in ELSEWHERE.items()
    }


def test_imports_are_seen_wherever_they_are_but_for_types() -> None:
    source = "import a.b\ndef f():\n    from c import d\nif TYPE_CHECKING:\n    import e"
    assert imported(source) == {"a.b", "c", "c.d"}
