"""Python values as changes of a fleet file."""

from __future__ import annotations

import tomllib
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.errors import Error
from handfast.agent.common.reader import Problem
from handfast.agent.fleet.model import FleetError
from handfast.deploy.api.changes import Classes, in_words_of_python, override
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
