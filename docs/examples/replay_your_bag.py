"""Replay a bag or another log, and read where the robot was.

python docs/examples/replay_your_bag.py drive.bag --vehicle my_robot.yaml

Without a log it makes one in the twin.
"""

import argparse

import terrafusion as tf

parser = argparse.ArgumentParser()
parser.add_argument("log", nargs="?", help="bag, log folder or catalogue name")
parser.add_argument("--vehicle", help="name or YAML file; by default what the log says")
parser.add_argument("--out", default="replay-out")
arguments = parser.parse_args()

log = arguments.log or tf.simulate("figure_eight", terrain="asphalt", seed=1)
result = tf.replay(log, vehicle=arguments.vehicle)
print(result)  # scores against the truth of the log, or against fixes held out
result.report(arguments.out)  # report.html, estimate.csv, metrics.json
table = result.estimate.to_pandas()  # a row a keyframe, with sigmas
print(table[["x_m", "y_m", "slip", "terrain", "status"]].tail(3).to_string())
