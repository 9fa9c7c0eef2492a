"""Simulate a robot described by a vehicle file, and see what a heavier load and mud change.

python docs/examples/simulate_your_robot.py --vehicle my_robot.yaml
"""

import argparse

import numpy as np

import terrafusion as tf

parser = argparse.ArgumentParser()
parser.add_argument("--vehicle", default="husky", help="name or YAML file of a simulated vehicle")
arguments = parser.parse_args()

for terrain in ("asphalt", "mud"):
    for payload in (0.0, 0.3):
        run = tf.simulate(
            "figure_eight",
            terrain=terrain,
            vehicle=arguments.vehicle,
            seed=1,
            effects={"mass/at_cg": payload} if payload else None,
        )
        steps = np.diff(run.truth.position_m[:, :2], axis=0)
        path_m = float(np.hypot(*steps.T).sum())
        print(f"{terrain:8}  load {payload:4.0%} of the mass  path {path_m:6.1f} m")
