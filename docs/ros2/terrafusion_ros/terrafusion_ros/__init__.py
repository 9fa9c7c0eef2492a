"""The terrafusion estimator as a ROS 2 node."""
