"""An incident in one file, for whoever is to say from elsewhere what happened: a zip archive.

It has the bag (a sound copy of it, or of its end), the parameters of all nodes, the map, the certificate, the last
diagnostics and the faults, what the doctor found on that computer, the nodes' logs, and versions. Secrets are left out
and named. To read one neither ROS nor the machine is needed.
"""

import errno
import hashlib
import importlib.metadata
import json
import platform
import re
import shutil
import stat
import tempfile
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.assessment import Assessment, assessed
from straightcomp_ros.analysis.interruption import LatchedFault, latched_faults, played
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.bags import MAP_ATTACHMENT, PARAMETERS_ATTACHMENT, BagError
from straightcomp_ros.bags.folder import BagInput, found_beside, found_files, opened, topic_names
from straightcomp_ros.bags.information import origin
from straightcomp_ros.bags.mcap_input import HEAD, rows
from straightcomp_ros.bags.reader import StreamDecoder, attachments_of, read_attachments
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.doctor import Finding
from straightcomp_ros.offline.audit import audit
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.output_files import json_text, utf8, write_whole
from straightcomp_ros.parameters.yaml_text import YamlError, dump_yaml, load_yaml
from straightcomp_ros.safety.faults import LABELLED, explained, one_line

SUMMARY, DETAILS, DOCTOR, BAG = "INCIDENT.txt", "incident.json", "doctor.json", "bag"
LARGEST = 1 << 30
"""Bytes of an incident when it is unpacked: half an hour of all streams, ten times over."""
_MOST = 500
"""Files in it."""
_LOG = 1 << 20
"""Bytes of the end of a log: some ten thousand lines."""
_FARTHEST = 10.0
"""What is kept before the last seconds at most, relative to them, so that commands can be computed again from the
amplifier's switch-on."""
_CERTIFICATE = ("certificate.html", "certificate.json")
_ABOVE = 3
"""Folders above a bag in which its certificate may be: a commission has its bags in `bags/`."""
_NAME = re.compile(
    rf"{SUMMARY}|{DETAILS}|{PARAMETERS_ATTACHMENT}|{MAP_ATTACHMENT}|diagnostics\.json|{DOCTOR}|versions\.json|"
    r"certificate\.(html|json)|(bag|logs)/[\w-][\w.-]{0,200}"
)
"""Names of files in an incident: none leaves the folder that it is unpacked to."""
_SECRET = re.compile(r"passw|secret|token|credential|private_key|api_?key", re.IGNORECASE)
_SECRET_IN_TEXT = re.compile(
    r"(?P<name>[\w.]*(?:passw|secret|token|credential|api_?key)\w*[\"']?\s*[=:]\s*)"
    r"(?:\"(?:[^\"\\\n]|\\.)*\"|'(?:[^'\\\n]|\\.)*'|[^\s,;]+)"
    r"|(?P<user>://[^\s/:@]*:)[^\s/]+(?=@)",
    re.IGNORECASE,
)
_LEFT_OUT, NO_REASON, _NO_FAULT = "(left out)", "without a reason", "no fault"
_PACKAGES = ("numpy", "scipy", "numba", "mcap", "rclpy", "rmw-fastrtps-cpp", "python-can", "asyncua")


class IncidentError(ValueError):
    """A file is no incident, or may not be unpacked; the message names it and the reason."""


@dataclass
class Judged:
    """What a bag says of its run: the cause in a line, the verdict, and the audit of its commands."""

    cause: str = ""
    remedy: str = ""  # what to do, after a fault
    verdict: str = ""
    audit: str = ""
    faults: Sequence[LatchedFault] = ()
    reports: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    assessment: Assessment | None = None

    def to_json(self) -> dict[str, Any]:
        """The texts, and the faults."""
        faults = [one._asdict() for one in self.faults]
        texts = {name: getattr(self, name) for name in ("cause", "remedy", "verdict", "audit")}
        return {**texts, "faults": faults}


def judged(bag: Path, logs: Mapping[str, str]) -> Judged:
    """Judge a bag, whatever is wrong with it; ``logs`` are the nodes' by name."""
    found = Judged()

    def without_place(error: Exception | str) -> str:
        """Where the bag was copied to, or unpacked, says nothing."""
        return str(error).replace(f"{bag.parent}/", "")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found.reports = read_reports(bag)
            found.faults = latched_faults(found.reports, 0)
        except BagError:
            pass
        try:
            found.assessment = assessed(bag)
            found.assessment.warnings = [without_place(text) for text in found.assessment.warnings]
            found.verdict = str(found.assessment.verdict)
        except (BagError, MetricsError, ParameterError) as error:
            found.verdict = f"none: {without_place(error)}"
        try:
            one = audit(bag)
            counts = f"{one.different} differ in a bit, {one.unverified} cannot be verified"
            found.audit = f"{one.commands} commands computed again: {counts}"
        except (BagError, ParameterError) as error:
            found.audit = f"none: {without_place(error)}"
    found.cause = _cause(found, logs)
    found.remedy = explained(found.cause)["remedy"]
    return found


def _cause(found: Judged, logs: Mapping[str, str]) -> str:
    """The earliest fault in the bag; where the recording itself failed, that of a log; else the verdict."""
    faults = [(one.label, one.reason) for one in found.faults if one.label in LABELLED]
    if not faults:
        # A node that ends, or a disk that is full, no longer reports.
        words = "|".join(LABELLED)
        for text in logs.values():
            # As nodes log one: behind what they say of it, its label and its reason. Some labels are plain words.
            faults += re.findall(rf"^(?:.*?: )?({words}): *(.*)$", text, re.MULTILINE)[:1]
        stopped = re.compile(r"recording stopped: (.*)$", re.MULTILINE)
        faults += [("recording_stopped", line) for text in logs.values() for line in stopped.findall(text)]
        faults += [(one.label, one.reason) for one in found.faults]
    if faults:
        label, reason = faults[0]
        return f"fault {label}: {reason.strip() or NO_REASON}"
    return f"{_NO_FAULT}; verdict {found.verdict}"


@dataclass(frozen=True)
class Packed:
    """An incident that was written: its cause, its size in bytes, and what is not in it, each with the reason."""

    file: Path
    cause: str
    size: int
    left_out: Sequence[str]


def pack(
    bag: Path, output: Path, findings: Iterable[Finding], *, last: float = 0.0, logs: Path | None = None
) -> Packed:
    """Write the incident of ``bag``, finished or not, to the file ``output``, whole or not at all.

    ``findings`` are the doctor's. ``last`` keeps the last seconds of the bag only, and before them what follows the
    amplifier's last switch-on, if that is not too long ago; 0 keeps all. ``logs`` is a folder with the nodes' logs; by
    default that beside the bag.

    Raises:
        BagError: the bag cannot be read.
        IncidentError: the incident would be larger than one that can be opened.
        OSError: the file cannot be written.
    """
    left_out: list[str] = []
    with tempfile.TemporaryDirectory(prefix="straightcomp_incident_") as place:
        copy = _copied(bag, Path(place), last, left_out)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is wrong with the copy was said of the bag
            contents = dict(_texts(bag, copy, logs, left_out))
        texts = {name: data.decode(errors="replace") for name, data in contents.items() if name.startswith("logs/")}
        found = judged(copy, texts)
        doctor = [asdict(one) for one in findings]
        contents[DOCTOR] = utf8(json_text(doctor))
        last_reports = {node: one[-1]._asdict() for node, one in found.reports.items() if one}
        contents["diagnostics.json"] = utf8(json_text(last_reports | {"faults": found.to_json()["faults"]}))
        contents["versions.json"] = utf8(json_text(_versions()))
        files = {f"{BAG}/{one.name}": one.read_bytes() for one in sorted(copy.iterdir())}
        contents |= files
        _check_size(bag, sum(map(len, contents.values())))
        made = datetime.now(timezone.utc).isoformat(timespec="seconds")
        details = {
            "made": made,
            "bag": bag.name,
            **found.to_json(),
            "left_out": left_out,
            "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()},
        }
        contents[DETAILS] = utf8(json_text(details))
        contents[SUMMARY] = utf8(f"{summary(details, doctor)}\nopen it with: straightcomp incident open FILE\n")
        archive = Path(place) / "incident.zip"
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as target:
            for name in (SUMMARY, *(name for name in contents if name != SUMMARY)):
                # A bag is compressed already.
                how = zipfile.ZIP_STORED if name.endswith(".mcap") else zipfile.ZIP_DEFLATED
                target.writestr(name, contents[name], how)
        write_whole(output, archive.read_bytes())
    return Packed(output, found.cause, output.stat().st_size, left_out)


def _copied(bag: Path, place: Path, last: float, left_out: list[str]) -> Path:
    """A copy of the bag in the folder ``place``: its own files, or a recovered bag where something is left out."""
    copy = place / BAG
    paths, _ = found_files(bag)
    secrets: list[str] = []
    sound, skip, gone, kept = True, 0, 0.0, 0.0
    try:
        with opened(bag) as files:
            _without_secrets(PARAMETERS_ATTACHMENT, attachments_of(files).get(PARAMETERS_ATTACHMENT, b""), secrets)
            if last:
                skip, gone, kept = _before_the_end(bag, files, last)
    except BagError as error:
        left_out.append(f"what is damaged in the bag: {error}")
        sound = False
    if sound and not last:
        _check_size(bag, sum(one.stat().st_size for one in paths))
    if sound and not secrets and not last and all(_NAME.fullmatch(f"{BAG}/{one.name}") for one in paths):
        copy.mkdir()
        for one in [*paths, *found_beside(bag, paths)]:
            shutil.copyfile(one, copy / one.name)
        if paths == [bag] and bag.suffix == ".db3" and bag.with_name("metadata.yaml").is_file():
            # Its recorder came to its end, also where the list in metadata.yaml is of other files and was left out.
            (copy / "metadata.yaml").touch()
        return copy

    def edit(name: str, data: bytes) -> bytes:
        return _without_secrets(name, data, left_out) if name == PARAMETERS_ATTACHMENT else data

    unfinished = recover(bag, copy, skip=skip, edit=edit).unfinished
    left_out += [f"bag: {name} was not finished, what had not reached the disk is lost" for name in unfinished]
    if last and not sound:
        whole, copy = copy, place / "last" / BAG
        with opened(whole) as files:
            skip, gone, kept = _before_the_end(whole, files, last)
        copy.parent.mkdir()
        recover(whole, copy, skip=skip)
    if skip:
        left_out.append(f"bag: the first {gone:.1f} s; the last {kept:.1f} s are there")
    return copy


def _check_size(bag: Path, size: int) -> None:
    if size > LARGEST:
        raise IncidentError(f"incident of {bag}: {size} bytes; allowed: {LARGEST}; pack the end of it with --last")


def _before_the_end(bag: Path, files: Sequence[BagInput], last: float) -> tuple[int, float, float]:
    """Number of messages before what ``last`` keeps of a bag, and the time in s before and after that place. It begins
    with the amplifier's last switch-on before the last seconds, if that is not longer ago than :data:`_FARTHEST` times
    these: from there on each command can be computed again.

    It goes by chunks, since the samples of a day do not fit into memory. Its time is that of `played`: a pause,
    or a clock that was set forward, takes 1 s at most, and one that was set back none.
    """
    topic = resolved(ENCODER.topic, topic_names(files), str(bag))
    time, count, newest_ns, was_on = 0.0, 0, 0, True
    chunks, starts = [(time, count)], [(time, count)]
    for data, places in (block for file in files for block in file.blocks([topic] if topic else [])):
        chunks.append((time, count))
        if topic in places:
            decoder = StreamDecoder(f"bag {bag}: topic '{topic}'", ENCODER.layout)
            decoder.add(data, places[topic])
            samples = decoder.finished()
            assert samples
            on = np.isfinite(samples.columns["coil_current"])
            if (on & ~np.append(was_on, on[:-1])).any():
                # The sample before the switch-on shows that the amplifier was off.
                starts.append(chunks[-2])
            was_on = on[-1]
        if places:
            own = places[topic] if topic in places else max(places.values(), key=len)
            stamps = rows(data, own, HEAD)["log_time"].astype(np.int64)
            time += float(played(np.append(newest_ns or stamps[0], stamps))[-1]) * 1e-9
            newest_ns = int(stamps[-1])
        count += sum(map(len, places.values()))
    begin = max((one for one in chunks if one[0] <= time - last), default=chunks[0])
    start = max(one for one in starts if one <= begin)
    if start[0] >= time - (1.0 + _FARTHEST) * last:
        begin = start
    return begin[1], begin[0], time - begin[0]


def _texts(bag: Path, copy: Path, logs: Path | None, left_out: list[str]) -> Iterator[tuple[str, bytes]]:
    """Files of an incident by name, other than the bag's own and what is computed."""
    attached = read_attachments(copy)
    for name, what in ((PARAMETERS_ATTACHMENT, "parameters"), (MAP_ATTACHMENT, "map")):
        if name in attached:
            yield name, attached[name]
        else:
            left_out.append(f"{what}: not attached to the bag")
    places = list(bag.absolute().parents)[:_ABOVE]
    certificate = next((one for one in places if (one / _CERTIFICATE[0]).is_file()), None)
    for name in _CERTIFICATE if certificate else ():
        if certificate and (certificate / name).is_file():
            yield name, (certificate / name).read_bytes()
    if certificate is None:
        left_out.append("certificate: none above the bag's folder")
    folder = logs or bag.absolute().parent / "logs"
    found = sorted(one for one in folder.glob("*.log") if one.is_file()) if folder.is_dir() else []
    for log in found[: _MOST // 2]:
        with log.open("rb") as opened:
            opened.seek(max(0, log.stat().st_size - _LOG))
            data = opened.read(_LOG)
        name = f"logs/{re.sub(r'[^A-Za-z0-9_.-]', '_', log.name).lstrip('.')[:100]}"
        yield name, _without_secrets(name, data, left_out)
    if not found:
        left_out.append(f"logs: none in {folder.name}/ beside the bag")


def _without_secrets(name: str, data: bytes, left_out: list[str]) -> bytes:
    """The text without values of names that look like secrets, and without passwords in addresses; what was found is
    added to ``left_out``, by name alone."""

    def replaced(match: re.Match[str]) -> str:
        known = match["name"]
        named = known.strip(" =:\"'") if known else "a password in an address"
        left_out.append(f"secret: {named} in {name}")
        return f"{known or match['user']}{_LEFT_OUT}"

    if not name.endswith(".yaml"):
        return _SECRET_IN_TEXT.sub(replaced, data.decode(errors="replace")).encode()

    def cleaned(tree: Any, path: str) -> Any:
        if isinstance(tree, Mapping):
            return {key: cleaned(one, f"{path}.{key}" if path else str(key)) for key, one in tree.items()}
        parameter = path.rpartition("ros__parameters.")[2]
        if tree not in ("", None) and _SECRET.search(parameter):
            left_out.append(f"secret: {parameter} in {name}")
            return _LEFT_OUT
        if isinstance(tree, list):
            return [cleaned(one, path) for one in tree]
        return _SECRET_IN_TEXT.sub(replaced, tree) if isinstance(tree, str) else tree

    try:
        tree = load_yaml(data)
    except YamlError:
        left_out.append(f"{name}: cannot be read")
        return b""
    before = len(left_out)
    changed = cleaned(tree, "")
    # Unchanged to the byte where nothing is secret.
    return dump_yaml(changed).encode() if len(left_out) > before else data


def _versions() -> dict[str, str]:
    """This package, its dependencies and the system."""
    found = {**origin(), "python": platform.python_version(), "system": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def summary(
    details: Mapping[str, Any], doctor: Sequence[Mapping[str, Any]], packed: Mapping[str, Any] | None = None
) -> str:
    """An incident in lines, its cause first; of one that was opened, also what the ``packed`` details say otherwise."""
    there = {name: details.get(name) if packed is None else packed.get(name) for name in ("verdict", "audit")}
    lines = [
        str(details["cause"]),
        *([f"what to do: {details['remedy']}"] if details["remedy"] else []),
        f"packed: {details.get('made')}, bag {details.get('bag')}",
        *(
            f"{name}: {details[name]}" + f" (on the computer that packed it: {other})" * (other != details[name])
            for name, other in there.items()
        ),
        *(f"doctor there, {one['state']}: {one['name']}: {one['detail']}" for one in doctor if one["state"] != "ok"),
        *(f"left out: {one}" for one in details.get("left_out", ())),
    ]
    return "\n".join(one_line(line, LARGEST) for line in lines)


def incident_page(found: Judged, details: Mapping[str, Any], doctor: Sequence[Mapping[str, Any]]) -> str:
    """The page of an opened incident as HTML: its cause and what to do, what the doctor there said, and the report of
    the run, if the stage moved."""
    # Only here: the logger, which packs incidents, needs no plots.
    from straightcomp_ros.analysis.html_page import blocks, html_page
    from straightcomp_ros.analysis.html_report import report_html

    fault = explained(found.cause)
    remedy = f"It means: {fault['means']}. Likely causes: {fault['causes']}. What to do: {fault['remedy']}"
    well = found.cause.startswith(_NO_FAULT) and bool(found.assessment and found.assessment.verdict.in_order)
    first = blocks.card(fault["text"], remedy if fault["remedy"] else f"Audit: {found.audit}", well)
    facts = [("packed", details.get("made")), ("bag", details.get("bag")), ("audit", found.audit)]
    facts += [(f"{name} on the computer that packed it", details.get(name)) for name in ("verdict", "audit")]
    names = {"state": "state", "name": "what", "detail": "found", "remedy": "what helps"}
    complaints = [{word: one[name] for name, word in names.items()} for one in doctor if one["state"] != "ok"]
    sections = [
        ("The incident", blocks.table([{"": name, " ": value} for name, value in facts])),
        ("What the doctor found on that computer", blocks.table(complaints)),
        ("Not in the file", blocks.list(details.get("left_out", ()))),
    ]
    if found.assessment:
        return report_html(found.assessment, incident=(first, sections))
    return html_page("Incident", f"Incident of {details.get('bag')}", first, sections, with_plots=False)


def unpack(file: Path, folder: Path) -> dict[str, Any]:
    """Unpack an incident into the empty ``folder``; returns its details.

    Nothing is written but files of the names that an incident has, and no more than :data:`LARGEST` bytes.

    Raises:
        IncidentError: the file is no incident, or was changed; nothing of a refused file is used.
        FileExistsError: the folder is not empty, as another process unpacks there.
        OSError: the file cannot be read, or the folder not be written.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            _check(file, entries)
            left = LARGEST
            for entry in entries:
                target = folder / entry.filename
                target.parent.mkdir(exist_ok=True)
                with archive.open(entry) as source, target.open("xb") as copy:
                    # An entry may be longer than it says.
                    while block := source.read(1 << 20):
                        if (left := left - len(block)) < 0:
                            raise IncidentError(f"{file}: is more than {LARGEST} bytes when it is unpacked")
                        copy.write(block)
        details = json.loads((folder / DETAILS).read_text(encoding="utf-8"))
        digests = dict(details["sha256"])
        [Finding(**one) for one in json.loads((folder / DOCTOR).read_text(encoding="utf-8"))]
        list(details.get("left_out", ()))
    except IncidentError:
        raise
    except Exception as error:  # of the archive, of what is compressed in it, of its files
        # Errors of bz2 have no number; a damaged archive has a place before its begin, and may lack a file.
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL, errno.ENOENT):
            raise OSError(error.errno, error.strerror, error.filename or str(folder)) from error
        raise IncidentError(f"{file}: is no incident, or is damaged: {type(error).__name__}: {error}") from error
    named = {entry.filename for entry in entries} - {SUMMARY, DETAILS}
    changed = sorted(
        name
        for name in named | set(digests)
        if name not in named or hashlib.sha256((folder / name).read_bytes()).hexdigest() != digests.get(name)
    )
    if changed:
        raise IncidentError(f"{file}: was changed after it was packed: {', '.join(changed[:5])}")
    return dict(details)


def _check(file: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    """Raise IncidentError for an archive that is none of ours, before anything of it is written."""
    names = [entry.filename for entry in entries]
    size = sum(entry.file_size for entry in entries)
    wrong = next((name for name in names if not _NAME.fullmatch(name)), None)
    for refused, why in (
        (len(entries) > _MOST, f"has {len(entries)} files; allowed: {_MOST}"),
        (wrong is not None, f"has a file {wrong!r}, which no incident has"),
        (len(set(names)) < len(names), "has two files of one name"),
        (any(stat.S_ISLNK(entry.external_attr >> 16) for entry in entries), "has a link"),
        (any(entry.flag_bits & 1 for entry in entries), "is encrypted"),
        (size > LARGEST, f"is {size} bytes when it is unpacked; allowed: {LARGEST}"),
        (not {SUMMARY, DETAILS} <= set(names), f"is no incident: it has no {DETAILS}"),
    ):
        if refused:
            raise IncidentError(f"{file}: {why}")
