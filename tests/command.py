"""`flytune` as a user runs it: a real process, from a folder of its own."""

import os
import signal
import subprocess
import sys

COMMAND = [sys.executable, "-m", "flytune"]


def flytune(*arguments, cwd, expect=0, timeout=300):
    """The command's output and errors, once it has ended with the exit code that is expected."""
    command = [*COMMAND, *map(str, arguments)]
    answer = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)
    assert answer.returncode == expect, answer.stderr
    return answer


def interrupted(*arguments, cwd, at):
    """What a command says after Ctrl-C, sent when a line of its progress holds `at`; it ends with 130."""
    process = subprocess.Popen(
        [*COMMAND, *arguments],
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stderr is not None
    for line in process.stderr:
        if at in line:
            process.send_signal(signal.SIGINT)
            break
    message = process.stderr.read()
    assert process.wait(timeout=120) == 130, message
    return message
