"""ROS 1 and ROS 2 bags: containers, message layouts, topics to channels."""
