"""A real flight to report on, and a real browser to open the report in."""

import dataclasses
import fcntl
import json
import os
import select
import shutil
import signal
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.control.policy import Policy, make_network
from flytune.response.fly import fly
from flytune.response.judge import judge
from flytune.show.report import Entry
from flytune.task.observation import SIZE
from flytune.task.task import load_task

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


@pytest.fixture(scope="session")
def task():
    """The baseline task."""
    return load_task("baseline")


@pytest.fixture(scope="session")
def flights(task):
    """Twelve real flights of two seconds, by an untrained network that holds the hover thrust and drifts."""
    actor = make_network(jax.random.key(0), (SIZE, 64, 64, 4), last_gain=0.01)
    pilot = Policy(actor=actor, input_scale=jnp.ones(SIZE), squash="tanh")
    return fly(pilot, task, trials=12, duration=2.0, who="untrained")


@pytest.fixture(scope="session")
def curve():
    """A training curve of 40 updates with what a real one has: nulls, causes that die out, one that never comes."""

    def row(update):
        return {
            "update": update,
            "steps": 16_384 * update,
            "seconds": 0.4 * update,
            "episode_reward": None if update < 3 else 300.0 + update,
            "reward": 0.4 + 0.005 * update,
            "terms": {"horizontal": 0.1 + 0.002 * update, "smoothness": -0.01, "survival": 0.05},
            "terminations": {"altitude": max(0, 30 - update), "speed": max(0, 20 - update), "diverged": 0},
            "episodes": 36,
            "episode_length": 489.0,
        }

    return [row(update) for update in range(1, 41)]


@pytest.fixture(scope="session")
def make_entry(task, flights, curve):
    """Factory of entries from the real flights; arguments replace fields of the entry, or of the flights."""
    fields = {field.name for field in dataclasses.fields(flights)} - {"task"}

    def make(**changes):
        flown = dataclasses.replace(
            flights,
            task=changes.get("task", task).name,
            **{key: value for key, value in changes.items() if key in fields},
        )
        given = {
            "name": "untrained",
            "task": task,
            "flights": flown,
            "judgement": judge(flown),
            "metrics": curve,
            "about": {"trainer": "none", "seed": "0"},
        }
        return Entry(**(given | {key: value for key, value in changes.items() if key not in fields}))

    return make


@pytest.fixture(scope="session")
def keep(flights):
    """Factory of the fields that flights have with some trials only."""

    def choose(trials):
        per_trial = {
            field.name: value[trials]
            for field in dataclasses.fields(flights)
            if isinstance(value := getattr(flights, field.name), np.ndarray) and len(value) == flights.trials
        }
        return per_trial | {"margins": {name: margin[trials] for name, margin in flights.margins.items()}}

    return choose


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


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A running headless Chromium; skips where there is none, except in continuous integration, where it fails."""
    found = [path for name in BROWSERS if (path := shutil.which(name))] + [p for p in ON_A_MAC if Path(p).exists()]
    if not found:
        reason = f"no browser: none of {', '.join(BROWSERS)} is installed"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    running = Browser(found[0], tmp_path_factory.mktemp("profile"))
    yield running
    running.close()
