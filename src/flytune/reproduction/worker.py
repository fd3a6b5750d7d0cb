"""One training of a study in a process of its own: `python -m flytune.reproduction.worker '{...}'`.

It writes its progress to standard output, one JSON object per line, and ends with the exit codes of the command line.
"""

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

from flytune.errors import FlytuneError

INTERVAL = 0.5  # s between two lines of progress


def main(order: str) -> int:
    """The exit code of one training: 0 done, 2 bad input, 3 diverged, 130 interrupted."""
    from flytune.task.files import load_task
    from flytune.training.loop import Progress, train

    options = json.loads(order)
    written = -INTERVAL

    def write(progress: Progress) -> None:
        nonlocal written
        if progress.update == progress.updates or time.monotonic() - written > INTERVAL:
            written = time.monotonic()
            print(json.dumps(dataclasses.asdict(progress)), flush=True)

    try:
        task, out = load_task(options.pop("task")), Path(options.pop("out"))
        train(task, out=out, on_progress=write, **options)
    except FlytuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # the process that reads is gone; the training continues from its checkpoint next time
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
