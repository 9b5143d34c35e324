"""DBC files that chance draws: messages of any layout, and boards with the meaning of their signals."""

import random

from straightcomp_ros.hardware.can.can_parameters import ProtectionParameters, WireParameters
from straightcomp_ros.parameters.declaration import from_mapping

_IDS_OF_2 = " ".join(str(37 * number % 256) for number in range(16))
_X = [("m", 1e-7, 32), ("um", 0.05, 33), ("nm", 10, 40), ("mm", 1, "float"), ("m", 1, "double")]
_Y = [("um", 0.1, 20), ("nm", 50, 24), ("m", 1e-8, 32), ("um", 1, "float"), ("mm", -0.001, 33)]
_CURRENT = [("A", 1e-4, 16), ("mA", 0.05, 18), ("A", 1, "float"), ("mA", 1, "double")]
_BITS = {"float": 32, "double": 64}
_SIZES = (*range(1, 9), 12, 16, 20, 24, 32, 48, 64)
_HEAD = 'VERSION "1"\nNS_ :\nBS_:\nBU_: X\n\n'


class _Message:
    """A message to whose ``bits`` signals are added, and its text in a DBC file."""

    def __init__(self, chance, name, identifier, cycle_ms=0.5):
        self.chance, self.name, self.identifier, self.cycle_ms = chance, name, identifier, cycle_ms
        self.bits, self.lines, self.types = 0, [], []

    def put(self, name, position, length, big_endian, *, signed=False, kind="", line=(1, 0), unit="", page=""):
        """A signal of the bits from ``position`` on, counted in its own byte order."""
        byte, bit = divmod(position, 8)
        start = 8 * byte + 7 - bit if big_endian else position
        place = f"{start}|{length}@{int(not big_endian)}{'-' if signed or kind else '+'}"
        self.lines.append(f' SG_ {name} {page}: {place} ({line[0]},{line[1]}) [0|0] "{unit}" X')
        if kind:
            self.types.append(f"SIG_VALTYPE_ {self.identifier} {name} : {1 if length == 32 else 2};")

    def add(self, name, length, *, whole=False, own_place=True, **how):
        """A signal in bytes of its own, somewhere in them unless it fills ``whole`` bytes."""
        kind = length if length in _BITS else ""
        length = _BITS.get(length, length)
        free = 0 if whole or kind else self.chance.randrange(-length % 8 + 1)
        self.put(name, self.bits + free, length, self.chance.random() < 0.5, kind=kind, **how)
        if own_place:
            self.bits += 8 * -(-(length + free) // 8)

    def quantity(self, name, choices):
        unit, scale, length = self.chance.choice(choices)
        offset = 0 if length in _BITS else self.chance.choice([0, 0, 20 * scale, -7 * scale])
        self.add(name, length, signed=True, line=(scale, offset), unit=unit)

    def protected(self, profile):
        """Add what a profile needs, and return its parameters."""
        if profile != "none":
            self.add(f"{self.name}_CRC", 16 if profile == "e2e_5" else 8, whole=True)
        width = 4 if profile in ("e2e_1", "e2e_2") else self.chance.choice([4, 8])
        self.add(f"{self.name}_CNT", width)
        data_id = _IDS_OF_2 if profile == "e2e_2" else "0x0abc" if profile == "e2e_5" else ""
        crc = f"{self.name}_CRC" if profile != "none" else ""
        return ProtectionParameters(profile, crc, f"{self.name}_CNT", data_id)

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
    chance = random.Random(seed)
    number = iter(chance.sample(range(0x100, 0x180), 8))

    def message(name, cycle_ms=0.5):
        # Every other identifier has 29 bits.
        identifier = next(number)
        return _Message(chance, name, identifier | 1 << 31 if identifier % 2 else identifier, cycle_ms)

    # Keywords of C, and names that differ by their case alone.
    first = message("Double")
    second = message("int") if chance.random() < 0.5 else first
    status = message("STATUS", chance.choice([1.0, 3.5]))
    current = chance.choice([first, second, message("Current")])
    first.quantity("Value", _X)
    second.quantity("value", _Y)
    current.quantity("switch", _CURRENT)
    profile = chance.choice(["none", "e2e_1", "e2e_2", "e2e_5", "j1850"])
    sample = first.protected(profile)
    y = second.protected(profile) if second is not first else ProtectionParameters()
    good = chance.random() < 0.5
    if good:
        second.add("Ok", 4, signed=chance.random() < 0.5)
    pages = chance.random() < 0.5
    if pages:
        status.add("Page", 3, page="M ")
        status.add("Amplifier", 3, page="m2 ", own_place=False)
        status.add("Fault", 8, page="m5 ")
    else:
        status.add("Amplifier", 3)
        status.add("Fault", 8)
    setting = message("Set")
    switches = message("SET") if chance.random() < 0.5 else setting
    setting.quantity("Current", _CURRENT)
    switches.add("Enable", 4, signed=chance.random() < 0.5)
    reset, echo = chance.random() < 0.7, chance.random() < 0.7
    if reset:
        switches.add("Reset", 4, signed=chance.random() < 0.5)
    if echo:
        switches.add("Echo", 4)
    asked = chance.choice(["none", "e2e_1", "e2e_2", "e2e_5", "j1850"])
    command = setting.protected(asked)
    enable = switches.protected(asked) if switches is not setting else ProtectionParameters()
    heart = message("Heart") if chance.random() < 0.5 else None
    if heart:
        heart.add("State", 5)
    used = dict.fromkeys([first, second, status, current, setting, switches, *([heart] if heart else [])])
    # By the names in a stage file: message, signal, and what else is said of it.
    roles = {
        "x": ("Double", "Value", {}),
        "y": (second.name, "value", {"factor": chance.choice([1.0, -1.0])}),
        "current": (current.name, "switch", {}),
        "amplifier": (
            "STATUS",
            "Amplifier",
            {"off_value": chance.choice([-1, 0]), "on_value": 5, "fault_value": chance.choice([3, 7])},
        ),
        "fault": ("STATUS", "Fault", {}),
        "command": ("Set", "Current", {}),
        "enable": (switches.name, "Enable", {"no_value": 1, "yes_value": 2}),
        **({"good": (second.name, "Ok", {"yes_value": 3})} if good else {}),
        **({"reset": (switches.name, "Reset", {"no_value": 2, "yes_value": 5})} if reset else {}),
        **({"echo": (switches.name, "Echo", {})} if echo else {}),
        **({"heartbeat": ("Heart", "State", {"boot_up_value": 3, "operational_value": 17})} if heart else {}),
    }
    values = {}
    for role, (named, signal, more) in roles.items():
        values |= {f"{role}.{name}": value for name, value in ({"message": named, "signal": signal} | more).items()}
    for part, protected in (("sample", sample), ("y", y), ("command", command), ("enable", enable)):
        values |= {f"protection.{part}.{name}": value for name, value in vars(protected).items()}
    lines = ['BA_DEF_ BO_ "GenMsgCycleTime" FLOAT 0 10000;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    lines += [f'BA_ "GenMsgCycleTime" BO_ {one.identifier} {one.cycle_ms};' for one in used]
    text = _HEAD + "\n".join([*(one.text() for one in used), *lines, *(line for one in used for line in one.types), ""])
    return text, from_mapping(WireParameters, values)
