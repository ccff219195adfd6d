"""What ``--cluster`` means."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.common.errors import MissingPackageError
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.cluster import choose
from handfast.deploy.cluster.choose import ClusterOptionError, check_cluster, make_engine
from handfast.deploy.cluster.engine import Cluster
from handfast.deploy.console.data_files import FLEETS, ROOT
from handfast.deploy.simulate.worker_pool import Pool
from tests.passing_law import PassingLaw
from tests.unit.deploy.cluster.test_sent import Doubles


class Shown:
    def __init__(self) -> None:
        self.said: list[str] = []
        self.now = ""

    def say(self, text: str) -> None:
        self.said.append(text)

    def at_work(self, text: str) -> None:
        self.now = text


def test_without_it_this_machine_drives() -> None:
    assert isinstance(make_engine(None, Doubles(), 2, 9.0, Shown()), Pool)


@pytest.mark.parametrize("where", ["tcp://there:8786", "tls://[fd00::1]:8786"])
def test_a_scheduler_by_its_address(where: str) -> None:
    engine = make_engine(where, Doubles(), 2, 9.0, Shown())
    assert isinstance(engine, Cluster)
    assert engine.name == where


def test_a_scheduler_by_its_file(tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    with pytest.raises(ClusterOptionError):
        check_cluster(str(file))
    file.write_text('{"type": "Scheduler", "address": "tcp://127.0.0.1:8786", "workers": {}}')
    engine = make_engine(str(file), Doubles(), 2, 9.0, Shown())
    assert isinstance(engine, Cluster)
    assert engine.name == f"tcp://127.0.0.1:8786 ({file})"


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ('{"a": 1}', ", and has no address"),
        ("[]", ", and has no address"),
        ('{"address": 8786}', ", and has no address"),
        ('{"address": "inproc://x"}', ', and its address is "inproc://x"'),
        ("fleet = 1", ", and is no JSON"),
        ("", ", and is no JSON"),
    ],
)
def test_what_is_no_file_of_a_scheduler_is_one_line(tmp_path: Path, text: str, wrong: str) -> None:
    file = tmp_path / "scheduler.json"
    file.write_text(text)
    with pytest.raises(ClusterOptionError, match="must be what a Dask scheduler writes") as raised:
        check_cluster(str(file))
    assert str(raised.value).startswith(f"--cluster {file}: ")
    assert str(raised.value).endswith(wrong)


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("ssh:", "--cluster ssh: names no fleet"),
        ("ssh:nofleet", "--cluster ssh:nofleet: .*nofleet"),
    ],
)
def test_a_fleet_that_is_none_is_refused_by_the_option(where: str, says: str) -> None:
    with pytest.raises(ClusterOptionError, match=says):
        check_cluster(where)


def test_workers_are_counted_beside_runs() -> None:
    shown = Shown()
    engine = make_engine("tcp://there:8786", Doubles(), 2, 9.0, shown, wait_s=600.0)
    assert isinstance(engine, Cluster)
    assert engine._patience_s == 600.0
    engine._count(8, 2)
    assert shown.now == "8 at a time on 2 workers"


@pytest.mark.parametrize(
    "where",
    [
        "",
        "there",
        "there:8786",
        "tcp://there",
        "tcp://:8786",
        "http://there:80",
        "tcp://there:0",
        "tcp://there:65536",
        "tcp://there:٣",
    ],
)
def test_anything_else_is_one_line(where: str) -> None:
    with pytest.raises(ClusterOptionError, match=r"must be tcp://HOST:PORT or tls://HOST:PORT of a Dask"):
        check_cluster(where)


def test_a_package_that_is_lacking_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "handfast.deploy.cluster.engine", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'handfast\[cluster\]'"):
        check_cluster("tcp://there:8786")


@pytest.mark.parametrize("where", ["tcp://there:8786", "tls://there:8786"])
@pytest.mark.parametrize(
    ("text", "says"), [("distributed: [a", "dask.yaml' is malformed"), ("- a", "must have a dict")]
)
def test_a_configuration_of_dask_that_cannot_be_read_is_one_line(
    where: str, text: str, says: str, tmp_path: Path
) -> None:
    (tmp_path / "dask.yaml").write_text(text)
    code = (
        "from handfast.deploy.cluster.choose import ClusterOptionError, check_cluster\n"
        f"try:\n    check_cluster({where!r})\nexcept ClusterOptionError as error:\n    print(error)\n"
    )
    environment = dict(os.environ) | {"DASK_CONFIG": str(tmp_path)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    (line,) = done.stdout.splitlines()
    assert line.startswith("Dask cannot be loaded with its configuration: ValueError: ")
    assert str(tmp_path / "dask.yaml") in line
    assert says in line
    assert done.stderr == ""


def test_plugins_of_a_fleet_go_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "law_that_goes_along")
    fleet = load_fleet(FLEETS / "pair.toml", law=law.reference)
    shown = Shown()
    assert set(choose._files([fleet], shown)) == {"law_that_goes_along.py"}
    alone = replace(fleet, control=replace(fleet.control, law="KnownInThisProcess"))
    assert choose._files([alone], shown) == {}, "such classes are in the work itself"
    assert shown.said == []
    law.leave()
    assert choose._files([fleet], shown) == {}
    (text,) = shown.said
    assert text.startswith("law_that_goes_along: ")
    assert text.endswith("; workers need it installed")


def test_dask_is_not_loaded_where_no_cluster_is_asked_for() -> None:
    modules = (
        "handfast.deploy.cluster.choose, handfast.deploy.commands.local.sweep, handfast.deploy.api.sweep"
    )
    code = f"import sys, {modules}; sys.exit('distributed' in sys.modules or 'dask' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
