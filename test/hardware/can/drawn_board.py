"""Boards that chance draws: DBC files with the signals of a board and its host anywhere, and what they mean."""

import random

from straightcomp_ros.hardware.can.can_parameters import ProtectionParameters, WireParameters
from straightcomp_ros.parameters.declaration import from_mapping

_IDS_OF_2 = " ".join(str(37 * number % 256) for number in range(16))
_X = [("m", 1e-7, 32), ("um", 0.05, 33), ("nm", 10, 40), ("mm", 1, "float"), ("m", 1, "double")]
_Y = [("um", 0.1, 20), ("nm", 50, 24), ("m", 1e-8, 32), ("um", 1, "float"), ("mm", -0.001, 33)]
_CURRENT = [("A", 1e-4, 16), ("mA", 0.05, 18), ("A", 1, "float"), ("mA", 1, "double")]
_BITS = {"float": 32, "double": 64}


class _Message:
    def __init__(self, chance, name, identifier, cycle_ms=0.5):
        self.chance, self.name, self.identifier, self.cycle_ms = chance, name, identifier, cycle_ms
        self.bits, self.lines, self.types = 0, [], []

    def add(self, name, length, *, signed=False, scale=1, offset=0, unit="", page="", whole=False, own_place=True):
        """A signal in bytes of its own, somewhere in them unless it fills ``whole`` bytes."""
        kind = length if length in _BITS else ""
        length = _BITS.get(length, length)
        whole = whole or bool(kind)
        free = 0 if whole else self.chance.randrange(-length % 8 + 1)
        motorola = self.chance.random() < 0.5
        start = self.bits + 7 - free if motorola else self.bits + free
        sign = "-" if signed or kind else "+"
        self.lines.append(
            f' SG_ {name} {page}: {start}|{length}@{int(not motorola)}{sign} ({scale},{offset}) [0|0] "{unit}" X'
        )
        if kind:
            self.types.append(f"SIG_VALTYPE_ {self.identifier} {name} : {1 if kind == 'float' else 2};")
        if own_place:
            self.bits += 8 * -(-(length + free) // 8)

    def quantity(self, name, choices):
        unit, scale, length = self.chance.choice(choices)
        whole = length not in _BITS
        offset = self.chance.choice([0, 0, 20 * scale, -7 * scale]) if whole else 0
        self.add(name, length, signed=True, scale=scale, offset=offset, unit=unit)

    def protected(self, profile):
        """Add what a profile needs, and return its parameters."""
        if profile != "none":
            self.add(f"{self.name}_CRC", 16 if profile == "e2e_5" else 8, whole=True)
        width = 4 if profile == "e2e_2" else self.chance.choice([4, 8]) if profile != "e2e_1" else 4
        self.add(f"{self.name}_CNT", width)
        data_id = _IDS_OF_2 if profile == "e2e_2" else "0x0abc" if profile == "e2e_5" else ""
        return ProtectionParameters(
            profile, f"{self.name}_CRC" if profile != "none" else "", f"{self.name}_CNT", data_id
        )

    def text(self):
        size = next(size for size in (*range(1, 9), 12, 16, 20, 24, 32, 48, 64) if size >= self.bits // 8)
        return f"BO_ {self.identifier} {self.name}: {size} X\n" + "\n".join(self.lines) + "\n"


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
    factor = chance.choice([1.0, -1.0])
    off, fault_value = chance.choice([-1, 0]), chance.choice([3, 7])
    # By the names in a stage file: message, signal, and what else is said of it.
    roles = {
        "x": ("Double", "Value", {}),
        "y": (second.name, "value", {"factor": factor}),
        "current": (current.name, "switch", {}),
        "amplifier": ("STATUS", "Amplifier", {"off_value": off, "on_value": 5, "fault_value": fault_value}),
        "fault": ("STATUS", "Fault", {}),
        "command": ("Set", "Current", {}),
        "enable": (switches.name, "Enable", {"no_value": 1, "yes_value": 2}),
    }
    if good:
        roles["good"] = (second.name, "Ok", {"yes_value": 3})
    if reset:
        roles["reset"] = (switches.name, "Reset", {"no_value": 2, "yes_value": 5})
    if echo:
        roles["echo"] = (switches.name, "Echo", {})
    if heart:
        roles["heartbeat"] = ("Heart", "State", {"boot_up_value": 3, "operational_value": 17})
    values = {}
    for role, (named, signal, more) in roles.items():
        values |= {f"{role}.{name}": value for name, value in ({"message": named, "signal": signal} | more).items()}
    for part, protected in (("sample", sample), ("y", y), ("command", command), ("enable", enable)):
        values |= {f"protection.{part}.{name}": value for name, value in vars(protected).items()}
    meaning = from_mapping(WireParameters, values)
    lines = ['VERSION "1"', "NS_ :", "BS_:", "BU_: X", "", *(one.text() for one in used)]
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" FLOAT 0 10000;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    lines += [f'BA_ "GenMsgCycleTime" BO_ {one.identifier} {one.cycle_ms};' for one in used]
    return "\n".join([*lines, *(line for one in used for line in one.types), ""]), meaning
