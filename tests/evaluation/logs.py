"""Logs of one flight as different programs write them: a response without overshoot, whose numbers are known."""

import numpy as np

TIME = np.arange(801) / 100  # s


def course(time, begin=0.0):
    """The error of a critically damped response of unit size: 1 before `begin`, then decaying."""
    since = np.clip(np.asarray(time) - begin, 0, None) * 2.5
    return np.exp(-since) * (1 + since)


def flown(time=TIME, begin=0.0):
    """x, y, z in m and yaw in rad on the way to (0, 0, 1) m and 0 rad."""
    error = course(time, begin)
    return error, -0.5 * error, 1 - 0.4 * error, 0.8 * error


def written(path, header, *columns, delimiter=",", before="", encoding="utf-8", decimal="."):
    """Write a log, and return its path as text."""
    rows = [
        delimiter.join(f"{value:.17g}".replace(".", decimal) for value in row) for row in zip(*columns, strict=True)
    ]
    path.write_text(before + "\n".join([*([header] if header else []), *rows]) + "\n", encoding=encoding)
    return str(path)


def plain(path, time=TIME, **options):
    """A log with the columns t, x, y, z, yaw."""
    return written(path, "t,x,y,z,yaw", time, *flown(time), **options)
