"""Models of strangers in a process of their own, with limits of memory and time that hold whatever they contain.

One process serves all models. Where a model takes too long, the process is ended; the next request starts another one.
"""

import atexit
import json
import os
import subprocess
import sys
import threading
import time
from multiprocessing.connection import wait
from pathlib import Path
from typing import IO, Any

LOAD_TIME = 30.0  # s to check a model and to make it ready; 100 MB take some 2 s
STEP_TIME = 10.0  # s for the actions of all trials at one time step; a network of the paper takes 0.1 ms


class Stopped(Exception):
    """A model was ended, or its process was; the text says why."""


class Sandbox:
    """The process that runs models, started with the first request."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = 0  # the process that may use it: after a fork, two would read the same answers
        atexit.register(self.end)

    def ask(self, request: dict[str, Any], content: bytes, seconds: float) -> tuple[dict[str, Any], bytes]:
        """The answer of the process, and its bytes.

        Raises:
            Stopped: there was none within that time, or the process has ended.
        """
        with self._lock:
            asked, answers = self._pipes()
            try:
                asked.write(json.dumps(request | {"size": len(content)}).encode() + b"\n" + content)
                asked.flush()
                answer = _Answer(answers.fileno(), time.monotonic() + seconds)
                head = json.loads(answer.line())
                return head, answer.bytes(head["size"])
            except TimeoutError:
                self.end()
                raise Stopped(f"takes longer than {seconds:g} s") from None
            except (OSError, EOFError, ValueError):
                code = self._process.wait() if self._process else 0
                self.end()
                raise Stopped(f"ended its process (exit code {code})") from None
            except BaseException:  # an answer that nobody reads must not be taken for the next one
                self.end()
                raise

    def _pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        if self._process is None or self._process.poll() is not None or self._owner != os.getpid():
            worker = str(Path(__file__).with_name("worker.py"))
            self._process = subprocess.Popen(
                [sys.executable, "-P", worker],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the program, which ends this process where it ends itself
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
            self._owner = os.getpid()
        assert self._process.stdin and self._process.stdout
        return self._process.stdin, self._process.stdout

    def end(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is not None and self._owner == os.getpid():
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    try:
                        pipe.close()
                    except OSError:  # what was not sent cannot be sent any more
                        continue


class _Answer:
    """What arrives from a process until a time."""

    def __init__(self, source: int, until: float) -> None:
        self._source, self._until, self._seen = source, until, bytearray()

    def line(self) -> bytes:
        while b"\n" not in self._seen:
            self._more()
        line, _, rest = bytes(self._seen).partition(b"\n")
        self._seen = bytearray(rest)
        return line

    def bytes(self, size: int) -> bytes:
        while len(self._seen) < size:
            self._more()
        return bytes(self._seen[:size])

    def _more(self) -> None:
        if not wait([self._source], max(self._until - time.monotonic(), 0)):
            raise TimeoutError
        arrived = os.read(self._source, 2**20)
        if not arrived:
            raise EOFError
        self._seen += arrived


SANDBOX = Sandbox()
