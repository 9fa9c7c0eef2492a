"""Run the estimator as messages arrive: from a recording, over DDS, or in a ROS 2 node."""
