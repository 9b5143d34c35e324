"""Which signal of a DBC file has which role between board and host, by the parameters `can.wire`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from straightcomp_ros.hardware.can.dbc_file import Dbc, DbcError, is_fd, limits
from straightcomp_ros.hardware.can.frames import UNITS, Amplifier
from straightcomp_ros.hardware.can.signal_code import refuse_signal, selectors
from straightcomp_ros.hardware.can.wire_parameters import ProtectedMessages, WireParameters
from straightcomp_ros.parameters.declaration import RefusedParameter

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

OF_BOARD = ("x", "y", "current", "counter", "good", "amplifier", "fault")
OF_HOST = ("command", "enable", "reset", "echo")
READINGS = ("x", "y", "good")
"""What a sample is not complete without, as far as the board has it."""
_NEEDED = ("x", "y", "amplifier", "command", "enable")
_SAYING = ("amplifier", "good", "enable", "reset")
"""Roles whose values have a meaning each."""
_COUNTS = (
    "wire.counter.signal",
    "wire.echo.signal",
    *(f"wire.protection.{part}.alive" for part in vars(ProtectedMessages())),
)
_LENGTHS = {"": 1.0, "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}
_CURRENTS = {"": 1.0, "A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6, "μA": 1e-6}
_FACTORS = {"m": _LENGTHS, "A": _CURRENTS}
"""By the SI unit of a field the units that a DBC file may have for it, with their factors."""
_FIELDS = {"command": "current", "heartbeat": "state"}


def field_of(role: str) -> str:
    """The field of a report, a command or a heartbeat that has the signal of a role."""
    return _FIELDS.get(role, role)


class Roles:
    """The signals of a board by their roles.

    Attributes:
        signals: signal of each role that the board has.
        homes: name of the message of each of these.

    Raises:
        RefusedParameter: file and meaning do not fit together; the names begin with ``wire.``.
    """

    def __init__(self, dbc: Dbc, meaning: WireParameters, fd: bool) -> None:
        self._dbc, self._meaning, self._fd = dbc, meaning, fd
        found = {role: self._signal(role) for role in (*OF_BOARD, *OF_HOST)}
        for role in _NEEDED:
            if found[role] is None:
                raise RefusedParameter(f"wire.{role}.signal", "'' is not allowed; the driver needs this signal")
        if meaning.heartbeat.message:
            found["heartbeat"] = self._signal("heartbeat")
        self.signals = {role: signal for role, signal in found.items() if signal is not None}
        self.homes = {role: self.message(role).name for role in self.signals}
        self._check_homes()
        self._check_values()

    def message(self, role: str) -> Message:
        """The message of a role: its own, or that of x or the command."""
        main = "command" if role in OF_HOST else "x"
        name = self._named(role).message or self._named(main).message
        where = role if self._named(role).message else main
        try:
            message = self._dbc.message(name)
        except DbcError as error:
            raise RefusedParameter(f"wire.{where}.message", str(error)) from None
        if is_fd(message) and not self._fd:
            text = f"'{name}' of {self._dbc.file} is a message of CAN FD; allowed: others ('{{group}}fd' is false)"
            raise RefusedParameter(f"wire.{where}.message", text)
        return message

    def find(self, message: Message, name: str, parameter: str) -> Signal:
        """The signal ``name`` that ``parameter`` asks for."""
        try:
            signal = self._dbc.signal(message, name)
            refuse_signal(message, signal)
        except DbcError as error:
            raise RefusedParameter(parameter, str(error)) from None
        if parameter in _COUNTS and (signal.is_signed or signal.is_float):
            text = f"'{name}' of message '{message.name}' is signed or a float; allowed: an unsigned integer"
            raise RefusedParameter(parameter, text)
        return signal

    def in_every_frame(self, message: Message, name: str, parameter: str) -> Signal:
        """As :meth:`find`, for a signal that must not be multiplexed."""
        signal = self.find(message, name, parameter)
        if selectors(message, signal):
            text = f"'{name}' of message '{message.name}' is multiplexed; allowed: a signal that is in every frame"
            raise RefusedParameter(parameter, text)
        return signal

    def factor(self, role: str) -> float:
        """From the file's unit of the role's signal to SI units, with the factor that the parameters give."""
        factor: float = self._named(role).factor
        if factor == 0.0:
            raise RefusedParameter(f"wire.{role}.factor", "0.0 is not allowed; allowed: any other number")
        signal, known = self.signals[role], _FACTORS[UNITS[field_of(role)]]
        given: str = self._named(role).unit
        unit = given or signal.unit or ""
        if unit not in known:
            place = f"'{signal.name}' of message '{self.homes[role]}'"
            text = f"{place} is in '{unit}'; allowed: {', '.join(known)[2:]}, or no unit for SI"
            if given:
                raise RefusedParameter(f"wire.{role}.unit", text)
            raise RefusedParameter(f"wire.{role}.signal", f"{text}; 'wire.{role}.unit' says what another spelling is")
        return known[unit] * factor

    def values(self) -> dict[str, Mapping[Any, int]]:
        """For each role that says something the raw value of each meaning."""
        amplifier = self._meaning.amplifier
        values: dict[str, Mapping[Any, int]] = {
            role: {False: self._named(role).no_value, True: self._named(role).yes_value} for role in _SAYING[1:]
        }
        values["amplifier"] = {
            Amplifier.OFF: amplifier.off_value,
            Amplifier.ON: amplifier.on_value,
            Amplifier.FAULT: amplifier.fault_value,
        }
        return values

    def _named(self, role: str) -> Any:
        return getattr(self._meaning, role)

    def _signal(self, role: str) -> Signal | None:
        named = self._named(role)
        if not named.signal:
            if named.message and role not in ("x", "command"):
                raise RefusedParameter(f"wire.{role}.signal", f"'' is not allowed beside message '{named.message}'")
            return None
        return self.find(self.message(role), named.signal, f"wire.{role}.signal")

    def _check_homes(self) -> None:
        homes = self.homes
        of_board = {homes[role] for role in homes if role not in OF_HOST}
        for role in OF_HOST:
            if homes.get(role) in of_board:
                where = role if self._named(role).message else "command"
                text = f"'{homes[role]}' is a message of the board already; allowed: one that the host sends"
                raise RefusedParameter(f"wire.{where}.message", text)
        if "heartbeat" in homes and homes["heartbeat"] in (homes[role] for role in homes if role != "heartbeat"):
            text = f"'{homes['heartbeat']}' has other signals of the board; allowed: a message of its own"
            raise RefusedParameter("wire.heartbeat.message", text)
        readings = {homes[role] for role in READINGS if role in homes}
        # Frames of several messages belong together by their counts, so that each sample must have one of each.
        page = self._page("x") if len(readings) == 1 else []
        of_sample = [role for role in (*READINGS, "counter") if homes.get(role) in readings]
        for role, wanted in (
            *((role, page) for role in of_sample),
            *((role, []) for role in OF_HOST if role in homes),
        ):
            if self._page(role) != wanted:
                place = f"'{self.signals[role].name}' of message '{homes[role]}'"
                text = f"{place} is not in all frames that it must be in; allowed: one that is"
                raise RefusedParameter(f"wire.{role}.signal", text)

    def _page(self, role: str) -> list[tuple[Signal, list[int]]]:
        """The multiplexer pages that have the role's signal."""
        return selectors(self.message(role), self.signals[role])

    def _check_values(self) -> None:
        signals = self.signals
        for role in (role for role in (*_SAYING, "heartbeat") if role in signals):
            named, (least, largest) = self._named(role), limits(signals[role])
            for name in (name for name in vars(named) if name.endswith("_value")):
                raw = getattr(named, name)
                # -1 says of the amplifier's states that they have no value of their own.
                if not least <= raw <= largest and not (role == "amplifier" and raw == -1 and name != "on_value"):
                    text = f"{raw} does not fit signal '{signals[role].name}' of message '{self.homes[role]}'"
                    raise RefusedParameter(f"wire.{role}.{name}", f"{text}; allowed: {least} to {largest}")
        if self._meaning.amplifier.fault_value < 0:
            message = self.message("amplifier")
            if self.homes.get("fault") != message.name or self._page("fault") != self._page("amplifier"):
                text = "-1 needs a signal for 'fault' in the same frames as the amplifier's"
                raise RefusedParameter("wire.amplifier.fault_value", text)
