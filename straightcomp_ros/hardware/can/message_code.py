"""Functions that pack and unpack the messages between board and host, generated from a DBC file and its meaning."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from straightcomp_ros.hardware.can.dbc_file import is_fd, limits, modulus
from straightcomp_ros.hardware.can.frames import UNITS, Amplifier, Command, FrameError, Report
from straightcomp_ros.hardware.can.protection import Crc
from straightcomp_ros.hardware.can.signal_code import Reading, Writing, compiled, in_page, pages, physical

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

_NEW = tuple.__new__
"""Makes a named tuple in half the time of the class's own constructor."""


@dataclass(frozen=True)
class Signals:
    """The signals of one message that mean something, by the field of :class:`Report` or :class:`Command`.

    ``factors`` gives for those with a physical value the factor to SI units; ``values`` for those that say something
    the raw value of each meaning; ``alive_modulus`` belongs to the field ``alive``.
    """

    message: Message
    identifier: int
    signals: Mapping[str, Signal]
    factors: Mapping[str, float]
    values: Mapping[str, Mapping[Any, int]]
    alive_modulus: int = 0
    crc: Crc | None = None

    @property
    def fd(self) -> bool:
        """Whether these are frames of CAN FD."""
        return is_fd(self.message)

    def counts(self, field: str) -> int:
        """Modulus of the counter in ``field``, 0 without one."""
        if field not in self.signals:
            return 0
        return self.alive_modulus if field == "alive" else modulus(self.signals[field])

    def span(self, field: str) -> tuple[float, float]:
        """Least and largest value in SI units that the signal of ``field`` can have."""
        signal, factor = self.signals[field], self.factors[field]
        ends = sorted((raw * signal.scale + signal.offset) * factor for raw in limits(signal))
        return ends[0], ends[1]

    def step(self, field: str) -> float:
        """Resolution of ``field`` in SI units; 0 for a float."""
        signal = self.signals[field]
        return 0.0 if signal.is_float else abs(signal.scale * self.factors[field])

    def _checks(self, reading: Reading) -> list[str]:
        lines = [f"if len(payload) != {self.message.length}: raise FrameError('length')"]
        if self.crc:
            lines.append(f"if {self.crc.sent} != {self.crc.computed}: raise FrameError('crc')")
        lines += reading.lines
        for field in ("alive", "counter"):
            if field in self.signals:
                signal, counts = self.signals[field], self.counts(field)
                lines.append(f"{field} = {self._raw(reading, field)}")
                if counts < 2**signal.length:
                    there = reading.shown[signal.name] and f"{field} is not None and "
                    lines.append(f"if {there}{field} >= {counts}: raise FrameError('alive')")
        return lines

    def _raw(self, reading: Reading, field: str) -> str:
        return reading.expression(self.signals[field], reading.raw[self.signals[field].name])

    def _value(self, reading: Reading, field: str) -> str:
        signal = self.signals[field]
        return reading.expression(signal, physical(signal, reading.raw[signal.name], self.factors[field]))

    def _compiled(self, reading: Reading, lines: Sequence[str], **names: Any) -> Callable[[bytes], Any]:
        known = {"FrameError": FrameError, "Report": Report, "Command": Command, "new": _NEW}
        return compiled("unpack", "payload", lines, {**reading.names, **self._crc_names(), **known, **names})

    def _crc_names(self) -> dict[str, Any]:
        return self.crc.names if self.crc else {}

    def unpacking(self, fields: Sequence[str]) -> Callable[[bytes], tuple[Any, ...]]:
        """The function from a payload to the values of ``fields``; it raises FrameError."""
        reading = Reading(self.message, list(self.signals.values()))
        values = [
            self._value(reading, field) if field in self.factors else self._raw(reading, field) for field in fields
        ]
        return self._compiled(reading, [*self._checks(reading), f"return {', '.join(values)},"])

    def unpacking_report(self, no_fault: int) -> Callable[[bytes], Report]:
        """The function from a payload to what the board reports; it raises FrameError.

        ``no_fault`` is the code of no fault.
        """
        reading = Reading(self.message, list(self.signals.values()))
        lines = self._checks(reading)
        values = {field: "None" for field in Report._fields} | {"good": "True"}
        for field in UNITS:
            if field in self.signals:
                values[field] = self._value(reading, field)
        for field in ("alive", "counter", "fault"):
            if field in self.signals:
                values[field] = field
        if "fault" in self.signals:
            lines.append(f"fault = {self._raw(reading, 'fault')}")
        names: dict[str, Any] = {}
        if "amplifier" in self.signals:
            lines += self._amplifier(reading, no_fault, names)
            values["amplifier"] = "amplifier"
        values["good"] = self._good(reading)
        lines.append(f"return new(Report, ({', '.join(values.values())}))")
        return self._compiled(reading, lines, **names)

    def _amplifier(self, reading: Reading, no_fault: int, names: dict[str, Any]) -> list[str]:
        signal, values = self.signals["amplifier"], self.values["amplifier"]
        names["amplifier_of"] = {raw: state for state, raw in values.items() if raw >= 0}.get
        names["other"] = Amplifier.OFF if values[Amplifier.OFF] < 0 else None
        names["FAULT"] = Amplifier.FAULT
        state = f"amplifier_of({reading.raw[signal.name]}, other)"
        if values[Amplifier.FAULT] < 0:
            state = f"(FAULT if fault != {no_fault} else {state})"
        shown = reading.shown[signal.name]
        there = f"({shown}) and " if shown else ""
        return [
            f"amplifier = {reading.expression(signal, state)}",
            f"if {there}amplifier is None: raise FrameError('state')",
        ]

    def _good(self, reading: Reading) -> str:
        """Whether both readings are good: the board says so, and they lie in the limits of the DBC file."""
        tests = []
        if "good" in self.signals:
            signal = self.signals["good"]
            tests.append(reading.expression(signal, f"{reading.raw[signal.name]} == {self.values['good'][True]}"))
        for field in ("x", "y"):
            if field in self.signals:
                signal = self.signals[field]
                least, largest = limits(signal)
                if signal.is_float or largest - least + 1 < 2**signal.length:
                    test = f"{least!r} <= {reading.raw[signal.name]} <= {largest!r}"
                    shown = reading.shown[signal.name]
                    tests.append(f"({test} if {shown} else True)" if shown else test)
        return " and ".join(tests) or "True"

    def unpacking_command(self) -> Callable[[bytes], Command]:
        """The function from a payload to a command; it raises FrameError."""
        reading = Reading(self.message, list(self.signals.values()))
        lines = self._checks(reading)
        values = dict.fromkeys(Command._fields, "None")
        if "current" in self.signals:
            values["current"] = self._value(reading, "current")
        if "echo" in self.signals:
            values["echo"] = reading.raw[self.signals["echo"].name]
        if "alive" in self.signals:
            values["alive"] = "alive"
        for field in ("enable", "reset"):
            if field in self.signals:
                no, yes = self.values[field][False], self.values[field][True]
                lines.append(f"{field} = {reading.raw[self.signals[field].name]}")
                lines.append(f"if {field} != {no} and {field} != {yes}: raise FrameError('pattern')")
                values[field] = f"{field} == {yes}"
        lines.append(f"return new(Command, ({', '.join(values.values())}))")
        return self._compiled(reading, lines)

    def packings(self, fields: Sequence[str]) -> list[Callable[[tuple[Any, ...]], bytes]]:
        """Functions from a tuple of ``fields`` to a payload, one for each page of a multiplexed message.

        They raise ValueError for a value that does not fit its signal.
        """
        signals = list(self.signals.values())
        return [self._packing(fields, page) for page in pages(self.message, signals)]

    def _packing(self, fields: Sequence[str], page: Mapping[str, int]) -> Callable[[tuple[Any, ...]], bytes]:
        shown = {field: one for field, one in self.signals.items() if in_page(self.message, one, page)}
        writing = Writing(
            self.message,
            {signal.name: field for field, signal in shown.items()},
            {signal.name: self.factors[field] for field, signal in shown.items() if field in self.factors},
            page,
        )
        names: dict[str, Any] = {**writing.names, **self._crc_names(), "refuse": self._refuse}
        lines = [f"{', '.join(fields)}, = values"]
        for field in shown:
            if field in self.values:
                lines.append(f"{field} = values_of_{field}[{field}]")
                names[f"values_of_{field}"] = sent_values(self.values[field])
        lines += writing.lines
        if self.crc:
            lines += [f"crc = {self.crc.computed}", f"return {self.crc.sealed}"]
        else:
            lines.append("return payload")
        return compiled("pack", "values", lines, names)

    def _refuse(self, name: str, value: float) -> NoReturn:
        field, signal = next((field, one) for field, one in self.signals.items() if one.name == name)
        ends = self.span(field) if field in self.factors else limits(signal)
        unit = f" {UNITS[field]}" if field in UNITS else ""
        raise ValueError(
            f"{field} of {value}{unit} does not fit signal '{name}' of message '{self.message.name}'; "
            f"allowed: {ends[0]:.9g} to {ends[1]:.9g}{unit}"
        )


def sent_values(values: Mapping[Any, int]) -> dict[Any, int]:
    """The raw value that says each meaning, also for those that have none of their own (-1).

    For "off" that is any that is free; for "fault", which the fault code says, that for "off".
    """
    free = next(raw for raw in range(len(values) + 1) if raw not in values.values())
    sent = {meaning: raw if raw >= 0 else free for meaning, raw in values.items()}
    return sent | {Amplifier.FAULT: sent[Amplifier.OFF]} if values.get(Amplifier.FAULT, 0) < 0 else sent
