"""What is sent of plugins to robots' computers."""

from __future__ import annotations

import sys
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import pytest

from handfast.agent.common import plugins
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.console import sources as module
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.console.sources import PluginFilesError, plugin_files, plugin_modules
from handfast.deploy.hosts import remote_program
from handfast.deploy.hosts.bundle import PLUGINS, program_archive
from handfast.plant.backend import Plant

PLANT = "from handfast import Plant\n\n\nclass Mine(Plant):\n    pass\n"


@pytest.fixture(autouse=True)
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, text in {
        "my_package/__init__.py": "",
        "my_package/inner/__init__.py": "",
        "my_package/inner/plant.py": PLANT,
        "my_package/table.csv": "1,2\n",
        "my_package/__pycache__/plant.cpython-311.pyc": "compiled",
        "my_module.py": PLANT,
        "shared/mine/__init__.py": PLANT,
        "shared/other/__init__.py": "",
        "fast/__init__.py": PLANT,
        "fast/core.so": "\0",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    plugins._registered.clear()
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("my_package", "my_module", "shared", "fast"):
            del sys.modules[name]


def files(*modules: str) -> set[str]:
    return {name for name, _ in plugin_files(modules)}


def test_a_whole_package_is_sent_and_nothing_else() -> None:
    package = {"my_package/__init__.py", "my_package/inner/__init__.py", "my_package/inner/plant.py"}
    assert files("my_package.inner.plant") == package | {"my_package/table.csv"}
    assert files("my_module") == {"my_module.py"}
    assert files("shared.mine") == {"shared/mine/__init__.py"}, "of a namespace the part that is meant"
    assert len(list(plugin_files(("my_module", "my_module")))) == 1


def test_the_modules_of_a_fleet() -> None:
    overrides = ["robot_defaults.plant=my_package.inner.plant:Mine", "robot.2.plant=my_module:Mine"]
    fleet = load_fleet(FLEETS / "pair.toml", overrides)
    assert plugin_modules(fleet) == ("my_module", "my_package.inner.plant")
    assert plugin_modules(load_fleet(FLEETS / "pair.toml")) == ()
    plugins.register("mine", Plant)
    with pytest.raises(PluginFilesError, match=r"^mine: this class is known in this process alone"):
        plugin_modules(load_fleet(FLEETS / "pair.toml", ["robot_defaults.plant=mine"]))


def test_the_archive_changes_with_them_and_is_as_ever_without(site: Path) -> None:
    plain, one = program_archive(), program_archive(("my_module",))
    with zipfile.ZipFile(BytesIO(one)) as archive:
        assert archive.read("my_module.py").decode() == PLANT
        assert archive.read(PLUGINS) == b"my_module"
    assert PLUGINS not in zipfile.ZipFile(BytesIO(plain)).namelist()
    assert program_archive(("my_module",)) == one != plain
    assert program_archive(("handfast.agent.control.own_law",)) == plain, "what is there anyway"
    (site / "my_module.py").write_text(PLANT + "\n")
    assert program_archive(("my_module",)) != one
    assert PLUGINS == remote_program.PLUGINS


def test_what_cannot_be_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PluginFilesError, match=r"^fast: fast/core.so is compiled for this machine: only"):
        files("fast")
    with pytest.raises(PluginFilesError, match=r"^math: it is no file of Python"):
        files("math")
    monkeypatch.setattr(module, "BYTES_MAX", 10)
    with pytest.raises(PluginFilesError, match=r"my_module.py is larger than 0 MB: put the class into a"):
        files("my_module")
