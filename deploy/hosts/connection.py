"""A conversation with the program that runs on a host (`deploy.hosts.remote_program`), over one ssh
connection."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.hosts import remote_program
from handfast.deploy.inventory import hosts

PROGRAM: Final = Path(remote_program.__file__)
PYTHONS: Final = ("python3", "python3.14", "python3.13", "python3.12", "python3.11")
GREETING_TIMEOUT_S: Final = 20.0
ANSWER_TIMEOUT_S: Final = 60.0
NOISE_BYTES_MAX: Final = 100_000
"""A login may print before our program speaks, so much at most."""
# A host must not fill this computer's memory, and what JSON stands for takes some thirty times its bytes: a
# longer answer is none of our program's. What it says of units is some 3 kB for each robot.
ANSWER_BYTES: Final = 65_536
ROBOT_BYTES: Final = 16_384
ERROR_MAX: Final = 500
"""Characters of what a host says is wrong."""
STDERR_BYTES_MAX: Final = 20_000
CLOCK_ROUNDS: Final = 5
CLOSE_S: Final = 0.5
END_S: Final = 2.0
"""ssh that has closed its output ends within this, or is ended."""
QUIET_LOGIN: Final = "what a login without a terminal prints must end (look into its .bashrc or .profile)"
NO_PYTHON: Final = "handfast finds no python"
START: Final = (
    'import sys; s = sys.stdin.buffer; exec(compile(s.read(int(s.readline())), "host_program", "exec"))'
)


Answer = tuple[dict[str, Any], bytes]


class HostError(RuntimeError):
    """A host cannot do what it is asked; the text is one clear line."""


class Clock(NamedTuple):
    """How far a host's wall clock is ahead of this machine's, and how much that may be wrong; s."""

    offset_s: float
    error_s: float


def bootstrap() -> str:
    """Shell text that starts our program with the first Python that is recent enough.

    Its last line of output, where there is none, begins with `NO_PYTHON` and says which were found.
    """
    # In single quotes, and without what one login shell or another would read within them.
    wanted = " ".join(f'"{name}"' for name in PYTHONS)
    test = "import sys; sys.exit(sys.version_info < (3, 11))"
    script = (
        f'found=; for p in {wanted}; do if "$p" -c "{test}" >/dev/null 2>&1; then '
        f"exec \"$p\" -P -u -c '\\''{START}'\\''; fi; "
        'v=$("$p" --version 2>/dev/null | head -n 1); [ -n "$v" ] && found="$found $p is $v;"; done; '
        f'echo "{NO_PYTHON}:$found"; exit 3'
    )
    return f"exec /bin/sh -c '{script}'"


class HostConnection:
    """Our program on one host, and ssh to there. A context manager: entering it waits until the program
    answers, leaving it ends the program. `abort` and `close` may be called before.

    Args:
        robots: how many there are on it: so much longer its answers may be.
        accept_new: takes the key of a host that was never met before for its own.

    Raises:
        HostError: there is no ssh here, or it cannot be started.
    """

    def __init__(self, host: HostSection, robots: int = 1, *, accept_new: bool = False) -> None:
        self.host: Final = host
        self._answer_bytes = ANSWER_BYTES + robots * ROBOT_BYTES
        self._about: dict[str, Any] | None = None
        self._said = ""
        try:
            self._process = subprocess.Popen(
                hosts.command(host, bootstrap(), accept_new=accept_new),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,  # a Ctrl-C is for us: what is under way is ended in order
            )
        except FileNotFoundError:
            raise HostError(hosts.NO_SSH) from None
        except OSError as error:
            raise HostError(f"{hosts.NOT_STARTED}: {(error.strerror or str(error)).lower()}") from None
        self._asked: queue.SimpleQueue[_Asked | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Answer | HostError | None] = queue.SimpleQueue()
        self._listener = threading.Thread(target=self._listen_errors, daemon=True)
        self._listener.start()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> HostConnection:
        """Raises `HostError`: the host cannot be reached, does not let us in, or has no Python for us."""
        try:
            program = PROGRAM.read_bytes()
            self._write(str(len(program)).encode() + b"\n" + program)
            greeting, _ = self._next(GREETING_TIMEOUT_S)
            if "no_python" in greeting:
                raise HostError(_no_python(self.host, printable(greeting["no_python"])))
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the conversation; safe to call twice, and from another thread."""
        stdin = self._process.stdin
        assert stdin is not None
        self._asked.put(None)
        with suppress(OSError):
            stdin.close()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        # A master connection of ssh's own, which goes on, may hold their pipes open.
        self._reader.join(CLOSE_S)
        self._listener.join(CLOSE_S)

    def abort(self) -> None:
        """Ends the conversation at once: a question under way fails. May be called from another thread."""
        self._process.kill()

    # ------------------------------------------------------------------ questions

    @property
    def about(self) -> dict[str, Any]:
        """What the program says of the computer (`remote_program.hello`); raises as `ask`. It is asked when
        that is wanted: a stop must not wait for it."""
        if self._about is None:
            self._about = self.ask("hello")
        return self._about

    def ask(
        self,
        what: str,
        *,
        timeout_s: float = ANSWER_TIMEOUT_S,
        answer_bytes: int | None = None,
        **arguments: Any,
    ) -> Any:
        """The answer to a request without data.

        Args:
            answer_bytes: the longest answer that there may be; by the number of robots unless given.

        Raises:
            HostError: it cannot be done there, or the connection was lost.
        """
        return self.exchange(what, None, timeout_s=timeout_s, answer_bytes=answer_bytes, **arguments)[0]

    def exchange(
        self,
        what: str,
        blob: bytes | None,
        *,
        timeout_s: float = ANSWER_TIMEOUT_S,
        answer_bytes: int | None = None,
        data_bytes: int = 0,
        **arguments: Any,
    ) -> tuple[Any, bytes]:
        """The answer to a request with data, and the data that came with it, `data_bytes` at most; else as
        `ask`."""
        head: dict[str, Any] = {"do": what, **arguments}
        if blob is not None:
            head["blob"] = len(blob)
        self._asked.put(_Asked(what, answer_bytes or self._answer_bytes, data_bytes))
        self._write(json.dumps(head).encode() + b"\n")
        if blob:
            self._write(blob)
        answer, data = self._next(timeout_s)
        if "error" in answer:
            raise HostError(printable(str(answer["error"])[:ERROR_MAX]))
        return answer.get("ok"), data

    def clock(self) -> Clock:
        """How the host's clock stands to this one: from the quickest of a few questions."""
        best: Clock | None = None
        for _ in range(CLOCK_ROUNDS):
            asked_ns = time.time_ns()
            there_ns = self.ask("clock")
            answered_ns = time.time_ns()
            if type(there_ns) is not int or not 0 <= there_ns < 2**63:
                raise HostError("it does not say what time it is there")
            error_s = (answered_ns - asked_ns) / 2e9
            if best is None or error_s < best.error_s:
                best = Clock((there_ns - (asked_ns + answered_ns) / 2) / 1e9, error_s)
        assert best is not None
        return best

    # ------------------------------------------------------------------ bytes

    def _write(self, data: bytes) -> None:
        stdin = self._process.stdin
        assert stdin is not None
        with suppress(OSError):  # it has ended: what it said before, or that, is what `_next` finds
            stdin.write(data)
            stdin.flush()

    def _next(self, timeout_s: float) -> Answer:
        try:
            answer = self._answers.get(timeout=timeout_s)
        except queue.Empty:
            self._process.kill()
            raise HostError(f"it did not answer within {timeout_s:.0f} s") from None
        if isinstance(answer, HostError):
            self._process.kill()
            raise answer
        if answer is None:
            raise self._lost()
        return answer

    def _lost(self) -> HostError:
        try:
            status = self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        self._listener.join(1.0)
        return HostError(hosts.ended(self.host, status, self._said))

    def _listen_errors(self) -> None:
        stream = self._process.stderr
        assert stream is not None
        with stream:
            while data := stream.read1(4096):  # type: ignore[attr-defined]
                if len(self._said) < STDERR_BYTES_MAX:
                    self._said += data.decode(errors="replace")

    def _read(self) -> None:
        """Passes on the greeting, and an answer for each question; None when there will be no more."""
        stream = self._process.stdout
        assert stream is not None
        try:
            with stream, suppress(OSError, ValueError):  # closed here
                if (greeting := _greeting(stream)) is None:
                    return
                self._answers.put((greeting, b""))
                # Nothing is read that was not asked for: it waits in the pipe.
                while "no_python" not in greeting and (asked := self._asked.get()) is not None:
                    if (answer := _answer(stream, asked)) is None:
                        return
                    self._answers.put(answer)
        except HostError as error:
            self._answers.put(error)
        finally:
            self._answers.put(None)


class _Asked(NamedTuple):
    """A question, and how long its answer may be."""

    what: str
    answer_bytes: int
    data_bytes: int


def _answer(stream: IO[bytes], asked: _Asked) -> Answer | None:
    """The next answer and its data, None when it ends before.

    Raises:
        HostError: it is longer than it can be, or no answer.
    """
    line = stream.readline(asked.answer_bytes + 1)
    if len(line) > asked.answer_bytes:
        raise HostError(
            f"its answer to {asked.what} is longer than {asked.answer_bytes} bytes: it is not read on"
        )
    if not line.endswith(b"\n"):
        return None
    try:
        head = json.loads(line)
    except (ValueError, RecursionError):
        head = None
    size = head.get("blob") or 0 if isinstance(head, dict) and ("ok" in head or "error" in head) else None
    if type(size) is not int or size < 0:
        raise HostError(f"its answer to {asked.what} makes no sense: {printable(repr(line[:60])[1:])}")
    if size > asked.data_bytes:
        raise HostError(
            f"its answer to {asked.what} has {size} bytes of data, {asked.data_bytes} were asked for at most"
        )
    data = stream.read(size)
    return (head, data) if len(data) == size else None


def _greeting(stream: IO[bytes]) -> dict[str, Any] | None:
    """Waits for our program's first line, through what a login prints; None when it does not come.

    Raises:
        HostError: the login prints on and on.
    """
    read = 0
    while line := stream.readline(4096):
        read += len(line)
        if read > NOISE_BYTES_MAX:
            raise HostError(f"its login prints more than {NOISE_BYTES_MAX // 1000} kB: {QUIET_LOGIN}")
        if line == remote_program.GREETING:
            return {}
        if line.startswith(NO_PYTHON.encode()):
            return {"no_python": line.decode(errors="replace").partition(":")[2].strip(" ;\n")}
    return None


def _no_python(host: HostSection, found: str) -> str:
    instead = f" ({found})" if found else ""
    return f"there is no Python of 3.11 or later on its PATH{instead}: install one, or link it there"
