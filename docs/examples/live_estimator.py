"""Run the estimator message by message, as on a robot, and print its state once a second.

python docs/examples/live_estimator.py
"""

import terrafusion as tf

log = tf.simulate("figure_eight", terrain="asphalt", seed=1)  # stands in for the robot's drivers
estimator = tf.Estimator.for_vehicle("elevate")

printed_ns = 0
for message in log.messages():
    estimator.add(message)
    state = estimator.odometry()  # None until the heading is known
    if state is not None and state.t_ns - printed_ns >= 1_000_000_000:
        printed_ns = state.t_ns
        east_m, north_m, _ = state.position_m
        print(f"{state.status:8}  east {east_m:7.2f} m  north {north_m:7.2f} m  slip {state.slip:5.2f}")
estimator.finish()
