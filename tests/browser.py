"""Headless Chromium: opens pages and answers questions about them, by the DevTools protocol over
two pipes.
"""

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
PROGRAM = next(filter(None, map(shutil.which, NAMES)), None)
OPTIONS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
OPTIONS += ["--disable-dev-shm-usage", "--no-first-run", "--remote-debugging-pipe"]
LONGEST = 60.0  # seconds that a page may take


class Page:
    """One page of the browser.

    Attributes
    ----------
    errors
        What went wrong in the page since it was opened: exceptions, and errors on its console.
    """

    def __init__(self, browser: "Browser", session: str) -> None:
        self._browser, self._session = browser, session
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self._ask(f"{domain}.enable")

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._browser.ask(method, self, self._session, **parameters)

    def open(self, file: Path, width: int, height: int = 900) -> None:
        """Open a file in a window of so many pixels. Wait until the page says it is ready."""
        self.errors.clear()
        self.resize(width, height)
        self._ask("Page.navigate", url=file.resolve().as_uri())
        self.wait("document.readyState === 'complete'")

    def resize(self, width: int, height: int = 900) -> None:
        """Give the window another size, as a phone that is turned."""
        self._ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.wait(f"innerWidth === {width}")

    def wait(self, condition: str) -> None:
        """Until a condition in JavaScript holds.

        Raises
        ------
        TimeoutError
            If it does not, with the page's errors.
        """
        end = time.monotonic() + LONGEST
        while not self.value(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"{condition}: not within {LONGEST} s; {self.errors}")
            time.sleep(0.05)

    def value(self, expression: str) -> Any:
        """The value of an expression in JavaScript, of a promise what it gives.

        Raises
        ------
        ValueError
            If the expression throws.
        """
        found = self._ask(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise ValueError(f"{expression}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def picture(self, file: Path, *, whole: bool = False) -> None:
        """Write what is seen in the window, or the whole page, as a PNG file."""
        found = self._ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(found["data"]))

    def pdf(self, file: Path) -> None:
        """Write the page as it is printed."""
        file.write_bytes(
            base64.b64decode(self._ask("Page.printToPDF", preferCSSPageSize=True)["data"])
        )

    def hear(self, event: dict[str, Any]) -> None:
        """Keep what went wrong."""
        about = event.get("params", {})
        if event["method"] == "Runtime.exceptionThrown":
            self.errors.append(str(about["exceptionDetails"]))
        if event["method"] == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert"):
            self.errors.append(str(about["args"]))
        if event["method"] == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.errors.append(about["entry"]["text"])


class Browser:
    """A browser that runs; its messages are JSON, each ended by a zero byte."""

    def __init__(self, to: int, back: int) -> None:
        self._to, self._back, self._number, self._rest = to, back, 0, b""

    def page(self) -> Page:
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        return Page(
            self, self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        )

    def ask(
        self, method: str, page: Page | None = None, session: str = "", **parameters: Any
    ) -> dict[str, Any]:
        """The answer to a message; events that come before it are told to the page.

        Raises
        ------
        ValueError
            If the browser answers with an error.
        """
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        os.write(
            self._to,
            json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0",
        )
        for found in self._messages():
            if found.get("id") == self._number:
                if "error" in found:
                    raise ValueError(f"{method}: {found['error']}")
                return dict(found["result"])
            if page and "method" in found:
                page.hear(found)
        raise EOFError(f"{method}: the browser has ended")

    def _messages(self) -> Iterator[dict[str, Any]]:
        while True:
            while b"\0" not in self._rest:
                if not (more := os.read(self._back, 1 << 20)):
                    return
                self._rest += more
            message, _, self._rest = self._rest.partition(b"\0")
            yield json.loads(message)


@contextmanager
def browser(home: Path) -> Iterator[Browser]:
    """A browser with its own new folder."""
    assert PROGRAM
    (theirs, to), (back, answers) = os.pipe(), os.pipe()
    said = [
        "bash",
        "-c",
        f'exec "$@" 3<&{theirs} 4>&{answers}',
        "bash",
        PROGRAM,
        f"--user-data-dir={home}",
        *OPTIONS,
    ]
    running = subprocess.Popen(
        said, pass_fds=(theirs, answers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(theirs)
    os.close(answers)
    try:
        yield Browser(to, back)
    finally:
        os.close(to)  # it ends without its pipe
        try:
            running.wait(20)
        except subprocess.TimeoutExpired:
            running.kill()
        os.close(back)
