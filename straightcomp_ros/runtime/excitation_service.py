"""The controller's service that excites its loop: ``~/excite``, a std_srvs/SetBool."""

from collections.abc import Callable
from typing import Protocol

from rclpy.node import Node
from std_srvs.srv import SetBool

from straightcomp_ros.control.excitation import FrequencyResponseError, Injection
from straightcomp_ros.timing.node_timing import EXCITING, FINISHED


class Excitable(Protocol):
    """A servo that takes an injection."""

    @property
    def running(self) -> bool: ...
    def inject(self, injection: Injection) -> None: ...


class ExcitationService:
    """Starts the excitation that the controller's parameters ``excitation.*`` describe, and stops it.

    Args:
        node: the controller.
        servo: gets the injection.
        make: makes it; raises FrequencyResponseError or ValueError if the parameters do not fit.
        left_travel: called with the reason when the platform left the allowed travel.

    Attributes:
        state: see :data:`~straightcomp_ros.timing.node_timing.EXCITATION`.
    """

    def __init__(
        self, node: Node, servo: Excitable, make: Callable[[], Injection], left_travel: Callable[[str], None]
    ) -> None:
        self._node, self._servo, self._make, self._left_travel = node, servo, make, left_travel
        self._injection: Injection | None = None
        self.state = ""
        node.create_service(SetBool, "~/excite", self._on_excite)

    def look(self) -> None:
        """Follow the excitation; call it after each cycle."""
        injection = self._injection
        if injection is None or not (injection.stopped or injection.finished):
            return
        self._injection = None
        self.state = injection.stopped or FINISHED
        if injection.stopped:
            self._node.get_logger().warning(f"the excitation ended early: {injection.stopped}")
            if self._servo.running:
                self._left_travel(injection.stopped)

    def _on_excite(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Inject what the parameters `excitation.*` describe into the commands (refused while the amplifier is off), or
        end that early."""
        refusal = self._start() if request.data else self._stop()
        response.success, response.message = not refusal, refusal or ("excites" if request.data else "stops")
        return response

    def _start(self) -> str:
        if not self._servo.running:
            return "the amplifier is off; switch it on first"
        if self._injection is not None:
            return "an excitation is running; stop it first"
        try:
            injection = self._make()
        except (FrequencyResponseError, ValueError) as error:
            return str(error)
        self._servo.inject(injection)
        self._injection, self.state = injection, EXCITING
        return ""

    def _stop(self) -> str:
        if self._injection is not None:
            self._injection.stop("it was stopped by request")
        return ""
