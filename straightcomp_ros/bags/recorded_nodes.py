"""What a bag says of the nodes that it recorded: their parameters, the survey behind their map, their diagnostics.

The values of parameters are not validated here: whoever runs a component with them does that.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from straightcomp_ros.bags import BAND_ATTACHMENT, MAP_ATTACHMENT, PARAMETERS_ATTACHMENT, BagError
from straightcomp_ros.bags.folder import opened, topic_names
from straightcomp_ros.bags.reader import Messages, decoded, messages_on
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.parameters.declaration import ParameterError, belongs_to_ros, from_mapping, under
from straightcomp_ros.parameters.yaml_text import PARAMETERS, dump_yaml, node_sections
from straightcomp_ros.timing.node_timing import Report, reporting_node

if TYPE_CHECKING:
    from straightcomp_ros.bags.reader import BagInput
    from straightcomp_ros.bags.writer import BagWriter


PARAMETERS_CHANGED, _TIME_NS = "parameters_changed", "time_ns"
"""Metadata record of each change of parameters in a recording, and its key of when it was noticed; the others are the
new values by node and dotted name."""
_ONCE_SAMPLES = (("controller", "reference_lead"), ("driver", "simulated.sample_memory"))
"""Times that early bags have as whole numbers of samples."""


def recorded_parameters(
    bag: Path, attachments: Mapping[str, bytes], remap: Mapping[str, str] | None = None
) -> dict[str, dict[str, Any]]:
    """Values by node, without its namespace, and dotted name, under the present names; empty when none are attached.

    The attachments are those of ``bag``, from :func:`straightcomp_ros.bags.reader.read_attachments`. Of nodes of one
    name that in the namespace of the encoder is taken, whose topic ``remap`` may name, over that without a
    namespace. Raises BagError when the parameter file is none, or has neither of them.
    """
    where = f"bag {bag}: {PARAMETERS_ATTACHMENT}"
    try:
        sections = node_sections(attachments.get(PARAMETERS_ATTACHMENT) or b"{}")
    except ParameterError as error:
        raise BagError(f"{where}: {error}; record the bag again") from error
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for key, given in sections:
        namespace, _, node = key.rpartition("/")
        own = found.setdefault(node, {}).setdefault(namespace.strip("/*"), {})
        own |= {name: value for name, value in given.items() if not belongs_to_ros(name)}
    home = ""
    if any(len(places) > 1 for places in found.values()):
        with opened(bag) as files:
            encoder = resolved((remap or {}).get(ENCODER.topic, ENCODER.topic), topic_names(files), str(bag))
        home = (encoder or "").rpartition("/")[0].strip("/")
    values: dict[str, dict[str, Any]] = {}
    for node, places in found.items():
        if len(places) > 1 and not places.keys() & {home, ""}:
            names = " and ".join(f"'/{namespace}/{node}'" for namespace in places)
            text = f"has {names}, and none in the namespace of the encoder"
            raise BagError(f"{where}: {text}; record the bag again with one of them in the logger's 'nodes'")
        chosen = [places[one] for one in ("", home) if one in places] or places.values()
        values[node] = {name: value for own in chosen for name, value in own.items()}
    for node, name in _ONCE_SAMPLES:
        own = values.get(node, {})
        if type(own.get(name)) is int and own.get("stage.rate"):
            own[name] /= own["stage.rate"]
    return values


def note_changes(
    bag: BagWriter, time_ns: int, before: Mapping[str, Mapping[str, Any]], after: Mapping[str, Mapping[str, Any]]
) -> None:
    """Store which of the nodes' parameters changed, noticed at ``time_ns``; nothing if none did."""
    values = {
        f"{node}.{name}": str(value)
        for node, own in after.items()
        for name, value in own.items()
        if value != before.get(node, {}).get(name) and not belongs_to_ros(name)
    }
    if values:
        bag.add_metadata(PARAMETERS_CHANGED, {_TIME_NS: str(time_ns), **values})


def noted_changes(files: Sequence[BagInput]) -> list[tuple[int, dict[str, str]]]:
    """When parameters changed in a recording, in ns, and to what, by node, without its namespace, and dotted name."""
    found = []
    for record in (record for file in files for record in file.metadata() if record.name == PARAMETERS_CHANGED):
        changed = dict(record.metadata)
        with suppress(KeyError, ValueError):
            when = int(changed.pop(_TIME_NS))
            found.append((when, {name.rpartition("/")[2]: value for name, value in changed.items()}))
    return found


def parameters_of(
    bag: Path,
    attachments: Mapping[str, bytes],
    given: Mapping[str, Mapping[str, Any]] | None,
    remap: Mapping[str, str] | None,
) -> Mapping[str, Mapping[str, Any]]:
    """As :func:`recorded_parameters`, or those that are ``given`` for a bag that has none of the controller attached.
    Raises BagError for a bag that has none and is given none, and for one that has both: only one can be the run's."""
    found = recorded_parameters(bag, attachments, remap)
    if "controller" in found:
        if given is not None:
            text = "has the parameters of its run attached; --params-file is for a bag without them"
            raise BagError(f"bag {bag}: {text}")
        return found
    if given is None:
        raise BagError(f"bag {bag}: the controller's parameters are not attached; give them with --params-file")
    return given


def attach_parameters(bag: BagWriter, values: Mapping[str, Mapping[str, Any]]) -> str:
    """Attach the parameters ``values`` by node and dotted name, the survey that they name, as it is on this machine
    now, and its map with the band; returns why there is no survey or no band, empty when they are attached."""
    from straightcomp_ros.straightness.guide_map import MapParameters, find_survey, load_map
    from straightcomp_ros.straightness.survey import SurveyError

    sections = {node: {PARAMETERS: dict(own)} for node, own in values.items() if own}
    bag.attach(PARAMETERS_ATTACHMENT, "application/yaml", dump_yaml(sections).encode())
    feedforwards = [own for node, own in values.items() if node.rpartition("/")[2] == "feedforward"]
    if len(feedforwards) != 1:
        count = "several feedforwards" if feedforwards else "no feedforward"
        return f"the map is not attached to the bag: {count} among the logger's 'nodes' answered"
    given = under("stage.guide.", *feedforwards)
    try:
        path = find_survey(str(given.get("file", MapParameters().file)))
        data = path.read_bytes()
    except (SurveyError, OSError) as error:
        return f"the map is not attached to the bag: {error}"
    bag.attach(MAP_ATTACHMENT, "text/csv", data)
    try:
        table = load_map(from_mapping(MapParameters, {**given, "file": str(path)})).table()
    except (ParameterError, SurveyError) as error:
        return f"the map's band is not attached to the bag: {error}"
    bag.attach(BAND_ATTACHMENT, "text/csv", table.encode())
    return ""


def unpacked_map(attachments: Mapping[str, bytes], folder: Path) -> Path | None:
    """Write the attached survey into ``folder``; returns the file, None where the bag has none attached."""
    if MAP_ATTACHMENT not in attachments:
        return None
    path = folder / MAP_ATTACHMENT
    path.write_bytes(attachments[MAP_ATTACHMENT])
    return path


def replayed_map(
    bag: Path, attachments: Mapping[str, bytes], parameters: Mapping[str, Mapping[str, Any]], folder: Path
) -> Path | None:
    """As :func:`unpacked_map`, to compute a run again. Raises BagError where nothing says which map the run had: none
    is attached, and among its ``parameters`` are none of a feedforward, which would name one."""
    found = unpacked_map(attachments, folder)
    if found is None and "feedforward" not in parameters:
        text = "has neither the run's map nor parameters of its feedforward attached"
        raise BagError(f"bag {bag}: {text}; record again with the feedforward among the logger's 'nodes'")
    return found


def read_reports(bag: Path) -> dict[str, list[Report]]:
    """What each node reported, by the node's name without its namespace, in the order of recording; empty for a bag
    without diagnostics.

    Nodes of all namespaces report on one topic: those in the namespace of the bag's encoder are taken. BagError if the
    bag is absent or damaged, or has several encoders, or none and several namespaces.
    """
    with opened(bag) as files:
        names = topic_names(files)
        encoder = resolved(ENCODER.topic, names, str(bag))
        topic = topic_of_reports(bag, names, encoder)
        messages = messages_on(topic, files) if topic else Messages(DIAGNOSTICS)
    return reports_in(bag, messages, encoder)


def topic_of_reports(bag: Path, names: Collection[str], encoder: str | None) -> str | None:
    """The topic on which the nodes of a bag report, of its topics' full ``names``: bags of release 0.1 have it in the
    nodes' namespace, which that of the ``encoder`` shows. BagError as of :func:`read_reports`."""
    own = DIAGNOSTICS.lstrip("/") if encoder is None else f"{encoder.rpartition('/')[0]}{DIAGNOSTICS}"
    return resolved(DIAGNOSTICS, names, str(bag)) or resolved(own, names, str(bag))


def reports_in(bag: Path, messages: Messages, encoder: str | None) -> dict[str, list[Report]]:
    """What :func:`read_reports` returns, from the ``messages`` of the diagnostics' topic of a bag; ``encoder`` is the
    full name of its encoder's topic. BagError as there."""
    reports: dict[str, list[Report]] = {}
    for number, data in enumerate(messages.data):
        where = f"bag {bag}: topic '{messages.topic}', message {number}"
        try:
            message = decoded(where, data, "diagnostic_msgs/msg/DiagnosticArray")
        except BagError as error:
            # Any program on the machine may publish here.
            warnings.warn(f"{error}; it is left out", stacklevel=2)
            continue
        time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            reports.setdefault(status.name, []).append(Report(time_ns, values, status.hardware_id))
    namespaces = {(encoder or name).rpartition("/")[0].strip("/") for name in reports}
    if len(namespaces) > 1:
        raise BagError(f"bag {bag}: nodes of several namespaces report: {', '.join(sorted(reports))}")
    namespace = next(iter(namespaces), "")
    return {node: found for name, found in reports.items() if (node := reporting_node(name, namespace))}
