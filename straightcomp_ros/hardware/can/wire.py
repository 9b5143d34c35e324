"""The messages between a board and its host, as a DBC file and the parameters `can.wire` describe them."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from straightcomp_ros.hardware.can.dbc_file import Dbc, DbcError, modulus
from straightcomp_ros.hardware.can.frames import UNITS, BoardFault
from straightcomp_ros.hardware.can.message_code import Signals
from straightcomp_ros.hardware.can.message_frames import CommandFrames, HeartbeatFrames, ReportFrames
from straightcomp_ros.hardware.can.protection import Crc, ProtectionParameters, alive_modulus, data_ids
from straightcomp_ros.hardware.can.roles import OF_BOARD, OF_HOST, READINGS, Roles, field_of
from straightcomp_ros.hardware.can.shipped_wire import FILE, shipped_wire
from straightcomp_ros.hardware.can.signal_code import used_part
from straightcomp_ros.hardware.can.wire_parameters import WireParameters
from straightcomp_ros.parameters.declaration import RefusedParameter, to_mapping

if TYPE_CHECKING:
    from cantools.database.can import Signal

_LEAST_COUNTS = 4
_USUAL_EVERY = 10
"""Samples between two of the slower frames, where the DBC file does not say it."""


class Wire:
    """All frames of one board and its host.

    Args:
        dbc: the DBC file.
        meaning: of its signals.
        node: added to the identifiers of the file, less one.
        fd: the bus is one for CAN FD.

    Attributes:
        sample: the frames with x.
        parts: all frames of which each sample has one, those with its number first: ``sample`` and those with y and
            ``good``, if they are others.
        part_modulus: of the count by which the frames of a sample belong together; 0: by their time.
        reports: all frames of the board but the heartbeat, by identifier.
        counting: frames with the sample's number: ``sample``, others, or None.
        homes: the board's frames by the role of each of their signals.
        commands: all frames of the host, in the order of sending: those with the current last.
        command: those with the current.
        command_modulus: as ``part_modulus``, of the frames of a command.
        status: frames with the amplifier's state.
        current: frames with the measured current; None for a board without.
        heartbeat: None for a board without.
        sample_modulus: of the count in each sample's own frames, by which samples are numbered; 0 without one.
        number_modulus: of the numbers of samples that board and host agree on; 0 without any.
        echo_modulus: of the echo in a command; 0 for a command without.
        fault_codes: the board's code of each fault: that with its name in the DBC file, else its number as far as it
            fits.

    Raises:
        RefusedParameter: file and meaning do not fit together; the names begin with ``wire.``.
    """

    def __init__(self, dbc: Dbc, meaning: WireParameters, node: int = 1, fd: bool = True) -> None:
        self.dbc, self.meaning, self.fd, self._node = dbc, meaning, fd, node
        self._places: dict[str, str] = {}
        self._taken: dict[int, str] = {}
        self._roles = roles = Roles(dbc, meaning, fd)
        signals, homes = roles.signals, roles.homes
        protection = self._protections(homes)
        reports: dict[str, ReportFrames] = {}
        for name, protected in protection.items():
            inside = [role for role in OF_BOARD if homes.get(role) == name]
            if inside:
                reports[name] = ReportFrames(self._signals(name, inside, *protected), meaning.fault.none_value)
        self.homes = {role: reports[homes[role]] for role in OF_BOARD if role in homes}
        self.sample, self.status = self.homes["x"], self.homes["amplifier"]
        self.current, self.counting = self.homes.get("current"), self.homes.get("counter")
        self.reports: Mapping[int, ReportFrames] = {frames.identifier: frames for frames in reports.values()}
        commands: dict[str, CommandFrames] = {}
        for name in dict.fromkeys(homes[role] for role in reversed(OF_HOST) if role in homes):
            inside = [role for role in OF_HOST if homes.get(role) == name]
            commands[name] = CommandFrames(self._signals(name, inside, *protection[name]))
        self.command = commands.pop(homes["command"])
        self.commands = *commands.values(), self.command
        self.parts = self._parts()
        self.part_modulus = self._common_modulus(self.parts)
        self.command_modulus = self._common_modulus(self.commands)
        self.heartbeat: HeartbeatFrames | None = None
        if "heartbeat" in signals:
            beat = self._signals(homes["heartbeat"], ["heartbeat"], "", ProtectionParameters())
            self.heartbeat = HeartbeatFrames(beat, meaning.heartbeat.boot_up_value, meaning.heartbeat.operational_value)
        self.sample_modulus = count_modulus(self.parts[0])
        self.number_modulus = self.counting.signals.counts("counter") if self.counting else self.sample_modulus
        self.echo_modulus = min(max(frames.signals.counts("echo") for frames in self.commands), self.number_modulus)
        self._fault_words = {int(raw): str(words) for raw, words in _choices(signals.get("fault")).items()}
        self.fault_codes = {fault: self._fault_code(fault) for fault in BoardFault}
        self._set_rates()
        self._check_numbers()

    @property
    def readback_lag(self) -> int:
        """Samples by which the measured current is older than the readings that it comes with.

        A current in a message of its own comes after the sample that it belongs to.
        """
        return 0 if self.current is None or self.current in self.parts else 1

    @property
    def identifiers(self) -> list[int]:
        """Of all frames that the board sends."""
        return [*self.reports, *([self.heartbeat.identifier] if self.heartbeat else [])]

    def source(self) -> str:
        """Name of the DBC file, and a checksum of it with the meaning: by it a firmware knows whether it has these
        frames."""
        usual = to_mapping(WireParameters())
        said = {name: value for name, value in to_mapping(self.meaning).items() if value != usual[name]}
        content = self.dbc.path.read_bytes() + repr(sorted(said.items())).encode()
        # It stands in texts of C.
        name = re.sub(r"[^A-Za-z0-9._-]", "_", self.dbc.path.name)
        return f"{name} {hashlib.sha256(content).hexdigest()[:12]}"

    def fault_words(self, code: int) -> str:
        """What the DBC file calls a fault code of the board."""
        return self._fault_words.get(code, f"fault {code}")

    def _fault_code(self, fault: BoardFault) -> int:
        for raw, words in self._fault_words.items():
            if words.lower().replace("_", " ") == fault.words:
                return raw
        if fault is BoardFault.NONE:
            return self.meaning.fault.none_value
        signal = self._roles.signals.get("fault")
        return min(int(fault), modulus(signal) - 1) if signal else 0

    def _protections(self, homes: Mapping[str, str]) -> dict[str, tuple[str, ProtectionParameters]]:
        """For each message by name where its protection is described, and how."""
        found: dict[str, tuple[str, ProtectionParameters]] = {}
        for part, roles in (
            ("sample", ("x",)),
            ("y", ("y",)),
            ("good", ("good",)),
            ("status", ("amplifier", "fault")),
            ("current", ("current", "counter")),
            *((role, (role,)) for role in OF_HOST),
        ):
            protected = getattr(self.meaning.protection, part)
            names = [homes[role] for role in roles if role in homes and homes[role] not in found]
            if not names and protected != ProtectionParameters():
                text = "is given, but the signals are in a message that is protected by another part"
                raise RefusedParameter(f"wire.protection.{part}", text)
            found |= {name: (part, protected) for name in names}
        return found

    def _signals(self, name: str, inside: Sequence[str], part: str, protected: ProtectionParameters) -> Signals:
        """The signals of the message ``name``: those of the roles ``inside``, and its protection."""
        message = self.dbc.message(name)
        place = f"wire.protection.{part}"
        self._places[name] = place
        try:
            identifier = self.dbc.identifier(message, self._node)
        except DbcError as error:
            raise RefusedParameter("node", str(error)) from None
        other = self._taken.setdefault(identifier, name)
        if other != name:
            raise RefusedParameter("dbc", f"messages '{other}' and '{name}' of {self.dbc.file} have one identifier")
        crc, everything = None, {field_of(role): self._roles.signals[role] for role in inside}
        alive = self._roles.in_every_frame(message, protected.alive, f"{place}.alive") if protected.alive else None
        if alive is not None:
            everything["alive"] = alive
        extra: list[Signal] = []
        if protected.profile != "none":
            try:
                ids = data_ids(protected.data_id, protected.profile, identifier)
            except DbcError as error:
                raise RefusedParameter(f"{place}.data_id", str(error)) from None
            crc_signal = self._roles.in_every_frame(message, protected.crc, f"{place}.crc")
            extra.append(crc_signal)
            try:
                by_identifier = not protected.data_id
                crc = Crc(message, crc_signal, alive, protected.profile, ids, by_identifier=by_identifier)
            except DbcError as error:
                raise RefusedParameter(f"{place}.crc", str(error)) from None
        elif protected.crc or protected.data_id:
            raise RefusedParameter(f"{place}.profile", "'none' is not allowed beside a CRC signal or data id")
        try:
            message = used_part(message, list({one.name: one for one in (*everything.values(), *extra)}.values()))
        except DbcError as error:
            raise RefusedParameter(f"wire.{inside[0]}.signal", str(error)) from None
        factors = {field_of(role): self._roles.factor(role) for role in inside if field_of(role) in UNITS}
        counts = alive_modulus(alive, protected.profile) if alive is not None else 0
        return Signals(message, identifier, everything, factors, self._roles.values(), counts, crc)

    def _parts(self) -> tuple[ReportFrames, ...]:
        found = dict.fromkeys(self.homes[role] for role in READINGS if role in self.homes)

        def rank(frames: ReportFrames) -> int:
            return 0 if frames is self.counting else 1 if count_modulus(frames) else 2

        return tuple(sorted(found, key=rank))

    def _common_modulus(self, parts: Sequence[ReportFrames | CommandFrames]) -> int:
        """Modulus of what the counts of these messages have in common; 0 if one of them has none."""
        moduli = [count_modulus(frames) for frames in parts]
        common = math.gcd(*moduli) if all(moduli) and len(parts) > 1 else 0
        if all(moduli) and len(parts) > 1 and common < _LEAST_COUNTS:
            names = " and ".join(f"'{one.signals.message.name}' to {count_modulus(one)}" for one in parts)
            text = f"frames that belong together have the same count, but {names} count otherwise"
            place = self._places[parts[-1].signals.message.name]
            raise RefusedParameter(
                f"{place}.alive", f"{text}; allowed: moduli with a common divisor >= {_LEAST_COUNTS}, or ''"
            )
        return common

    def _set_rates(self) -> None:
        sample_ms = self.sample.signals.message.cycle_time
        for frames in self.reports.values():
            if frames not in self.parts:
                cycle_ms = frames.signals.message.cycle_time
                frames.every = max(1, round(cycle_ms / sample_ms)) if sample_ms and cycle_ms else _USUAL_EVERY

    def _check_numbers(self) -> None:
        counts = self.parts[0].signals.counts("alive")
        if self.counting and self.counting not in self.parts and (not counts or self.number_modulus % counts):
            text = (
                f"'{self.counting.signals.message.name}' is not allowed without a count in the frames of 'x' that "
                "divides the counter's; allowed: the message of 'x', or give 'wire.protection.sample.alive'"
            )
            raise RefusedParameter("wire.counter.message", text)
        if self.sample_modulus and self.sample_modulus < _LEAST_COUNTS:
            name = self.parts[0].signals.message.name
            text = f"message '{name}' counts to {self.sample_modulus}; allowed: >= {_LEAST_COUNTS} counts"
            raise RefusedParameter("wire.counter.signal", text)
        if any("echo" in frames.signals.signals for frames in self.commands) and not self.number_modulus:
            raise RefusedParameter("wire.echo.signal", "needs a count of the samples: 'counter' or 'protection.sample'")
        if self.echo_modulus and self.number_modulus % self.echo_modulus:
            signal, message = self._roles.signals["echo"].name, self._roles.homes["echo"]
            text = (
                f"'{signal}' of message '{message}' counts to {self.echo_modulus}; allowed: a divisor of the "
                f"{self.number_modulus} of the samples"
            )
            raise RefusedParameter("wire.echo.signal", text)


def _choices(signal: Signal | None) -> Mapping[int, Any]:
    return (signal.choices if signal else None) or {}


def count_modulus(frames: ReportFrames | CommandFrames) -> int:
    """Of what counts these frames: the count of the samples if they have it, else that of the frames; 0 without."""
    return frames.signals.counts("counter") or frames.signals.counts("alive")


def make_wire(file: str, meaning: WireParameters, node: int, fd: bool) -> Wire:
    """The wire of the DBC ``file``, or without one of the package's own; raises RefusedParameter."""
    if file:
        return _made(file, _modified(file), meaning, node, fd)
    usual = to_mapping(WireParameters())
    for name, value in to_mapping(meaning).items():
        if value != usual[name]:
            raise RefusedParameter(f"wire.{name}", f"{value!r} is not allowed without a file in '{{group}}dbc'")
    return _made(FILE, 0, shipped_wire(fd), node, fd)


@lru_cache(maxsize=16)
def _made(file: str, modified: int, meaning: WireParameters, node: int, fd: bool) -> Wire:
    """A wire, made once as long as its file is not ``modified``."""
    try:
        dbc = Dbc(file)
    except DbcError as error:
        raise RefusedParameter("dbc", str(error)) from None
    return Wire(dbc, meaning, node, fd)


def _modified(file: str) -> int:
    try:
        return os.stat(os.path.expanduser(file)).st_mtime_ns
    except OSError:
        return 0
