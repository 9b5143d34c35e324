"""DBC files that chance draws: messages of any layout, and boards with the meaning of their signals."""

import random

from straightcomp_ros.hardware.can.can_parameters import WireParameters
from straightcomp_ros.parameters.declaration import from_mapping

_IDS_OF_2 = " ".join(str(37 * number % 256) for number in range(16))
_X = [("m", 1e-7, 32), ("um", 0.05, 33), ("nm", 10, 40), ("mm", 1, "float"), ("m", 1, "double")]
_Y = [("um", 0.1, 20), ("nm", 50, 24), ("m", 1e-8, 32), ("um", 1, "float"), ("mm", -0.001, 33)]
_CURRENT = [("A", 1e-4, 16), ("mA", 0.05, 18), ("A", 1, "float"), ("mA", 1, "double")]
_BITS = {"float": 32, "double": 64}
_PROFILES = ["none", "e2e_1", "e2e_2", "e2e_5", "j1850"]
_SIZES = (*range(1, 9), 12, 16, 20, 24, 32, 48, 64)
_HEAD = 'VERSION "1"\nNS_ :\nBS_:\nBU_: X\n\n'


class _Message:
    """A message to whose ``bits`` signals are added, and its text in a DBC file; ``values`` gets the meaning of those
    with a role, by the names in a stage file."""

    def __init__(self, chance, name, identifier, cycle_ms=0.5, values=None):
        self.chance, self.name, self.identifier, self.cycle_ms = chance, name, identifier, cycle_ms
        self.bits, self.lines, self.types, self.values = 0, [], [], values

    def put(self, name, position, length, big_endian, *, signed=False, kind="", line=(1, 0), unit="", page=""):
        """A signal of the bits from ``position`` on, counted in its own byte order."""
        byte, bit = divmod(position, 8)
        start = 8 * byte + 7 - bit if big_endian else position
        place = f"{start}|{length}@{int(not big_endian)}{'-' if signed or kind else '+'}"
        self.lines.append(f' SG_ {name} {page}: {place} ({line[0]},{line[1]}) [0|0] "{unit}" X')
        if kind:
            self.types.append(f"SIG_VALTYPE_ {self.identifier} {name} : {1 if length == 32 else 2};")

    def add(self, role, name, length, says=(), *, whole=False, own_place=True, **how):
        """A signal in bytes of its own, somewhere in them unless it fills ``whole`` bytes."""
        kind = length if length in _BITS else ""
        length = _BITS.get(length, length)
        free = 0 if whole or kind else self.chance.randrange(-length % 8 + 1)
        self.put(name, self.bits + free, length, self.chance.random() < 0.5, kind=kind, **how)
        if own_place:
            self.bits += 8 * -(-(length + free) // 8)
        if role:
            meaning = {"message": self.name, "signal": name, **dict(says)}
            self.values |= {f"{role}.{of}": value for of, value in meaning.items()}

    def quantity(self, role, name, choices, says=()):
        unit, scale, length = self.chance.choice(choices)
        offset = 0 if length in _BITS else self.chance.choice([0, 0, 20 * scale, -7 * scale])
        self.add(role, name, length, says, signed=True, line=(scale, offset), unit=unit)

    def switch(self, role, name, **says):
        self.add(role, name, 4, says, signed=self.chance.random() < 0.5)

    def protect(self, group, profile):
        """Add what a profile needs, under the names that `wire.protection` has for it."""
        crc, counter = f"{self.name}_CRC" if profile != "none" else "", f"{self.name}_CNT"
        if crc:
            self.add("", crc, 16 if profile == "e2e_5" else 8, whole=True)
        self.add("", counter, 4 if profile in ("e2e_1", "e2e_2") else self.chance.choice([4, 8]))
        data_id = _IDS_OF_2 if profile == "e2e_2" else "0x0abc" if profile == "e2e_5" else ""
        meaning = {"profile": profile, "crc": crc, "alive": counter, "data_id": data_id}
        self.values |= {f"protection.{group}.{of}": value for of, value in meaning.items()}

    def text(self):
        size = next(size for size in _SIZES if size >= self.bits // 8)
        return f"BO_ {self.identifier} {self.name}: {size} X\n" + "\n".join(self.lines) + "\n"


def drawn_message(seed):
    """The text of a DBC file with one message: signals of both byte orders, signed, unsigned, float and multiplexed,
    of which those of one page do not overlap."""
    chance = random.Random(seed)
    message = _Message(chance, "Message", 1)
    message.bits = 8 * chance.choice((1, 2, 3, 5, 7, 8, 8, 8, 12, 16, 64))
    multiplexed, first = chance.random() < 0.5, chance.random() < 0.5
    if multiplexed:
        message.put("Page", 0, 4, first, page="M ")
    for page in ("m1 ", "m3 ") if multiplexed else ("",):
        position, order = 4 if multiplexed else 0, first
        while position < message.bits:
            # Whole bytes of one order: those of the other never overlap them.
            end = min(8 * (position // 8 + chance.choice([1, 2, 4, 8, 8])), message.bits)
            order = chance.random() < 0.5 if position >= 8 else order
            while position < end:
                room = end - position
                kind = "float" if room >= 32 and chance.random() < 0.5 else ""
                whole = [bits for bits in (8, 16, 32, 64) if (32 if kind else 0) <= bits <= room]
                either = kind or (whole and chance.random() < 0.5)
                length = chance.choice(whole) if either else chance.randint(1, min(64, room))
                line = chance.choice([(1, 0), (0.5, 0), (1e-7, 0), (-0.25, 3), (2, -100), (1, 40)])
                if len(message.lines) < 2 or chance.random() < 0.5:
                    how = {"signed": not kind and chance.random() < 0.5, "kind": kind, "line": line, "page": page}
                    message.put(f"Signal{len(message.lines)}", position, length, order, **how)
                position += length
    return _HEAD + "\n".join([message.text(), *message.types, ""])


def drawn_board(seed):
    """The text of a DBC file and the meaning of its signals."""
    chance, values, made = random.Random(seed), {}, []
    number = iter(chance.sample(range(0x100, 0x180), 8))

    def message(name, cycle_ms=0.5):
        # Every other identifier has 29 bits.
        identifier = next(number)
        identifier |= 1 << 31 if identifier % 2 else 0
        made.append(_Message(chance, name, identifier, cycle_ms, values))
        return made[-1]

    # Keywords of C, and names that differ by their case alone.
    first = message("Double")
    second = message("int") if chance.random() < 0.5 else first
    status = message("STATUS", chance.choice([1.0, 3.5]))
    current = chance.choice([first, second, message("Current")])
    first.quantity("x", "Value", _X)
    second.quantity("y", "value", _Y, {"factor": chance.choice([1.0, -1.0])})
    current.quantity("current", "switch", _CURRENT)
    profile = chance.choice(_PROFILES)
    first.protect("sample", profile)
    if second is not first:
        second.protect("y", profile)
    if chance.random() < 0.5:
        second.switch("good", "Ok", yes_value=3)
    page, other, own_place = "", "", True
    if chance.random() < 0.5:
        status.add("", "Page", 3, page="M ")
        page, other, own_place = "m2 ", "m5 ", False
    states = {"off_value": chance.choice([-1, 0]), "on_value": 5, "fault_value": chance.choice([3, 7])}
    status.add("amplifier", "Amplifier", 3, states, own_place=own_place, page=page)
    status.add("fault", "Fault", 8, page=other)
    setting = message("Set")
    switches = message("SET") if chance.random() < 0.5 else setting
    setting.quantity("command", "Current", _CURRENT)
    switches.switch("enable", "Enable", no_value=1, yes_value=2)
    if chance.random() < 0.7:
        switches.switch("reset", "Reset", no_value=2, yes_value=5)
    if chance.random() < 0.7:
        switches.add("echo", "Echo", 4)
    profile = chance.choice(_PROFILES)
    setting.protect("command", profile)
    if switches is not setting:
        switches.protect("enable", profile)
    if chance.random() < 0.5:
        message("Heart").add("heartbeat", "State", 5, {"boot_up_value": 3, "operational_value": 17})
    used = [one for one in made if one.lines]
    lines = ['BA_DEF_ BO_ "GenMsgCycleTime" FLOAT 0 10000;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    lines += [f'BA_ "GenMsgCycleTime" BO_ {one.identifier} {one.cycle_ms};' for one in used]
    text = _HEAD + "\n".join([*(one.text() for one in used), *lines, *(line for one in used for line in one.types), ""])
    return text, from_mapping(WireParameters, values)
