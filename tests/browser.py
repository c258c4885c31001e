"""A browser without a screen, spoken to by Chromium's own protocol: what a page shows and does."""

import base64
import itertools
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")


class Page:
    """A page that is open. ``errors``: what its scripts have thrown or logged as errors."""

    def __init__(self, link: ClientConnection, session: str) -> None:
        self._link, self._session, self._numbers = link, session, itertools.count(100)
        self.errors: list[str] = []
        for domain in ("Runtime", "Page", "Log"):
            self._ask(f"{domain}.enable")

    def _ask(self, method: str, **parameters: Any) -> Any:
        number = next(self._numbers)
        self._link.send(
            json.dumps({"id": number, "method": method, "params": parameters,
                        "sessionId": self._session})
        )  # fmt: skip
        while True:
            said = json.loads(self._link.recv(30))
            if said.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.errors.append(json.dumps(said["params"])[:600])
            if said.get("id") == number:
                assert "error" not in said, said["error"]
                return said["result"]

    def open(self, address: str, width: int = 1400, height: int = 1000, dark: bool = False) -> None:
        """Loads an address on a screen of this size."""
        self._ask("Emulation.setDeviceMetricsOverride", width=width, height=height,
                  deviceScaleFactor=1, mobile=width < 600)  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._ask("Emulation.setEmulatedMedia", features=[scheme])
        self._ask("Page.navigate", url="about:blank")
        self._ask("Page.navigate", url=address)

    def value(self, expression: str) -> Any:
        """Of an expression in the page."""
        got = self._ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in got, got["exceptionDetails"]
        return got["result"].get("value")

    def until(self, expression: str, seconds: float = 60.0) -> Any:
        """Waits until an expression is true; its value."""
        deadline = time.monotonic() + seconds
        while not (
            found := self.value(
                f"(() => {{ try {{ return {expression} }} catch {{ return 0 }} }})()"
            )
        ):
            assert time.monotonic() < deadline, f"not within {seconds:g} s: {expression}"
            time.sleep(0.05)
        return found

    def heap_bytes(self) -> float:
        """What scripts hold of the memory, without what is garbage."""
        self._ask("HeapProfiler.collectGarbage")
        return float(self._ask("Runtime.getHeapUsage")["usedSize"])

    def press(self, key: str) -> None:
        """A key, by its name in events."""
        text = {"text": key} if len(key) == 1 else {}
        self._ask("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self._ask("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self, path: Path) -> None:
        """A PNG file of the whole page."""
        size = self._ask("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        got = self._ask("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(got["data"]))

    def printed(self) -> bytes:
        """The page as a PDF."""
        return base64.b64decode(self._ask("Page.printToPDF", printBackground=True)["data"])


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A browser for the block, with its files in a folder, and an empty page in it."""
    assert CHROMIUM
    line = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0",
            f"--user-data-dir={folder}", "--no-first-run", "about:blank"]  # fmt: skip
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            said = iter(process.stderr.readline, "")
            address = next(m.group(1) for one in said if (m := re.search(r"on (ws://\S+)", one)))
            with connect(address, max_size=None) as link:
                link.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
                found = json.loads(link.recv())["result"]["targetInfos"]
                target = next(one["targetId"] for one in found if one["type"] == "page")
                attach = {"targetId": target, "flatten": True}
                link.send(
                    json.dumps({"id": 2, "method": "Target.attachToTarget", "params": attach})
                )
                while (answer := json.loads(link.recv())).get("id") != 2:
                    pass
                yield Page(link, answer["result"]["sessionId"])
        finally:
            process.kill()


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with browser(tmp_path / "browser") as page:
        yield page
