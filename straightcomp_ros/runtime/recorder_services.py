"""The services of a recorder: start, stop, pause, resume, split and snapshot, each a std_srvs/Trigger."""

from collections.abc import Callable

from rclpy.node import Node
from std_srvs.srv import Trigger

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorder import Recorder


def serve_recorder(node: Node, recorder: Recorder, start: Callable[[], str], fetch: Callable[[], None]) -> None:
    """Create the services.

    Args:
        node: provides them under private names, ``~/start`` and so on.
        recorder: carries them out.
        start: starts the recorder; returns the answer.
        fetch: passes the messages so far to the recorder: a service acts on later ones.
    """

    def begin() -> str:
        """Record to a new bag."""
        return start()

    def stop() -> str:
        """Finish the bag."""
        recorder.stop()
        return f"{recorder.written} messages are in {recorder.folder}"

    def pause() -> str:
        """Leave later messages out of the bag."""
        recorder.intake.paused = True
        return "paused: messages are not recorded until ~/resume"

    def resume() -> str:
        """Record again."""
        recorder.intake.paused = False
        return "recording"

    def split() -> str:
        """Continue in the bag's next file."""
        recorder.split()
        return "the bag continues in a new file"

    def snapshot() -> str:
        """Write the last seconds from memory (parameter snapshot) to the bag."""
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
