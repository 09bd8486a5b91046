"""The topics of a ROS 2 robot as a source: recorded briefly, chosen from, then subscribed to."""
