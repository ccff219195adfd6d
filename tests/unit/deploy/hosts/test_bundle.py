"""What is sent to a robot's computer.

What is compiled as a wheel: for whom it is, and that pip installs it.
"""

from __future__ import annotations

import platform
import re
import subprocess
import sys
import threading
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from handfast.deploy.console.data_files import ROBOT_REQUIREMENTS
from handfast.deploy.hosts import bundle
from handfast.deploy.hosts.bundle import (
    Bundle,
    BundleError,
    Platform,
    bundle_for,
    compiled_modules,
    program_archive,
    runs_here,
    suffix,
    wheel,
)

PI = Platform((3, 11), "aarch64", ("glibc", "2.36"))


def about(**changes: Any) -> dict[str, Any]:
    return {
        "system": "Linux",
        "python": [3, 11, 2],
        "machine": "aarch64",
        "libc": ["glibc", "2.36"],
    } | changes


def test_the_platform_is_that_of_the_host():
    assert Platform.of(about()) == PI
    assert PI.tags[0] == "manylinux_2_36_aarch64"
    assert PI.tags[-2:] == ["manylinux_2_17_aarch64", "manylinux2014_aarch64"]
    assert Platform.of(about(libc=["", ""])).tags == ["musllinux_1_2_aarch64", "musllinux_1_1_aarch64"]
    with pytest.raises(BundleError, match="it runs Darwin"):
        Platform.of(about(system="Darwin"))


def test_our_packages_are_the_same_bytes_every_time_and_without_the_operators():
    archive = program_archive()
    assert archive == program_archive()
    names = zipfile.ZipFile(BytesIO(archive)).namelist()
    assert "handfast/agent/core.py" in names
    assert {"handfast/bridges/mavlink/__main__.py", "handfast/__init__.py"} <= set(names)
    assert not any(name.startswith(("handfast/deploy", "tests")) or name.endswith(".pyc") for name in names)


def test_the_version_names_all_that_is_in_it():
    one = Bundle(Path(), {"pip-26.3-py3-none-any.whl": "a", "numpy-2.whl": "b"}, b"x")
    assert one.pip == "pip-26.3-py3-none-any.whl"
    others = [
        Bundle(Path(), {**one.wheels, "numpy-2.whl": "c"}, b"x"),
        Bundle(Path(), one.wheels, b"y"),
    ]
    assert len({one.version, *(other.version for other in others)}) == 3
    assert one.version == Bundle(Path("elsewhere"), one.wheels, b"x").version
    assert re.fullmatch(r"[\w.+]+-[0-9a-f]{8}-[0-9a-f]{8}", one.version)
    same = [each.version.rpartition("-")[0] for each in (one, *others)]
    assert same[0] == same[1] != same[2], "but for its last part that of all computers with our packages"


def test_all_that_robots_need_is_locked_with_hashes():
    text = ROBOT_REQUIREMENTS.read_text()
    names = set(re.findall(r"^([a-z0-9-]+)==", text, re.MULTILINE))
    assert {
        "eclipse-zenoh",
        "numpy",
        "msgpack",
        "pymavlink",
        "pymap3d",
        "pyserial",
        "cryptography",
        "mcap",
        "zstandard",
        "orjson",
        "pip",
    } <= names
    assert not {"rich", "matplotlib", "pyarrow"} & names, "the operator's"
    assert text.count("--hash=sha256:") >= len(names)
    assert "://" not in text, "no addresses of package hosts"


def test_wheels_are_fetched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fetched = []

    def download(platform: Platform, folder: Path) -> None:
        fetched.append(platform)
        (folder / "pip-1.whl").write_bytes(b"abc")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(bundle, "_download", download)
    first, again = bundle_for(PI, b"x"), bundle_for(PI, b"x")
    assert fetched == [PI]
    assert first.wheels == again.wheels
    assert first.wheels["pip-1.whl"].startswith("ba7816bf")
    assert (first.folder / "pip-1.whl").read_bytes() == b"abc"
    bundle_for(Platform((3, 12), "aarch64", ("glibc", "2.36")), b"x")
    assert len(fetched) == 2


def test_a_registry_that_is_not_there_is_waited_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def download(platform: Platform, folder: Path) -> None:
        asked.append(platform)
        raise BundleError("no wheels for it")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(bundle, "_download", download)
    for _ in range(3):
        with pytest.raises(BundleError, match="no wheels"):
            bundle_for(PI, b"x")
    assert len(asked) == 1


def test_a_download_can_be_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nexec sleep 60\n")
    python.chmod(0o755)
    begun = threading.Event()

    class Guard(set[Any]):
        def add(self, process: Any) -> None:
            super().add(process)
            begun.set()

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(bundle.sys, "executable", str(python))
    monkeypatch.setattr(bundle, "_downloads", Guard())

    def end() -> None:
        begun.wait(10.0)
        bundle.end_downloads()

    thread = threading.Thread(target=end)
    thread.start()
    with pytest.raises(BundleError, match=r"no wheels for Python 3\.11, aarch64, glibc 2\.36: interrupted"):
        bundle_for(PI, b"x")
    thread.join()


def test_an_interrupted_download_leaves_nothing_that_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def download(platform: Platform, folder: Path) -> None:
        (folder / "numpy-1.whl").write_bytes(b"half")
        raise BundleError("no wheels for it")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(bundle, "_download", download)
    for _ in range(2):
        with pytest.raises(BundleError, match="no wheels"):
            bundle_for(PI, b"x")
    assert not list(tmp_path.rglob("*.whl"))


HERE = sys.version_info[:2], platform.machine(), platform.libc_ver()
MODULES = {f"0f__mypyc{suffix()}": b"shared", f"agent/core{suffix()}": b"core"}


def test_it_is_for_computers_of_this_machines_kind():
    python, machine, libc = HERE
    assert runs_here(*HERE)
    assert not runs_here((python[0], python[1] + 1), machine, libc)
    assert not runs_here(python, "riscv64", libc)
    assert not runs_here(python, machine, ("", ""))


def test_only_what_is_compiled_is_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in (*MODULES, "agent/core.py", f"deploy/cli{suffix()}", f"other{suffix()}"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(MODULES.get(name, b"something else"))
    assert compiled_modules(("agent",), tmp_path) == {}, "this is the Python form"
    monkeypatch.setattr(bundle, "COMPILED", True)
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
