"""Plugins: classes of others, found by the reference that a fleet file gives.

A reference is ``package.module:Class``, the name of an entry point in a group, or a name that was registered
in this process. Importing one runs the code of others: whatever that does wrong is one `PluginError`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from math import inf, nan
from numbers import Real
from types import UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin

from agent.common.errors import Error
from agent.common.reader import Reader
from agent.common.settings import Entry, entries, section_entry
from agent.common.wording import joined, nearest, printable, show

_REFERENCE: Final = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*):([A-Za-z_]\w*)", re.ASCII)
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,60}", re.ASCII)
_SECTION: Final = re.compile(r"[a-z][a-z0-9_]{0,40}")
_OURS: Final = ("agent", "plant", "bridges", "deploy", "handfast", "importlib", "dataclasses", "typing")
_registered: Final[dict[str, type[Any]]] = {}


class PluginError(Error, ValueError):
    """A class that cannot be used: one line that names it, what is wrong and what would be right."""


def register(name: str, plugin: type[Any]) -> None:
    """Makes a class known by a name in this process alone, before any entry point of that name."""
    if not _NAME.fullmatch(name):
        raise PluginError(f"{show(name)}: a name has letters, digits, - and _, and begins with a letter")
    _registered[name] = plugin


def resolve(reference: str, group: str) -> str:
    """The reference as ``package.module:Class`` where it is an entry point's name, else as it is.

    Raises:
        PluginError: it is neither spelled as a reference nor a known name.
    """
    if _REFERENCE.fullmatch(reference) or reference in _registered:
        return reference
    spelled = 'a class is written "package.module:Class"'
    if not _NAME.fullmatch(reference):
        raise PluginError(f"{show(reference)}: {spelled}")
    found = _entry_points(group)
    if reference not in found:
        known = sorted({*_registered, *found})
        near = nearest(reference, known)
        there_are = f"names here are: {', '.join(known)}" if known else f"no entry point is in {group}"
        hint = f"did you mean {near}?" if near else there_are
        raise PluginError(f"no plugin has the name {show(reference)}; {hint}")
    if not _REFERENCE.fullmatch(found[reference]):
        raise PluginError(f"{show(reference)}: its entry point is {show(found[reference])}; {spelled}")
    return found[reference]


def load(reference: str, group: str, base: str = "") -> type[Any]:
    """The class of a reference.

    Args:
        group: of entry points, where a name is looked for.
        base: ``module:Class`` of ours that it must be a subclass of; "" for any class.

    Raises:
        PluginError: there is none, or it is no such class.
    """
    resolved = resolve(reference, group)
    plugin = _registered[reference] if resolved in _registered else _imported(resolved)
    if not isinstance(plugin, type):
        raise PluginError(f"{reference}: is no class, but {type(plugin).__name__}")
    if base:
        wanted = _imported(base)
        if not issubclass(plugin, wanted):
            raise PluginError(
                f"{reference}: is no subclass of {wanted.__name__}: write "
                f"class {plugin.__name__}({wanted.__name__}), with from handfast import {wanted.__name__}"
            )
    return plugin


def section(plugin: type[Any], reference: str, taken: Iterable[str]) -> Entry | None:
    """The table of a plugin's own in the fleet file; None when it has none.

    Args:
        plugin: its class; `section` names the table, `Settings` is the table's model.
        taken: names that the table cannot have.

    Raises:
        PluginError: the class declares it wrongly.
    """
    name, model = getattr(plugin, "section", None), getattr(plugin, "Settings", None)
    if name is None and model is None:
        return None
    if not isinstance(name, str) or not _SECTION.fullmatch(name) or name in taken:
        why = "is taken" if isinstance(name, str) and name in taken else "is no name of a table"
        raise PluginError(
            f'{reference}: section = {show(name)} {why}: write for example section = "{_example(plugin)}"'
        )
    parameters = getattr(model, "__dataclass_params__", None)
    if not isinstance(model, type) or not is_dataclass(model) or not getattr(parameters, "frozen", False):
        raise PluginError(f"{reference}: Settings must be a class below @dataclass(frozen=True)")
    try:
        wrong = _wrong_fields(model, model.__name__)
    except Exception as error:
        raise PluginError(
            f"{reference}: its Settings cannot be read: {blame(error, plugin)}; write each field "
            'as name: float = setting(1.0, "What it is", unit="m", ge=0)'
        ) from None
    if wrong:
        raise PluginError(f"{reference}: {wrong}")
    return section_entry(name, model, printable((model.__doc__ or "").strip().split("\n")[0]))


def _wrong_fields(model: type, place: str) -> str:
    """What is wrong with the fields of a model, "" for nothing: a type that no file holds, a default that is
    none."""
    for entry in entries(model).values():
        here = joined(place, entry.key)
        inside = entry.table or entry.tables
        if inside is not None:
            if wrong := _wrong_fields(inside, here):
                return wrong
            continue
        if entry.setting.parse is None and not _is_held(entry.hint):
            kind = getattr(entry.hint, "__name__", str(entry.hint))
            return (
                f"{here} is {printable(kind)}: a file holds float, int, bool, str, Literal and tuples of them"
            )
        reader = Reader(model)
        if not entry.required:
            reader.default(entry, here)
        for problem in reader.problems:
            return f"the default of {problem}"
    return ""


def _is_held(hint: Any) -> bool:
    """Whether a file can hold a value of this type."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return all(type(arg) in (str, int, bool) for arg in args)
    if origin is tuple:
        return all(arg is Ellipsis or _is_held(arg) for arg in args)
    if origin in (Union, UnionType):
        return all(map(_is_held, args))
    return hint in (float, int, bool, str)


def number(given: Any) -> float:
    """A real number of others (int, float, a scalar of numpy) as Python's own; NaN for anything else."""
    if not isinstance(given, Real):
        given = python(given)
    if isinstance(given, bool) or not isinstance(given, Real):
        return nan
    try:
        return float(given)
    except OverflowError:
        return inf


def python(given: Any) -> Any:
    """An array, or a scalar of one, as Python's own list or number; anything else as it is."""
    return given.tolist() if hasattr(type(given), "tolist") else given


def blame(error: BaseException, plugin: type[Any] | None = None) -> str:
    """An exception in one line: type, text, and file and line of the innermost code of others.

    Args:
        plugin: only the innermost line of its package counts, by the file's name.
    """
    package = "" if plugin is None else plugin.__module__.partition(".")[0]
    place, own, trace = "", "", error.__traceback__
    while trace is not None:
        running = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
        file, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
        place = place if running in _OURS else f" ({file}:{line})"
        own = f" ({file.rpartition('/')[2]}:{line})" if running == package else own
        trace = trace.tb_next
    if isinstance(error, SyntaxError) and error.filename:
        place = own = f" ({error.filename}:{error.lineno})"
    try:
        text = str(error.msg if isinstance(error, SyntaxError) else error).strip().split("\n")[0]
    except Exception:  # its class is of others too
        text = "an exception without a text"
    return printable(f"{type(error).__name__}: {text[:200]}{place if plugin is None else own}")


def _imported(reference: str) -> Any:
    module_name, _, class_name = reference.partition(":")
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if module_name == missing or module_name.startswith(missing + "."):
            raise PluginError(
                f"{reference}: there is no module {missing}: is its package installed in this environment?"
            ) from None
        raise PluginError(f"{reference}: cannot be imported: {blame(error)}") from None
    except (Exception, SystemExit) as error:
        raise PluginError(f"{reference}: cannot be imported: {blame(error)}") from None
    if not hasattr(module, class_name):
        classes = [name for name, value in vars(module).items() if isinstance(value, type)]
        near = nearest(class_name, classes)
        own = [name for name in classes if getattr(module, name).__module__ == module_name]
        hint = f"did you mean {near}?" if near else f"it has: {', '.join(own) or 'no class'}"
        raise PluginError(f"{reference}: there is no {class_name} in {module_name}; {hint}")
    return getattr(module, class_name)


@cache
def _entry_points(group: str) -> Mapping[str, str]:
    from importlib.metadata import entry_points  # here: only those need it who use a name

    return {point.name: point.value for point in entry_points(group=group)}


def _example(plugin: type[Any]) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", plugin.__name__).lower()
