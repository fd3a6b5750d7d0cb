"""`flytune` as a user runs it: a real process, from a folder of its own; and, for what it refuses, in this process."""

import subprocess
import sys

from flytune.cli.main import main

COMMAND = [sys.executable, "-m", "flytune"]

# the command in an interpreter that gets Ctrl-C at the very moment it prints what is waited for, however busy the
# machine is: a signal from outside could come after the end of a short training
INTERRUPTED = """
import signal, sys

class Watched:
    def __init__(self, stream, awaited):
        self.stream, self.awaited, self.seen = stream, awaited, False

    def write(self, text):
        count = self.stream.write(text)
        if self.awaited in text and not self.seen:
            self.seen = True
            signal.raise_signal(signal.SIGINT)
        return count

    def __getattr__(self, name):
        return getattr(self.stream, name)

sys.stderr = Watched(sys.stderr, sys.argv.pop(1))
from flytune.cli.main import main
sys.exit(main())
"""


def flytune(*arguments, cwd, expect=0, timeout=300):
    """The command's output and errors, once it has ended with the exit code that is expected."""
    command = [*COMMAND, *map(str, arguments)]
    answer = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)
    assert answer.returncode == expect, answer.stderr
    return answer


def interrupted(*arguments, cwd, at):
    """What a command says that is interrupted (Ctrl-C) when a line of its progress holds `at`; it ends with 130."""
    command = [sys.executable, "-c", INTERRUPTED, at, *map(str, arguments)]
    answer = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600, check=False)
    assert at in answer.stderr, answer.stderr
    assert answer.returncode == 130, answer.stderr
    return answer.stderr


def refused(*arguments, capsys):
    """The one line that a command writes to standard error when it ends with 2 and has printed nothing."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.endswith("\n") and said.err.count("\n") == 1, said.err
    return said.err
