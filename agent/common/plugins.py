"""Plugins: classes of others, found by the reference that a fleet file gives.

A reference is ``package.module:Class``, the name of an entry point in a group, or a name that was registered
in this process. Importing one runs the code of others: whatever that does wrong is one `PluginError`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import is_dataclass
from functools import cache
from importlib import import_module
from math import inf, nan
from numbers import Real
from types import UnionType
from typing import Any, Final, Literal, NoReturn, Union, get_args, get_origin

from handfast.agent.common.errors import Error
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Entry, T, entries, section_entry
from handfast.agent.common.wording import did_you_mean, joined, printable, show

_REFERENCE: Final = re.compile(r"[^\W\d]\w*(?:\.[^\W\d]\w*)*:[^\W\d]\w*")
_NAME: Final = re.compile(r"[^\W\d][\w-]{0,60}")
_NAMES_SAY: Final = "a name has letters, digits, - and _, and begins with no digit"
_SECTION: Final = re.compile(r"[a-z][a-z0-9_]{0,40}")
_OURS: Final = ("handfast",)
_BETWEEN: Final = (*_OURS, "importlib", "dataclasses", "typing")
"""Packages whose code is not what failed: it calls that of others."""
_ABSENT: Final = object()
_registered: Final[dict[str, type[Any]]] = {}


class PluginError(Error, ValueError):
    """A class that cannot be used: one line that names it, what is wrong and what would be right."""


class NoAnswerError(TimeoutError):
    """Is raised within a call of others' code that does not return; it is not called again."""


def attempt(call: Callable[[], T], failed: Callable[[BaseException], T]) -> T:
    """What `call` gives; whatever code of others raises in it, but for KeyboardInterrupt, `failed` takes."""
    try:
        return call()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # asyncio.CancelledError and SystemExit are no Exception
        return failed(error)


def make(plugin: type[T], signature: str, failure: Callable[[str], Error], *arguments: object) -> T:
    """An instance of a class of others.

    Args:
        signature: how its `__init__` is to be written.
        failure: what is raised for a line that says what is wrong.
    """

    def failed(error: BaseException) -> NoReturn:
        raise failure(blame(error, plugin, signature)) from None

    made = attempt(lambda: plugin(*arguments), failed)
    if not issubclass(type(made), plugin):
        raise failure(f"its __new__ must make an instance of the class, not {type(made).__name__}")
    return made


def register(name: str, plugin: type[Any]) -> None:
    """Makes a class known by a name in this process alone, before any entry point of that name."""
    if not _NAME.fullmatch(name):
        raise PluginError(f"{show(name)}: {_NAMES_SAY}")
    _registered[name] = plugin


def resolve(reference: str, group: str, also: Iterable[str] = ()) -> str:
    """The reference as ``package.module:Class`` where it is an entry point's name, else as it is.

    Args:
        also: names that may stand there too, and may have been meant.

    Raises:
        PluginError: it is neither spelled as a reference nor a known name.
    """
    if _REFERENCE.fullmatch(reference) or reference in _registered:
        return reference
    spelled = 'a class is written "package.module:Class"'
    if not _NAME.fullmatch(reference):
        raise PluginError(f"{show(reference)}: {spelled}; {_NAMES_SAY}")
    found = _entry_points(group)
    if reference not in found:
        known = sorted(filter(_NAME.fullmatch, {*_registered, *found}))
        there_are = f"names here are: {', '.join(known)}" if known else f"no entry point is in {group}"
        hint = did_you_mean(reference, [*also, *known]) or there_are
        raise PluginError(f"no plugin has the name {show(reference)}; {hint}")
    value = next(iter(found[reference]))
    if len(found[reference]) > 1:
        two = " and ".join(f"{name} ({value})" for value, name in found[reference].items())
        raise PluginError(f"{show(reference)} is the name of plugins of {two}: write the class that you mean")
    if not _REFERENCE.fullmatch(value):
        raise PluginError(f"{show(reference)}: its entry point is {show(value)}; {spelled}")
    return value


def load(reference: str, group: str, base: str = "", also: Iterable[str] = ()) -> type[Any]:
    """The class of a reference.

    Args:
        group: of entry points, where a name is looked for.
        base: ``module:Class`` of ours that it must be a subclass of; "" for any class.
        also: names that may stand there too, and may have been meant.

    Raises:
        PluginError: there is none, or it is no such class.
    """
    resolved = resolve(reference, group, also)
    plugin = _registered[reference] if resolved in _registered else _imported(resolved)
    if base:
        require(plugin, base, f"{reference}:")
    elif not isinstance(plugin, type):
        raise PluginError(f"{reference}: is no class, but {type(plugin).__name__}")
    return plugin


def require(plugin: object, base: str, named: str) -> None:
    """Nothing, where `plugin` is a class below `base`, ``module:Class`` of ours.

    Raises:
        PluginError: it is none; `named` begins the line.
    """
    wanted = _imported(base)
    name, is_class = wanted.__name__, issubclass(type(plugin), type)
    if is_class and issubclass(plugin, wanted):  # type: ignore[arg-type]
        return
    what = f"subclass of {name}" if is_class else f"class, but {type(plugin).__name__}"
    own = getattr(plugin, "__name__", "Mine") if is_class else "Mine"
    raise PluginError(f"{named} is no {what}: write class {own}({name}), with from handfast import {name}")


def declared(plugin: type[Any], reference: str, name: str) -> Any:
    """An attribute of a class of others, None where it has none.

    Raises:
        PluginError: its metaclass does.
    """

    def failed(error: BaseException) -> NoReturn:
        raise PluginError(f"{reference}: its {name} cannot be read: {blame(error, plugin)}") from None

    return attempt(lambda: getattr(plugin, name, None), failed)


def section(plugin: type[Any], reference: str, taken: Iterable[str]) -> Entry | None:
    """The table of a plugin's own in the fleet file; None when it has none.

    Args:
        plugin: its class; `section` names the table, `Settings` is the table's model.
        taken: names that the table cannot have.

    Raises:
        PluginError: the class declares it wrongly.
    """
    name, model = declared(plugin, reference, "section"), declared(plugin, reference, "Settings")
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

    def unreadable(error: BaseException) -> NoReturn:
        raise PluginError(
            f"{reference}: its Settings cannot be read: {blame(error, plugin)}; write each field "
            'as name: float = setting(1.0, "What it is", unit="m", ge=0)'
        ) from None

    wrong = attempt(lambda: _wrong_fields(model, model.__name__), unreadable)
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


def blame(error: BaseException, plugin: type[Any] | None = None, signature: str = "") -> str:
    """An exception that `attempt` met, in one line: type, text, and place of the innermost code of others.

    Args:
        plugin: only the innermost line of its package counts, by the file's name.
        signature: how what was called is to be written: said where it cannot be called as it is.
    """
    package = "" if plugin is None else _module(plugin).partition(".")[0]
    place, own, trace = "", "", error.__traceback__
    inside = trace and trace.tb_next and trace.tb_next.tb_next
    hint = f"; write def {signature}" if signature and isinstance(error, TypeError) and not inside else ""
    while trace is not None:
        running = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
        file, line = trace.tb_frame.f_code.co_filename, trace.tb_lineno
        place = place if running in _BETWEEN else f" ({file}:{line})"
        own = f" ({file.rpartition('/')[2]}:{line})" if running == package else own
        trace = trace.tb_next
    if isinstance(error, SyntaxError) and error.filename:
        place = own = f" ({error.filename}:{error.lineno})"
    said = error.msg if isinstance(error, SyntaxError) else error
    text = attempt(lambda: str(said), lambda _: "an exception without a text")  # its class is of others too
    text = ": ".join(filter(None, (type(error).__name__, text.strip().split("\n")[0][:200])))
    return printable(text + (place if plugin is None else own)) + hint


def _imported(reference: str) -> Any:
    module_name, _, class_name = reference.partition(":")
    top = module_name.partition(".")[0]
    ours = f"{reference}: {top} is the name of this program's package: give your module another name"

    def failed(error: BaseException) -> NoReturn:
        missing = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
        if missing and (module_name == missing or module_name.startswith(missing + ".")):
            lacking = f"there is no module {missing}: is its package installed in this environment?"
            raise PluginError(ours if top in _OURS else f"{reference}: {lacking}") from None
        raise PluginError(f"{reference}: cannot be imported: {blame(error)}") from None

    def found() -> tuple[Mapping[str, Any], Any]:
        module = import_module(module_name)
        return vars(module), getattr(module, class_name, _ABSENT)  # a module may have a __getattr__

    names, plugin = attempt(found, failed)
    if plugin is _ABSENT:
        classes = [name for name, value in names.items() if issubclass(type(value), type)]
        own = [name for name in classes if _module(names[name]) == module_name]
        hint = did_you_mean(class_name, classes) or f"it has: {', '.join(own) or 'no class'}"
        no_class = f"{reference}: there is no {class_name} in {module_name}; {hint}"
        raise PluginError(ours if top in _OURS else no_class)
    return plugin


def _module(plugin: type[Any]) -> str:
    return str(type.__getattribute__(plugin, "__module__"))  # its metaclass may raise where it is asked


@cache
def _entry_points(group: str) -> Mapping[str, Mapping[str, str]]:
    """By name what entry points give, and by that the package that does: more than one, where several do."""
    from importlib.metadata import entry_points  # here: only those need it who use a name

    found: dict[str, dict[str, str]] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, {})[point.value] = point.dist.name if point.dist else "a package"
    return found


def _example(plugin: type[Any]) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", plugin.__name__).lower()
