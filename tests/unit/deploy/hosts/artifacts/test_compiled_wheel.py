"""What is compiled as a wheel: for whom it is, and that pip installs it."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from handfast.deploy.hosts.artifacts import bundle, compiled_wheel
from handfast.deploy.hosts.artifacts.bundle import Platform, bundle_for
from handfast.deploy.hosts.artifacts.compiled_wheel import compiled_modules, runs_here, suffix, wheel

HERE = sys.version_info[:2], platform.machine(), platform.libc_ver()
MODULES = {f"0f__mypyc{suffix()}": b"shared", f"agent/core{suffix()}": b"core"}


def test_it_is_for_computers_of_this_machines_kind():
    python, machine, libc = HERE
    assert runs_here(*HERE)
    assert not runs_here((python[0], python[1] + 1), machine, libc)
    assert not runs_here(python, "riscv64", libc)
    assert not runs_here(python, machine, ("", ""))


def test_a_c_library_may_be_newer_but_not_older(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("glibc", "2.36"))
    python, machine, _ = HERE
    fits = {version: runs_here(python, machine, ("glibc", version)) for version in ("2.9", "2.36", "2.100")}
    assert fits == {"2.9": False, "2.36": True, "2.100": True}


def test_only_what_is_compiled_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in (*MODULES, "agent/core.py", f"deploy/cli{suffix()}", f"other{suffix()}"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(MODULES.get(name, b"something else"))
    assert compiled_modules(("agent",), tmp_path) == {}, "this is the Python form"
    monkeypatch.setattr(compiled_wheel, "COMPILED", True)
    assert compiled_modules(("agent",), tmp_path) == MODULES


def test_pip_installs_it(tmp_path: Path):
    name, data = wheel(MODULES)
    assert wheel(MODULES) == (name, data), "the same bytes every time"
    assert wheel({**MODULES, "agent/other.so": b""})[0] != name
    (tmp_path / name).write_bytes(data)
    words = ["install", "--quiet", "--no-index", "--no-deps", "--target", str(tmp_path / "there"), name]
    subprocess.run([sys.executable, "-m", "pip", *words], cwd=tmp_path, check=True)
    for path, content in MODULES.items():
        assert (tmp_path / "there" / path).read_bytes() == content


def test_a_bundle_has_it_for_such_computers_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def download(_: Platform, folder: Path) -> None:
        (folder / "a.whl").write_bytes(b"a")

    monkeypatch.setattr(bundle, "cache_folder", lambda name: tmp_path / name)
    monkeypatch.setattr(bundle, "_download", download)
    made = {"of": MODULES}
    monkeypatch.setattr(bundle, "compiled_modules", lambda packages: made["of"])
    here, elsewhere = Platform(*HERE), Platform((3, 11), "riscv64", ("glibc", "2.36"))
    first, again, other = (bundle_for(each, b"x") for each in (here, here, elsewhere))
    assert set(other.wheels) == {"a.whl"}
    assert set(first.wheels) == {"a.whl", wheel(MODULES)[0]}
    assert first.wheels == again.wheels
    assert first.version.rpartition("-")[0] == other.version.rpartition("-")[0] != first.version
    made["of"] = {**MODULES, f"agent/core{suffix()}": b"newer"}
    newer = bundle_for(here, b"x")
    assert newer.version != first.version
    assert {path.name for path in newer.folder.glob("*.whl")} == set(newer.wheels), "the old one is gone"
    made["of"] = {}
    assert set(bundle_for(here, b"x").wheels) == {"a.whl"}
