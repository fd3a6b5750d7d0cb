"""What docs/results/dial.md says of the policies with a dial, measured again.

    python benchmarks/dial.py map RUN [RUN ...]   20 settings of each policy, and what is required of them
    python benchmarks/dial.py turns [CONTROLLER [SWEEP_TIME]]
                                                  1,000 flights in which the dial is turned at random times; a turn over
                                                  the whole range takes SWEEP_TIME seconds (0: one step), else its own
    python benchmarks/dial.py wishes              `flytune tune` for 30 settling times, in a process each
    python benchmarks/dial.py price               the policy with a dial beside the policies for one response
    python benchmarks/dial.py picture FILE.png    three wishes and three responses, and the map

RUN and CONTROLLER are what `flytune evaluate` takes; without it, the policy that ships.
"""

import dataclasses
import itertools
import os
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import numpy as np

from flytune import find_controller, fly, judge, load_task
from flytune.control.response_map import response_map
from flytune.control.schedule import with_schedule
from flytune.evaluation.judge import AXES
from flytune.evaluation.statistics import bootstrap_interval, quantile

SETTINGS, TRIALS = 20, 100
SCHEDULES, FLIGHTS, TURNS, DURATION = 50, 20, (2, 7), 20.0  # 1,000 flights of 20 s with 2 to 6 turns each
WISHES, FASTEST, SLOWEST = 30, 1.6, 11.0  # settling times in s
SINGLE = {"inspection-refined": 0.2, "baseline-refined": 0.8, "acrobatic-refined": 1.0}


def feasible_share(judged, good):
    """The share of the feasible trials that are good, in percent."""
    return 100 * np.mean(np.asarray(good)[~judged.infeasible])


def at_setting(policy, task, speed):
    """The figures of one setting on 100 trials."""
    judged = judge(fly(policy.at(speed=speed), task, trials=TRIALS, seed=1))
    settled = np.all([np.isfinite(judged.settling_time[axis]) for axis in AXES], axis=0)
    return {
        "speed": speed,
        "settled": feasible_share(judged, settled),
        "settling": quantile(judged.settling_time["position"], 0.5),
        "error": 1e3 * quantile(judged.steady_state_error["position"], 0.5),
        "overshoot": 100 * quantile(judged.overshoot["position"], 0.9),
        "of axes": [100 * (quantile(judged.overshoot[axis], 0.9) or 0) for axis in AXES],
        "kept": feasible_share(judged, ~judged.violated["speed"]),
        "peak": quantile(judged.peak_speed, 0.5),
        "variation": float(np.mean(judged.action_total_variation)),
    }


def measure_map(names):
    """The table of each policy."""
    for name in names:
        found = find_controller(name)
        print(f"{name}\nspeed  settled %  settling s  error mm  overshoot p90 % (x, y, z, yaw)  bound kept %  peak m/s")
        rows = [at_setting(found.controller, found.task, value) for value in found.task.dial["speed"].grid(SETTINGS)]
        for row in rows:
            axes = ", ".join(f"{value:.0f}" for value in row["of axes"])
            print(
                f"{row['speed']:5.3f}  {row['settled']:9.0f}  {row['settling']:10.2f}  {row['error']:8.2f}"
                f"  {row['overshoot']:6.1f} ({axes:>12})  {row['kept']:23.0f}  {row['peak']:8.2f}"
            )
        times = [row["settling"] for row in rows]
        settled, kept = (min(row[name] for row in rows) for name in ("settled", "kept"))
        error = max(row["error"] for row in rows)
        passed = {name: max(row["of axes"][index] for row in rows) for index, name in enumerate(AXES)}
        print(
            f"at least {settled:.0f} % settled on all axes, error at most {error:.2f} mm, bound kept in at least "
            f"{kept:.0f} %, settling time strictly falling: {all(a > b for a, b in itertools.pairwise(times))}; "
            f"overshoot inside the band in 90 % of the trials: {', '.join(name for name in AXES if not passed[name])}\n"
        )


def turned_flights(policy, task, random):
    """One schedule, flown: its turns, and per flight the time until the new bound is kept, after each turn."""
    number = random.integers(*TURNS)
    times = np.sort(random.uniform(0.3, DURATION - 3.0, number))
    dial = task.dial["speed"]
    values = [float(dial.at(share)) for share in random.uniform(0, 1, number + 1)]
    schedule = [[0.0, values[0]], *([round(float(t), 2), v] for t, v in zip(times, values[1:], strict=True))]
    schedule = [pair for index, pair in enumerate(schedule) if not index or pair[0] > schedule[index - 1][0]]
    flights = fly(
        with_schedule(policy, {"speed": schedule}), task, trials=FLIGHTS, seed=int(random.integers(2**31)),
        duration=DURATION,
    )  # fmt: skip
    speed = np.linalg.norm(flights.velocity, axis=-1)
    jumps = np.abs(np.diff(flights.action, axis=1)).max(axis=-1)
    ends = [*(start for start, _ in schedule[1:]), DURATION]
    delays, at_turn = [], []
    for (start, bound), end in zip(schedule[1:], ends[1:], strict=True):
        first, last = round(start * 100), round(end * 100)
        over = speed[:, first : last + 1] > bound
        delays += [0.01 * (np.flatnonzero(row)[-1] + 1) if row.any() else 0.0 for row in over]
        at_turn += list(jumps[:, first])
    return flights, schedule, delays, at_turn, jumps


def turns(name="dial", sweep_time=None):
    """1,000 flights with turns at random times."""
    found, random = find_controller(name), np.random.default_rng(0)
    policy = found.controller
    if sweep_time is not None:
        dials = {each: dataclasses.replace(dial, sweep_time=float(sweep_time)) for each, dial in policy.dials.items()}
        policy = dataclasses.replace(policy, dials=dials)
    crashed = late = 0
    delays, at_turn, elsewhere, up, settled = [], [], [], 0, 0
    for _ in range(SCHEDULES):
        flights, schedule, delay, jump, jumps = turned_flights(policy, found.task, random)
        crashed += int(judge(flights).crashed.sum())
        settled += judge(flights).settled("position")
        late += int(np.any(flights.margins["speed"] < 0, axis=1).sum())
        up += sum(after > before for (_, before), (_, after) in itertools.pairwise(schedule))
        delays, at_turn = delays + delay, at_turn + jump
        elsewhere.append(jumps[:, 100:].ravel())
    spread = np.quantile(delays, [0.5, 0.95, 0.99, 1.0])
    print(
        f"{SCHEDULES * FLIGHTS} flights, {len(delays)} turns ({up * FLIGHTS} of them up): {crashed} crashed, "
        f"{settled} settled at the end of {DURATION:g} s\n"
        "time after a turn until the new speed bound is kept: median {:.2f}, p95 {:.2f}, p99 {:.2f}, largest {:.2f} s\n"
        "flights that cross the bound of the setting at which the dial stands: {}\n"
        "largest change of an action in the step of a turn: median {:.3f}, p99 {:.3f}, largest {:.3f}; in all steps "
        "after the first second: p99 {:.3f}, largest {:.3f}".format(
            *spread, late, *np.quantile(at_turn, [0.5, 0.99, 1.0]),
            *np.quantile(np.concatenate(elsewhere), [0.99, 1.0]),
        )
    )  # fmt: skip


def wishes():
    """30 settling times, drawn evenly, each as a command of its own."""
    random, answered = np.random.default_rng(0), 0
    for wish in random.uniform(FASTEST, SLOWEST, WISHES).round(2):
        with tempfile.TemporaryDirectory() as folder:
            began = time.monotonic()
            command = [
                sys.executable,
                "-m",
                "flytune",
                "tune",
                "--settling-time",
                str(wish),
                "--out",
                f"{folder}/tuned",
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            took = time.monotonic() - began
        lines = done.stdout.splitlines()
        untrained = done.returncode == 0 and any("after 0 trainings" in line for line in lines)
        answered += untrained
        verdict = next((line for line in reversed(lines) if line.startswith("validation")), done.stderr.strip())
        print(f"{wish:5.2f} s  {took:5.1f} s of work  {'no training' if untrained else 'trained':11}  {verdict[14:]}")
    print(f"{answered} of {WISHES} answered without training")


def price():
    """The policy with a dial beside the single policies, on the same trials."""
    found = find_controller("dial")
    print("setting      policy               settled  settling s  error mm  jitter   bytes")
    for name, speed in SINGLE.items():
        task = load_task(name)
        for label, policy in ((name, find_controller(name).controller), ("dial", found.controller.at(speed=speed))):
            own = task if label == name else found.task
            judged = judge(fly(policy, own, trials=200, seed=5, duration=20.0 if speed < 0.5 else 10.0))
            print(
                f"{speed:.1f} m/s      {label:20} {judged.settled('position'):4}/200"
                f"  {quantile(judged.settling_time['position'], 0.5):10.2f}"
                f"  {1e3 * quantile(judged.steady_state_error['position'], 0.5):8.2f}"
                f"  {np.mean(judged.action_total_variation):.4f}"
                f"  {sum(np.asarray(leaf).nbytes for leaf in (*policy.actor.weights, *policy.actor.biases)):6}"
            )


def picture(path):
    """Three wishes, their responses, and the wished against the measured settling time."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    found, colours = find_controller("dial"), ("#c2571a", "#2a7f9e", "#5a4a9c")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4), dpi=110, width_ratios=(1.6, 1))
    for wish, colour in zip((2.5, 5.0, 10.0), colours, strict=True):
        setting = found.with_dial({"settling_time": wish}).controller
        flights = fly(setting, found.task, trials=TRIALS, seed=1, duration=20.0)
        distance = np.linalg.norm(flights.position - flights.target_position, axis=-1)
        left.plot(flights.time, distance[:25].T, color=colour, linewidth=0.5, alpha=0.5)
        took = quantile(judge(flights).settling_time["position"], 0.5)
        left.axvline(
            took, color=colour, linewidth=1.5, linestyle="--", label=f"asked {wish:g} s, measured {took:.2f} s"
        )
    left.set(xlabel="time [s]", ylabel="distance to the target [m]", xlim=(0, 16), ylim=(0, None))
    left.set_title("One policy, three settings of its dial, 25 flights each", fontsize=10)
    left.legend(title="settling time, median", fontsize=8, title_fontsize=8)
    known = response_map(found.controller)
    fastest, slowest = known.range()
    for wish in np.geomspace(fastest, slowest, 15):
        setting = found.with_dial({"settling_time": float(wish)}).controller
        times = judge(fly(setting, found.task, trials=TRIALS, seed=7, duration=25.0)).settling_time["position"]
        low, high = bootstrap_interval([times], number=500)
        right.plot([wish, wish], [low, high], color="#2a7f9e", linewidth=1)
        right.plot(wish, quantile(times, 0.5), "o", color="#2a7f9e", markersize=4)
    right.plot([fastest, slowest], [fastest, slowest], color="0.6", linewidth=0.8, zorder=0)
    for name in SINGLE:
        task = load_task(name)
        times = judge(fly(find_controller(name).controller, task, trials=TRIALS, seed=7, duration=25.0)).settling_time
        took = quantile(times["position"], 0.5)
        right.plot(took, took, "s", color="#c2571a", markersize=6, markerfacecolor="none")
        right.annotate(
            name.removesuffix("-refined"), (took, took), xytext=(6, -10), textcoords="offset points", fontsize=8
        )
    right.set(xscale="log", yscale="log", xlabel="settling time asked for [s]", ylabel="measured, median [s]")
    ticks = [2, 3, 4, 6, 8, 10]
    for axis in (right.xaxis, right.yaxis):
        axis.set_ticks(ticks, [str(tick) for tick in ticks])
        axis.set_ticks([], minor=True)
    right.set_title("Squares: policies trained for one response", fontsize=10)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in ("map", "turns", "wishes", "price", "picture"):
        sys.exit(__doc__)
    command, arguments = sys.argv[1], sys.argv[2:]
    if command == "map":
        measure_map(arguments or ["dial"])
    else:
        {"turns": turns, "wishes": wishes, "price": price, "picture": picture}[command](*arguments)
