"""A sweep's folder: what was asked, and a row for every run that is done, kept from the moment it is.

``sweep.toml`` and ``fleet.toml`` (the fleet file's text as it was given) are the question, ``results.csv``
the answers so far. A second sweep with the same question goes on where the first one ended, however it
ended; one with another question is refused.
"""

from __future__ import annotations

import csv
import fcntl
import io
import os
import tomllib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, Final

import tomli_w

from handfast.agent.common.closing import Closing
from handfast.agent.common.wording import printable
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.recording.run_files import FLEET_FILE, must_have_a_name
from handfast.deploy.sweep.plan import Plan, Question
from handfast.deploy.sweep.run import VERDICTS, Row
from handfast.deploy.sweep.varied import Axis, Range, SweepError, parse_over
from handfast.deploy.verdict.metrics import columns

FORMAT: Final = 1
SWEEP_FILE: Final = "sweep.toml"
RESULTS_FILE: Final = "results.csv"
SOURCES: Final = "sources"
NEW: Final = ".new"
_WORDS: Final = {"true": True, "false": False, "": None}


class SweepFolder(Closing):
    """The folder of one sweep, held by one process at a time. A context manager.

    Args:
        path: made if need be; empty, or with a sweep that asks the same.
        sources: of the program that is to drive (`deploy.console.sources`), empty where that is not known.

    Raises:
        SweepError: the folder holds something else, rows that another program has driven while others are
            missing, is in use, or cannot be written.
    """

    def __init__(self, path: Path, question: Question, plan: Plan, sources: str = "") -> None:
        self.path, self.plan = path, plan
        self.rows: dict[int, Row] = {}
        self._results = path / RESULTS_FILE
        if path.exists() and not path.is_dir():
            raise SweepError(f"{path} is a file: name a folder, new or of a sweep that goes on, with --out")
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._claim(question, sources)
                self._read()
                self._keep_to(sources)
                self._stream = open(self._results, "ab", buffering=0)  # noqa: SIM115 (until close)
            except BaseException:
                os.close(self._lock)
                raise
        except BlockingIOError:
            raise SweepError(f"{path}: another sweep is at work in this folder") from None
        except OSError as error:
            raise SweepError(f"cannot write the sweep's folder {path}: {error.strerror or error}") from None

    def close(self) -> None:
        self._stream.close()
        os.close(self._lock)

    @property
    def missing(self) -> list[int]:
        """Runs that are still to be driven, in the order in which they are."""
        return [run for run in self.plan.order() if run not in self.rows]

    def add(self, row: Row) -> None:
        """Keeps one run's row: once this returns it outlives the process.

        Raises:
            SweepError: it cannot be written.
        """
        self.rows[row.run] = row
        line = _line(self._cells(row))
        try:
            while line:  # a full disk takes a part
                line = line[os.write(self._stream.fileno(), line) :]
            must_have_a_name(self._stream.fileno())
        except OSError as error:
            raise SweepError(f"cannot write {self._results}: {error.strerror or error}") from None

    def complete(self) -> None:
        """Puts the rows in the order of the runs, now that all are there.

        Raises:
            SweepError: the file cannot be written.
        """
        table = [self._header(), *(self._cells(self.rows[run]) for run in sorted(self.rows))]
        try:
            replace_file(self._results, csv_bytes(table))
        except OSError as error:
            raise SweepError(f"cannot write {self._results}: {error.strerror or error}") from None

    def _claim(self, question: Question, sources: str) -> None:
        """Makes the folder this sweep's, unless it is that already."""
        asked, known = _asked(question, self.plan), self.path / SWEEP_FILE
        if known.exists():
            _compare(self.path, _read_toml(known), asked, self.plan.cells[0].fleet.name)
            return
        text = question.text.encode()
        if not self._was_begun(text):
            raise SweepError(
                f"{self.path} is not empty and holds no sweep: name another folder with --out, or remove it"
            )
        (self.path / FLEET_FILE).write_bytes(text)
        # Last: a folder with this file is a sweep that can go on.
        replace_file(known, _sweep_file(asked, sources))

    def _was_begun(self, text: bytes) -> bool:
        """Whether there is nothing but what one leaves that was killed here, or met a full disk."""
        names = {path.name for path in self.path.iterdir()}
        if not names <= {FLEET_FILE, SWEEP_FILE + NEW}:
            return False
        return FLEET_FILE not in names or text.startswith((self.path / FLEET_FILE).read_bytes())

    def _keep_to(self, sources: str) -> None:
        """Refuses to have rows driven by one program beside those of another."""
        known = self.path / SWEEP_FILE
        asked = _read_toml(known)
        before = asked.get(SOURCES, "")
        if before in ("", sources) or not sources or not self.missing:
            return
        if not self.rows:
            replace_file(known, _sweep_file(asked, sources))
            return
        raise SweepError(
            f"{self.path}: the {len(self.rows)} of {self.plan.runs} runs that are done were driven by other "
            f"Python files, of handfast or of a plugin, than those that are here now ({before}, now "
            f"{sources}). Go on with those, or name another folder with --out; if no run can come out "
            f"otherwise by what has changed, take the line `{SOURCES}` out of {known}"
        )

    def _header(self) -> list[str]:
        return [
            "run",
            *self.plan.fields,
            "repeat",
            "seed",
            "settled",
            "safe",
            *columns(),
            "verdict",
            "reason",
            "wall_s",
        ]

    def _cells(self, row: Row) -> list[str]:
        return [
            str(row.run),
            *self.plan.run_values(row.run),
            str(row.run % self.plan.repeat),
            str(row.seed),
            _word(row.settled),
            _word(row.safe),
            *(repr(row.numbers[name]) if name in row.numbers else "" for name in columns()),
            row.verdict,
            row.reason,
            f"{row.wall_s:.3f}",
        ]

    def _read(self) -> None:
        """Takes the rows that are there; a last one that was cut off by a crash is forgotten."""
        header = self._header()
        content = self._results.read_bytes() if self._results.exists() else b""
        if _line(header).startswith(content):
            replace_file(self._results, _line(header))
            return
        whole = content.rfind(b"\n") + 1 or len(content)
        if whole != len(content):
            os.truncate(self._results, whole)
        text = content[:whole].decode("utf-8", errors="replace")
        for number, cells in enumerate(csv.reader(io.StringIO(text, newline="")), 1):
            if number == 1 and cells == header:
                continue
            row = None
            if number > 1 and len(cells) == len(header):
                with suppress(ValueError, KeyError):
                    row = self._row(dict(zip(header, cells, strict=True)))
            if row is None or self._cells(row) != cells:
                raise SweepError(
                    f"{self._results}, line {number}: not a row of this sweep; remove the line"
                    if number > 1
                    else f"{self._results}: the first line is not this sweep's heading"
                )
            self.rows[row.run] = row

    def _row(self, cells: dict[str, str]) -> Row:
        run = int(cells["run"])
        numbers = {name: float(cells[name]) for name in columns() if cells[name]}
        if not 0 <= run < self.plan.runs or cells["verdict"] not in VERDICTS:
            raise ValueError(cells)
        if not all(map(isfinite, numbers.values())):
            raise ValueError(numbers)
        return Row(
            run,
            self.plan.run_seed(run),
            cells["verdict"],
            cells["reason"],
            _WORDS[cells["safe"]],
            _WORDS[cells["settled"]],
            numbers,
            float(cells["wall_s"]),
        )


def read_question(folder: Path) -> Question:
    """The question of the sweep in `folder`.

    Raises:
        SweepError: there is none, or it cannot be read.
    """
    table = _read_toml(folder / SWEEP_FILE)
    try:
        text = (folder / FLEET_FILE).read_text(encoding="utf-8")
        over = [parse_over(each) for each in table["over"]]
        return Question(
            str(folder / FLEET_FILE),
            text,
            table.get("law"),
            tuple(table["set"]),
            tuple(each for each in over if isinstance(each, Axis)),
            table["repeat"],
            table.get("random_starts_m"),
            tuple(each for each in over if isinstance(each, Range)),
        )
    except OSError as error:
        raise SweepError(f"cannot read {folder / FLEET_FILE}: {error.strerror or error}") from None
    except (KeyError, TypeError):
        raise SweepError(f"{folder / SWEEP_FILE} is not what a sweep has written") from None


def read_digest(folder: Path) -> str:
    """`Plan.digest` of the sweep in `folder`; raises as `read_question`."""
    return str(_read_toml(folder / SWEEP_FILE).get("fleet_digest", ""))


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file all at once: whoever reads it sees the old or the new one, never a part."""
    new = path.with_name(path.name + NEW)
    try:
        new.write_bytes(content)
        new.replace(path)
    except OSError:
        with suppress(OSError):
            new.unlink(missing_ok=True)
        raise


def csv_bytes(rows: Iterable[Sequence[str]]) -> bytes:
    """Rows of cells as a CSV file."""
    return b"".join(_line(row) for row in rows)


def _line(cells: Sequence[str]) -> bytes:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue().encode("utf-8", errors="replace")


def _word(value: bool | None) -> str:
    return "" if value is None else "true" if value else "false"


def _asked(question: Question, plan: Plan) -> dict[str, Any]:
    law = {} if question.law is None else {"law": question.law}
    return {
        "format": FORMAT,
        "handfast": handfast_version(),
        "fleet": question.source,
        **law,
        "set": list(question.overrides),
        **plan.identity(),
        "runs": plan.runs,
    }


def _sweep_file(asked: dict[str, Any], sources: str) -> bytes:
    """`SWEEP_FILE` of what is asked, and who drives it if that is known."""
    return tomli_w.dumps({"sweep": asked | ({SOURCES: sources} if sources else {})}).encode()


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))["sweep"]
    except OSError as error:
        raise SweepError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, KeyError):
        table = None
    if not isinstance(table, dict):
        raise SweepError(f"{path} is not what a sweep has written")
    return table


_WORDED: Final = {
    "format": "the folder's format",
    "handfast": "the version of handfast",
    "over": "--over",
    "repeat": "--repeat",
    "seed": "the seed",
    "random_starts_m": "--random-starts",
    "law": "--law",
    "set": "--set",
}


def _compare(path: Path, there: dict[str, Any], asked: dict[str, Any], fleet: str) -> None:
    """Refuses a folder whose runs would be others; `fleet` is the name of what is asked for."""
    differs = [
        name
        for name in ("format", "handfast", "over", "repeat", "seed", "random_starts_m")
        if there.get(name) != asked.get(name)
    ]
    if there.get("fleet_digest") != asked["fleet_digest"]:
        differs += [name for name in ("law", "set") if there.get(name) != asked.get(name)]
    renamed = any("fleet.name" in str(each) for each in (there.get("set"), asked.get("set")))
    before = None if renamed else _fleet_name(path)
    said = [f"the fleet is {fleet}, was {before}"] if before not in (None, fleet) else []
    said += [f"{_WORDED[name]} is {_show(asked.get(name))}, was {_show(there.get(name))}" for name in differs]
    if there.get("fleet_digest") == asked["fleet_digest"] and not differs:
        if there.get("runs", asked["runs"]) == asked["runs"]:
            return
        raise SweepError(
            f"{path / SWEEP_FILE} has been changed: what it asks makes {asked['runs']} runs, and it says "
            f"runs = {_show(there['runs'])}. Undo that, or ask for another sweep in another folder"
        )
    if not said:
        said = ["the fleet file is another one, or has been changed"]
    its_own = {"format", "handfast"}.isdisjoint(differs)  # by another program it can not be gone on with
    go_on = f", or go on with that one: handfast sweep {path}" if its_own else ""
    holds = "another sweep" if its_own else "a sweep of another program"
    raise SweepError(f"{path} holds {holds}: {'; '.join(said)}. Name another folder with --out{go_on}")


def _fleet_name(path: Path) -> str | None:
    """The name of the fleet whose sweep a folder holds, None where its file does not say."""
    try:
        table = tomllib.loads((path / FLEET_FILE).read_text(encoding="utf-8"))["fleet"]
        return printable(str(table["name"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _show(value: object) -> str:
    if value is None or value == []:
        return "not given"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
