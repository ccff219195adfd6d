"""Whom a MAVLink session speaks to, as whom, and how it signs: keys and timestamps in files.

A signature is worth something only while no timestamp is used twice, whatever the clock does: a timestamp
ahead of those in use is kept in a file, by a thread, since an SD card may take seconds to write it.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.security import private_files
from handfast.agent.security.private_files import KeyFileError, home_folder
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.requests import AUDITED

KEY_BYTES: Final = 32
EPOCH_S: Final = 1_420_070_400
"""2015-01-01 00:00 UTC, from which MAVLink counts, in steps of 10 us."""
STEPS_PER_S: Final = 100_000
AHEAD: Final = 20 * STEPS_PER_S
"""What is stored is so far ahead of what is used. Less than a minute: a vehicle refuses others that are a
minute behind what it has seen."""
LEFT_AHEAD: Final = STEPS_PER_S
"""The same for what is stored in the end: messages signed since `Timestamps.next` was asked last."""
_NS_PER_STEP: Final = 10_000
_MAX: Final = 2**48 - 1


class SigningError(ValueError):
    """A key or timestamp file that cannot be used; the text says what to do."""


def load_key(path: str | Path) -> bytes:
    """The 32 bytes of a key file: as they are, or as 64 hexadecimal digits.

    Raises:
        SigningError: it is not there, not a key, or others than this user may read or change it.
    """
    path = Path(path)
    try:
        data = private_files.read(path, private=True)
    except KeyFileError as error:
        raise SigningError(f"the signing key: {error}") from None
    if len(data) == KEY_BYTES:
        return data
    if re.fullmatch(rb"\s*[0-9a-fA-F]{64}\s*", data):
        return bytes.fromhex(data.decode("ascii"))
    raise SigningError(
        f"the signing key {path} must be {KEY_BYTES} bytes or {2 * KEY_BYTES} hexadecimal digits"
    )


def make_key(path: str | Path) -> bytes:
    """Writes a new random key, as hexadecimal digits, for this user only; never over a file.

    Raises:
        SigningError: there is a file already, or it cannot be written.
    """
    path = Path(path)
    key = secrets.token_bytes(KEY_BYTES)
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with open(handle, "w", encoding="ascii") as file:
            file.write(key.hex() + "\n")
            file.flush()
            os.fsync(handle)
    except FileExistsError:
        raise SigningError(f"{path} is there already: a key is never written over") from None
    except OSError as error:
        raise SigningError(f"cannot write the signing key {path}: {private_files.reason(error)}") from None
    return key


def state_file(name: str) -> Path:
    """Where the timestamp of one bridge is kept, in the user's folder for state.

    Args:
        name: of the bridge among all of this user's, as "rovers-3".
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    root = Path(base) if base.startswith("/") else home_folder() / ".local" / "state"
    return root / "handfast" / f"signing-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"


class Timestamps:
    """The timestamps of one signing bridge: they only grow, also over a restart, a crash, a loss of power
    and a clock that is set back. One process at a time uses a file.

    Args:
        path: its file; its folder is made.
        now_ns: the present, wall time.

    Attributes:
        trouble: why the file cannot be kept up to date, "" while it can.

    Raises:
        SigningError: the file cannot be read or written.
    """

    def __init__(self, path: Path, now_ns: int) -> None:
        self._path = path
        self.trouble = ""
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._last = max(timestamp_at(now_ns), _read(path))
            self._stored = self._last + AHEAD
            _write(path, self._stored)
        except OSError as error:
            raise SigningError(
                f"cannot keep the signing timestamp in {path}: {private_files.reason(error)}"
            ) from None
        except KeyFileError as error:
            raise SigningError(f"cannot keep the signing timestamp: {error}") from None
        self._wanted = self._stored
        self._wake = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._keep, name="signing timestamp", daemon=True)
        self._thread.start()

    @property
    def latest(self) -> int:
        """The last one given, or the one from which the next is counted."""
        return self._last

    def next(self, now_ns: int, at_least: int = 0) -> int:
        """The timestamp (10 us since 2015) to sign the next messages with, one more for each of them.

        Args:
            at_least: what signing has come to since: counted on from there. Later than the last one always.
        """
        self._last = min(_MAX, max(self._last + 1, at_least, timestamp_at(now_ns)))
        if self._last + AHEAD // 2 > self._wanted:
            self._wanted = self._last + AHEAD
            self._wake.set()
        return self._last

    def close(self) -> None:
        """Ends the thread; what is stored stays ahead of what was used, but by little: a bridge that is
        started again and again must not run away from the clock of others who sign.
        """
        self._ended = True
        self._wake.set()
        self._thread.join(1.0)
        if not self._thread.is_alive():
            with contextlib.suppress(KeyFileError):
                _write(self._path, min(self._stored, self._last + LEFT_AHEAD))

    def _keep(self) -> None:
        while not self._ended:
            self._wake.wait()
            self._wake.clear()
            wanted = self._wanted
            if wanted <= self._stored:
                continue
            try:
                _write(self._path, wanted)
                self._stored, self.trouble = wanted, ""
            except KeyFileError as error:
                self.trouble = f"cannot keep the signing timestamp: {error}"


@dataclass(frozen=True)
class Signing:
    """What a session needs to sign: the key of 32 bytes, the timestamps, the number of this link."""

    key: bytes
    timestamps: Timestamps
    link_id: int = 0


def open_signing(fleet: str, robot: int, key_file: str, now_ns: int) -> Signing:
    """What a robot's bridge signs with.

    Args:
        fleet: its name.
        key_file: as the fleet file has it; `~` is the user's home.
        now_ns: the present, wall time.

    Raises:
        SigningError: the key cannot be used, or the timestamp not be kept.
    """
    key = load_key(Path(key_file).expanduser())
    return Signing(key, Timestamps(state_file(f"{fleet}-{robot}"), now_ns))


def timestamp_at(now_ns: int) -> int:
    """The wall time (ns) as signatures count it: 10 us since 2015, 0 before."""
    return max(0, now_ns // _NS_PER_STEP - EPOCH_S * STEPS_PER_S)


def _read(path: Path) -> int:
    if not private_files.exists(path):
        return 0
    text = private_files.read(path).decode("ascii", "replace").strip()
    if not re.fullmatch(r"[0-9]{1,15}", text) or int(text) > _MAX:
        raise SigningError(
            f"the signing timestamp in {path} is damaged: remove it while this machine's clock is right"
        )
    return int(text)


def _write(path: Path, value: int) -> None:
    """Whole or not at all, also when the power fails."""
    private_files.write(path, f"{value}\n".encode("ascii"), private=True)


@dataclass(frozen=True)
class SessionSettings:
    """Whom to speak to, and as whom.

    Attributes:
        system: the vehicle's id; None: the first autopilot that is heard.
        component: the own one. The own system is the vehicle's.
        state_rate_hz: of ATTITUDE and LOCAL_POSITION_NED.
        datum: offered as the EKF's origin; None: nothing is offered.
        signing: the key that both sides sign with; None: unsigned, and signatures are not looked at.
        token: tells the own heartbeats (`custom_mode`) and questions for the time from those of a bridge that
            speaks as the same system and component. Random; 0: none.
        parameters: names of those to read.

    Raises:
        ValueError: an identity that is another's.
    """

    system: int | None = None
    component: int = constants.COMPONENT_ONBOARD_COMPUTER
    state_rate_hz: float = 25.0
    datum: Geodetic | None = None
    signing: Signing | None = None
    token: int = 0
    parameters: tuple[str, ...] = AUDITED

    def __post_init__(self) -> None:
        if self.system is not None and not 1 <= self.system < constants.SYSTEM_GROUND_STATION:
            raise ValueError(f"system must be from 1 to 254 (255 is the ground station's), not {self.system}")
        if not 2 <= self.component <= 254:
            raise ValueError(f"component must be from 2 to 254 (1 is the autopilot's), not {self.component}")
        if not 1.0 <= self.state_rate_hz <= 1000.0:
            raise ValueError(f"state_rate_hz must be from 1 to 1000, not {self.state_rate_hz}")
        if not 0 <= self.token < 2**32:
            raise ValueError(f"token must be from 0 to 2^32 - 1, not {self.token}")


def session_settings(
    section: MavlinkSection,
    token: int,
    *,
    signing: Signing | None = None,
    datum: Geodetic | None = None,
    parameters: tuple[str, ...] = (),
) -> SessionSettings:
    """Whom to speak to, and as whom, as a robot's section of the fleet file has it.

    Args:
        token, signing, parameters: as `SessionSettings` has them.
        datum: offered as the EKF's origin; None: nothing is offered.

    Raises:
        ValueError: an identity that is another's.
    """
    return SessionSettings(
        system=section.system,
        state_rate_hz=section.state_rate_hz,
        datum=datum,
        signing=signing,
        token=token,
        parameters=parameters,
    )
