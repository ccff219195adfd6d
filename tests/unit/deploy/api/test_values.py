"""Values that Python callers give: turned into changes of a fleet file, or named in an error."""

from __future__ import annotations

import copy
import tomllib
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.errors import Error
from handfast.agent.common.reader import Problem
from handfast.agent.fleet.model import FleetError
from handfast.deploy.api.drive import run, simulate
from handfast.deploy.api.fleet import load
from handfast.deploy.api.recording import Recording, load_recording
from handfast.deploy.api.sweep import sweep
from handfast.deploy.api.values import Classes, Known, a_path, in_words_of_python, override
from handfast.deploy.recording.run_files import RecordingError
from handfast.plant.backend import Reading


@pytest.mark.parametrize(
    ("value", "read"),
    [
        (True, True),
        (3, 3),
        (0.1, 0.1),
        (1e-12, 1e-12),
        (np.float64(2.5), 2.5),
        (np.int64(7), 7),
        (np.array([1.0, 2.0]), [1.0, 2.0]),
        ("50ms", "50ms"),
        ('a "quoted", line\nand π', 'a "quoted", line\nand π'),
        ((0.1, [2, 3]), [0.1, [2, 3]]),
        (OrderedDict(at=1.0, robots=[1]), {"at": 1.0, "robots": [1]}),
        (Path("a/b"), "a/b"),
        (Reading, "handfast.plant.backend:Reading"),
    ],
    ids=repr,
)
def test_a_value_is_read_as_it_was(value: object, read: object) -> None:
    text = override("a.b", value, Classes())
    assert tomllib.loads(text) == {"a": {"b": read}}


@pytest.mark.parametrize("value", [None, object(), b"x", {1, 2}], ids=["none", "object", "bytes", "set"])
def test_a_value_that_no_file_holds_is_refused_with_its_field(value: object) -> None:
    with pytest.raises(Error, match=r"^a\.b: a number, text, .* was expected, got "):
        override("a.b", value, Classes())


def test_a_class_that_nobody_can_import_gets_a_name_in_this_process() -> None:
    class Mine:
        pass

    classes = Classes()
    assert override("control.law", Mine, classes) == 'control.law="Mine"'
    assert classes.known == {"Mine": Mine}


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (
            RecordingError("x is not empty: name another folder with --out, or remove it"),
            "another folder, or",
        ),
        (FleetError("f", [Problem("--set control.kp", "no")]), "  control.kp: no"),
        (FleetError("f", [Problem("--over control.kp=1", "no")]), "  control.kp=1: no"),
        (FleetError("f", [Problem("--law", "no")]), "  law: no"),
    ],
    ids=str,
)
def test_errors_name_no_options_of_the_command_line(error: Any, says: str) -> None:
    with pytest.raises(type(error)) as caught, in_words_of_python():
        raise error
    assert says in str(caught.value)
    assert "--" not in str(caught.value)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate("delta", duration=1)


@pytest.mark.parametrize(
    ("ask", "says"),
    [
        (lambda it: it.hands[99], r"^there is no robot 99; there are 1, 2, 3, 4, 5, 6$"),
        (lambda it: it.desired["1"], r"^there is no robot '1'; there are 1, .*, 6 \(whole numbers\)$"),
        (lambda it: it.robots[99], "^there is no robot 99; there are 1"),
        (lambda it: it.distance("1", "2"), r"^there is no robot '1'; there are 1, .* \(whole numbers\)$"),
        (lambda it: it.distances[2, 1], r"^there is no edge \(2, 1\): it is \(1, 2\)$"),
        (lambda it: it.wanted[1, 6], r"^there is no edge \(1, 6\); there are \(1, 2\), \(1, 3\), "),
        (lambda it: it.fleet.edges[2, 1], r"^there is no edge \(2, 1\): it is \(1, 2\)$"),
        (lambda it: it.fleet.edges[1, 6], r"^there is no edge \(1, 6\); there are \(1, 2\)"),
        (lambda it: it.tables["hands"]["x"], "^there is no column 'x'; there are t_s, robot"),
    ],
)
def test_a_key_that_there_is_not_is_said_with_those_that_there_are(
    recording: Recording, ask: Any, says: str
) -> None:
    with pytest.raises(Error, match=says):
        ask(recording)


def test_it_is_a_dictionary_to_all_others() -> None:
    known = Known("robot", {1: "one"})
    assert known == {1: "one"}
    assert (known.get(2), 2 in known) == (None, False)
    with pytest.raises(Error, match=r"^there is no robot 2; there are 1$"):
        copy.deepcopy(known)[2]
    many: Known[int, int] = Known("robot", dict.fromkeys(range(100), 0))
    with pytest.raises(Error, match=r"58, 59 and 40 more$"):
        many[100]
    nothing: Known[int, int] = Known("robot", {})
    with pytest.raises(Error, match=r"^there is no robot 1, nor any other$"):
        nothing[1]


@pytest.mark.parametrize("given", [5, None, True, b"x", "a\0", "\ud800"])
def test_what_is_no_path_is_said(given: Any, recording: Recording) -> None:
    for use in (
        lambda: simulate("pair", duration=1, out=5 if given is None else given),
        lambda: run("pair", duration=1, out=5 if given is None else given),
        lambda: recording.save(given),
        lambda: load("pair").save(given),
        lambda: load_recording(given),
    ):
        with pytest.raises(Error, match=r"^(out|the folder|the file|the folder that .*) must be a path, got"):
            use()
    assert a_path("a", "out") == a_path(Path("a"), "out") == Path("a")


@pytest.mark.parametrize("name", ["report", "check", "progress"])
def test_flags_are_true_or_false(name: str, recording: Recording) -> None:
    for call in (simulate, run, sweep):
        if (call, name) not in ((simulate, "progress"), (sweep, "report")):
            with pytest.raises(Error, match=rf"^{name} must be True or False, got 'no'$"):
                call("pair", duration=1, **{name: "no"})  # type: ignore[operator]
    with pytest.raises(Error, match=r"^report must be True or False, got 3$"):
        recording.save("nowhere", report=3)  # type: ignore[arg-type]
