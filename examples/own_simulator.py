"""Fly a policy in a simulator of your own: flytune's, with a steady push from the side.

A simulator that is written in JAX needs one function: the state one control period later. Here it is flytune's own
function and a change of the velocity after it. Simulators that are not written in JAX offer `place`, `advance` and
`states` instead; see "To add a simulator" in CONTRIBUTING.md.

python examples/own_simulator.py
python examples/own_simulator.py --trials 5   for a first look
"""

import argparse
import dataclasses

import flytune
from flytune.physics import dynamics
from flytune.simulation.jax_simulator import JaxSimulator

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--trials", type=int, default=100, help="trials in each simulator")
parser.add_argument("--push", type=float, default=0.2, help="acceleration along x, m/s^2")
options = parser.parse_args()


def pushed_step(vehicle, state, action):
    """The state one control period later, with a push along x."""
    after = dynamics.step(vehicle, state, action)
    x, y, z = after.velocity
    return dataclasses.replace(after, velocity=(x + options.push * dynamics.CONTROL_PERIOD, y, z))


class PushedSimulator(JaxSimulator):
    """flytune's simulator with another step."""

    def __init__(self, vehicle, number):
        super().__init__(vehicle, number)
        self.physics = pushed_step


task = flytune.load_task("baseline-refined")
policy = flytune.find_controller("baseline-refined")
for simulator in ("flytune", PushedSimulator):
    flights = flytune.fly(policy, task, trials=options.trials, simulator=simulator)
    print(f"{flights.simulator}: {flytune.judge(flights).line()}")
