"""The messages between a board and its host, as a DBC file and the parameters `can.wire` describe them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from straightcomp_ros.hardware.can.dbc_file import Dbc, DbcError, is_fd, modulus
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault
from straightcomp_ros.hardware.can.message_code import Signals
from straightcomp_ros.hardware.can.message_frames import CommandFrames, HeartbeatFrames, ReportFrames
from straightcomp_ros.hardware.can.protection import Crc, ProtectionParameters, alive_modulus, data_ids
from straightcomp_ros.hardware.can.shipped_wire import FILE, shipped_wire
from straightcomp_ros.hardware.can.signal_code import selectors
from straightcomp_ros.hardware.can.wire_parameters import WireParameters
from straightcomp_ros.settings.declaration import RefusedParameter, to_mapping

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_LENGTHS = {"": 1.0, "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}
_CURRENTS = {"": 1.0, "A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6, "μA": 1e-6}
_UNITS = {"x": _LENGTHS, "y": _LENGTHS, "current": _CURRENTS, "command": _CURRENTS}
_OF_BOARD = ("x", "y", "current", "counter", "good", "amplifier", "fault")
_OF_HOST = ("command", "enable", "reset", "echo")
_NEEDED = ("x", "y", "amplifier", "command", "enable")
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
        sample: the frames with x and y.
        reports: all frames of the board but the heartbeat, by identifier.
        counting: frames with the sample's number: ``sample``, others, or None.
        status: frames with the amplifier's state.
        heartbeat: None for a board without.

    Raises:
        RefusedParameter: file and meaning do not fit together; the names begin with ``wire.``.
    """

    def __init__(self, dbc: Dbc, meaning: WireParameters, node: int = 1, fd: bool = True) -> None:
        self.dbc, self.meaning = dbc, meaning
        self._node, self._fd = node, fd
        found = {role: self._signal(role) for role in (*_OF_BOARD, *_OF_HOST)}
        for role in _NEEDED:
            if found[role] is None:
                raise RefusedParameter(f"wire.{role}.signal", "'' is not allowed; the driver needs this signal")
        signals = {role: signal for role, signal in found.items() if signal is not None}
        homes = {role: self._message(role).name for role in signals}
        self._check_homes(homes, signals)
        protection = self._protections(homes)
        reports: dict[str, ReportFrames] = {}
        for name, protected in protection.items():
            if name == homes["command"]:
                continue
            inside = {role: signals[role] for role in _OF_BOARD if homes.get(role) == name}
            reports[name] = ReportFrames(self._signals(name, inside, *protected), meaning.fault.none_value)
        self.sample, self.status = reports[homes["x"]], reports[homes["amplifier"]]
        self.counting = reports[homes["counter"]] if "counter" in homes else None
        self.reports: Mapping[int, ReportFrames] = {frames.identifier: frames for frames in reports.values()}
        commands = {"current" if role == "command" else role: signals[role] for role in _OF_HOST if role in signals}
        self.command = CommandFrames(self._signals(homes["command"], commands, *protection[homes["command"]]))
        self.heartbeat = self._heartbeat()
        self._fault_words = {int(raw): str(words) for raw, words in _choices(signals.get("fault")).items()}
        self._set_rates()
        self._check_numbers()

    @property
    def identifiers(self) -> list[int]:
        """Of all frames that the board sends."""
        return [*self.reports, *([self.heartbeat.identifier] if self.heartbeat else [])]

    @property
    def sample_modulus(self) -> int:
        """Of the count in each sample's own frame, by which samples are numbered; 0 if there is none."""
        return self.sample.signals.counts("counter") or self.sample.signals.counts("alive")

    @property
    def number_modulus(self) -> int:
        """Of the numbers of samples that board and host agree on; 0 if there are none."""
        return self.counting.signals.counts("counter") if self.counting else self.sample_modulus

    @property
    def echo_modulus(self) -> int:
        """Of the echo in a command; 0 for a command without."""
        counts = self.command.signals.counts("echo")
        return min(counts, self.number_modulus)

    def fault_words(self, code: int) -> str:
        """What the DBC file calls a fault code of the board."""
        return self._fault_words.get(code, f"fault {code}")

    def fault_code(self, fault: BoardFault) -> int:
        """The board's code of a fault: that with its name in the DBC file, else its number as far as it fits."""
        for raw, words in self._fault_words.items():
            if words.lower().replace("_", " ") == fault.words:
                return raw
        if fault is BoardFault.NONE:
            return self.meaning.fault.none_value
        signal = self._signal("fault")
        return min(int(fault), modulus(signal) - 1) if signal else 0

    def _named(self, role: str) -> Any:
        return getattr(self.meaning, role)

    def _message(self, role: str) -> Message:
        main = "command" if role in _OF_HOST else "x"
        name = self._named(role).message or self._named(main).message
        where = role if self._named(role).message else main
        try:
            message = self.dbc.message(name)
        except DbcError as error:
            raise RefusedParameter(f"wire.{where}.message", str(error)) from None
        if is_fd(message) and not self._fd:
            text = f"'{name}' of {self.dbc.file} is a message of CAN FD; allowed: others ('{{group}}fd' is false)"
            raise RefusedParameter(f"wire.{where}.message", text)
        return message

    def _signal(self, role: str) -> Signal | None:
        named = self._named(role)
        if not named.signal:
            if named.message and role not in ("x", "command"):
                raise RefusedParameter(f"wire.{role}.signal", f"'' is not allowed beside message '{named.message}'")
            return None
        return self._find(self._message(role), named.signal, f"wire.{role}.signal")

    def _find(self, message: Message, name: str, parameter: str) -> Signal:
        try:
            return self.dbc.signal(message, name)
        except DbcError as error:
            raise RefusedParameter(parameter, str(error)) from None

    def _check_homes(self, homes: Mapping[str, str], signals: Mapping[str, Signal]) -> None:
        for role, main, why in (
            ("y", "x", "both readings of a sample come in one frame"),
            ("good", "x", "it must belong to the readings"),
            *((role, "command", "the host sends one message") for role in _OF_HOST[1:]),
        ):
            if role in homes and homes[role] != homes[main]:
                text = f"'{homes[role]}' is not allowed; allowed: '{homes[main]}', as '{{group}}wire.{main}': {why}"
                raise RefusedParameter(f"wire.{role}.message", text)
        if homes["command"] in (homes[role] for role in homes if role in _OF_BOARD):
            raise RefusedParameter("wire.command.message", f"'{homes['command']}' is a message of the board already")
        for role in _OF_HOST:
            if role in signals and selectors(self._message(role), signals[role]):
                text = f"'{signals[role].name}' is multiplexed; allowed: a signal that is in every frame"
                raise RefusedParameter(f"wire.{role}.signal", text)
        message = self._message("amplifier")
        together = homes.get("fault") == homes["amplifier"]
        together = together and selectors(message, signals["fault"]) == selectors(message, signals["amplifier"])
        if self.meaning.amplifier.fault_value < 0 and not together:
            text = "-1 needs a signal for 'fault' in the same frames as the amplifier's"
            raise RefusedParameter("wire.amplifier.fault_value", text)

    def _protections(self, homes: Mapping[str, str]) -> dict[str, tuple[str, ProtectionParameters]]:
        """For each message by name where its protection is described, and how."""
        found: dict[str, tuple[str, ProtectionParameters]] = {}
        for part, roles in (
            ("sample", ("x",)),
            ("status", ("amplifier", "fault")),
            ("current", ("current", "counter")),
            ("command", ("command",)),
        ):
            protected = getattr(self.meaning.protection, part)
            names = {homes[role] for role in roles if role in homes} - set(found)
            if not names and protected != ProtectionParameters():
                text = "is given, but the signals are in a message that is protected by another part"
                raise RefusedParameter(f"wire.protection.{part}", text)
            found |= {name: (part, protected) for name in names}
        return found

    def _signals(self, name: str, inside: Mapping[str, Signal], part: str, protected: ProtectionParameters) -> Signals:
        message = self.dbc.message(name)
        place = f"wire.protection.{part}"
        try:
            identifier = self.dbc.identifier(message, self._node)
        except DbcError as error:
            raise RefusedParameter("node", str(error)) from None
        crc, everything = None, dict(inside)
        alive = self._find(message, protected.alive, f"{place}.alive") if protected.alive else None
        if alive is not None:
            everything["alive"] = alive
        if protected.profile != "none":
            try:
                ids = data_ids(protected.data_id, protected.profile, identifier)
            except DbcError as error:
                raise RefusedParameter(f"{place}.data_id", str(error)) from None
            crc_signal = self._find(message, protected.crc, f"{place}.crc")
            try:
                crc = Crc(message, crc_signal, alive, protected.profile, ids)
            except DbcError as error:
                raise RefusedParameter(f"{place}.crc", str(error)) from None
        elif protected.crc or protected.data_id:
            raise RefusedParameter(f"{place}.profile", "'none' is not allowed beside a CRC signal or data id")
        factors = {role: self._factor(role, part) for role in inside if role in ("x", "y", "current")}
        counts = alive_modulus(alive, protected.profile) if alive is not None else 0
        return Signals(message, identifier, everything, factors, self._values(), counts, crc)

    def _factor(self, field: str, part: str) -> float:
        """From the file's unit to SI units, with the factor that the parameters give."""
        role = "command" if part == "command" else field
        signal = self._signal(role)
        unit, known = (signal.unit or "") if signal else "", _UNITS[role]
        factor: float = self._named(role).factor
        if unit not in known or factor == 0.0:
            if factor == 0.0:
                raise RefusedParameter(f"wire.{role}.factor", "0.0 is not allowed; allowed: any other number")
            text = f"'{self._named(role).signal}' is in '{unit}'; allowed: {', '.join(known)[2:]}, or no unit for SI"
            raise RefusedParameter(f"wire.{role}.signal", text)
        return known[unit] * factor

    def _values(self) -> dict[str, Mapping[Any, int]]:
        amplifier = self.meaning.amplifier
        values: dict[str, Mapping[Any, int]] = {
            role: {False: self._named(role).no_value, True: self._named(role).yes_value}
            for role in ("good", "enable", "reset")
        }
        values["amplifier"] = {
            Amplifier.OFF: amplifier.off_value,
            Amplifier.ON: amplifier.on_value,
            Amplifier.FAULT: amplifier.fault_value,
        }
        return values

    def _heartbeat(self) -> HeartbeatFrames | None:
        named = self.meaning.heartbeat
        if not named.message:
            return None
        signals = self._signals(
            self._message("heartbeat").name, {"fault": self._signal("heartbeat")}, "", ProtectionParameters()
        )
        return HeartbeatFrames(signals, named.boot_up_value, named.operational_value)

    def _set_rates(self) -> None:
        sample_ms = self.sample.signals.message.cycle_time
        for frames in self.reports.values():
            if frames is not self.sample:
                cycle_ms = frames.signals.message.cycle_time
                frames.every = max(1, round(cycle_ms / sample_ms)) if sample_ms and cycle_ms else _USUAL_EVERY

    def _check_numbers(self) -> None:
        counts = self.sample.signals.counts("alive")
        if self.counting and self.counting is not self.sample and (not counts or self.number_modulus % counts):
            text = (
                f"'{self.counting.signals.message.name}' is not allowed without a count in the frames of 'x' that "
                "divides the counter's; allowed: the message of 'x', or give 'wire.protection.sample.alive'"
            )
            raise RefusedParameter("wire.counter.message", text)
        if self.sample_modulus and self.sample_modulus < _LEAST_COUNTS:
            text = f"counts to {self.sample_modulus}; allowed: >= {_LEAST_COUNTS} counts"
            raise RefusedParameter("wire.counter.signal", text)
        if self.command.signals.counts("echo") and not self.number_modulus:
            raise RefusedParameter("wire.echo.signal", "needs a count of the samples: 'counter' or 'protection.sample'")
        if self.echo_modulus and self.number_modulus % self.echo_modulus:
            text = f"counts to {self.echo_modulus}, which does not divide the {self.number_modulus} of the samples"
            raise RefusedParameter("wire.echo.signal", text)


def _choices(signal: Signal | None) -> Mapping[int, Any]:
    return (signal.choices if signal else None) or {}


@lru_cache(maxsize=16)
def make_wire(file: str, meaning: WireParameters, node: int, fd: bool) -> Wire:
    """The wire of the DBC ``file``, or without one of the package's own; raises RefusedParameter."""
    if not file:
        given = to_mapping(meaning)
        usual = to_mapping(WireParameters())
        for name, value in given.items():
            if value != usual[name]:
                raise RefusedParameter(f"wire.{name}", f"{value!r} is not allowed without a file in '{{group}}dbc'")
        return Wire(Dbc(FILE), shipped_wire(fd), node, fd)
    try:
        dbc = Dbc(file)
    except DbcError as error:
        raise RefusedParameter("dbc", str(error)) from None
    return Wire(dbc, meaning, node, fd)
