"""Learn antenna, gyro, wheel scale and delays from drives of a robot, and write its vehicle file.

python docs/examples/calibrate_sensors.py monday tuesday --out my_robot.yaml

Without logs it makes one in the twin.
"""

import argparse

import terrafusion as tf

parser = argparse.ArgumentParser()
parser.add_argument("logs", nargs="*", help="bags, log folders or catalogue names, in the order driven")
parser.add_argument("--vehicle", help="name or YAML file to start from")
parser.add_argument("--out", default="my_robot.yaml")
arguments = parser.parse_args()

logs = arguments.logs or [tf.simulate("figure_eight", terrain="asphalt", seed=1)]
learned = tf.calibrate_sensors(logs, vehicle=arguments.vehicle)
print("\n".join(learned.summary()))  # each number before and after, and what the drives could not tell
print(f"next: terrafusion replay LOG --vehicle {learned.write(arguments.out)}")
