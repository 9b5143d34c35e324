"""A board's DBC file and the meaning of its signals: the frames between board and host, and what they leave open.

Each signal that means something has a role, whose parameters in `can.wire` name it. :class:`Wire` has the frames with
these signals; file and meaning that do not fit together are refused with the parameter, the signal and the rule.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from straightcomp_ros.hardware.can.can_parameters import READINGS, ProtectionParameters, WireParameters
from straightcomp_ros.hardware.can.dbc_file import (
    Dbc,
    DbcError,
    is_fd,
    limits,
    refuse_signal,
    selectors,
    used_signals,
)
from straightcomp_ros.hardware.can.frames import (
    UNITS,
    BoardFault,
    Command,
    Crc,
    Frames,
    Report,
    data_ids,
)
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.parameters.declaration import RefusedParameter

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

OF_BOARD = ("x", "y", "current", "counter", "good", "amplifier", "fault", "referenced")
OF_HOST = ("command", "enable", "reset", "echo")
_NEEDED = ("x", "y", "amplifier", "command", "enable")
_SWITCHES = ("good", "referenced", "enable", "reset")
_PROTECTED = {
    "sample": ("x",),
    "y": ("y",),
    "good": ("good",),
    "status": ("amplifier", "fault"),
    "current": ("current", "counter", "referenced"),
    **{role: (role,) for role in OF_HOST},
}
"""By the group of `wire.protection` the roles whose message it describes, if no group before it does."""
_COUNTS = ("wire.counter.signal", "wire.echo.signal", *(f"wire.protection.{group}.alive" for group in _PROTECTED))
_CODED = ("amplifier", *_SWITCHES, "heartbeat", "fault")
"""Roles of signals whose raw values have meanings."""
_FACTORS = {
    "m": {"": 1.0, "m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9},
    "A": {"": 1.0, "A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6, "μA": 1e-6},
}
"""By the SI unit of a field the units that a DBC file may have for it, with their factors."""
_FIELDS = {"command": "current", "heartbeat": "state"}
"""The field of a report, a command or a heartbeat, where it is not called as the role."""
_LEAST_FACTOR = 1e-12
_LEAST_COUNTS = 4
_USUAL_EVERY = 10
"""Samples between two of the slower frames, where the DBC file does not say it."""
_HEARTBEAT_PERIOD = 0.05
"""s, where the DBC file does not say it."""


@contextlib.contextmanager
def _naming(parameter: str) -> Iterator[None]:
    """What the DBC file refuses is refused by the name of ``parameter``."""
    try:
        yield
    except DbcError as error:
        raise RefusedParameter(parameter, str(error)) from None


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
        signals: by their roles.
        homes: the board's frames by the role of each of their signals.
        commands: all frames of the host, in the order of sending: those with the current last.
        command: those with the current.
        command_modulus: as ``part_modulus``, of the frames of a command.
        current: frames with the measured current; None for a board without.
        heartbeat: None for a board without.
        sample_modulus: of the count in each sample's own frames, by which samples are numbered; 0 without one.
        number_modulus: of the numbers of samples that board and host agree on; 0 without any.
        echo_modulus: of the echo in a command; 0 for a command without.
        fault_codes: the board's code of each fault: that with its name in the DBC file, else its number, else the
            signal's largest or least value; never the one that says no fault.

    Raises:
        RefusedParameter: file and meaning do not fit together; the names begin with ``wire.``.
    """

    def __init__(self, dbc: Dbc, meaning: WireParameters, node: int, fd: bool) -> None:
        self.dbc, self.meaning, self.fd, self.node = dbc, meaning, fd, node
        self._groups: dict[str, str] = {}
        """By message the group of parameters that describes its protection."""
        self._taken: dict[int, str] = {}
        self._users: dict[tuple[str, str], str] = {}
        """By message and signal the parameter that names it."""
        self.signals = signals = self._signals_of_roles()
        self._names = names = {role: self._message(role).name for role in signals}
        self._pages = {role: selectors(self._message(role), signal) for role, signal in signals.items()}
        self._check_messages()
        self._check_values()
        protections = self._protections()
        of_board, of_host = (
            {
                name: self._frames(name, [role for role in roles if names.get(role) == name], *protections[name], kind)
                for name in dict.fromkeys(names[role] for role in order if role in names)
            }
            # What is sent last is the command, which is said first.
            for roles, order, kind in ((OF_BOARD, OF_BOARD, Report), (OF_HOST, OF_HOST[::-1], Command))
        )
        self.homes = {role: of_board[names[role]] for role in OF_BOARD if role in names}
        self.sample, self.current = self.homes["x"], self.homes.get("current")
        self.counting = self.homes.get("counter")
        self.reports: Mapping[int, Frames] = {
            of_board[name].identifier: of_board[name] for name in protections if name in of_board
        }
        self.command = of_host.pop(names["command"])
        self.commands = *of_host.values(), self.command
        parts = dict.fromkeys(self.homes[role] for role in READINGS if role in names)
        self.parts = (*sorted(parts, key=lambda one: 0 if one is self.counting else 1 if one.sample_modulus else 2),)
        self.part_modulus, self.command_modulus = self._common_modulus(self.parts), self._common_modulus(self.commands)
        self.heartbeat: Frames | None = None
        if "heartbeat" in signals:
            self.heartbeat = self._frames(names["heartbeat"], ["heartbeat"], "", ProtectionParameters(), None)
            self.heartbeat.period = self.heartbeat.period or _HEARTBEAT_PERIOD
        self.sample_modulus = self.parts[0].sample_modulus
        self.number_modulus = self.counting.counts("counter") if self.counting else self.sample_modulus
        self.echo_modulus = min(max(frames.counts("echo") for frames in self.commands), self.number_modulus)
        choices = signals["fault"].choices if "fault" in signals else None
        self._fault_words = {int(raw): str(words) for raw, words in (choices or {}).items()}
        self.fault_codes = {fault: self._fault_code(fault) for fault in BoardFault}
        for frames in self.reports.values():
            if frames not in self.parts:
                every = frames.period / self.sample.period if self.sample.period and frames.period else _USUAL_EVERY
                frames.every = max(1, round(every))
        self._check_numbers()

    @property
    def identifiers(self) -> list[int]:
        """Of all frames that the board sends."""
        return [*self.reports, *([self.heartbeat.identifier] if self.heartbeat else [])]

    def intervals(self, rate: float) -> tuple[float, float]:
        """Times in s, at a ``rate`` in Hz, from one state of the amplifier to the next, and from one heartbeat to the
        next: 0 without."""
        frames, period = self.homes["amplifier"], 1.0 / rate
        turns = len(frames.pages) if self._pages["amplifier"] else 1
        state = turns * (period if frames in self.parts else max(frames.period, frames.every * period))
        return state, self.heartbeat.period if self.heartbeat else 0.0

    def noise(self, axis: str, resolution: float) -> float:
        """Difference in m that two readings of ``x`` or ``y`` may have at rest: two counts, of the frame or a coarser
        encoder with this ``resolution``, and half a one for the rounding of numbers in metres."""
        return 2.5 * max(self.homes[axis].step(axis), resolution)

    def source(self) -> str:
        """Name of the DBC file, and a checksum of it with the meaning: by it a firmware knows whether it has these
        frames."""
        content = self.dbc.path.read_bytes() + repr(sorted(self.meaning.given.items())).encode()
        # It stands in texts of C.
        name = re.sub(r"[^A-Za-z0-9._-]", "_", self.dbc.path.name)
        return f"{name} {hashlib.sha256(content).hexdigest()[:12]}"

    def fault_words(self, code: int) -> str:
        """What the DBC file calls a fault code of the board."""
        return self._fault_words.get(code, f"fault {code}")

    def _fault_code(self, fault: BoardFault) -> int:
        signal, none = self.signals.get("fault"), self.meaning.fault.none_value
        if signal is None:
            return 0
        if fault is BoardFault.NONE:
            return none
        named = [
            raw for raw, words in self._fault_words.items() if words.lower().replace(" ", "_") == fault.name.lower()
        ]
        least, largest = map(int, limits(signal))
        for code in (*named, int(fault), largest, least):
            if least <= code <= largest and code != none:
                return code
        text = f"{self._place('fault')} holds {none} only, which says no fault; allowed: a signal with another value"
        raise RefusedParameter("wire.fault.signal", text)

    def _signals_of_roles(self) -> dict[str, Signal]:
        found: dict[str, Signal] = {}
        for role in (*OF_BOARD, *OF_HOST, "heartbeat"):
            named, parameter = getattr(self.meaning, role), f"wire.{role}.signal"
            if named.signal if role != "heartbeat" else named.message:
                found[role] = self._find(self._message(role), named.signal, parameter)
            elif role in _NEEDED:
                raise RefusedParameter(parameter, "'' is not allowed; the driver needs this signal")
            elif role != "heartbeat" and named.message:
                raise RefusedParameter(parameter, f"'' is not allowed with message '{named.message}'")
        return found

    def _role_of_message(self, role: str) -> str:
        """The role whose parameters name the message of ``role``: its own, or that of x or the command."""
        main = "command" if role in OF_HOST else "x"
        return role if getattr(self.meaning, role).message else main

    def _message(self, role: str) -> Message:
        parameter = f"wire.{self._role_of_message(role)}.message"
        name = getattr(self.meaning, self._role_of_message(role)).message
        with _naming(parameter):
            message = self.dbc.message(name)
        if is_fd(message) and not self.fd:
            text = f"'{name}' of {self.dbc.file} is a message of CAN FD; allowed: others ('{{group}}fd' is false)"
            raise RefusedParameter(parameter, text)
        return message

    def _find(self, message: Message, name: str, parameter: str, *, in_every_frame: bool = False) -> Signal:
        """The signal ``name`` that ``parameter`` asks for."""
        with _naming(parameter):
            signal = self.dbc.signal(message, name)
            refuse_signal(message, signal)
        place = f"'{name}' of message '{message.name}'"
        if parameter in {f"wire.{role}.signal" for role in _CODED} and signal.is_float:
            raise RefusedParameter(parameter, f"{place} is a float; allowed: an integer")
        if parameter in _COUNTS and (signal.is_signed or signal.is_float):
            raise RefusedParameter(parameter, f"{place} is signed or a float; allowed: an unsigned integer")
        if parameter in _COUNTS and limits(signal)[0] != 0:
            raise RefusedParameter(parameter, f"{place} counts from {limits(signal)[0]}; allowed: from 0")
        if in_every_frame and selectors(message, signal):
            raise RefusedParameter(parameter, f"{place} is multiplexed; allowed: a signal that is in every frame")
        # A frame is packed signal by signal: of two meanings one would not be sent.
        other = self._users.setdefault((message.name, name), parameter)
        if other != parameter:
            raise RefusedParameter(parameter, f"{place} is that of '{other}' too; allowed: a signal of its own")
        return signal

    def _check_messages(self) -> None:
        names = self._names
        of_board = {names[role] for role in names if role not in OF_HOST}
        for role in OF_HOST:
            if names.get(role) in of_board:
                text = f"'{names[role]}' is a message of the board already; allowed: one that the host sends"
                raise RefusedParameter(f"wire.{self._role_of_message(role)}.message", text)
        if names.get("heartbeat") in [names[role] for role in names if role != "heartbeat"]:
            text = f"'{names['heartbeat']}' has other signals of the board; allowed: a message of its own"
            raise RefusedParameter("wire.heartbeat.message", text)
        readings = {names[role] for role in READINGS if role in names}
        # Frames of several messages belong together by their counts, so that each sample must have one of each.
        page = self._pages["x"] if len(readings) == 1 else []
        wanted = {role: page for role in (*READINGS, "counter") if names.get(role) in readings}
        wanted |= {role: [] for role in OF_HOST if role in names}
        for role, own in wanted.items():
            if self._pages[role] != own:
                text = "is not in all frames that it must be in; allowed: one that is"
                raise RefusedParameter(f"wire.{role}.signal", f"{self._place(role)} {text}")

    def _check_values(self) -> None:
        for role in (role for role in _CODED if role in self.signals):
            named, (least, largest) = getattr(self.meaning, role), limits(self.signals[role])
            for name in (name for name in vars(named) if name.endswith("_value")):
                raw = getattr(named, name)
                # -1 says of the amplifier's states but "on" that they have no value of their own.
                if not least <= raw <= largest and not (role == "amplifier" and raw == -1):
                    text = f"{raw} does not fit signal {self._place(role)}; allowed: {least} to {largest}"
                    raise RefusedParameter(f"wire.{role}.{name}", text)
        for role in (role for role in ("amplifier", *_SWITCHES) if role in self.signals):
            values, (least, largest) = self._values()[role], limits(self.signals[role])
            given = [raw for raw in values.values() if raw != -1]
            if len(set(given)) < len(given):
                text = f"{self._place(role)} has one value for two meanings: {given}; allowed: different ones"
                raise RefusedParameter(f"wire.{role}", text)
            if values.get(State.OFF) == -1 and len(given) > largest - least:
                text = f"-1 leaves no value of {self._place(role)} for off; allowed: a signal with more than {given}"
                raise RefusedParameter("wire.amplifier.off_value", text)
        if self.meaning.amplifier.fault_value < 0:
            together = self._names.get("fault") == self._names["amplifier"]
            if not together or self._pages["fault"] != self._pages["amplifier"]:
                text = "-1 needs a signal for 'fault' in the same frames as the amplifier's"
                raise RefusedParameter("wire.amplifier.fault_value", text)

    def _place(self, role: str) -> str:
        return f"'{self.signals[role].name}' of message '{self._names[role]}'"

    def _protections(self) -> dict[str, tuple[str, ProtectionParameters]]:
        """For each message by name the group that describes its protection, and how."""
        found: dict[str, tuple[str, ProtectionParameters]] = {}
        for group, roles in _PROTECTED.items():
            protected = getattr(self.meaning.protection, group)
            names = [self._names[role] for role in roles if self._names.get(role) not in (None, *found)]
            if not names and protected != ProtectionParameters():
                text = "is given, but the signals are in a message that another group protects"
                raise RefusedParameter(f"wire.protection.{group}", text)
            found |= {name: (group, protected) for name in names}
        return found

    def _frames(
        self, name: str, inside: Sequence[str], group: str, protected: ProtectionParameters, kind: Any
    ) -> Frames:
        """The frames of the message ``name``: the signals of the roles ``inside``, and their protection."""
        message = self.dbc.message(name)
        self._groups[name] = place = f"wire.protection.{group}"
        with _naming("node"):
            identifier = self.dbc.identifier(message, self.node)
        other = self._taken.setdefault(identifier, name)
        if other != name:
            raise RefusedParameter("dbc", f"messages '{other}' and '{name}' of {self.dbc.file} have one identifier")
        fields = {_FIELDS.get(role, role): self.signals[role] for role in inside}
        alive, used, crc = None, list(fields.values()), None
        if protected.alive:
            alive = fields["alive"] = self._find(message, protected.alive, f"{place}.alive", in_every_frame=True)
            used.append(alive)
        if protected.profile != "none":
            with _naming(f"{place}.data_id"):
                ids = data_ids(protected.data_id, protected.profile, identifier)
            used.append(self._find(message, protected.crc, f"{place}.crc", in_every_frame=True))
            with _naming(f"{place}.crc"):
                crc = Crc(message, used[-1], alive, protected.profile, ids, by_identifier=not protected.data_id)
        elif protected.crc or protected.data_id:
            raise RefusedParameter(f"{place}.profile", "'none' is not allowed with a CRC signal or data id")
        with _naming(f"wire.{inside[0]}.signal"):
            message = used_signals(message, list({one.name: one for one in used}.values()))
        factors = {_FIELDS.get(role, role): self._factor(role) for role in inside if _FIELDS.get(role, role) in UNITS}
        code = self.signals.get("fault")
        no_fault = self.meaning.fault.none_value & (1 << code.length) - 1 if code else 0
        wraps = self.meaning.x_wraps
        if wraps and "x" in fields and fields["x"].is_float:
            raise RefusedParameter("wire.x_wraps", f"{self._place('x')} is a float; allowed: false")
        return Frames(message, identifier, fields, factors, self._values(), kind, crc, no_fault, wraps)

    def _factor(self, role: str) -> float:
        """From the file's unit of the role's signal to SI units, with the factor that the parameters give."""
        named, known = getattr(self.meaning, role), _FACTORS[UNITS[_FIELDS.get(role, role)]]
        factor: float = named.factor
        if abs(factor) < _LEAST_FACTOR:
            text = f"{factor} is not allowed; allowed: >= {_LEAST_FACTOR:g}, of either sign"
            raise RefusedParameter(f"wire.{role}.factor", text)
        unit = named.unit or self.signals[role].unit or ""
        if unit not in known:
            text = f"{self._place(role)} is in '{unit}'; allowed: {', '.join(known)[2:]}, or no unit for SI"
            if named.unit:
                raise RefusedParameter(f"wire.{role}.unit", text)
            raise RefusedParameter(f"wire.{role}.signal", f"{text}; 'wire.{role}.unit' says what another spelling is")
        return known[unit] * factor

    def _values(self) -> dict[str, Mapping[Any, int]]:
        """For each role that says something the raw value of each meaning."""
        switches, amplifier = {role: getattr(self.meaning, role) for role in _SWITCHES}, self.meaning.amplifier
        states = zip(State, (amplifier.off_value, amplifier.on_value, amplifier.fault_value), strict=True)
        return {"amplifier": dict(states)} | {
            role: {False: named.no_value, True: named.yes_value} for role, named in switches.items()
        }

    def _common_modulus(self, several: Sequence[Frames]) -> int:
        """Modulus of what the counts of these messages have in common; 0 if one of them has none."""
        moduli = [frames.sample_modulus for frames in several]
        if len(several) == 1 or not all(moduli):
            return 0
        common = math.gcd(*moduli)
        if common < _LEAST_COUNTS:
            names = " and ".join(f"'{one.name}' to {one.sample_modulus}" for one in several)
            text = f"frames that belong together have the same count, but {names} count otherwise"
            raise RefusedParameter(
                f"{self._groups[several[-1].name]}.alive",
                f"{text}; allowed: moduli with a common divisor >= {_LEAST_COUNTS}, or ''",
            )
        return common

    def _check_numbers(self) -> None:
        counts = self.parts[0].counts("alive")
        if self.counting and self.counting not in self.parts and (not counts or self.number_modulus % counts):
            text = (
                f"'{self.counting.name}' is not allowed without a count in the frames of 'x' that divides the "
                "counter's; allowed: the message of 'x', or give 'wire.protection.sample.alive'"
            )
            raise RefusedParameter("wire.counter.message", text)
        if self.sample_modulus and self.sample_modulus < _LEAST_COUNTS:
            text = f"message '{self.parts[0].name}' counts to {self.sample_modulus}; allowed: >= {_LEAST_COUNTS} counts"
            raise RefusedParameter("wire.counter.signal", text)
        if "echo" in self.signals and not self.number_modulus:
            raise RefusedParameter("wire.echo.signal", "needs a count of the samples: 'counter' or 'protection.sample'")
        if self.echo_modulus and self.number_modulus % self.echo_modulus:
            text = f"{self._place('echo')} counts to {self.echo_modulus}; allowed: a divisor of the "
            raise RefusedParameter("wire.echo.signal", f"{text}{self.number_modulus} of the samples")


@lru_cache(maxsize=16)
def wire_of(file: str, modified: int, meaning: WireParameters, node: int, fd: bool) -> Wire:
    """The wire of the DBC ``file``, made once as long as that is not ``modified`` (ns); raises RefusedParameter."""
    with _naming("dbc"):
        dbc = Dbc(file)
    return Wire(dbc, meaning, node, fd)


_SHORT = 256
"""Samples: a counter of no more counts does not bridge a fifth of a second at 2 kHz."""

_WITHOUT = {
    "good": "bad readings are found only by their limits",
    "referenced": "after a power cycle x must be referenced before it is used",
    "current": "the commanded one stands for the measured one",
    "heartbeat": "a board that restarts is found only by its samples and its state",
    "echo": "the board does not know which sample a command answers, and how old it is",
    "reset": "the board must clear its fault when a command says off",
}
"""By role what a board without its signal does not allow."""


def gaps(wire: Wire) -> list[str]:
    """One sentence for each thing that the frames lack; none for the package's own."""
    found = [
        f"{frames.name} has no CRC: a damaged frame is found only where it is not plausible"
        for frames in (*wire.reports.values(), *wire.commands)
        if frames.crc is None
    ]
    for what, several, modulus in (
        ("sample", wire.parts, wire.part_modulus),
        ("command", wire.commands, wire.command_modulus),
    ):
        if len(several) > 1 and not modulus:
            names = " and ".join(frames.name for frames in several)
            found.append(f"{names} do not all have a counter: frames that come together are taken for one {what}")
    if not wire.sample_modulus:
        found.append(
            "no counter numbers the samples: repeated ones are not found, lost ones only after eight more; after a "
            "silence of ten the numbers start anew, which is a fault while the amplifier is on"
        )
    elif wire.number_modulus <= _SHORT:
        found.append(
            f"{wire.parts[0].name} counts to {wire.sample_modulus} only: after a silence of as many "
            "samples the numbers start anew, which is a fault while the amplifier is on"
        )
    if not any("alive" in frames.fields for frames in wire.commands):
        found.append("no counter numbers the commands: the board does not find repeated ones")
    return found + [f"no signal for '{role}': {words}" for role, words in _WITHOUT.items() if role not in wire.signals]
