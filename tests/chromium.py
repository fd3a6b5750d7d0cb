"""A real browser to open pages in, and what to ask it of a page."""

import fcntl
import json
import os
import select
import signal
import time
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
ON_A_MAC = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",  # figures in space need WebGL, here in software
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
ALLOWED = ("file:", "data:", "blob:")  # all a page may ask for: itself and what it carries

# how many lines, boxes and dots of the traces have a size
DRAWN = """
[...document.querySelectorAll(".figure > div")[%d].querySelectorAll(".scatterlayer path, .boxlayer path")]
  .filter(path => path.getBBox().width + path.getBBox().height > 0).length
"""

# texts of a figure that leave it, and names that lie upon a title, a curve's panel or the buttons
MISPLACED = """
(plot => {
  const box = element => element.getBoundingClientRect();
  const whole = box(plot);
  const texts = [...plot.querySelectorAll("text")].filter(text => text.textContent.trim() && box(text).width > 0);
  const out = texts.filter(text => box(text).left < whole.left - 1 || box(text).right > whole.right + 1
    || box(text).bottom > whole.bottom + 1 || box(text).top < whole.top - 1);
  const others = [...plot.querySelectorAll(".annotation-text, .modebar-btn, .xy > .plot, .bglayer rect.bg")];
  const names = [...plot.querySelectorAll(".legendtext")].filter(name => others.some(other => {
    const [a, b] = [box(name), box(other)];
    return b.width > 0 && a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  }));
  return [...out, ...names].map(text => text.textContent);
})(document.querySelectorAll(".figure > div")[%d])
"""


def assert_quiet(browser: "Browser") -> None:
    """Fail where the page has thrown, complained or asked for anything over a network."""
    for event in browser.events:
        method, told = event["method"], event.get("params", {})
        assert method not in ("Runtime.exceptionThrown", "Page.javascriptDialogOpening"), told
        assert method != "Log.entryAdded" or told["entry"]["level"] != "error", told
        assert method != "Runtime.consoleAPICalled" or told["type"] not in ("error", "warning", "assert"), told
        assert method != "Network.requestWillBeSent" or told["request"]["url"].startswith(ALLOWED), told


class Browser:
    """Headless Chromium, spoken to in its DevTools protocol through a pair of pipes: no port, no driver, no package."""

    def __init__(self, program: str, profile: Path) -> None:
        """Start it with an empty profile and open a blank page."""
        pairs = os.pipe(), os.pipe()
        # Chromium reads commands from descriptor 3 and writes answers to 4; ours must not be in their way
        high = [[fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in pair] for pair in pairs]
        for end in (*pairs[0], *pairs[1]):
            os.close(end)
        (its_input, self._output), (self._input, its_output) = high
        actions = [
            (os.POSIX_SPAWN_DUP2, its_input, 3),
            (os.POSIX_SPAWN_DUP2, its_output, 4),
            (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
        ]
        arguments = [program, *FLAGS, f"--user-data-dir={profile}", "--window-size=1200,900", "about:blank"]
        self._process = os.posix_spawn(program, arguments, os.environ, file_actions=actions, setpgroup=0)
        os.close(its_input)
        os.close(its_output)
        self._received, self._session, self._number = b"", None, 0
        self.events: list[dict] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def open(self, page: Path) -> None:
        """Load a file and wait until the page says it has loaded."""
        self.events.clear()
        self.call("Page.navigate", url=page.as_uri())
        self.wait_for("document.readyState === 'complete' && location.protocol === 'file:'")

    def evaluate(self, expression: str):
        """The value of a JavaScript expression in the page; promises are awaited."""
        answer = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, condition: str, seconds: float = 30.0) -> None:
        """Return once the condition holds in the page; fail after so many seconds."""
        end = time.monotonic() + seconds
        while not self.evaluate(f"Boolean({condition})"):
            assert time.monotonic() < end, f"not within {seconds} s: {condition}"
            time.sleep(0.05)

    def call(self, method: str, **parameters):
        """The result of one command; events that arrive meanwhile are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._output, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            self.events.append(answer)

    def _receive(self, seconds: float = 60.0) -> dict:
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._input], [], [], seconds)
            assert ready, f"the browser said nothing for {seconds} s"
            chunk = os.read(self._input, 1 << 20)
            assert chunk, "the browser ended"
            self._received += chunk
        message, self._received = self._received.split(b"\0", 1)
        return json.loads(message)

    def close(self) -> None:
        """End it and the processes that it started."""
        os.killpg(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)
        os.close(self._input)
        os.close(self._output)
