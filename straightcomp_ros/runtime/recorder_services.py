"""The services of a recorder: start, stop, pause, resume, split and snapshot, each a std_srvs/Trigger."""

from collections.abc import Callable

from rclpy.node import Node
from std_srvs.srv import Trigger

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorder import Recorder


def serve_recorder(node: Node, recorder: Recorder, start: Callable[[], str], fetch: Callable[[], None]) -> None:
    """Create the services.

    Args:
        node: has them as private names, ``~/start`` and so on.
        recorder: is told.
        start: starts it, and says so.
        fetch: hands the recorder what has come until now: a service acts on what comes after it.
    """

    def begin() -> str:
        """Record to a new bag."""
        return start()

    def stop() -> str:
        """Finish the bag."""
        recorder.stop()
        return f"{recorder.written} messages are in {recorder.folder}"

    def pause() -> str:
        """Leave out of the bag what comes from now on."""
        recorder.intake.paused = True
        return "paused: what comes now is not recorded"

    def resume() -> str:
        """Record again."""
        recorder.intake.paused = False
        return "recording"

    def split() -> str:
        """Go on in the bag's next file."""
        recorder.split()
        return "the bag goes on in a new file"

    def snapshot() -> str:
        """Write the last seconds that were kept in memory (parameter snapshot) to the bag."""
        return f"{recorder.intake.snapshot()} messages go to the bag"

    def served(
        act: Callable[[], str], needs_bag: bool
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def callback(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            fetch()
            if needs_bag and not recorder.recording:
                response.success, response.message = False, "nothing is being recorded; allowed after ~/start"
                return response
            try:
                response.success, response.message = True, act()
            except BagError as error:
                response.success, response.message = False, str(error)
            return response

        return callback

    for name, act in (
        ("start", begin),
        ("stop", stop),
        ("pause", pause),
        ("resume", resume),
        ("split", split),
        ("snapshot", snapshot),
    ):
        node.create_service(Trigger, f"~/{name}", served(act, needs_bag=act is not begin))
