"""The meaning of the signals in config/straightcomp.dbc, on either kind of bus."""

from straightcomp_ros.hardware.can.protection import ProtectionParameters
from straightcomp_ros.hardware.can.wire_parameters import (
    AmplifierParameters,
    FaultParameters,
    HeartbeatParameters,
    ProtectedMessages,
    QuantityParameters,
    SignalParameters,
    SwitchParameters,
    WireParameters,
)

FILE = "config/straightcomp.dbc"


def shipped_wire(fd: bool) -> WireParameters:
    """The mapping for CAN FD, or for a classic bus."""
    encoder, command = ("EncoderFd", "CommandFd") if fd else ("Encoder", "Command")
    slow = "" if fd else "CoilCurrent"
    return WireParameters(
        x=QuantityParameters(encoder, "StageX"),
        y=QuantityParameters(signal="PlatformY"),
        current=QuantityParameters(slow, "MeasuredCurrent"),
        counter=SignalParameters(slow, "SampleCounter"),
        good=SwitchParameters(signal="EncodersValid"),
        amplifier=AmplifierParameters(signal="Amplifier"),
        fault=FaultParameters(signal="BoardFault"),
        heartbeat=HeartbeatParameters("Heartbeat", "NodeState"),
        command=QuantityParameters(command, "ControlCurrent"),
        enable=SwitchParameters(signal="Enable", no_value=1, yes_value=2),
        reset=SwitchParameters(signal="ResetFault", no_value=1, yes_value=2),
        echo=SignalParameters(signal="EchoedCounter"),
        protection=ProtectedMessages(
            sample=ProtectionParameters("e2e_1", "EncoderCrc", "EncoderAlive"),
            current=ProtectionParameters("none") if fd else _PROTECTED_CURRENT,
            command=ProtectionParameters("e2e_1", "CommandCrc", "CommandAlive"),
        ),
    )


_PROTECTED_CURRENT = ProtectionParameters("e2e_1", "CoilCurrentCrc", "CoilCurrentAlive")
