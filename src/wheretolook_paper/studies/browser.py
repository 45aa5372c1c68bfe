"""A headless Chromium, driven through the DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def chromium() -> str | None:
    """Return the path of the browser, None if there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Tab:
    """One page; `errors` are those of its console and uncaught exceptions."""

    def __init__(self, address: str, size: tuple[int, int]) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=1 << 27)  # type: ignore[var-annotated]
        self._number = 0
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )

    def call(self, method: str, **params: Any) -> Any:
        """Call a DevTools method and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            self._note(message)
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return message["result"]

    def _note(self, message: dict[str, Any]) -> None:
        kind = message.get("method")
        params = message.get("params", {})
        is_error = "error" in (params.get("type"), params.get("entry", {}).get("level"))
        if kind == "Runtime.exceptionThrown" or (kind in ("Runtime.consoleAPICalled", "Log.entryAdded") and is_error):
            self.errors.append(str(params))

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        return result["result"].get("value")

    @property
    def text(self) -> str:
        """The visible text."""
        return str(self.evaluate("document.body ? document.body.innerText : ''"))

    def wait(self, condition: Callable[[Tab], bool], seconds: float = 60.0) -> None:
        """Wait for a condition."""
        end = time.monotonic() + seconds
        while not condition(self):
            assert time.monotonic() < end, f"timed out; the page shows:\n{self.text}\n{self.errors}"
            time.sleep(0.1)

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def click_on(self, selector: str, index: int = 0) -> None:
        """Click an element by its CSS selector, once it exists."""
        script = (
            f"(() => {{ const e = document.querySelectorAll({json.dumps(selector)})[{index}]; if (!e) return null;"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        self.wait(lambda tab: tab.evaluate(script) is not None, 20)
        self.click(*self.evaluate(script))

    def key(self, name: str, code: int) -> None:
        """Press a key, given its name and its Windows key code."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)

    def save(self, path: Path, left: int, top: int, width: int, height: int) -> None:
        """Write a rectangle of the page as a WebP file."""
        clip = {"x": left, "y": top, "width": width, "height": height, "scale": 1}
        image = self.call("Page.captureScreenshot", format="webp", quality=75, clip=clip)
        path.write_bytes(base64.b64decode(image["data"]))

    def press(self, label: str) -> None:
        """Click the last element with exactly this text, once it exists."""
        script = (
            "(() => { const e = [...document.querySelectorAll('button, [role=tab], label, span, p, div')]"
            f".filter(e => e.innerText && e.innerText.trim() === {json.dumps(label)}"
            " && e.getBoundingClientRect().width > 0).pop();"
            " if (!e) return null; e.scrollIntoView({block: 'center'}); const r = e.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        self.wait(lambda tab: tab.evaluate(script) is not None, 20)
        self.click(*self.evaluate(script))

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """Drag the mouse from one pixel to another."""
        way = [tuple(a + (b - a) * k / steps for a, b in zip(start, end, strict=True)) for k in range(steps + 1)]
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=start[0], y=start[1], button="none")
        for kind, (x, y) in [("mousePressed", start), *(("mouseMoved", at) for at in way), ("mouseReleased", end)]:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1, buttons=1)
            time.sleep(0.03)

    def close(self) -> None:
        self._socket.close()


class Browser:
    """A browser with its profile in a folder."""

    def __init__(self, folder: Path, size: tuple[int, int] = (1280, 800)) -> None:
        program = chromium()
        assert program is not None
        options = "--headless=new --no-sandbox --disable-dev-shm-usage --use-angle=swiftshader --ignore-gpu-blocklist "
        options += "--enable-unsafe-swiftshader --remote-debugging-port=0 --remote-allow-origins=* --no-first-run "
        options += f"--hide-scrollbars --window-size={size[0]},{size[1]} --user-data-dir={folder} about:blank"
        self.size = size
        self._tabs: list[Tab] = []
        null = subprocess.DEVNULL
        self.process = subprocess.Popen([program, *options.split()], stdout=null, stderr=null)
        port = folder / "DevToolsActivePort"
        end = time.monotonic() + 60
        while not (port.is_file() and port.read_text().strip()):
            assert time.monotonic() < end and self.process.poll() is None, "Chromium does not start"
            time.sleep(0.1)
        self.port = int(port.read_text().split()[0])

    def open(self, url: str) -> Tab:
        """Open an address in a new tab."""
        request = Request(f"http://127.0.0.1:{self.port}/json/new?about:blank", method="PUT")
        with urlopen(request) as answer:
            tab = Tab(json.load(answer)["webSocketDebuggerUrl"], self.size)
        self._tabs.append(tab)
        tab.go(url)
        return tab

    def close(self) -> None:
        for tab in self._tabs:
            tab.close()
        self.process.terminate()
        self.process.wait(timeout=15)
