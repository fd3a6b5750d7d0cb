"""Fly one policy at three settings of its dial, and turn the dial in flight.

python examples/turn_a_dial.py
python examples/turn_a_dial.py --trials 10   for a first look
"""

import argparse

import flytune

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--trials", type=int, default=100)
arguments = parser.parse_args()

found = flytune.find_controller("dial")  # a policy that ships: it needs no training
for speed in (0.3, 0.8, 1.4):
    flights = flytune.fly(found.controller.at(speed=speed), found.task, trials=arguments.trials)
    print(f"dial at {speed} m/s: {flytune.judge(flights).line()}")

# slow for 5 s, then faster; the speed bound of the flight follows the dial
turned = flytune.evaluate("dial", dial={"speed": [[0, 0.3], [5, 1.2]]}, trials=arguments.trials)
print(f"turned after 5 s: {turned.judgement.line()}")

# which setting gives a settling time of 4 s, by the response map that the policy carries
response_map = flytune.response_map(found.controller)
print(f"for a settling time of 4 s: dial at {response_map.setting_for(4.0):.2f} m/s")
