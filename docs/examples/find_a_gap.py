"""Compare runs of a robot with runs that count as normal, and name what has changed.

python docs/examples/find_a_gap.py

The robot here is the twin with wheels 6 % larger; put your own logs in place of the lists.
"""

import terrafusion as tf

DRIVE = {"scenario": "figure_eight", "terrain": "asphalt"}
normal = [tf.simulate(**DRIVE, seed=seed) for seed in range(1, 5)]
today = [tf.simulate(**DRIVE, seed=seed, effects={"wheel_radius/scale": 0.06}) for seed in (11, 12)]

found = tf.diagnose(today, references=normal, effects=["wheel_radius", "mass", "gyro_bias"])
print(found)
print("verdict:", found.verdict.kind, ", ".join(found.verdict.named))
