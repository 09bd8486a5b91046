"""A ROS 2 node as a SLAM module."""
