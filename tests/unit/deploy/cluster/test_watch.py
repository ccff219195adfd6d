"""Which workers may be given runs; with a scheduler that only answers."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

import cloudpickle
import pytest

from handfast.deploy.cluster import watch
from handfast.deploy.cluster.connection import ClusterError
from handfast.deploy.cluster.identity import NONE, SOURCES, identity
from handfast.deploy.cluster.on_worker import PROCESS
from handfast.deploy.cluster.watch import There, Watch, remote

HERE = f"{sys.version_info[0]}.{sys.version_info[1]}.9.final.0"


class Scheduler:
    """Workers by their addresses: what each answers to a question, by the question's name."""

    def __init__(self) -> None:
        self.python = HERE
        self.workers: dict[str, dict[str, Any]] = {}

    async def versions(self, packages: list[str]) -> dict[str, Any]:
        return {"host": {"python": self.python}}

    async def ncores(self) -> dict[str, int]:
        return dict.fromkeys(self.workers, 1)

    async def identity(self, n_workers: int) -> dict[str, Any]:
        assert n_workers == -1
        return {"workers": {each: {"name": about.get("name", each)} for each, about in self.workers.items()}}

    async def broadcast(self, msg: dict[str, Any], workers: list[str], on_error: str) -> dict[str, Any]:
        return {
            each: {"host": {"python": self.workers[each].get("versions", HERE)}, "packages": {}}
            for each in workers
        }


class Client:
    status = "running"

    def __init__(self) -> None:
        self.scheduler = Scheduler()
        self.asked: list[tuple[str, str, tuple[Any, ...]]] = []

    def sync(
        self, call: Callable[..., Any], *arguments: Any, callback_timeout: float = 0.0, **named: Any
    ) -> Any:
        return asyncio.run(call(*arguments, **named))

    async def _run(
        self, call: Callable[..., Any], *arguments: Any, workers: list[str], on_error: str
    ) -> dict[str, Any]:
        name = call.__closure__[1].cell_contents  # type: ignore[attr-defined]
        (address,) = workers
        self.asked.append((address, name, arguments))
        found = self.scheduler.workers[address].get(name)
        if name == "about" and found is None:
            found = dict(identity()) | {PROCESS: f"process of {address}"}
        if isinstance(found, float):
            await asyncio.sleep(found)
        return {address: found}


class Stopped(Watch):
    """A watch that looks when it is told to."""

    def _run(self) -> None:
        pass


def watching(client: Client) -> Watch:
    return Stopped(client, "campaign", b"plan", {}, 9.0)


def test_who_has_the_same_is_told_of_the_campaign_once() -> None:
    client = Client()
    client.scheduler.workers = {"a": {}}
    seen = watching(client)
    for _ in range(3):
        seen._look()
    assert seen.usable() == [("a", There(1, "process of a"))]
    assert client.asked == [("a", "about", ()), ("a", "begin", ("campaign", b"plan", {}, 9.0))]
    assert list(seen.said()) == []


@pytest.mark.parametrize(
    ("answers", "why"),
    [
        ({"versions": "3.9.1.final.0"}, "it has Python 3.9, here is"),
        ({"about": ModuleNotFoundError("No module named 'deploy'")}, "it has no handfast like this one (Mod"),
        ({"about": ModuleNotFoundError("deploy")}, "deploy): install the same there, pip install 'handfast["),
        ({"about": dict(identity()) | {"numpy": "1.0", PROCESS: "x"}}, "it has numpy 1.0, here is"),
        ({"about": dict(identity()) | {"pymap3d": NONE, PROCESS: "x"}}, "it lacks the package pymap3d: pip"),
        (
            {"about": dict(identity()) | {SOURCES: "other", PROCESS: "x"}},
            "its sources of handfast are others",
        ),
        ({"begin": OSError(28, "No space left on device")}, "No space left on device"),
    ],
)
def test_who_differs_is_named_with_the_difference_and_others_work(answers: dict[str, Any], why: str) -> None:
    client = Client()
    client.scheduler.workers = {"bad": answers, "good": {}}
    seen = watching(client)
    seen._look()
    seen._look()
    (text,) = seen.said()
    assert text.startswith("the worker bad is given nothing: ")
    assert why in text
    assert [address for address, _ in seen.usable()] == ["good"]
    assert (seen.seen.refused, seen.seen.unknown) == (1, 0)


def test_a_worker_that_does_not_answer_holds_up_nobody_and_is_asked_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watch, "ASK_S", 0.02)
    client = Client()
    client.scheduler.workers = {"slow": {"about": 30.0}, "good": {}}
    seen = watching(client)
    seen._look()
    assert [address for address, _ in seen.usable()] == ["good"]
    assert seen.seen.unknown == 1
    del client.scheduler.workers["slow"]["about"]
    monkeypatch.setattr(watch, "ASK_S", 10.0)
    seen._ask_at_s.clear()
    seen._look()
    assert {address for address, _ in seen.usable()} == {"good", "slow"}


def test_one_that_is_another_process_now_is_looked_at_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "KEEP_S", 0.0)
    client = Client()
    client.scheduler.workers = {"a": {"keep": "process of a"}}
    seen = watching(client)
    seen._look()
    seen._look()
    assert seen.seen.workers["a"].process == "process of a"
    client.scheduler.workers["a"] = {"keep": "", "about": dict(identity()) | {PROCESS: "another"}}
    seen._look()
    seen._ask_at_s.clear()
    seen._look()
    assert seen.seen.workers["a"].process == "another"


def test_a_scheduler_of_another_python_is_refused() -> None:
    client = Client()
    client.scheduler.python = "3.9.1.final.0"
    with pytest.raises(ClusterError, match=r"the scheduler runs Python 3\.9, here is"):
        watching(client)


def test_what_is_sent_imports_its_module_only_where_it_is_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scheduler reads it and need not have handfast: it travels by value."""
    data = cloudpickle.dumps(remote("handfast.deploy.cluster.sent", "pack"))
    monkeypatch.setitem(sys.modules, "handfast.deploy.cluster.watch", None)
    monkeypatch.setitem(sys.modules, "handfast.deploy.cluster.sent", None)
    read = cloudpickle.loads(data)
    with pytest.raises(ModuleNotFoundError):
        read(1)


def test_a_worker_that_is_refused_is_called_by_its_name_too() -> None:
    client = Client()
    client.scheduler.workers = {"tcp://there:1": {"versions": "3.9.1.final.0", "name": "lab-7"}}
    seen = watching(client)
    seen._look()
    (text,) = seen.said()
    assert text.startswith("the worker tcp://there:1 (lab-7) is given nothing: ")
