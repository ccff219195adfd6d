"""handfast.agent.common.plugins: a stranger's class is found, or one line says what is wrong with it."""

from __future__ import annotations

import asyncio
import re
import sys
from collections.abc import Iterator
from dataclasses import make_dataclass
from enum import Enum
from math import nan
from pathlib import Path
from textwrap import dedent
from typing import Any, Literal

import pytest

from handfast.agent.common import plugins
from handfast.agent.common.plugins import PluginError
from handfast.agent.common.settings import setting

GROUP = "handfast.tests"
PACKAGE = {
    "__init__.py": "",
    "good.py": """
        from dataclasses import dataclass

        from handfast.agent.common.plugins import PluginError
        from handfast.agent.common.settings import setting


        @dataclass(frozen=True)
        class Settings:
            \"\"\"How it slips.\"\"\"

            slip: float = setting(0.1, "Slip.", ge=0, lt=1)


        class Drag(PluginError):
            section = "drag"
            Settings = Settings


        class Plain:
            pass


        class Melted:
            section = "drag"

            class Settings:
                slip = 0.1


        class Loose:
            section = "drag"

            @dataclass(frozen=True)
            class Settings:
                slip: float = 0.1


        class Odd(Drag):
            section = "Not A Name"


        VALUE = 3
        """,
    "broken.py": "import math\n\nprint(math.pie)\n",
    "unfinished.py": "def f(:\n",
    "lacking.py": "import no_such_package_at_all\n",
    "leaving.py": "raise SystemExit(3)\n",
    "cancelled.py": "import asyncio\n\nraise asyncio.CancelledError\n",
    "odd.py": """
        class Meta(type):
            def __getattribute__(cls, name):
                raise ValueError("meta " + name)


        class Hidden(metaclass=Meta):
            pass


        def __getattr__(name):
            raise ValueError("no " + name)
        """,
    "größe.py": "class Weiß:\n    pass\n",
}


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "strange_things"
    folder.mkdir()
    for name, text in PACKAGE.items():
        (folder / name).write_text(dedent(text))
    info = tmp_path / "strange_things-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strange-things\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        f"[{GROUP}]\ndrag = strange_things.good:Drag\nwhole = strange_things.good\n"
        "two words = strange_things.good:Drag\nclash = strange_things.good:Drag\n"
    )
    other = tmp_path / "other_things-1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other-things\nVersion: 1\n")
    (other / "entry_points.txt").write_text(f"[{GROUP}]\nclash = strange_things.good:Plain\n")
    monkeypatch.syspath_prepend(tmp_path)
    plugins._entry_points.cache_clear()
    yield folder
    plugins._entry_points.cache_clear()
    plugins._registered.clear()
    for name in [name for name in sys.modules if name.startswith("strange_things")]:
        del sys.modules[name]


def test_a_class_is_found_by_its_module_by_its_name_and_when_it_was_registered() -> None:
    drag = plugins.load("strange_things.good:Drag", GROUP)
    assert drag.__name__ == "Drag"
    assert plugins.load("drag", GROUP) is drag
    assert plugins.resolve("drag", GROUP) == "strange_things.good:Drag"
    plugins.register("mine", drag)
    assert plugins.load("mine", GROUP, "handfast.agent.common.plugins:PluginError") is drag


@pytest.mark.parametrize(
    ("reference", "says"),
    [
        ("no_such_thing.at_all:X", "there is no module no_such_thing: is its package installed"),
        ("strange_things.god:Drag", "there is no module strange_things.god"),
        ("strange_things.good:Drga", "there is no Drga in strange_things.good; did you mean Drag?"),
        ("strange_things.good:Quite", "it has: Settings, Drag, Plain, Melted, Loose, Odd"),
        ("strange_things.good:VALUE", "is no class, but int"),
        ("strange_things.good:Plain", "is no subclass of PluginError: write class Plain(PluginError)"),
        ("strange_things.broken:X", r"AttributeError: .*pie.* \(.*broken.py:3\)"),
        ("strange_things.unfinished:X", r"SyntaxError: .* \(.*unfinished.py:1\)"),
        ("strange_things.lacking:X", r"ModuleNotFoundError: .*no_such_package_at_all.* \(.*lacking.py:1\)"),
        ("strange_things.leaving:X", r"SystemExit: 3 \(.*leaving.py:1\)"),
        ("strange_things/good.py:Drag", 'a class is written "package.module:Class"'),
        ("strange_things.good", 'a class is written "package.module:Class"'),
        ("drg", 'no plugin has the name "drg"; did you mean drag?'),
        ("spring", "names here are: clash, drag, whole$"),
        ("two words", "a name has letters, digits, - and _, and begins with no digit$"),
        (
            "clash",
            r"strange-things \(strange_things.good:Drag\) and other-things \(strange_things.good:Plain\)",
        ),
        ("strange_things.cancelled:X", r"CancelledError \(.*cancelled.py:3\)"),
        ("strange_things.odd:X", r"cannot be imported: ValueError: no X \(.*odd.py:12\)"),
        (
            "handfast.no_such:X",
            "handfast is the name of this program's package: give your module another name$",
        ),
        ("handfast:Sledge", "handfast is the name of this program's package"),
        ("whole", 'its entry point is "strange_things.good"'),
    ],
)
def test_what_is_wrong_is_one_line(reference: str, says: str) -> None:
    with pytest.raises(PluginError) as caught:
        plugins.load(reference, GROUP, "handfast.agent.common.plugins:PluginError")
    text = str(caught.value)
    assert re.search(says.replace("(PluginError)", r"\(PluginError\)"), text)
    assert reference in text
    assert "\n" not in text


@pytest.mark.parametrize("kind", [ValueError, SystemExit, asyncio.CancelledError, GeneratorExit])
def test_whatever_code_of_others_raises_is_met(kind: type[BaseException]) -> None:
    def call() -> str:
        raise kind("away")

    assert plugins.attempt(call, lambda error: plugins.blame(error)).startswith(f"{kind.__name__}: away (")


def test_ctrl_c_is_not() -> None:
    def call() -> str:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        plugins.attempt(call, lambda error: "met")


def test_the_table_of_a_class() -> None:
    drag = plugins.load("strange_things.good:Drag", GROUP)
    entry = plugins.section(drag, "drag", ())
    assert entry is not None
    assert (entry.key, entry.hint, entry.setting.doc) == ("drag", drag.Settings, "How it slips.")
    assert plugins.section(PluginError, "none", ()) is None


class Colour(Enum):
    RED = 1


INNER = make_dataclass("Inner", [("b", bool, setting(1, "x"))], frozen=True)


def of_field(hint: Any, default: Any, **rest: Any) -> type[Any]:
    model = make_dataclass("Ground", [("a", hint, setting(default, "x", **rest))], frozen=True)
    return type("Drag", (), {"section": "drag", "Settings": model})


@pytest.mark.parametrize(
    ("plugin", "says"),
    [
        (of_field(float, -1.0, ge=0), "the default of Ground.a: must be at least 0, got -1.0"),
        (of_field(float, "abc"), 'the default of Ground.a: must be a number, such as 1.0, got "abc"'),
        (of_field(float, nan), "the default of Ground.a: must be a finite number, got nan"),
        (of_field(float, None), "the default of Ground.a: must be a number, such as 1.0, got None"),
        (of_field(Literal["a", "b"], "c"), 'the default of Ground.a: must be one of "a", "b", got "c"'),
        (of_field(tuple[float, float], (1.0,)), "the default of Ground.a: must be an array of 2 numbers"),
        (of_field(Colour, Colour.RED), "Ground.a is Colour: a file holds float, int, bool, str, Literal"),
        (of_field(Any, 1), "Ground.a is Any: a file holds float"),
        (of_field(INNER, None), "the default of Ground.a.b: must be true or false"),
    ],
)
def test_a_default_that_no_file_can_give_is_refused_by_class_and_field(plugin: type[Any], says: str) -> None:
    with pytest.raises(PluginError) as caught:
        plugins.section(plugin, "ref", ())
    assert str(caught.value).startswith(f"ref: {says}")
    assert "\n" not in str(caught.value)
