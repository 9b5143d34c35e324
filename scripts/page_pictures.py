"""Makes what a person looks at from the sample bags, and pictures of it by Chromium: wide, narrow and printed.

    python -m scripts.page_pictures FOLDER [--commission DIR] [--moving FILE]

Report, incident, stage report, map page, the live view with the last seconds of a bag and a fault, and the pages of
docs/; with the folder of a commission also its certificate. Needs `chromium`, and for the printed ones `pdftoppm`
(poppler-utils). Look at them after a change of a page or of `analysis/style.css`.
"""

import argparse
import base64
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

from PIL import Image

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.cell.observation import StrokeErrors
from straightcomp_ros.cli.main import main as straightcomp
from straightcomp_ros.contract import ENCODER, POSITION, POSITION_EVERY
from straightcomp_ros.nodes.view_node import SHOWN, SLOT_S
from straightcomp_ros.safety.faults import Fault, explained
from straightcomp_ros.view.page_server import Series, ViewServer, distribution
from trials.incidents import record_fault
from trials.wear import stroke_pool, write_store

REPOSITORY = Path(__file__).resolve().parent.parent
BAG = REPOSITORY / "bags" / "smc"
_WIDTHS = {"wide": 1280, "narrow": 390}
_HEIGHT, _TALLEST = 800, 6000
"""Pixels of the window, and of a picture of a long page."""
_MOVING, _FRAME_NS = (1280, 940), 200_000_000
"""Pixels of the moving picture, and time from one of its frames to the next in ns."""
_DRAWN_S = 1.5
"""Until plots are drawn, and the live view has its news."""


class Browser:
    """Chromium without a window, controlled over a pair of pipes (Chrome DevTools Protocol)."""

    def __init__(self, profile: str) -> None:
        reads, self._to = os.pipe()
        self._from, writes = os.pipe()
        options = (
            f"--headless --no-sandbox --disable-gpu --hide-scrollbars --remote-debugging-pipe --user-data-dir={profile}"
        )
        command = f"exec chromium {options} 3<&{reads} 4>&{writes} 2>/dev/null"
        self._process = subprocess.Popen(["bash", "-c", command], pass_fds=(reads, writes))
        self._numbers, self._read = count(1), b""
        for one in (reads, writes):
            os.close(one)
        self._session: dict[str, str] = {}
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        attached = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        self.ask("Page.enable")

    def ask(self, method: str, **parameters: Any) -> Any:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (answer := self._message()).get("id") != number:
            pass
        return answer["result"]

    def _message(self) -> Any:
        while b"\0" not in self._read:
            if not (more := os.read(self._from, 1 << 20)):
                raise RuntimeError("chromium has ended")
            self._read += more
        text, _, self._read = self._read.partition(b"\0")
        return json.loads(text)

    def wait_for(self, condition: str) -> None:
        while not self.value(condition):
            time.sleep(0.1)

    def value(self, expression: str) -> Any:
        return self.ask("Runtime.evaluate", expression=expression)["result"].get("value")

    def show(self, width: int, height: int = _HEIGHT, scheme: str = "light") -> None:
        """Set the window's size in pixels and its colours."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self.ask("Emulation.setDeviceMetricsOverride", **size)
        self.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def shot(self, **options: Any) -> bytes:
        return base64.b64decode(self.ask("Page.captureScreenshot", **options)["data"])

    def close(self) -> None:
        os.close(self._to)
        self._process.kill()
        self._process.wait()


def pictures(browser: Browser, name: str, address: str, folder: Path) -> None:
    """Write NAME_wide.png, NAME_dark.png, NAME_narrow.png and NAME_print-1.png …"""
    for kind, width in {**_WIDTHS, "dark": _WIDTHS["wide"]}.items():
        browser.show(width, scheme="dark" if kind == "dark" else "light")
        for url in ("about:blank", address):
            browser.ask("Page.navigate", url=url)
            browser.wait_for("document.readyState == 'complete'")
        time.sleep(_DRAWN_S)
        content = browser.ask("Page.getLayoutMetrics")["cssContentSize"]
        if content["width"] > width:
            print(f"{name}: is {content['width']} pixels wide in a window of {width}", file=sys.stderr)
        clip = {"x": 0, "y": 0, "width": width, "height": min(_TALLEST, content["height"]), "scale": 1}
        (folder / f"{name}_{kind}.png").write_bytes(browser.shot(clip=clip, captureBeyondViewport=True))
    browser.ask("Emulation.setEmulatedMedia", features=[])
    printed = folder / f"{name}.pdf"
    pdf = browser.ask(
        "Page.printToPDF", printBackground=False, preferCSSPageSize=True, paperWidth=8.27, paperHeight=11.69
    )
    printed.write_bytes(base64.b64decode(pdf["data"]))
    subprocess.run(["pdftoppm", "-r", "60", "-png", str(printed), str(folder / f"{name}_print")], check=True)


def verb(words: str) -> None:
    straightcomp(words.split())


def report(folder: Path) -> str:
    verb(f"evaluate {BAG} --report {folder}/report.html --force")
    return (folder / "report.html").as_uri()


def incident(folder: Path) -> str:
    record_fault(Fault.Y_OUT_OF_RANGE, folder / "faulty" / "bag")
    verb(f"incident {folder}/faulty/bag -o {folder}/incident.zip --force")
    verb(f"incident open {folder}/incident.zip -o {folder}/incident")
    return (folder / "incident" / "incident.html").as_uri()


def stage_report(folder: Path) -> str:
    write_store(folder / "store", stroke_pool(1), days=160, begin=60)
    verb(f"history report {folder}/store -o {folder}/stages --force")
    return max((folder / "stages").glob("*.html"), key=lambda page: page.stat().st_size).as_uri()


def survey_map(folder: Path) -> str:
    verb(f"map build {REPOSITORY}/examples/noisy_survey.csv -o {folder}/map.csv --plot {folder}/map.png --force")
    return (folder / "map.png").as_uri()


def docs(folder: Path) -> str:
    words = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder / "site")]
    subprocess.run(words, cwd=REPOSITORY, check=True)
    return (folder / "site" / "safety.html").as_uri()


def shown_view(**other: Any) -> tuple[ViewServer, dict[str, list[tuple[int, float]]]]:
    """A live view without samples, and those of the bag by series; ``other`` than the usual state."""
    server = ViewServer(0, {name: Series(SLOT_S, factor) for name, (*_, factor) in SHOWN.items()}, {})
    streams = {ENCODER if stream is POSITION else stream for stream, *_ in SHOWN.values()}
    columns, samples = read_streams(BAG, {one.topic: one.layout for one in streams}), {}
    for name, (stream, column, _) in SHOWN.items():
        found = columns[ENCODER.topic if stream is POSITION else stream.topic]
        each = slice(None, None, POSITION_EVERY if stream is POSITION else 1)
        stamps, values = found.stamp[each].tolist(), found.columns[column][each].tolist()
        samples[name] = list(zip(stamps, values, strict=True))
    node = {"state": "active", "rate_hz": "2000.0", "overruns": "0", "lost": "0", "late_p99_us": "81"}
    state: dict[str, Any] = {
        "fresh": True,
        "amplifier_on": True,
        "x_mm": 12.345,
        "stroke_error_pp_um": 0.171,
        "maintenance": "",
        "stage": "stage “synthetic”, hardware simulated",
        "due_us": 250.0,
        "latency": distribution(evaluate_bag(BAG).latency),
        "limit": {"um": 0.4, "source": "limits.yaml"},
        "rest": StrokeErrors().rest,
        "gap": 3,
        "faults": [],
        "nodes": {name: node for name in ("driver", "feedforward", "controller", "logger")},
    }
    server.show(state | other)
    return server, samples


def view(_: Path) -> str:
    """The live view, with the last 20 s of the bag and a fault."""
    fault = explained(f"{Fault.Y_OUT_OF_RANGE.label}: y = 412.3 µm; allowed: within ±400 µm ('watch.y_limit')")
    server, samples = shown_view(amplifier_on=False, faults=[{"node": "driver", **fault}])
    for name, found in samples.items():
        server.add(name, found)
    return server.url


def moving(browser: Browser, file: Path) -> None:
    """The live view of the stroke in the bag, from its first to its last sample, as an animated picture."""
    server, samples = shown_view()
    browser.show(*_MOVING)
    browser.ask("Page.navigate", url=server.url)
    browser.wait_for("document.readyState == 'complete'")
    frames, begin, end = [], samples["x"][0][0], samples["x"][-1][0]
    for until in range(begin + _FRAME_NS, end, _FRAME_NS):
        for name, found in samples.items():
            server.add(name, [one for one in found if until - _FRAME_NS <= one[0] < until])
        time.sleep(_DRAWN_S / 3)
        frames.append(Image.open(io.BytesIO(browser.shot())).convert("RGB"))
    how = {"duration": round(_FRAME_NS * 1e-6), "loop": 0, "quality": 40, "method": 0}
    frames[0].save(file, save_all=True, append_images=frames[1:], **how)


PAGES = {one.__name__: one for one in (report, incident, stage_report, survey_map, docs, view)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--commission", type=Path, metavar="DIR", help="folder of `straightcomp commission`")
    parser.add_argument(
        "--moving", type=Path, metavar="FILE", help="also the live view of a stroke, docs/images/live.webp"
    )
    parser.add_argument("--only", nargs="*", choices=PAGES, default=PAGES, help="pictures of these pages alone")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, closing(Browser(f"{work}/profile")) as browser:
        for name in options.only:
            pictures(browser, name, PAGES[name](Path(work)), options.folder)
        if options.moving:
            moving(browser, options.moving)
        if options.commission:
            page = (options.commission / "certificate.html").absolute()
            pictures(browser, "certificate", page.as_uri(), options.folder)


if __name__ == "__main__":
    main()
