"""The topics of a bag, and which one is meant by a relative name."""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from straightcomp_ros.bags import BagError


class RecordedTopic(NamedTuple):
    """A topic of a bag: full name, ROS type, encoding (``cdr``), and the type's text as the bag has it, empty where it
    has none, with the text's encoding (``ros2msg``, ``ros2idl``)."""

    name: str
    type_name: str
    encoding: str
    definition: str = ""
    definition_encoding: str = "ros2msg"


def resolved(name: str, topics: Collection[str], bag: str) -> str | None:
    """The bag's topic for a relative name (``encoder``): ``/encoder``, otherwise the only one of that name in a
    namespace. A full name (``/encoder``) means exactly that topic. Some writers leave out a name's first slash.

    Returns the topic's name in the bag, or None when it is not among ``topics``. Raises BagError, with the name of the
    ``bag``, when several namespaces have the topic.
    """
    absolute = name if name.startswith("/") else f"/{name}"
    found = sorted(topic for topic in topics if topic.endswith(absolute) and absolute != name)
    for exact in (absolute, absolute[1:]):
        if exact in topics:
            return exact
    if len(found) > 1:
        raise BagError(f"bag {bag}: topic '{name}' is {' and '.join(found)}; ask for one by its full name")
    return found[0] if found else None


def chosen_topics(wanted: Iterable[str], topics: set[str], bag: str, remap: Mapping[str, str]) -> dict[str, str]:
    """Each of the ``wanted`` names that the bag has, by the bag's full name for it; parameters as :func:`resolved`.

    ``remap`` gives for some of the wanted names the bag's own. Raises BagError when several namespaces have a topic, or
    the bag lacks one that ``remap`` names.
    """
    chosen = {}
    for name in wanted:
        full = resolved(remap.get(name, name), topics, bag)
        if full:
            chosen[full] = name
        elif name in remap:
            raise BagError(f"bag {bag}: has no topic '{remap[name]}' for '{name}'; it has {', '.join(sorted(topics))}")
    return chosen
